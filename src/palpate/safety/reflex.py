"""A reflex: what is risky is interrupted while it is under way (Bresa, arXiv 2503.21989)."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from palpate.errors import PalpateError
from palpate.networks.guarded import Guard
from palpate.networks.in_numpy import GuardInNumpy
from palpate.worlds.world import ControlLaw, InterruptingLaw


class Reflex(InterruptingLaw):
    """A control law whose motions a guard interrupts, asked in every control period.

    Where the risk of the action under way, in the situation that the sensors show now, is above the
    guard's threshold, the recovery's action takes its place, as a decision of that moment would. It
    holds until the next decision, as to go back to what was warned of would bring the warning back;
    and is itself replaced where it is risky after `pace` control periods. Worlds beside it go on.

    `observe` makes of observations side by side the features (worlds, features) that the guard
    knows. Without a `law` an action is done as it is; without a guard nothing is interrupted.

    It fails closed: where the risk is not finite, as after a sensor has dropped out, there is no
    action until the next decision: NaN is handed to the law, which fails closed (`ImpedanceLaw`
    brakes); without a law the command is zero.

    `executed` (worlds, actions) is what is under way, `interrupted` (worlds,) bool whether it was
    replaced in the last control period. The networks are evaluated by NumPy
    (`palpate.networks.in_numpy`).

    Raises `PalpateError` for a pace below 1.
    """

    def __init__(
        self,
        law: ControlLaw | None,
        observe: Callable[[Any], Float[np.ndarray, "worlds features"]],
        pace: int,
    ):
        if pace < 1:
            raise PalpateError(f"the pace is at least 1 control period, not {pace}")
        self.law, self.pace = law, pace
        self._observe = observe
        self._guard: GuardInNumpy | None = None
        self._threshold = 1.0

    def watch_with(self, guard: Guard, threshold: float) -> None:
        """From now on by this guard, whose weights are copied, and its threshold of risk.

        Raises `PalpateError` for a threshold outside [0, 1].
        """
        if not 0.0 <= threshold <= 1.0:
            raise PalpateError(f"the threshold is {threshold}: expected a risk in [0, 1]")
        self._guard, self._threshold = GuardInNumpy(guard), threshold

    def begin(
        self,
        observation: Any,
        action: Float[np.ndarray, "worlds actions"],
        fresh: Bool[np.ndarray, " worlds"],
    ) -> None:
        """Take a decision for each world; see `ControlLaw.begin`."""
        self.executed = np.array(action, float)
        self.interrupted = np.zeros(len(action), bool)
        self._began = observation  # what each action under way started from
        self._held = np.full(len(action), self.pace)  # control periods: a decision can go at once
        if self.law is not None:
            self.law.begin(observation, action, fresh)

    def command(self, observation: Any) -> Float[np.ndarray, "worlds commands"]:
        """What to do in the next control period, after a look at what is risky now."""
        if self._guard is not None:
            self._look(observation)
        if self.law is not None:
            return self.law.command(observation)
        return np.where(np.isfinite(self.executed).all(axis=1, keepdims=True), self.executed, 0.0)

    def _look(self, observation: Any) -> None:
        assert self._guard is not None
        features = np.asarray(self._observe(observation), np.float32)
        risk = self._guard.risk(features, self.executed)
        lost = ~np.isfinite(risk) & np.isfinite(self.executed).all(axis=1)
        self.interrupted = which = lost | ((risk > self._threshold) & (self._held >= self.pace))
        self._held += 1
        if not which.any():
            return
        self.executed[which] = self._guard.recover(features[which])
        self.executed[lost] = np.nan
        self._held[which] = 1
        if self.law is not None:
            # The law takes the decisions of all: those of the others as they were.
            began = (
                np.where(which.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
                for new, old in zip(observation, self._began, strict=True)
            )
            self._began = type(observation)._make(began)
            self.law.begin(self._began, self.executed, np.zeros(len(which), bool))
