"""A joint from everything that was seen of its part: Gauss-Newton over all looks at once.

Points of the part in one look, moved by the joint, have to be on its surface in another (point to
plane, with the mean of both normals: Rusinkiewicz 2019, ACM TOG 38:4), and each way of a hand on it
on one circle or line. Far outliers have no say (Tukey's biweight). What is flat and turns has its
hinge in its plane.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from palpate.identification.interactive.screws import AXES, STEP, Pose, Screw
from palpate.identification.interactive.ways import Way, is_of_two_ends, travel_deviation, whiten
from palpate.perception.clouds import Cloud

ALIKE = 0.8  # cosine of the angle between normals of the same surface
CUTOFF = 4.685  # standard deviations: Tukey's biweight, 95 % as efficient as least squares
PATCH = 0.08  # m: the errors of points so near each other are not independent
MODEL_ERROR = 1e-3  # m: of surfaces that are no planes, and of their normals
POINTS = 700  # of a pair of looks
PAIRS = 14
# What errors of labels add, as factors of standard deviations of directions and places: from the
# errors of parts of thirty appliances of seeds 600000 to 600004, which no figure is measured on.
INFLATION = 2.5, 2.5, 5.0, 5.0
REFUTED = 4.0  # 90 % intervals from a joint: what is further away is another one
FEWEST = 20  # points that say anything
LEAST = 1e-3  # rad or m between two places
ROUNDS, COARSE = 8, 3  # of Gauss-Newton, and those first ones that look further
SETTLED = 1e-4  # rad and m by which a round changes a joint that needs no more of them
SURPRISE = 1.0  # of a hand's way, for the joint that it moves: twice what is usual
NEAR = 0.025, 0.05  # m beside noise, from a point to its surface: late and early
FLAT, IS_FLAT = 0.015, 0.8  # m beside noise from a plane, and share of points: of what is flat
# rad and m that a hinge is off the edge that was taken for it: less, until a hand has felt it, as
# looks that show its part from two sides pull it further away
AT_EDGE, FELT_AT_EDGE = (math.radians(1.0), 0.005), (math.radians(3.0), 0.015)
OUT_OF_PLANE = math.radians(2.0), 0.03  # rad and m that the hinge of a board is out of its plane


@dataclasses.dataclass(frozen=True, eq=False)
class Sighting:
    """Points of a part in one look, as if what carries it had not moved since it was described."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    deviation: Float[np.ndarray, " n"]
    tree: cKDTree


@dataclasses.dataclass(frozen=True, eq=False)
class Estimate:
    """A joint, its position in each look, and how far to trust it.

    `covariance` is of the screw's four numbers (`Screw.varied`) at its point; `misfit` is twice the
    negative logarithm of the likelihood, less that of points which meet nothing, and `independent`
    how many observations it stands on.
    """

    screw: Screw
    positions: Float[np.ndarray, " looks"]
    covariance: Float[np.ndarray, "4 4"]
    misfit: float
    independent: float

    @property
    def criterion(self) -> float:
        """Of Bayesian information, less what is the same for both kinds of joint."""
        numbers = 4.0 if self.screw.joint == "revolute" else 2.0
        return self.misfit + numbers * math.log(max(self.independent, 2.0))

    @property
    def intervals(self) -> tuple[float, float]:
        """Half-widths of 90 % intervals, the wider of two: of the direction, deg, and place, m."""
        wide = 1.645 * np.sqrt(np.diag(self.covariance))
        return float(np.degrees(wide[:2].max())), float(wide[2:].max())

    def refutes(self, screw: Screw) -> bool:
        """Whether a joint of its kind is too far away to be the same; of another it cannot say."""
        if screw.joint != self.screw.joint:
            return False
        turned, aside = self.screw.distance_to(screw)
        most, away = REFUTED * np.array(self.intervals)
        return bool(turned > most or (aside > away and screw.joint == "revolute"))


def sighting(cloud: Cloud, chosen: Int[np.ndarray, " n"], back: Pose) -> Sighting:
    """Points of a look, moved `back` to where their carrier was when it was described."""
    moved = back.at(cloud.points[chosen])
    normals = back.turned(cloud.normals[chosen])
    return Sighting(moved, normals, cloud.deviation[chosen], cKDTree(moved))


def refine(
    screw: Screw,
    positions: Float[np.ndarray, " looks"],
    seen: Sequence[Sighting | None],
    ways: Sequence[Way],
    edge: Screw | None = None,
) -> Estimate:
    """The joint that explains what was seen of its part, from a first guess, and with its hinge
    about at an `edge` where one was seen.

    Looks in which a part was not seen have None, and keep their position unless a hand began or
    ended there. The position in the look before the first way stays as it is, or if the part was
    not seen there, in the first look with it: it says where the joint's zero is. Looks that show it
    at one place move together.
    """
    alike = _alike(positions, seen, ways)
    pairs = _pairs(positions, list(dict.fromkeys(alike.values())))
    shown = sorted({look for pair in pairs for look in pair})
    random = np.random.default_rng(0)
    chosen = {look: _subset(seen[look], random) for look in shown}
    handled = {before + gone for before, _ in ways for gone in (0, 1)}
    used = [*shown, *sorted({alike.get(look, look) for look in handled} - set(shown))]
    if ways and (zero := alike.get(ways[0][0])) in shown:
        used.remove(zero)
        used.insert(0, zero)
    felt = any(not is_of_two_ends(way) for _, way in ways)
    planes = [] if felt else [one for look in shown if (one := _plane_of(seen[look])) is not None]
    column = {look: AXES + number for number, look in enumerate(used[1:])}
    unknown = AXES + len(column)
    column |= {look: column[first] for look, first in alike.items() if first in column}
    middle = np.mean([way.mean(axis=0) for _, way in ways], axis=0) if ways else screw.point
    screw, positions = screw.near(middle), np.array(positions, float)
    # what nothing says anything of stays as it is; where a slide's axis is, nothing can say
    prior = np.full(unknown, 1e-2)
    prior[:2], prior[2:AXES] = 1.0, 1.0 if screw.joint == "revolute" else 1e6
    sums = _Sums(unknown)
    for number in range(ROUNDS):
        sums = _Sums(unknown)
        for pair in pairs:
            _add_pair(sums, screw, positions, pair, seen, chosen, column, NEAR[number < COARSE])
        _add_planes(sums, screw, planes)
        if edge is not None and screw.joint == "revolute":
            _add_edge(sums, screw, edge, FELT_AT_EDGE if felt else AT_EDGE)
        for before, way in ways:
            _add_way(sums, screw, way)
            _add_travel(sums, screw, positions, column, before, way)
        change = -np.linalg.solve(sums.information + np.diag(prior), sums.slope)
        change[:2] = np.clip(change[:2], -0.3, 0.3)
        change[2:AXES] = np.clip(change[2:AXES], -0.2, 0.2)
        screw = screw.varied(change[:AXES]).near(middle)
        for look, place in column.items():
            positions[look] += np.clip(change[place], -0.3, 0.3)
        if number > COARSE and np.abs(change[:AXES]).max() < SETTLED:
            break
    inverse = np.linalg.inv(sums.information + np.diag(prior))
    covariance = inverse @ (sums.scatter + np.diag(prior)) @ inverse
    covariance = covariance[:AXES, :AXES] * np.outer(INFLATION, INFLATION)
    return Estimate(screw, positions, covariance, sums.misfit, sums.independent)


class _Sums:
    """The normal equations, the scatter of patches that errors are estimated from, the misfit."""

    def __init__(self, unknown: int) -> None:
        self.information, self.scatter = np.zeros((2, unknown, unknown))
        self.slope = np.zeros(unknown)
        self.misfit = self.independent = 0.0

    def add(
        self,
        rows: np.ndarray,
        standard: np.ndarray,
        weight: np.ndarray | None = None,
        patches: Int[np.ndarray, " n"] | None = None,
        columns: list[int] | None = None,
    ) -> None:
        """Rows of slopes and residuals, whitened, with the weights of robust least squares, and
        errors that are alike within `patches`, by default independent. The rows have the slopes of
        some `columns`, by default of all.
        """
        columns = list(range(len(self.slope))) if columns is None else columns
        weighted = rows if weight is None else weight[:, None] * rows
        own = np.ix_(columns, columns)
        self.information[own] += rows.T @ weighted
        self.slope[columns] += standard @ weighted
        if patches is not None:
            each = (weighted * standard[:, None]).T
            rows = np.stack([np.bincount(patches, one) for one in each], axis=1)
        self.scatter[own] += rows.T @ rows


def _add_pair(
    sums: _Sums,
    screw: Screw,
    positions: Float[np.ndarray, " looks"],
    pair: tuple[int, int],
    seen: Sequence[Sighting | None],
    chosen: dict[int, np.ndarray],
    column: dict[int, int],
    near: float,
) -> None:
    """Points of one look against the surface in another."""
    first, second = pair
    one, other, own = seen[first], seen[second], chosen[first]
    assert one is not None  # by `_pairs`
    assert other is not None
    turn = positions[second] - positions[first]
    pose = screw.pose(turn)
    source, turned = pose.at(one.points[own]), pose.turned(one.normals[own])
    reach = near + 3.0 * float(np.median(other.deviation))
    distance, index = other.tree.query(source, distance_upper_bound=reach)
    met = np.isfinite(distance)
    index = np.where(met, index, 0)
    met &= np.vecdot(other.normals[index], turned) > ALIKE
    if met.sum() < FEWEST:
        return
    start, source, index = one.points[own][met], source[met], index[met]
    normal = turned[met] + other.normals[index]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    deviation = one.deviation[own][met] ** 2 + other.deviation[index] ** 2 + MODEL_ERROR**2
    scale = np.sqrt(deviation)
    standard = np.vecdot(normal, source - other.points[index]) / scale
    slopes = [
        np.vecdot(normal, screw.varied(STEP * one).pose(turn).at(start) - source) / STEP
        for one in np.eye(AXES)
    ]
    along, columns = np.vecdot(normal, screw.velocity(source)), list(range(AXES))
    for look, sign in ((second, 1.0), (first, -1.0)):
        if look in column:
            slopes.append(sign * along)
            columns.append(column[look])
    rows = np.stack(slopes, axis=1) / scale[:, None]
    weight = np.clip(1.0 - (standard / CUTOFF) ** 2, 0.0, None) ** 2
    patches = patches_of(source)
    sums.add(rows, standard, weight, patches, columns)
    count = int(patches.max()) + 1
    sums.misfit += count / len(source) * float(np.sum(_biweight(standard)))
    sums.independent += count


def _plane_of(seen: Sighting | None) -> tuple[np.ndarray, np.ndarray] | None:
    """The normal of what was seen of a part, and a place on it; None if that is not flat."""
    assert seen is not None  # by `_pairs`
    normal = np.linalg.eigh(seen.normals.T @ seen.normals)[1][:, -1]
    height = seen.points @ normal
    middle = float(np.median(height))
    on = np.abs(height - middle) < FLAT + 3.0 * seen.deviation
    on &= np.abs(seen.normals @ normal) > ALIKE
    return (normal, middle * normal) if on.mean() > IS_FLAT else None


def _add_planes(sums: _Sums, screw: Screw, planes: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """A board that turns has its hinge in its plane, wherever it is: looks alone leave open how far
    the axis is turned in that. A hand that has held it says so better."""
    if screw.joint == "prismatic" or not planes:
        return
    normals, places = map(np.array, zip(*planes, strict=True))
    scale = math.sqrt(len(planes)) * np.repeat(OUT_OF_PLANE, len(planes))  # one error for all looks

    def errors(screw: Screw) -> Float[np.ndarray, " n"]:
        aside = np.vecdot(normals, screw.point - places)
        return np.concatenate([normals @ screw.axis, aside]) / scale

    standard = errors(screw)
    rows = np.zeros((len(standard), len(sums.slope)))
    for axis, one in enumerate(np.eye(AXES)):
        rows[:, axis] = (errors(screw.varied(STEP * one)) - standard) / STEP
    sums.add(rows, standard)


def _add_edge(sums: _Sums, screw: Screw, edge: Screw, off: tuple[float, float]) -> None:
    """A hinge is at an edge that was seen, about: what looks and ways say more exactly wins."""

    def errors(screw: Screw) -> Float[np.ndarray, "4"]:
        across, near = np.array(edge.across), screw.near(edge.point)
        return np.concatenate([across @ screw.axis, across @ (near.point - edge.point)]) / scale

    scale = np.repeat(off, 2)
    standard = errors(screw)
    rows = np.zeros((len(standard), len(sums.slope)))
    for axis, one in enumerate(np.eye(AXES)):
        rows[:, axis] = (errors(screw.varied(STEP * one)) - standard) / STEP
    sums.add(rows, standard)


def _add_way(sums: _Sums, screw: Screw, way: Float[np.ndarray, "times 3"]) -> None:
    """The way of a hand, whose errors are whitened: there the information is the scatter."""
    slopes, standard = whiten(screw, way)
    rows = np.zeros((len(standard), len(sums.slope)))
    rows[:, :AXES] = slopes
    sums.add(rows, standard)
    sums.misfit += float(standard @ standard)
    sums.independent += len(standard)


def _add_travel(
    sums: _Sums,
    screw: Screw,
    positions: Float[np.ndarray, " looks"],
    column: dict[int, int],
    before: int,
    way: Float[np.ndarray, "times 3"],
) -> None:
    """How far a hand took the part: of a sheet that slides in its plane no cloud says it."""
    rows, start = np.zeros((1, len(sums.slope))), way[:3].mean(axis=0)
    gone = positions[before + 1] - positions[before]
    scale = travel_deviation(way)

    def error(screw: Screw) -> float:
        went = float(screw.position_of(start, way)[-3:].mean())
        return (gone - went) * float(np.linalg.norm(screw.velocity(start))) / scale

    for look, sign in ((before + 1, 1.0), (before, -1.0)):
        if look in column:
            rows[0, column[look]] = sign * float(np.linalg.norm(screw.velocity(start))) / scale
    if not rows.any():
        return
    standard = np.array([error(screw)])
    for axis, one in enumerate(np.eye(AXES)):
        rows[0, axis] = (error(screw.varied(STEP * one)) - standard[0]) / STEP
    sums.add(rows, standard)


def surprise(estimate: Estimate, way: Float[np.ndarray, "times 3"]) -> float:
    """How far a way is from one that a joint allows, as far as that is known: about 1 of its own.

    The squared Mahalanobis distance of its errors, for each of them: those of the hand, and what
    the covariance of the joint leaves open.
    """
    slopes, standard = whiten(estimate.screw, way)
    known = np.linalg.inv(estimate.covariance + 1e-10 * np.eye(AXES))
    left = slopes.T @ standard
    explained = left @ np.linalg.solve(known + slopes.T @ slopes, left)
    return float((standard @ standard - explained) / len(standard))


def _alike(
    positions: Float[np.ndarray, " looks"], seen: Sequence[Sighting | None], ways: Sequence[Way]
) -> dict[int, int]:
    """For each look that shows a part, the look that stands for all with it at the same place.

    Positions (rad or m) up to `LEAST` from each other are one place. Before and after a hand took
    the part they are never one: the look after is left out then, as only the hand says how far.
    """
    known = [look for look, one in enumerate(seen) if one is not None and len(one.points) >= FEWEST]
    found: dict[int, int] = {}
    first = -1
    for look in sorted(known, key=lambda look: positions[look]):
        if first < 0 or positions[look] - positions[first] > LEAST:
            first = look
        found[look] = first
    for before, _ in ways:
        if before in found and found.get(before + 1) == found[before]:
            first = found.pop(before + 1)
            if first == before + 1:
                found = {look: before if one == first else one for look, one in found.items()}
    return found


def _pairs(positions: Float[np.ndarray, " looks"], distinct: list[int]) -> list[tuple[int, int]]:
    """Looks to compare: neighbours among those in which a part is at different places."""
    distinct = sorted(distinct, key=lambda look: positions[look])
    found = [*itertools.pairwise(distinct), *zip(distinct, distinct[2:], strict=False)]
    if len(distinct) > 3:
        found.append((distinct[0], distinct[-1]))
    return found[:PAIRS]


def _subset(seen: Sighting | None, random: np.random.Generator) -> Int[np.ndarray, " n"]:
    assert seen is not None
    count = len(seen.points)
    return np.sort(random.choice(count, min(count, POINTS), replace=False))


def patches_of(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """The number of the cube of `PATCH` m that each point is in."""
    place = np.floor(points / PATCH).astype(int)
    place -= place.min(axis=0)
    _, wide, high = place.max(axis=0) + 1
    # one number for each cube: rows take five times as long to tell from each other
    cube = (place[:, 0] * wide + place[:, 1]) * high + place[:, 2]
    return np.unique(cube, return_inverse=True)[1]


def nearness(cloud: Cloud, other: Cloud, motion: Pose) -> Float[np.ndarray, " points"]:
    """How near the surface of another look each point of a look is, once it has moved (logarithm of
    Tukey's likelihood, over that of what is far away or meets nothing)."""
    moved = motion.at(cloud.points)
    reach = NEAR[0] + 3.0 * other.error
    distance, index = other.tree.query(moved, distance_upper_bound=reach)
    met = np.isfinite(distance)
    index = np.where(met, index, 0)
    away = np.vecdot(other.normals[index], moved - other.points[index])
    scale = np.sqrt(cloud.deviation**2 + other.deviation[index] ** 2 + MODEL_ERROR**2)
    return np.where(met, -0.5 * _biweight(away / scale), 0.0)


def _biweight(standard: np.ndarray) -> np.ndarray:
    """Twice the loss of Tukey's biweight, less that of what is far away, or meets nothing."""
    return -(CUTOFF**2) / 3.0 * np.clip(1.0 - (standard / CUTOFF) ** 2, 0.0, None) ** 3
