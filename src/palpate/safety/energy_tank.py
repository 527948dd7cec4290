"""A tank of energy: what an action may draw from, and all that it may draw."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.safety.port import Numbers, Port, Vectors, finite, power, size


@dataclass(frozen=True, kw_only=True)
class EnergyTank:
    """Energy in J that a controller may give to its robot, and what it is filled by.

    It begins with `initial`, never holds more than `upper`, and is filled by nothing but the energy
    that actions take out of the robot. Below `lower` nothing is to be drawn; what is left down to
    the `reserve` is for what contact draws unforeseen while the robot brakes (Ferraguti, Secchi and
    Fantuzzi, ICRA 2013, whose bounds are the upper and the lower). No more than `flow` W is to be
    drawn at any time.

    Raises `PalpateError` unless 0 < reserve < lower <= initial <= upper, and for no flow.
    """

    initial: float
    upper: float
    lower: float = 0.2
    reserve: float = 0.05
    flow: float = math.inf

    def __post_init__(self) -> None:
        order = 0.0, self.reserve, self.lower, self.initial, self.upper
        rises = order[0] < order[1] < order[2] <= order[3] <= order[4] < math.inf
        if not rises:
            raise PalpateError(
                "a tank has 0 < reserve < lower bound <= initial <= upper bound, in J, not "
                f"{self.reserve}, {self.lower}, {self.initial} and {self.upper}"
            )
        if not self.flow > 0.0:
            raise PalpateError(f"the power that a tank gives is positive, in W, not {self.flow}")

    def booked(self, level: Numbers, port: Port, fastest: float) -> Numbers:
        """The level after what the action of the last period drew.

        A force F that is held from one sample to the next draws F . (q' - q), whatever else acts
        on the robot and whatever it does between the samples: exact, where F . v dt is a guess.
        Where nobody knows how far the robot went, it is taken to have gone along the force at
        `fastest` (m/s), for one period at least.
        """
        drawn = power(port.force, port.displacement)
        known = np.isfinite(drawn)
        if not known.all():
            time = np.where(np.isfinite(port.elapsed), port.elapsed, math.inf)
            time = np.maximum(time, port.period)
            worst = np.where(finite(port.force), size(port.force) * fastest * time, math.inf)
            # Of no force, for ever, nothing; and a debt of more than a full tank is none to pay.
            worst = np.minimum(np.nan_to_num(worst, posinf=math.inf), level + self.upper)
            drawn = np.where(known, drawn, worst)
        return np.minimum(level - drawn, self.upper)

    def followed(
        self, level: Numbers, drawn: Float[np.ndarray, "robots periods"]
    ) -> Float[np.ndarray, "robots periods"]:
        """The level after each of many periods in which so much was drawn (J).

        What is more than the tank holds is lost: reflection at the upper bound.
        """
        free = level[:, None] - np.cumsum(drawn, axis=1)
        lost = np.maximum.accumulate(np.maximum(free - self.upper, 0.0), axis=1)
        return free - lost


@dataclass(frozen=True, kw_only=True)
class TankMeter:
    """A tank that is booked and blocks nothing: what a controller would have drawn from it.

    The state is its level, (robots,) J, which may be below zero.
    """

    tank: EnergyTank
    fastest: float = 1.0  # m/s, see `EnergyTank.booked`

    def begin(self, robots: int) -> Numbers:
        """See `Filter.begin`."""
        return np.full(robots, self.tank.initial)

    def level(self, state: Numbers) -> Numbers:
        """See `Filter.level`."""
        return state

    def __call__(self, state: Numbers, port: Port, action: Vectors) -> tuple[Numbers, Vectors]:
        """See `Filter.__call__`: every action passes."""
        return self.tank.booked(state, port, self.fastest), action
