"""Who is in command: a policy while its eyes can be trusted, else a brake.

No clock, no thread: time and messages come in, an order comes out, so that every fault can be
tried in a test.

    waiting   at rest; good states are counted, and enough of them in a row start the policy
    running   the policy decides, within the limits
    braking   down to rest at the limit of acceleration, whatever is seen meanwhile
    stopped   at rest; the last state was bad, or none comes. A good one: waiting

A brake is never left before rest, and there is no way from rest to motion but through `GOOD`
states in a row during which the gripper stood still; then the acceleration grows softly.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol, runtime_checkable

import numpy as np

from palpate.deployment.intake import BadStateError, Intake
from palpate.errors import PalpateError

GOOD = 50  # good states in a row, before the policy starts
SOFT = 50  # periods in which the acceleration grows to its limit after a start
PAUSE = 2.0  # periods without a command after which a robot brakes by itself
ASKED = "asked to stop"
STANDING = 0.02  # m by which a gripper at rest may move, servo and noise included


class Mode(IntEnum):
    """See the module."""

    WAITING = 0
    RUNNING = 1
    BRAKING = 2
    STOPPED = 3


@dataclass(frozen=True)
class Limits:
    """What a command may be: `speed` in m/s, `acceleration` in m/s^2, one every `period` s.

    Raises `PalpateError` for a limit that is not greater than 0.
    """

    speed: float
    acceleration: float
    period: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < float("inf"):
                raise PalpateError(f"a limit of {name} is greater than 0, not {value}")

    @property
    def change(self) -> float:
        """The largest change of a command, m/s."""
        return self.acceleration * self.period


@dataclass(frozen=True, slots=True, eq=False)
class Order:
    """The gripper velocity (3,) in m/s to hold for a period, and why: "" while all is well."""

    mode: Mode
    velocity: np.ndarray
    reason: str


@runtime_checkable
class Decision(Protocol):
    """What the loop asks: it sees every state and decides on the newest."""

    def forget(self) -> None:
        """The next state is the first of a series."""
        ...

    def see(self, gripper: np.ndarray, markers: np.ndarray) -> None:
        """A state, one period after the last: (3,) and (markers, 3) in m."""
        ...

    def decide(self, command: np.ndarray) -> np.ndarray:
        """The next command (3,) in m/s, after the one in force."""
        ...


class Supervisor:
    """See the module.

    Args:
        intake: says which states are good.
        decision: the policy.
        limits: of speed and acceleration.
    """

    def __init__(self, intake: Intake, decision: Decision, limits: Limits):
        self._intake = intake
        self._decision = decision
        self._limits = limits
        self._now: float | None = None
        self._good = 0  # states in a row
        self._ran = 0  # decisions since the start
        self._stood = np.zeros(3)  # where the gripper was when counting began, m
        self.mode = Mode.WAITING
        self.velocity = np.zeros(3, np.float32)
        self.reason = "no state has come yet"

    @property
    def seen(self) -> int:
        """Sequence number of the newest good state, 0 without one."""
        newest = self._intake.newest
        return 0 if newest is None else newest.sequence

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
            self._brake(self._limits.change * max(1.0, elapsed / period - PAUSE))
        return Order(self.mode, self.velocity, self.reason)

    def halt(self, now: float) -> Order:
        """One period of going to rest because it was asked for; nothing is looked at."""
        self._now = now
        self._start_over(ASKED)
        self._brake(self._limits.change)
        return Order(self.mode, self.velocity, self.reason)

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
                self._decision.see(state.gripper, state.markers)
                fresh += 1
        return fresh, fault or self._intake.missing(now)

    def _start_over(self, fault: str) -> None:
        if self.mode is not Mode.BRAKING:
            self.reason = fault
        self.mode = Mode.BRAKING
        self._intake.forget()
        self._decision.forget()

    def _count(self, fresh: int) -> None:
        newest = self._intake.newest
        gripper = self._stood if newest is None else newest.gripper
        if not self._good:
            self._stood = gripper
        if length(gripper - self._stood) > STANDING:
            self._start_over("the gripper moved while it should stand")
            return
        self.mode = Mode.WAITING
        self._good += fresh
        if self._good >= GOOD:
            self.mode, self.reason, self._ran = Mode.RUNNING, "", 0
            self._run()

    def _run(self) -> None:
        wanted = self._decision.decide(self.velocity)
        if not np.isfinite(wanted).all():
            self._start_over("the policy gave a command that is not finite")
            return
        self._ran += 1
        change = self._limits.change * min(1.0, self._ran / SOFT)
        moved = self.velocity + shortened(wanted - self.velocity, change)
        self.velocity = shortened(moved, self._limits.speed)

    def _brake(self, change: float) -> None:
        """Along its own direction, so that no power is put in."""
        self.velocity = slowed(self.velocity, change)
        if not self.velocity.any():
            self.mode = Mode.STOPPED
            self._good = 0


def length(vector: np.ndarray) -> float:
    """Euclidean norm."""
    return float(np.sqrt(vector @ vector))


def shortened(vector: np.ndarray, most: float) -> np.ndarray:
    """The vector itself up to the length `most`, else the one of that length beside it."""
    norm = length(vector)
    return vector if norm <= most else vector * np.float32(most / norm)


def slowed(velocity: np.ndarray, change: float) -> np.ndarray:
    """The velocity shorter by `change`, or zero: one step of a brake."""
    speed = length(velocity)  # zero too where the squares of denormal numbers vanish
    return velocity * np.float32(max(0.0, 1 - change / speed)) if speed else np.zeros_like(velocity)
