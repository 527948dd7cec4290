"""One action on an appliance: where and which way, what was seen, and what the hand felt."""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Float

from palpate.perception.clouds import Cloud

STILL = 0.008  # m: a hand that went no further has moved nothing


@dataclasses.dataclass(frozen=True, eq=False)
class Push:
    """Where a hand takes hold, or presses, and which way it wants to go.

    `point` (m) is one that was seen, `direction` a unit vector, both in the world's axes. A hand
    that holds may pull any way; one that presses slips where it does not press against the surface.
    `force` (N) and `travel` (m) are the most that it gives and goes.
    """

    point: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]
    does: Literal["hold", "press"] = "hold"
    force: float = 40.0
    travel: float = 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class Handling:
    """What was seen and felt while a hand was at a point; nothing was felt where it got no hold.

    `points` (m) are where it was at `times` (s) and `forces` (N) what it gave, in the world's axes.
    `after` was seen while it still held on.
    """

    push: Push

    before: Cloud
    after: Cloud
    times: Float[np.ndarray, " times"]
    points: Float[np.ndarray, "times 3"]
    forces: Float[np.ndarray, "times 3"]

    @property
    def held(self) -> bool:
        """Whether the hand had hold of something."""
        return len(self.points) > 1

    @property
    def travel(self) -> float:
        """How far the hand got from where it began, m."""
        if not self.held:
            return 0.0
        ends = self.points[-3:].mean(axis=0) - self.points[:3].mean(axis=0)
        return float(np.linalg.norm(ends))

    @property
    def moved(self) -> bool:
        """Whether what it had hold of has moved."""
        return self.travel > STILL
