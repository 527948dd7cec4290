"""Who decides in a closed loop: one protocol for policies, planners and hand-written laws."""

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Key

from palpate.errors import PalpateError

SAME_PERIOD = 1e-3  # relative: that of a recording's clock is known no better


@runtime_checkable
class Controller(Protocol):
    """Who decides: `(carry, observation, goal, key) -> (carry, action)`.

    In a trial the observation is what the worlds hand out, and every array of it, of the goal and
    of the action leads with the worlds. `goal` is what the task asks for from the start of a trial
    on (None where nothing varies): a controller carries how far it has come. `key` is randomness
    for those that use any (None otherwise).

    A `palpate.networks.Policy` has the same signature with features for an observation; what makes
    features of what is seen stands in front of it, and is carried with it (`LearnedController`).

    `period`: seconds from one decision to the next that it was made for; None: any.
    """

    @property
    def period(self) -> float | None: ...

    def initial_carry(self, command: Any) -> Any:
        """What to carry into the first call; `command` (worlds, ...) is the action in force."""
        ...

    def __call__(
        self, carry: Any, observation: Any, goal: Any, key: Key[Array, "*worlds"] | None
    ) -> tuple[Any, Any]:
        """The next carry, and the action to hold for one control period."""
        ...


class _NotStarted(NamedTuple):
    command: Any


class FeedbackController(ABC):
    """A controller whose carry begins with what it sees first."""

    period: float | None = None

    def initial_carry(self, command: Any) -> Any:
        """See `Controller.initial_carry`."""
        return _NotStarted(command)

    def __call__(
        self, carry: Any, observation: Any, goal: Any, key: Key[Array, "*worlds"] | None
    ) -> tuple[Any, Any]:
        """See `Controller`."""
        if isinstance(carry, _NotStarted):
            carry = self.start(carry.command, observation, goal)
        return self.decide(carry, observation, goal)

    @abstractmethod
    def start(self, command: Any, observation: Any, goal: Any) -> Any:
        """The carry of a controller that sees its first observation, while `command` holds."""

    @abstractmethod
    def decide(self, carry: Any, observation: Any, goal: Any) -> tuple[Any, Any]:
        """The next carry and the action."""


class HeldStill:
    """Nothing is done: what an object does by itself."""

    period = None

    def initial_carry(self, command: Any) -> np.ndarray:
        """The action that does nothing, (worlds, ...)."""
        return np.zeros_like(command)

    def __call__(
        self, carry: np.ndarray, observation: Any, goal: Any, key: Any
    ) -> tuple[Any, np.ndarray]:
        """Zero for every world."""
        return carry, carry


class OpenLoop(FeedbackController):
    """Actions that were laid down before the start, (worlds, steps, ...), whatever is seen."""

    def __init__(self, actions: np.ndarray, period: float):
        self._actions, self.period = actions, period

    def start(self, command: Any, observation: Any, goal: Any) -> tuple[np.ndarray, int]:
        """All actions, and how many were taken."""
        return self._actions, 0

    def decide(
        self, carry: tuple[np.ndarray, int], observation: Any, goal: Any
    ) -> tuple[Any, np.ndarray]:
        """The next of them."""
        actions, step = carry
        return (actions, step + 1), actions[:, step]


def check_period(controller: Controller, control_period: float) -> None:
    """Raise `PalpateError` if the controller was made for another control period (s)."""
    period = controller.period
    if period is not None and not math.isclose(period, control_period, rel_tol=SAME_PERIOD):
        raise PalpateError(
            f"a controller that decides every {period:g} s does not fit a world with a control "
            f"period of {control_period:g} s: train it with a model of that period"
        )
