"""The real-time shell around a `Supervisor`: deadlines, a link, and a record of how it went."""

import gc
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from palpate.deployment.latency import Histogram
from palpate.deployment.messages import CommandMessage, encode_command
from palpate.deployment.plausibility import Values
from palpate.deployment.supervisor import Mode, Supervisor

SPIN = 5e-4  # s before a deadline from which on the clock is watched instead of sleeping
LATE = 1e-3  # s after a deadline from which on it counts as missed
LEAD = 2e-3  # s after a state by which the loop wakes: time for it to arrive
FOLLOW = 0.02  # of a period, by which a deadline may move to keep that lead
EVENTS = 1000  # changes of mode that are kept


@runtime_checkable
class Link(Protocol):
    """What carries messages; `clock` is the one that arrivals are stamped with, in s."""

    clock: Callable[[], float]

    def arrivals(self) -> Sequence[tuple[float, bytes]]:
        """What came since the last call, as (time of arrival, message), oldest first."""
        ...

    def send(self, data: bytes) -> None:
        """Send without waiting."""
        ...


@dataclass
class Record:
    """How a loop went. `lateness`: from a deadline to the wake-up. Of states that the policy
    decided on, `decisions`: from the wake-up until the command is known, messages and checks
    included; `turnaround`: from a state's arrival until its command is sent.
    `events`: (s since the start, mode, reason) of every change of mode.
    """

    lateness: Histogram = field(default_factory=Histogram)
    decisions: Histogram = field(default_factory=Histogram)
    turnaround: Histogram = field(default_factory=Histogram)
    late: int = 0
    skipped: int = 0
    events: list[tuple[float, Mode, str]] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "late_over_1ms": self.late,
            "deadlines_skipped": self.skipped,
            "lateness": self.lateness.to_dict(),
            "decisions": self.decisions.to_dict(),
            "turnaround": self.turnaround.to_dict(),
            "events": [
                {"time_s": round(time, 4), "mode": mode.name.lower(), "reason": reason}
                for time, mode, reason in self.events
            ],
        }


def run_loop(
    supervisor: Supervisor,
    link: Link,
    period: float,
    goes_on: Callable[[float], bool],
    report: Callable[[Mode, str], None] = lambda mode, reason: None,
    watch: Callable[[float, Values], None] = lambda time, values: None,
) -> Record:
    """One order every `period` s while `goes_on(seconds since the start)`; then a brake to rest.

    Deadlines lie `LEAD` after the arrival of a state, as far as following the sender's clock by
    `FOLLOW` of a period allows, or when a state becomes missing, if that is sooner. One that has
    passed is skipped, not made up for. A first call may be slow: warm up what decides before.
    Garbage is collected before and after, not in between. `report` hears of every change of mode,
    and `watch` of the newest good state, when its command is sent.
    """
    record, clock = Record(), link.clock
    session, sequence = secrets.randbits(64), 0
    mode, reason = None, ""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        link.arrivals()  # what is older than the loop
        began = deadline = clock()
        while True:
            deadline = min(deadline + period, max(supervisor.due, clock()))
            wait_until(clock, deadline)
            now = clock()
            record.lateness.add(now - deadline)
            if now - deadline > LATE:
                record.late += 1
            arrivals = link.arrivals()
            going = goes_on(now - began)
            order = supervisor.tick(now, arrivals) if going else supervisor.halt(now)
            decided = clock()
            sequence += 1
            link.send(
                encode_command(
                    CommandMessage(
                        session, sequence, order.mode, supervisor.decided_on, order.action
                    )
                )
            )
            if arrivals:
                if (values := supervisor.values) is not None:
                    watch(now - began, values)
                newest = arrivals[-1][0]
                if order.mode is Mode.RUNNING:
                    record.decisions.add(decided - now)
                    record.turnaround.add(clock() - newest)
                most = FOLLOW * period
                deadline += min(max(newest + LEAD - now, -most), most)
            if (order.mode, order.reason) != (mode, reason):
                mode, reason = order.mode, order.reason
                report(mode, reason)
                if len(record.events) < EVENTS:
                    record.events.append((now - began, mode, reason))
            if not going and order.mode is Mode.STOPPED:
                return record
            behind = int((clock() - deadline) / period)
            if behind > 0:
                record.skipped += behind
                deadline += behind * period
    finally:
        gc.enable()
        gc.unfreeze()


def wait_until(clock: Callable[[], float], deadline: float) -> None:
    """Sleep until shortly before, because a sleep ends late; then watch the clock."""
    left = deadline - clock() - SPIN
    if left > 0:
        time.sleep(left)
    while clock() < deadline:
        pass
