"""Energy tanks as textbooks have them: a valve that is asked once a sample.

Both keep a constant spring K_c outside of the tank, and let what is stiffer, w = K_v e with
K_v = K - K_c, draw from it while it is above its lower bound. Held for a period, what flows is not
what flowed at its beginning: sampled, both create energy (`palpate reproduce energy-audit`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.errors import PalpateError
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.port import Impedance, Numbers, Port, Vectors, finite, power


@dataclass(frozen=True, kw_only=True)
class TextbookValve:
    """Ferraguti, Secchi and Fantuzzi, ICRA 2013: T' = sigma v^T D v - alpha w . v.

    sigma = [T <= upper bound] lets in what the damping dissipates, alpha = [T >= lower bound] lets
    w pass. `constant` (N/m) is K_c. The state is the level T, (robots,) J. An action that is not
    finite is replaced by damping alone. Raises `PalpateError` where the port has no impedance, and
    for a constant that is negative or not finite.
    """

    tank: EnergyTank
    constant: float = 50.0
    returns: bool = False  # whether w, too, may fill the tank: Schindlbeck's gamma

    def __post_init__(self) -> None:
        if not 0.0 <= self.constant < np.inf:
            raise PalpateError(f"a constant stiffness is 0 N/m or more, not {self.constant}")

    def begin(self, robots: int) -> Numbers:
        """See `Filter.begin`."""
        return np.full(robots, self.tank.initial)

    def level(self, state: Numbers) -> Numbers:
        """See `Filter.level`."""
        return state

    def __call__(self, state: Numbers, port: Port, action: Vectors) -> tuple[Numbers, Vectors]:
        """See `Filter.__call__`."""
        spring, velocity = impedance_of(port), port.velocity
        damped = -np.einsum("bij,bj->bi", spring.damping, velocity)
        varying = spring.stiffness - self.constant * np.eye(velocity.shape[1])
        pulled = np.einsum("bij,bj->bi", varying, spring.error)
        fills, opens = state <= self.tank.upper, state >= self.tank.lower
        outflow = power(pulled, velocity)
        if self.returns:  # what takes energy out of the robot always passes
            passes = opens | (outflow <= 0.0)
            paid = np.where(outflow > 0.0, opens * outflow, fills * outflow)
        else:
            passes, paid = opens, opens * outflow
        filled = fills * -power(damped, velocity)
        level = state + port.period * (filled - paid)
        shaped = self.constant * spring.error + damped + passes[:, None] * pulled
        sound = finite(shaped) & finite(action) & np.isfinite(level)
        shaped = np.where(sound[:, None], shaped, np.where(np.isfinite(damped), damped, 0.0))
        return np.where(sound, level, state), shaped


def schindlbeck(tank: EnergyTank, constant: float = 50.0) -> TextbookValve:
    """Schindlbeck and Haddadin, ICRA 2015: w fills the tank as well when it takes energy out.

    Then it passes whatever the level is: gamma = [p >= 0] of its power p = -w . v.
    """
    return TextbookValve(tank=tank, constant=constant, returns=True)


def impedance_of(port: Port) -> Impedance:
    """What the action is made of; raises `PalpateError` where nobody says that."""
    if port.impedance is None:
        raise PalpateError(
            "this filter needs to know the impedance that an action is made of; passivity and "
            "kinetic-barrier do not"
        )
    return port.impedance
