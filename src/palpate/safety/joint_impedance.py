"""Impedance of joints: each a spring to an angle, damped for the inertia that it has."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from palpate.errors import PalpateError
from palpate.safety.impedance import double_diagonalised_damping
from palpate.safety.port import finite
from palpate.worlds.world import ControlLaw


class JointImpedance(ControlLaw):
    """Torques tau = K (q_d - q) - D qdot of the joints of arms side by side.

    An action in [-1, 1]^(2 n) is, for each of n joints, how far its set-point is from where it is
    at the decision, as a share of `displacement_limit` (rad), and its stiffness, evenly over
    `stiffness_range` (N m/rad). D is `double_diagonalised_damping` for the inertia observed then.

    Observations have `position` (rad), `velocity` (rad/s), both (arms, n), and `mass` (arms, n, n)
    kg m^2. `target`, `stiffness` and `damping` are those in force. A decision that is not finite
    leaves damping alone. Raises `PalpateError` for limits that are not positive and finite.
    """

    def __init__(
        self,
        displacement_limit: float,
        stiffness_range: tuple[float, float],
        damping_ratio: float = 0.7,
    ):
        low, high = stiffness_range
        if not (0.0 < displacement_limit < math.inf and 0.0 < low <= high < math.inf):
            raise PalpateError(
                "limits of joints are positive and finite, from low to high, not "
                f"{displacement_limit} rad and {stiffness_range} N m/rad"
            )
        self._limit, self._low, self._span = displacement_limit, low, high - low
        self._ratio = damping_ratio

    def begin(
        self,
        observation: Any,
        action: Float[np.ndarray, "arms actions"],
        fresh: Bool[np.ndarray, " arms"],
    ) -> None:
        """Take a decision for each arm; see `ControlLaw.begin`."""
        sound = finite(action)[:, None]
        action = np.where(sound, np.clip(action, -1.0, 1.0), 0.0)
        count = action.shape[1] // 2
        self.target = observation.position + self._limit * action[:, :count]
        stiffness = self._low + self._span * (action[:, count:] + 1.0) / 2.0
        springs = stiffness[:, :, None] * np.eye(count)
        self.damping = double_diagonalised_damping(observation.mass, springs, self._ratio)
        self.stiffness = np.where(sound[:, :, None], springs, 0.0)

    def command(self, observation: Any) -> Float[np.ndarray, "arms joints"]:
        """Torques in N m for the next control period."""
        error = (self.target - observation.position)[:, :, None]
        pull = self.stiffness @ error - self.damping @ observation.velocity[:, :, None]
        return pull[:, :, 0]
