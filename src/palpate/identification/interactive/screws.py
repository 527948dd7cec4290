"""Motion of one joint, about a line or along one, and its fit to the way of a hand."""

import dataclasses
import functools
import math
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

Points = Float[np.ndarray, "n 3"]
FARTHEST = 3.0  # m from a hand's way to an axis: what turns about one further away slides
AXES, STEP = 4, 1e-5  # numbers of a screw, and of their differences that give slopes (rad, m)
TOUCH = 1e-3  # m, how well the way of a hand is known, offsets that stay apart


class Pose(NamedTuple):
    """x -> rotation x + origin."""

    rotation: Float[np.ndarray, "3 3"]
    origin: Float[np.ndarray, "3"]

    def __matmul__(self, other: "Pose") -> "Pose":
        """First the other, then this one."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.origin + self.origin)

    @property
    def inverse(self) -> "Pose":
        """The way back."""
        back = self.rotation.T
        return Pose(back, -back @ self.origin)

    def at(self, points: Points) -> Points:
        """Points, moved."""
        return points @ self.rotation.T + self.origin

    def turned(self, vectors: Points) -> Points:
        """Directions, moved."""
        return vectors @ self.rotation.T

    @property
    def chord(self) -> float:
        """How far (m) what is 1 m from the axis goes, straight: twice the sine of half its turn."""
        return float(np.linalg.norm(self.rotation - UNTURNED)) / math.sqrt(2.0)


UNTURNED = np.eye(3)
NOWHERE = Pose(UNTURNED, np.zeros(3))


@dataclasses.dataclass(frozen=True)
class Screw:
    """A joint: its kind, the direction of its axis (unit), and a point that it goes through (m)."""

    joint: Literal["revolute", "prismatic"]
    axis: Float[np.ndarray, "3"]
    point: Float[np.ndarray, "3"]

    def pose(self, position: float) -> Pose:
        """Of what it carries, at a position (rad or m) from where it was described (Rodrigues)."""
        if (known := self._poses.get(position)) is not None:
            return known
        if self.joint == "prismatic":
            found = Pose(UNTURNED, position * self.axis)
        else:
            rotation = rotation_about(self.axis, position)
            found = Pose(rotation, self.point - rotation @ self.point)
        self._poses[position] = found
        return found

    @functools.cached_property
    def _poses(self) -> dict[float, Pose]:
        """By position: where its parts are in each look is asked for again and again."""
        return {}

    @property
    def across(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Two unit vectors across its axis, right-handed with it."""
        return _frame(self.axis)

    def moved(self, pose: Pose) -> "Screw":
        """The same joint on what has moved."""
        return dataclasses.replace(
            self, axis=pose.rotation @ self.axis, point=pose.at(self.point[None])[0]
        )

    def position_of(self, start: Float[np.ndarray, "3"], points: Points) -> Float[np.ndarray, " n"]:
        """Where the joint is when a point that began at `start` is nearest to each of these."""
        if self.joint == "prismatic":
            return (points - start) @ self.axis
        first, second = _frame(self.axis)
        from_axis = start - self.point
        angle = math.atan2(float(from_axis @ second), float(from_axis @ first))
        away = points - self.point
        turned = np.arctan2(away @ second, away @ first) - angle
        return np.unwrap(np.concatenate([[0.0], (turned + np.pi) % (2.0 * np.pi) - np.pi]))[1:]

    def velocity(self, points: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape 3"]:
        """Of points that it carries, m/s, while the joint goes at 1 rad/s or m/s."""
        if self.joint == "prismatic":
            return np.broadcast_to(self.axis, points.shape)
        return (points - self.point) @ _cross_matrix(self.axis).T

    def strays(self, points: Points) -> Float[np.ndarray, "n 2"]:
        """How far (m) points of one way are from a circle about the axis, or a line along it."""
        first, second = _frame(self.axis)
        away = points - self.point
        if self.joint == "prismatic":
            across = np.stack([away @ first, away @ second], axis=1)
        else:
            radius = np.hypot(away @ first, away @ second)
            across = np.stack([radius, away @ self.axis], axis=1)
        return across - across.mean(axis=0)

    def varied(self, by: Float[np.ndarray, "4"]) -> "Screw":
        """With its axis turned by two small angles (rad), and moved aside by two lengths (m)."""
        first, second = _frame(self.axis)
        axis = self.axis + by[0] * first + by[1] * second
        point = self.point + by[2] * first + by[3] * second
        return dataclasses.replace(self, axis=axis / np.linalg.norm(axis), point=point)

    def distance_to(self, other: "Screw") -> tuple[float, float]:
        """Degrees between its axis and another one, whichever way they point, and how far (m) from
        its axis the other's point is."""
        sine = math.hypot(*cross(self.axis, other.axis))
        aside = math.hypot(*cross(self.axis, other.point - self.point))
        return math.degrees(math.asin(min(sine, 1.0))), aside

    def radii(self, points: Points) -> Float[np.ndarray, " n"]:
        """How far (m) points are from the line of its axis."""
        return np.linalg.norm((points - self.point) @ _cross_matrix(self.axis).T, axis=1)

    def is_beyond(
        self, points: Points, carried: Float[np.ndarray, "3"], carrier: Float[np.ndarray, "3"]
    ) -> Bool[np.ndarray, " n"]:
        """Which points are nearer to the half plane from its axis through a place of what it
        carries than to that through a place of the carrier."""
        ways = []
        for place in (carried, carrier):
            away = place - self.near(place).point
            ways.append(away / max(float(np.linalg.norm(away)), 1e-6))
        return (points - self.point) @ (ways[0] - ways[1]) > 0.0

    def is_far_from(self, points: Points) -> bool:
        """Whether it is a hinge so far from a way that what goes along that slides."""
        return self.joint == "revolute" and float(self.radii(points).mean()) > FARTHEST

    def near(self, place: Float[np.ndarray, "3"]) -> "Screw":
        """The same, with the point of its axis that is nearest to a place."""
        along = float((place - self.point) @ self.axis)
        return dataclasses.replace(self, point=self.point + along * self.axis)


def rotation_about(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """The rotation by an angle (rad) about a unit vector."""
    cross = _cross_matrix(axis)
    return UNTURNED + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def cross(one: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The cross product of two vectors, for which NumPy's takes seven times as long."""
    return _cross_matrix(one) @ other


def _frame(axis: Float[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across an axis, right-handed with it."""
    cross = _cross_matrix(axis)
    first = cross[:, np.argmin(np.abs(axis))]
    first = first / math.sqrt(float(first @ first))
    return first, cross @ first


def _cross_matrix(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Its product with a vector is the cross product."""
    x, y, z = axis.tolist()  # numbers of Python, from which NumPy makes an array sooner
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def screws_of_way(points: Points) -> list[Screw]:
    """The line and the circle that a hand's way follows, the likelier of the two first.

    Likelier by the Bayesian information criterion, the circle with three numbers more. Positive is
    the way that the hand went.
    """
    middle = points.mean(axis=0)
    _, _, directions = np.linalg.svd(points - middle, full_matrices=False)
    along = directions[0] * np.sign(directions[0] @ (points[-1] - points[0]))
    line = Screw("prismatic", along, middle)
    circle = _circle(points, middle, directions)
    if circle is None:
        return [line]
    misfits = [float(np.sum(np.square(one.strays(points)))) / TOUCH**2 for one in (line, circle)]
    # neighbouring moments have nearly the same error: a tenth of them count
    likelier = 0.1 * misfits[1] + 3.0 * math.log(0.1 * len(points) + 2.0) < 0.1 * misfits[0]
    return [circle, line] if likelier else [line, circle]


def _circle(points: Points, middle: np.ndarray, directions: np.ndarray) -> Screw | None:
    """Through a way: least squares of squared distances (Kasa 1976), then of distances."""
    flat = (points - middle) @ directions[:2].T
    matrix = np.column_stack([2.0 * flat, np.ones(len(flat))])
    found, *_ = np.linalg.lstsq(matrix, np.sum(flat**2, axis=1), rcond=None)
    centre, square = found[:2], found[2] + found[:2] @ found[:2]
    if not 0.0 < square < FARTHEST**2:
        return None
    screw = Screw(
        "revolute", np.cross(directions[0], directions[1]), middle + centre @ directions[:2]
    )
    for _ in range(8):
        base = screw.strays(points).ravel()
        steps = 1e-5 * np.eye(4)
        slopes = np.stack(
            [(screw.varied(s).strays(points).ravel() - base) / 1e-5 for s in steps], 1
        )
        change = np.linalg.lstsq(slopes, -base, rcond=1e-9)[0]
        size = max(
            1.0, float(np.abs(change[:2]).max() / 0.3), float(np.abs(change[2:]).max() / 0.3)
        )
        screw = screw.varied(change / size)
    if screw.is_far_from(points):
        return None
    end = screw.position_of(points[0], points[-1:])[0]
    return dataclasses.replace(screw, axis=screw.axis * np.sign(end)) if end else screw
