"""How far a hand has taken two joints, one on what the other carries.

Both positions are told by the hand's way alone, unless both joints take it in one direction, as
those of a lid that lies flat: from there an elbow may bend up or down. So a way is followed from
that end at which the joints are told apart best.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from palpate.identification.interactive.screws import Pose, Screw, cross
from palpate.identification.interactive.ways import MOMENTS

STEPS, MORE_STEPS = 5, 25  # of Gauss-Newton: at each moment of a way, and from a guess
DAMPED, MOST_STEP = 1e-5, 0.2  # m^2, rad or m
GUESSES = -0.6, 0.6  # rad or m that both may have gone, in one direction or the other
SAME = 0.1  # rad or m between two ends that are one
# rad or m by which a way may lead elsewhere: where both take the hand in one direction, 5 mm at
# 10 cm from a hinge are as much
MISSED = 0.3

Points = Float[np.ndarray, "times 3"]
Positions = tuple[float, float]


class Linkage(NamedTuple):
    """Two joints on a `base`, the second on what the first carries, and the `point` where a hand
    holds what the second carries, while both are at 0 (m)."""

    base: Pose
    joints: tuple[Screw, Screw]
    point: Float[np.ndarray, "1 3"]

    def there(
        self, positions: Float[np.ndarray, "2"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 2"]]:
        """The place of the hand (m), and its derivatives by both positions (rad or m)."""
        outer, inner = self.joints
        first = outer.pose(float(positions[0]))
        on_first = inner.pose(float(positions[1])).at(self.point)
        on_base = first.at(on_first)
        slopes = np.concatenate(
            [outer.velocity(on_base), inner.velocity(on_first) @ first.rotation.T]
        )
        return self.base.at(on_base)[0], (slopes @ self.base.rotation.T).T

    def area(self, positions: Positions) -> float:
        """How well the hand tells both positions: the area that its derivatives span, m^2 of two
        hinges (the manipulability of Yoshikawa 1985)."""
        return math.hypot(*cross(*self.there(np.array(positions))[1].T))

    def follow(self, began: Positions, way: Points, most: float) -> Positions | None:
        """Where a hand has taken both, from where they began; None if they miss its way by more
        than the `most` (m).

        Three coordinates of each point of the way are to be explained by two positions, from those
        of the point before.
        """
        positions = np.array(began)
        for place in way[np.linspace(0, len(way) - 1, MOMENTS).astype(int)]:
            positions = self._approach(place, positions, STEPS)
            if np.linalg.norm(self.there(positions)[0] - place) > most:
                return None
        return float(positions[0]), float(positions[1])

    def leads(self, began: Positions, ended: Positions, way: Points, most: float) -> bool:
        """Whether a hand on its way takes both from where they began to where they ended."""
        if np.linalg.norm(self.there(np.array(ended))[0] - way[-1]) > most:
            return False
        first, last = began, ended
        if self.area(ended) > self.area(began):
            way, first, last = way[::-1], ended, began
        reached = self.follow(first, way, most)
        return reached is not None and float(np.abs(np.subtract(reached, last)).max()) < MISSED

    def ends(self, began: Positions, way: Points, most: float) -> list[Positions]:
        """Where both may be at the end of a hand's way: several where it is open how they bend."""
        followed = self.follow(began, way, most)
        found = [] if followed is None else [followed]
        for gone in itertools.product(GUESSES, GUESSES):
            end = self._approach(way[-1], np.add(began, gone), MORE_STEPS)
            ended = float(end[0]), float(end[1])
            if (
                all(np.abs(end - other).max() > SAME for other in found)
                and self.area(ended) > self.area(began)
                and self.leads(began, ended, way, most)
            ):
                found.append(ended)
        return found

    def _approach(
        self, place: Float[np.ndarray, "3"], positions: Float[np.ndarray, "2"], steps: int
    ) -> Float[np.ndarray, "2"]:
        """The positions at which the hand is nearest to a place (Gauss-Newton)."""
        for _ in range(steps):
            here, slopes = self.there(positions)
            square = slopes.T @ slopes + DAMPED * np.eye(2)
            step = np.linalg.solve(square, slopes.T @ (place - here))
            positions = positions + np.clip(step, -MOST_STEP, MOST_STEP)
        return positions
