"""A control barrier of kinetic energy: never faster than that, and no tank."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from palpate.errors import PalpateError
from palpate.safety.port import Numbers, Port, Vectors, finite, kinetic_energy, power


@dataclass(frozen=True, kw_only=True)
class KineticBarrier:
    """h = `most` - 1/2 v^T Lambda v is kept positive by h' >= -`rate` h (Ames et al., ECC 2019).

    Of the actions that keep it, the nearest: u = F - v max(0, F . v - rate h) / v^2, as of the
    strongest simple baseline against energy tanks (arXiv 2411.02186). Energy in J, rate in 1/s. An
    action that is not finite is replaced by none. The state is empty. Raises `PalpateError` for
    numbers that are not positive and finite.
    """

    most: float = 0.5
    rate: float = 10.0

    def __post_init__(self) -> None:
        for name, value in (("most energy", self.most), ("rate", self.rate)):
            if not 0.0 < value < math.inf:
                raise PalpateError(f"the {name} of a barrier is positive and finite, not {value}")

    def begin(self, robots: int) -> Numbers:
        """See `Filter.begin`."""
        return np.zeros(robots)

    def level(self, state: Numbers) -> None:
        """See `Filter.level`: it has no tank."""

    def __call__(self, state: Numbers, port: Port, action: Vectors) -> tuple[Numbers, Vectors]:
        """See `Filter.__call__`."""
        velocity = port.velocity
        left = self.most - kinetic_energy(port.mass, velocity)
        over = np.maximum(power(action, velocity) - self.rate * left, 0.0)
        square = np.maximum(power(velocity, velocity), 1e-12)
        shaped = action - velocity * (over / square)[:, None]
        return state, np.where(finite(shaped)[:, None], shaped, 0.0)
