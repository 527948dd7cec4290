"""Who is in command: a policy while its eyes can be trusted, else a brake.

No clock, no thread: time and messages come in, an order comes out, so that every fault can be
tried in a test.

    waiting   at rest; good states are counted, and enough of them in a row start the policy
    running   the policy decides, within the limits
    braking   down to rest, every channel at the limit of its rate, whatever is seen meanwhile
    stopped   at rest; the last state was bad, or none comes. A good one: waiting

At rest every number of the action is that of the channels' rest, zero unless said otherwise, and
all limits count from there. A brake is never left before rest, and there is no way
from rest to motion but through `GOOD` states in a row during which the robot stood still; then
the rate of the action grows softly to its limit.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol, runtime_checkable

import numpy as np

from palpate.deployment.intake import BadStateError, Intake
from palpate.deployment.messages import StateMessage
from palpate.deployment.plausibility import Values
from palpate.errors import PalpateError
from palpate.networks import Channel, count_of

GOOD = 50  # good states in a row, before the policy starts
SOFT = 50  # periods in which the rate of the action grows to its limit after a start
AT = 0.01  # s, of the loop in which GOOD and SOFT are meant: half a second in any
FEWEST = 10  # of either, however slow the loop
PAUSE = 2.0  # periods without a command after which a robot brakes by itself
ASKED, NOTHING = "asked to stop", "no state has come yet"


class Mode(IntEnum):
    """See the module."""

    WAITING = 0
    RUNNING = 1
    BRAKING = 2
    STOPPED = 3


class Limits:
    """What an action may be: as its channels declare, one every `period` s.

    `vectors`: of each vector of a channel its place in the flat action, its largest distance from
    `rest` (an action; None: zeros), and the largest norm of its change in a period.

    Raises `PalpateError` for a channel without limits and for one that is not greater than 0.
    """

    def __init__(self, actions: Sequence[Channel], period: float, rest: np.ndarray | None = None):
        _check_greater("period", period)
        self.period, self.count = period, count_of(actions)
        self.rest = np.zeros(self.count, np.float32)
        if rest is not None:
            self.rest += rest
        self.vectors: list[tuple[slice, float, float]] = []
        first = 0
        for channel in actions:
            if channel.rate_limit is None:
                raise PalpateError(
                    f"the {channel.name} has no limit of its rate, and without one nothing can "
                    "brake: give --rate-limit"
                )
            _check_greater(f"the {channel.name}", channel.bound)
            _check_greater(f"the rate of the {channel.name}", channel.rate_limit)
            size = channel.shape[-1]
            change = channel.rate_limit * period
            for start in range(first, first + channel.count, size):
                self.vectors.append((slice(start, start + size), channel.bound, change))
            first += channel.count


def _check_greater(name: str, value: float) -> None:
    if not 0 < value < float("inf"):
        raise PalpateError(f"a limit of {name} is greater than 0, not {value}")


@dataclass(frozen=True, slots=True, eq=False)
class Order:
    """The action, flat, to hold for a period, and why: "" while all is well."""

    mode: Mode
    action: np.ndarray
    reason: str


@runtime_checkable
class Decision(Protocol):
    """What the loop asks: it sees every state and decides on the newest."""

    def forget(self) -> None:
        """The next state is the first of a series."""
        ...

    def see(self, values: Values) -> None:
        """A state, one period after the last."""
        ...

    def decide(self, command: np.ndarray) -> np.ndarray:
        """The next action, after the one in force; both flat.

        Where motions take longer than a period, `holds` then says whether it is the one under way.
        """
        ...


class Supervisor:
    """See the module.

    Args:
        intake: says which states are good.
        decision: the policy.
        limits: of the action.
    """

    def __init__(self, intake: Intake, decision: Decision, limits: Limits):
        self._intake = intake
        self._decision = decision
        self._limits = limits
        self._now: float | None = None
        self._good = 0  # states in a row
        self._ran = 0  # decisions since the start
        self._decided_on = 0
        self._first: StateMessage | None = None  # when counting began
        self.mode = Mode.WAITING
        self.action = limits.rest
        self.reason = NOTHING
        self._needed, self._soft = (
            max(FEWEST, round(count * AT / limits.period)) for count in (GOOD, SOFT)
        )

    @property
    def seen(self) -> int:
        """Sequence number of the newest good state, 0 without one."""
        newest = self._intake.newest
        return 0 if newest is None else newest.sequence

    @property
    def values(self) -> Values | None:
        """What the newest good state showed, None without one."""
        newest = self._intake.newest
        return None if newest is None else newest.values

    @property
    def decided_on(self) -> int:
        """Sequence number of the state that the motion under way was decided on."""
        return self._decided_on if self.mode is Mode.RUNNING else self.seen

    @property
    def due(self) -> float:
        """When a tick is needed at the latest, to brake if no state comes: s, perhaps infinite."""
        return self._intake.due

    def tick(self, now: float, arrivals: Iterable[tuple[float, bytes]]) -> Order:
        """One period: `now` in s on a clock that never runs back, and what arrived since the last
        tick, as (time of arrival on that clock, message), oldest first.
        """
        period = self._limits.period
        elapsed = period if self._now is None else now - self._now
        self._now = now
        fresh, fault = self._take(now, arrivals)
        if not 0 <= elapsed <= PAUSE * period:
            fault = f"the loop was held up for {1e3 * elapsed:.0f} ms"
        if fault:
            self._start_over(fault)
        elif fresh and self.mode is Mode.RUNNING:
            self._run()
        elif fresh and self.mode is not Mode.BRAKING:
            self._count(fresh)
        if self.mode is Mode.BRAKING:
            # After a pause the robot has begun to brake by itself: go on where it is by now.
            self._brake(max(1.0, elapsed / period - PAUSE))
        return Order(self.mode, self.action, self.reason)

    def halt(self, now: float) -> Order:
        """One period of going to rest because it was asked for; nothing is looked at."""
        self._now = now
        self._start_over(ASKED)
        self._brake(1.0)
        return Order(self.mode, self.action, self.reason)

    def _take(self, now: float, arrivals: Iterable[tuple[float, bytes]]) -> tuple[int, str]:
        """How many good states there are, all of which the decision sees, and the first fault."""
        fresh, fault = 0, ""
        for arrived, data in arrivals:
            try:
                good = self._intake.take(arrived, data)
            except BadStateError as error:
                fault = fault or str(error)
                self._decision.forget()
                continue
            if good and (state := self._intake.newest) is not None:
                self._decision.see(state.values)
                fresh += 1
        return fresh, fault or self._intake.missing(now)

    def _start_over(self, fault: str) -> None:
        if self.mode is not Mode.BRAKING:
            self.reason = fault
        self.mode = Mode.BRAKING
        self._intake.forget()
        self._decision.forget()

    def _count(self, fresh: int) -> None:
        if not self._good or self._first is None:
            self._first = self._intake.newest
        if self._first is not None and (motion := self._intake.motion(self._first)):
            self._start_over(motion)
            return
        self.mode = Mode.WAITING
        self._good += fresh
        if self._good >= self._needed:
            self.mode, self.reason, self._ran = Mode.RUNNING, "", 0
            self._run()

    def _run(self) -> None:
        wanted = self._decision.decide(self.action)
        if not np.isfinite(wanted).all():
            self._start_over("the policy gave a command that is not finite")
            return
        if not getattr(self._decision, "holds", False):
            self._decided_on = self.seen
        self._ran += 1
        share = min(1.0, self._ran / self._soft)
        action = np.empty_like(self.action)
        for part, limit, change in self._limits.vectors:
            own, rest = self.action[part], self._limits.rest[part]
            moved = own + shorten(wanted[part] - own, change * share)
            action[part] = rest + shorten(moved - rest, limit)
        self.action = action

    def _brake(self, periods: float) -> None:
        """Every vector along its own direction, so that no power is put in."""
        action = np.empty_like(self.action)
        for part, _, change in self._limits.vectors:
            rest = self._limits.rest[part]
            action[part] = rest + brake(self.action[part] - rest, change * periods)
        self.action = action
        if (action == self._limits.rest).all():
            self.mode = Mode.STOPPED
            self._good = 0


def length(vector: np.ndarray) -> float:
    """Euclidean norm."""
    return float(np.sqrt(vector @ vector))


def shorten(vector: np.ndarray, most: float) -> np.ndarray:
    """The vector itself up to the length `most`, else the one of that length beside it."""
    norm = length(vector)
    return vector if norm <= most else vector * np.float32(most / norm)


def brake(vector: np.ndarray, change: float) -> np.ndarray:
    """The vector shorter by `change`, or zero: one step of a brake."""
    norm = length(vector)  # zero too where the squares of denormal numbers vanish
    return vector * np.float32(max(0.0, 1 - change / norm)) if norm else np.zeros_like(vector)
