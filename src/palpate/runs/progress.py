"""Loops that take long: they tell how far they are, and end with a whole step when asked to.

    with interruptible() as stop:
        for step in progress(range(1000), "training"):
            ...
            if stop:
                break

Ctrl-C ends the loop after the step in which it came.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from typing import Any


class Stop:
    """True once somebody asked to stop; see `interruptible`."""

    def __init__(self) -> None:
        self._asked = False

    def __bool__(self) -> bool:
        return self._asked

    def ask(self, *signal_and_frame: Any) -> None:
        """Ask to stop after the present step; asking twice raises `KeyboardInterrupt` at once."""
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True
        # not print: a signal may come in the middle of one, and streams are not reentrant
        os.write(2, b"\nstopping after this step; once more stops at once\n")


@contextlib.contextmanager
def interruptible() -> Iterator[Stop]:
    """Let a loop finish its step and save before Ctrl-C (or SIGTERM) ends it.

    The loop looks at the `Stop` it is given, saves and leaves; `KeyboardInterrupt` is raised at
    the end of the block, so that nothing after it takes the work for finished. Signals only reach
    the main thread; in another the block changes nothing.
    """
    stop = Stop()
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
                before[number] = signal.signal(number, stop.ask)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if stop:
        raise KeyboardInterrupt


class Progress:
    """What `progress` returns: iterate over it, and `show` a few numbers beside the time left."""

    _SECONDS = 20.0  # between two lines of a log; and never more lines than ten and the first

    def __init__(self, steps: Iterable[Any] | int, description: str, done: int):
        self._steps = range(steps) if isinstance(steps, int) else steps
        self._description = description
        self._first = self._done = done
        self._total = done + len(self._steps) if isinstance(self._steps, Sized) else None
        self._shown = ""

    def __iter__(self) -> Iterator[Any]:
        return self._on_terminal() if sys.stderr.isatty() else self._in_log()

    def show(self, **metrics: Any) -> None:
        """Put numbers beside the bar from now on; those that are None are left out."""
        known = {name: value for name, value in metrics.items() if value is not None}
        self._shown = ", ".join(f"{name}={float(value):.4g}" for name, value in known.items())

    def _on_terminal(self) -> Iterator[Any]:
        from tqdm import tqdm

        with tqdm(
            total=self._total, initial=self._done, desc=self._description, dynamic_ncols=True
        ) as bar:
            for item in self._steps:
                yield item
                bar.set_postfix_str(self._shown, refresh=False)
                bar.update()

    def _in_log(self) -> Iterator[Any]:
        began = printed = time.monotonic()
        due = self._done  # the first line comes as soon as the time left can be told
        for item in self._steps:
            yield item
            self._done += 1
            now = time.monotonic()
            if self._done == self._total:
                break
            if self._done >= due and now - printed >= self._SECONDS:
                self._print(now - began)
                printed, due = now, self._done + (self._total or 0) / 10
        self._print(time.monotonic() - began)

    def _print(self, elapsed: float) -> None:
        from tqdm import tqdm

        total = "" if self._total is None else f"/{self._total}"
        line = f"{self._description}: {self._done}{total} steps"
        line += f", {tqdm.format_interval(elapsed)} passed"
        if self._total is not None and self._done > self._first:
            left = elapsed * (self._total - self._done) / (self._done - self._first)
            line += f", {tqdm.format_interval(left)} left"
        print(f"{line}, {self._shown}" if self._shown else line, file=sys.stderr, flush=True)


def progress(steps: Iterable[Any] | int, description: str, done: int = 0) -> Progress:
    """Iterate over `steps` (a number means that many) and show on stderr how long it still takes.

    On a terminal this is a tqdm bar. In a log it is a line after 20 seconds, then one for every
    tenth of the work but no more than one in 20 seconds, and one at the end. `done` steps went
    before, in the work that is now resumed.
    """
    return Progress(steps, description, done)


# Goes through the rounds of a search or a sampler as they are done, and may show how far it is.
Watch = Callable[[Sequence[Any]], Iterable[Any]]


def without_progress(rounds: Sequence[Any]) -> Sequence[Any]:
    """The rounds as they are: nobody is shown how far it is."""
    return rounds
