"""Stiffness that rises slowly enough to need no tank (Kronander and Billard, T-RO 2016)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from palpate.errors import PalpateError
from palpate.safety.impedance import double_diagonalised_damping
from palpate.safety.port import Matrices, Port, Vectors, finite
from palpate.safety.valves import impedance_of


class Springs(NamedTuple):
    """Of the last period; NaN where an episode has just begun."""

    stiffness: Matrices  # N/m
    damping: Matrices  # N s/m


@dataclass(frozen=True, kw_only=True)
class StiffnessRate:
    """Stiffness no faster than alpha Lambda - D <= 0 and K' + alpha D' - 2 alpha K <= 0 allow.

    (doi 10.1109/TRO.2016.2593492.) Of the step to the commanded stiffness the greatest share is
    done that keeps both; damping belongs to the stiffness that is reached, of the ratio
    `damping_ratio`. What a set-point that jumps gives is not bounded by it. The state is the last
    stiffness and damping. An action that is not finite is replaced by damping alone.
    """

    damping_ratio: float = 1.0
    axes: int = 2

    def __post_init__(self) -> None:
        if not 0.0 < self.damping_ratio < np.inf:
            raise PalpateError(f"a damping ratio is positive, not {self.damping_ratio}")

    def begin(self, robots: int) -> Springs:
        """See `Filter.begin`."""
        nothing = np.full((robots, self.axes, self.axes), np.nan)
        return Springs(nothing, nothing)

    def level(self, state: Springs) -> None:
        """See `Filter.level`: it has no tank."""

    def __call__(self, state: Springs, port: Port, action: Vectors) -> tuple[Springs, Vectors]:
        """See `Filter.__call__`."""
        wanted, velocity = impedance_of(port), port.velocity
        fresh = np.isnan(state.stiffness[:, :1, :1])
        stiffness = np.where(fresh, wanted.stiffness, state.stiffness)
        damping = np.where(fresh, wanted.damping, state.damping)
        # The greatest alpha for which D - alpha Lambda is not negative.
        alpha = np.linalg.eigvals(np.linalg.solve(port.mass, damping)).real.min(axis=1)
        alpha = np.maximum(alpha, 1e-9)[:, None, None]
        step = wanted.stiffness - stiffness + alpha * (wanted.damping - damping)
        allowed = 2.0 * alpha * port.period * stiffness
        rises = np.linalg.eigvals(np.linalg.solve(allowed, step)).real.max(axis=1)
        share = 1.0 / np.maximum(rises, 1.0)
        stiffness = stiffness + share[:, None, None] * (wanted.stiffness - stiffness)
        damping = double_diagonalised_damping(port.mass, stiffness, self.damping_ratio)
        damped = -np.einsum("bij,bj->bi", damping, velocity)
        shaped = damped + np.einsum("bij,bj->bi", stiffness, wanted.error)
        sound = finite(shaped) & finite(action)
        shaped = np.where(sound[:, None], shaped, np.where(np.isfinite(damped), damped, 0.0))
        return Springs(stiffness, damping), shaped
