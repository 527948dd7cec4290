"""A point in a plane between two obstacles, whose motion can be interrupted.

The dynamics and geometry of the first navigation task of Thananjeyan et al. 2021 (Recovery RL,
arXiv 2010.15920), with each of its steps cut into ten.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from palpate.errors import PalpateError
from palpate.worlds.world import World

PERIODS = 10  # control periods in a step of the original
NOISE = 0.05  # standard deviation of the motion's noise, of a whole step
START, START_SPREAD = (-50.0, 0.0), 1.0
# Where the original collects what a critic learns from before: beside either wall.
SCATTERED_X, SCATTERED_Y = (-80.0, 50.0), (2.0, 5.0)
# Rectangles (x from, to, y from, to) that may not be entered: two walls, and one that joins them.
OBSTACLES = (
    (-100.0, 150.0, 5.0, 10.0),
    (-100.0, 150.0, -10.0, -5.0),
    (-100.0, -80.0, -10.0, 10.0),
)
VIEW = (-60.0, 10.0, -12.0, 12.0)  # x and y that a picture shows


class PointObservation(NamedTuple):
    """What is seen: the state itself, as in the original."""

    time: float  # s since reset; a step of the original is one second
    position: np.ndarray  # (2,), exact


class PointTruth(NamedTuple):
    """The state, and whether it is forbidden."""

    time: float
    position: np.ndarray  # (2,)
    inside: bool  # an obstacle


class Navigation(World):
    """s' = s + a + N(0, .05^2), |a_i| <= 1, cut into ten: a tenth of the motion, noise / sqrt 10.

    The action (2,) is the motion of a whole step, of which a control period does a tenth; one that
    is not finite moves nothing. Starts at (-50, 0) + N(0, 1), or at `start` (x, y); `scattered`
    lets episodes begin beside the walls, as those do that the original collects violations from.
    Inside an obstacle the point stays where it is.
    """

    def __init__(self, scattered: bool = False) -> None:
        self._scattered = scattered
        self._random: np.random.Generator | None = None

    @property
    def control_period(self) -> float:
        return 1.0 / PERIODS

    def reset(self, seed: int, *, start: Sequence[float] | None = None) -> PointObservation:
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise PalpateError(f"a seed is a whole number, 0 or greater, not {seed!r}")
        random = np.random.default_rng(seed)
        if start is not None:
            place = np.asarray(start, float)
        elif self._scattered:
            side = random.choice((-1.0, 1.0))
            place = np.array([random.uniform(*SCATTERED_X), side * random.uniform(*SCATTERED_Y)])
        else:
            place = START + START_SPREAD * random.standard_normal(2)
        if place.shape != (2,) or not np.isfinite(place).all():
            raise PalpateError(f"a point starts at (x, y), not at {start}")
        self._random, self._position, self._count = random, place, 0
        return self._observe()

    def step(self, action: np.ndarray) -> PointObservation:
        if self._random is None:
            raise PalpateError("a navigation world runs after reset(seed), not before")
        action = np.asarray(action, float)
        if action.shape != (2,):
            raise PalpateError(f"a point moves by (x, y), not by {action}")
        kick = self._random.standard_normal(2) * (NOISE / math.sqrt(PERIODS))
        if not _inside(*self._position):
            motion = np.clip(action, -1, 1) if np.isfinite(action).all() else np.zeros(2)
            self._position = self._position + motion / PERIODS + kick
        self._count += 1
        return self._observe()

    def _observe(self) -> PointObservation:
        return PointObservation(self._count / PERIODS, self._position.copy())

    def truth(self) -> PointTruth:
        if self._random is None:
            raise PalpateError("a navigation world has a truth after reset(seed), not before")
        return PointTruth(self._count / PERIODS, self._position.copy(), _inside(*self._position))

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        """Obstacles red, the goal green, the point blue, on white."""
        place = self.truth().position
        low_x, high_x, low_y, high_y = VIEW
        x = np.linspace(low_x, high_x, width)[None]
        y = np.linspace(high_y, low_y, height)[:, None]
        picture = np.full((height, width, 3), 255, np.uint8)
        for left, right, below, above in OBSTACLES:
            picture[(left <= x) & (x <= right) & (below <= y) & (y <= above)] = (200, 60, 50)
        picture[np.hypot(x, y) < 4] = (90, 180, 90)
        picture[np.hypot(x - place[0], y - place[1]) < 1] = (40, 70, 180)
        return picture


def _inside(x: float, y: float) -> bool:
    return any(a <= x <= b and c <= y <= d for a, b, c, d in OBSTACLES)
