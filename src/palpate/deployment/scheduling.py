"""Asking the operating system for punctuality."""

import contextlib
import os
from collections.abc import Iterator

LOOP, ROBOT = 20, 10  # of 99: above all ordinary work, below the system's own threads


@contextlib.contextmanager
def real_time(priority: int = LOOP) -> Iterator[bool]:
    """Let this thread, and those it starts inside, run before all ordinary work.

    Gives False where that is not permitted or unknown: then a busy machine makes the loop late,
    which its record shows. Linux permits it to root, and to users with a limit `rtprio`. A process
    started inside is as urgent; start it before.
    """
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError):
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, *before)
