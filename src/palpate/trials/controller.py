"""Controllers of any worlds: those that begin with what they see, and those that look at nothing.

In a trial every array of an observation, of the goal and of the action leads with the worlds. The
goal is what is asked for from the start of a trial on: a controller carries how far it has come.
"""

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Key

from palpate.errors import PalpateError
from palpate.networks import Controller

SAME_PERIOD = 1e-3  # relative: that of a recording's clock is known no better


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


class Noted:
    """A controller of which is kept what it sees, and its actions (worlds, ...), step by step."""

    def __init__(self, controller: Controller):
        self._controller, self.period = controller, controller.period
        self.initial_carry = controller.initial_carry
        self.observations: list[Any] = []
        self.actions: list[Any] = []

    def __call__(
        self, carry: Any, observation: Any, goal: Any, key: Key[Array, "*worlds"] | None
    ) -> tuple[Any, Any]:
        """See `Controller`."""
        carry, action = self._controller(carry, observation, goal, key)
        self.observations.append(observation)
        self.actions.append(action)
        return carry, action


def check_period(controller: Controller, control_period: float) -> None:
    """Raise `PalpateError` if the controller was made for another control period (s)."""
    period = controller.period
    if period is not None and not math.isclose(period, control_period, rel_tol=SAME_PERIOD):
        raise PalpateError(
            f"a controller that decides every {period:g} s does not fit a world with a control "
            f"period of {control_period:g} s: expected one that was trained through a model "
            f"identified at {1 / control_period:g} Hz"
        )
