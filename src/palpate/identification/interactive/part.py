"""A part of an appliance as it is believed to be: its joint, and where it was in each look."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from palpate.identification.interactive.refinement import Estimate
from palpate.identification.interactive.screws import Pose, Screw
from palpate.perception.clouds import Cloud

SUPPORT = 200  # points of a look that a position is looked for with
UNSURE = 45.0  # deg: a part whose axis is less known than so is shown by no two looks
# deg: how well the direction of an axis is known, and shares of the points of the best look that
# another one has to show to describe a part whose axis is, or is not: its points may not be its own
KNOWN, SHARES = 3.0, (0.1, 0.3)
LIKE = 0.95  # cosine of the angle between an edge and the axis that is estimated from it
HINGE = 0.05  # m between the axes of what turns about one hinge

Support = tuple[Float[np.ndarray, "support 3"], Float[np.ndarray, "support 3"]]


@dataclasses.dataclass(eq=False)
class Part:
    """A part, what carries it (-1: what stands still), and its joint as it was described.

    All parts are described in one configuration, in which every joint is at zero: the one in which
    each was found. `positions` has one for each look.
    """

    parent: int
    estimate: Estimate
    positions: list[float]
    seen: dict[int, np.ndarray]  # by look: which of its points
    ways: list[tuple[int, np.ndarray]]  # a look before, and a hand's way in the world after it
    support: Support  # points and normals, as described
    provisional: bool = False  # found by the ends of one way, on a carrier that moved as well
    edge: Screw | None = None  # that its hinge was taken to be at, as its joint is described

    @property
    def screw(self) -> Screw:
        """Its joint."""
        return self.estimate.screw

    @property
    def shown(self) -> int:
        """A look that shows it: the one before a hand took it first, or that with most of it."""
        if self.ways:
            return self.ways[0][0]
        return max(self.seen, key=lambda look: len(self.seen[look]))

    @property
    def longest_way(self) -> float:
        """How far a hand has taken it at most, m."""
        return max((float(np.linalg.norm(way[-1] - way[0])) for _, way in self.ways), default=0.0)

    @property
    def range(self) -> tuple[float, float]:
        """The least and the greatest position that was seen."""
        return min(self.positions), max(self.positions)

    def looks_that_describe(self, fewest: int) -> list[int]:
        """The look that shows most of it, and those at both ends of its range, which may show its
        other side; of those that show at least `fewest` of its points, and enough beside the most.
        """
        most = max(map(len, self.seen.values()), default=0)
        share = SHARES[0 if self.estimate.intervals[0] < KNOWN else 1]
        shown = [one for one, own in self.seen.items() if len(own) >= max(fewest, share * most)]
        if not shown:
            return []
        at = self.positions
        ends = min(shown, key=lambda look: at[look]), max(shown, key=lambda look: at[look])
        return sorted({max(shown, key=lambda look: len(self.seen[look])), *ends})

    def settle(self, estimate: Estimate) -> None:
        """Take an estimate of its joint, and of where it was in each look."""
        self.estimate = estimate
        self.positions = [float(one) for one in estimate.positions]

    def positions_of(self, screw: Screw) -> list[float]:
        """Where another joint has to be for the part to be where it was, in each look."""
        place = self.support[0].mean(axis=0)
        was = np.array([self.screw.pose(one).at(place[None])[0] for one in self.positions])
        return screw.position_of(place, was).tolist()


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A part that is not among the others yet: how it has moved from one look to another."""

    motion: Pose
    first: int
    second: int

    def between(self, look: int) -> tuple[int, Pose]:
        """The other of the two looks, and how the part has moved from this one to it."""
        if look == self.first:
            return self.second, self.motion
        return self.first, self.motion.inverse


def support_of(
    clouds: Sequence[Cloud], masks: Sequence[Int[np.ndarray, " _"]], poses: Sequence[Pose]
) -> Support:
    """Points and normals of a part in several looks, which may show two sides of it, each moved."""
    found = []
    for cloud, mask, pose in zip(clouds, masks, poses, strict=True):
        chosen = mask[:: max(1, len(mask) // SUPPORT)]
        found.append((pose.at(cloud.points[chosen]), pose.turned(cloud.normals[chosen])))
    points, normals = zip(*found, strict=True)
    return np.concatenate(points), np.concatenate(normals)


def is_same_hinge(hinge: Screw, other: Screw, turned: float = 0.0, aside: float = 0.0) -> bool:
    """Whether another joint turns about the same line as a hinge, as well as edges are known, or
    less well by as much as the other is `turned` (deg) and `aside` (m)."""
    angle, away = other.distance_to(hinge)
    alike = angle < min(np.degrees(np.arccos(LIKE)) + turned, UNSURE)
    return other.joint == "revolute" and bool(alike and away < HINGE + aside)
