"""A filter before which no controller can create energy, at any rate of control."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from palpate.errors import PalpateError
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.port import Numbers, Port, Vectors, finite, power, size

LATE = 1.5  # periods after which a sample is late
BRAKING = 0.05  # s: time constant of braking, where an action is not known
TINY = 1e-300  # J, in place of nothing in a quotient


@dataclass(frozen=True, kw_only=True)
class PassivityFilter:
    """The whole action of a controller, held to what a tank of energy can pay for.

    What the last action drew is booked by the encoders (`EnergyTank.booked`): then the energy of
    robot and tank together never rises by more than the work done from outside, whatever acts and
    however slowly it is sampled. What the next one draws is predicted as for a robot that moves
    freely, of effective mass Lambda:

        v' = v + Lambda^-1 F dt,  1/2 v'^T Lambda v' <= 1/2 v^T Lambda v + budget,

    where the budget is what is in the tank above its lower bound, and at most its flow times dt.
    The actions F of this are a ball; one outside is replaced by that at whose end v' is shorter.
    So with an empty tank the robot can still be braked and steered, and nothing is taken from an
    action that the tank can pay.

    Contact can make an action draw more than predicted: at most |F| times how far the robot gets in
    a period, when it is not faster than `fastest` (m/s, or rad/s of all joints together), than it
    is now, or than predicted. No action is so great that this would empty the tank below its
    reserve.

    It fails closed: an action that is not finite is replaced by braking, and where the velocity is
    not known either, by nothing. After a sample that was missing or late, or a clock that jumped,
    no energy is drawn in that period, only taken out. What is missing is paid as the worst.

    The state is the level of the tank, (robots,) J. Raises `PalpateError` for a speed that is not
    positive and finite.
    """

    tank: EnergyTank
    fastest: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 < self.fastest < math.inf:
            raise PalpateError(f"the fastest speed is positive and finite, not {self.fastest} m/s")

    def begin(self, robots: int) -> Numbers:
        """See `Filter.begin`."""
        return np.full(robots, self.tank.initial)

    def level(self, state: Numbers) -> Numbers:
        """See `Filter.level`."""
        return state

    def __call__(self, state: Numbers, port: Port, action: Vectors) -> tuple[Numbers, Vectors]:
        """See `Filter.__call__`."""
        tank, period = self.tank, port.period
        velocity, mass = port.velocity, port.mass
        level = tank.booked(state, port, self.fastest)
        budget = np.minimum(level - tank.lower, tank.flow * period)
        on_time = (port.elapsed > 0.0) & (port.elapsed <= LATE * period)
        moving = np.ones(len(level), bool)
        numbers = (action + velocity + port.displacement).sum() + mass.sum()
        if not (on_time.all() and np.isfinite(numbers)):
            sound = on_time & finite(port.displacement)
            budget = np.where(sound, budget, np.minimum(budget, 0.0))
            moving = finite(velocity) & np.isfinite(mass).all(axis=(1, 2))
            velocity = np.where(moving[:, None], velocity, 0.0)
            mass = np.where(moving[:, None, None], mass, np.eye(velocity.shape[1]))
            braking = -(mass @ velocity[:, :, None])[:, :, 0] / BRAKING
            action = np.where(finite(action)[:, None], action, braking)
        momentum = (mass @ velocity[:, :, None])[:, :, 0]
        moved = np.linalg.solve(mass, action[:, :, None])[:, :, 0]
        now = 0.5 * power(velocity, momentum)
        gain = period * power(action, velocity + 0.5 * period * moved)
        if (over := gain > budget).any():
            share = np.sqrt(np.maximum(now + budget, 0.0) / np.maximum(now + gain, TINY))
            shares = share[:, None]
            shorter = shares * action + (shares - 1.0) * momentum / period
            action = np.where(over[:, None], shorter, action)
            moved = np.where(
                over[:, None], shares * moved + (shares - 1.0) * velocity / period, moved
            )
        # Below its reserve there is what braking may cost.
        room = np.where(level > tank.reserve, level - tank.reserve, np.maximum(level, 0.0))
        speed = np.maximum(size(velocity), size(velocity + period * moved))
        costs = np.maximum(speed, self.fastest) * size(action) * period
        if (costs > room).any():
            action = action * np.minimum(room / np.maximum(costs, TINY), 1.0)[:, None]
        return level, np.where(moving[:, None], action, 0.0)
