"""A filter before the servos of one robot, within the control periods of its world."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from palpate.safety.port import Filter, Port


class FilteredDrive:
    """As much of the servos' forces as the filter lets pass: a `palpate.worlds.world.Drive`.

    `mass` (axes, axes) kg is what they move, `period` (s) the time for which a force is held.
    `level` is what is in the filter's tank (J, NaN without one), `least` the least of it since the
    episode began, and `drawn` (J) what forces have put into the robot, without what they took out.
    """

    def __init__(self, one: Filter, mass: Float[np.ndarray, "axes axes"], period: float):
        self._filter, self._mass, self._period = one, mass[None], period

    def begin(self) -> None:
        """An episode begins: the tank is as in the beginning, and no force was held."""
        self._state = self._filter.begin(1)
        self._force = np.zeros((1, self._mass.shape[1]))
        self._before: np.ndarray | None = None
        self.drawn, self.level = 0.0, self._level()
        self.least = self.level

    def __call__(
        self,
        force: Float[np.ndarray, " axes"],
        position: Float[np.ndarray, " axes"],
        velocity: Float[np.ndarray, " axes"],
    ) -> Float[np.ndarray, " axes"]:
        """What passes of a force that is wanted now, where the encoders show this."""
        went = np.zeros_like(position) if self._before is None else position - self._before
        port = Port(
            self._force, went[None], velocity[None], self._mass, np.full(1, self._period),
            self._period,
        )  # fmt: skip
        self._before = position.copy()
        self.drawn += max(0.0, float((self._force[0] * went).sum()))
        self._state, self._force = self._filter(self._state, port, force[None])
        self.level = self._level()
        self.least = min(self.least, self.level)
        return self._force[0]

    def _level(self) -> float:
        level = self._filter.level(self._state)
        return float("nan") if level is None else float(level[0])
