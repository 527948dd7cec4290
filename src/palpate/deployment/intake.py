"""Which states may be believed: those that follow one another, in time, from one sender.

No clock is read here: the arrival time of each message comes with it.
"""

import math
from collections.abc import Sequence

from palpate.deployment.messages import StateMessage, decode_state
from palpate.deployment.plausibility import Check
from palpate.errors import PalpateError
from palpate.networks import Channel

MISSING = "no state"  # how a sentence about one that did not come begins
PATIENCE = 1.4  # periods after one state at which the next one is missing
LATE = 1.0  # periods that a state may have been under way longer than the fastest
JITTER = 0.5  # periods by which two of the sender's stamps may differ from one period
DRIFT = 2e-4  # s/s by which two clocks may drift


class BadStateError(PalpateError):
    """A state that is not to be believed."""


class Intake:
    """Takes messages as they arrive and tells good states from stale ones and faults.

    A good state is whole, possible (`Check`), the very next of its session, stamped one period
    after the last, and not late. How long a message takes cannot be known without a common clock;
    late is one that took longer than the fastest of its session so far, by `LATE` periods.
    """

    def __init__(self, check: Check, sensors: Sequence[Channel], period: float):
        self._check = check
        self._sensors = sensors
        self._period = period
        self._session: int | None = None
        self._fastest = 0.0  # arrival minus stamp: delay plus the offset of the clocks, s
        self._arrived = 0.0
        self.newest: StateMessage | None = None
        self.stale = 0

    def forget(self) -> None:
        """The next state starts a new series; the delay of its session is still known."""
        self.newest = None
        self._check.forget()

    @property
    def due(self) -> float:
        """When the next state counts as missing, in s; infinite before a first one."""
        return math.inf if self.newest is None else self._arrived + PATIENCE * self._period

    def motion(self, first: StateMessage) -> str:
        """What moved since the state `first` although the robot was at rest; "" if nothing did."""
        return "" if self.newest is None else self._check.motion(first.values, self.newest.values)

    def missing(self, now: float) -> str:
        """What to say if the next state should have come by `now` (s); "" while it need not."""
        if now < self.due:
            return ""
        return f"{MISSING} for {1e3 * (now - self._arrived):.0f} ms"

    def take(self, arrived: float, data: bytes) -> bool:
        """Whether this message, which `arrived` at so many s, is a new good state: then `newest`.

        A stale one is dropped and counted. Raises `BadStateError` for a fault, and forgets the
        series.
        """
        try:
            return self._take(arrived, decode_state(data, self._sensors))
        except PalpateError as error:
            self.forget()
            raise BadStateError(str(error)) from error

    def _take(self, arrived: float, state: StateMessage) -> bool:
        last = self.newest
        if not math.isfinite(state.time):
            raise BadStateError("a state has no time")
        if state.session != self._session:
            self._session, self._fastest = state.session, math.inf
            if last is not None:
                raise BadStateError("another sender took over")
        elif last is not None:
            if state.sequence <= last.sequence:
                self.stale += 1
                return False
            self._check_sequel(last, state)
        took = arrived - state.time
        if took - self._fastest > LATE * self._period:
            raise BadStateError(f"a state is {1e3 * (took - self._fastest):.0f} ms late")
        if problem := self._check.problem(state.values):
            raise BadStateError(problem)
        self._fastest = min(self._fastest + DRIFT * self._period, took)
        self._arrived, self.newest = arrived, state
        return True

    def _check_sequel(self, last: StateMessage, state: StateMessage) -> None:
        lost = state.sequence - last.sequence - 1
        if lost:
            raise BadStateError(f"{lost} states were lost")
        elapsed = state.time - last.time
        if abs(elapsed - self._period) > JITTER * self._period:
            raise BadStateError(
                f"the sender's clock went on by {1e3 * elapsed:.1f} ms between two states"
            )
