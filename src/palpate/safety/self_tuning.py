"""Impedance that tunes itself: stiff along the motion while something resists it, else soft."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from palpate.errors import PalpateError
from palpate.safety.impedance import ImpedanceLaw, directed_stiffness


class SelfTuningLaw(ImpedanceLaw):
    """Stiffness without learning: Balatti, Kanoulas, Tsagarakis and Ajoudani, IROS 2018.

    While the force against the motion, from the observed wrench, is above `contact_force` N, the
    stiffness along the motion rises by `gain` N/m per metre and second of the tracking error;
    else it is `resting` N/m. Across the motion it is the lowest of `stiffness_range`. Of an action
    only the displacement counts; the other two numbers are ignored. All else is `ImpedanceLaw`'s.

    Observations have a `wrench` (worlds, 2 or more) in N besides; where it is not finite the
    stiffness does not rise. Raises `PalpateError` for values that are not positive and finite.
    """

    def __init__(
        self,
        displacement_limit: float,
        stiffness_range: tuple[float, float],
        *,
        resting: float,
        contact_force: float,
        gain: float,
        control_period: float = 1e-3,
        **limits: Any,
    ):
        super().__init__(
            displacement_limit, stiffness_range, constant_stiffness=resting,
            control_period=control_period, **limits,
        )  # fmt: skip
        for name, value in (("contact force", contact_force), ("gain", gain)):
            if not 0 < value < math.inf:
                raise PalpateError(f"the {name} is positive and finite, not {value}")
        self._range, self._resting = stiffness_range, resting
        self._contact_force, self._rise = contact_force, gain * control_period
        self._along = np.zeros(0)

    def begin(
        self,
        observation: Any,
        action: Float[np.ndarray, "worlds actions"],
        fresh: Bool[np.ndarray, " worlds"],
    ) -> None:
        """See `ImpedanceLaw.begin`."""
        super().begin(observation, action, fresh)
        step = self._wanted[0] - np.where(self._sound[:, None], observation.position[:, :2], 0.0)
        self._direction = step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)
        if len(self._along) != len(step):
            self._along = np.full(len(step), self._resting)
        self._along[fresh] = self._resting

    def spring(self) -> None:
        """None: the stiffness changes within a decision."""

    def command(self, observation: Any) -> Float[np.ndarray, "worlds 3"]:
        """See `ImpedanceLaw.command`."""
        with np.errstate(invalid="ignore", over="ignore"):  # a sensor that fails stiffens nothing
            against = -np.sum(observation.wrench[:, :2] * self._direction, axis=1)
            ahead = self._wanted[0] - observation.position[:, :2]
            error = np.maximum(np.sum(ahead * self._direction, axis=1), 0.0)
            risen = np.minimum(self._along + self._rise * error, self._range[1])
        felt = (against > self._contact_force) & np.isfinite(against + error)
        self._along = np.where(felt, risen, self._resting)
        across = np.full(len(felt), self._range[0])
        self._wanted = self._wanted[0], directed_stiffness(self._along, across, self._direction)
        self._moving = True
        return super().command(observation)
