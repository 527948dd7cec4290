"""The map a robot plans on: walls, what can be moved, the robot itself, where from and where to.

Lengths in metres, angles in radians, x to the right and y up. Beyond `bounds` nothing is known, and
so nothing goes there.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from palpate.errors import PalpateError, list_names, quote
from palpate.numerics.polygons import (
    LARGEST,
    centre_polygon,
    check_polygon,
    check_pose,
    circumscribed_radius,
    edges_of,
    place_points,
)

Pose = tuple[float, float, float]
DRIVES = ("differential", "holonomic")
MOST_CELLS = 4_000_000
MOST_MOVABLES = 2_000
LEAST_CELL, LARGEST_CELL = 1e-4, 100.0  # m


@dataclass(frozen=True, eq=False)
class Movable:
    """Something that may be moved: `outline` (points, 2) about its centroid, and its pose.

    `hints` are what a side-car file says of its dynamics, for whoever simulates it; planning reads
    none of them.
    """

    name: str
    outline: np.ndarray
    pose: Pose
    hints: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def from_corners(
        name: str, corners: object, hints: Mapping[str, Any] | None = None
    ) -> "Movable":
        """From corners in the world; theta counts from how it stands there.

        Raises `PalpateError` as `check_polygon`.
        """
        outline, (x, y) = centre_polygon(check_polygon(corners, f"movable {quote(name)}"))
        return Movable(name, outline, (x, y, 0.0), dict(hints or {}))

    @cached_property
    def polygon(self) -> Polygon:
        """Where it stands."""
        return Polygon(place_points(self.outline, self.pose))

    @cached_property
    def radius(self) -> float:
        """Of the disc about its centroid that holds it, m."""
        return circumscribed_radius(self.outline)

    def moved(self, pose: Pose | np.ndarray) -> "Movable":
        """The same at another pose."""
        return dataclasses.replace(self, pose=as_pose(pose))


@dataclass(frozen=True, eq=False)
class Robot:
    """A base that is planned for as the disc that holds it.

    `radius` in m. `drive` is "differential" (drives where it looks, turns in place) or
    "holonomic". It holds an object with `reach` m between the disc and the face it holds; None
    is the map's margin. With `push_only` it cannot hold on: it moves objects before it, straight
    ahead. `outline` is for pictures.
    """

    radius: float
    drive: str = "differential"
    reach: float | None = None
    outline: np.ndarray | None = field(default=None, repr=False)
    push_only: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.radius) and 0 < self.radius < 1e3):
            raise PalpateError(f"the robot's radius is {self.radius}: expected metres above 0")
        if self.drive not in DRIVES:
            raise PalpateError(
                f"the robot's drive is {quote(self.drive)}: expected one of {', '.join(DRIVES)}"
            )
        if self.reach is not None and not 0 <= self.reach < 1e3:
            raise PalpateError(f"the robot's reach is {self.reach}: expected metres, 0 or more")


@dataclass(frozen=True, eq=False)
class Map:
    """What is known before planning.

    `walls` is a shapely geometry of polygons; `bounds` is (left, bottom, right, top); `margin`
    is the clearance in m that robot and carried objects keep; `cell_size` in m is that of the
    search grid. `goals` are poses in order of preference of the file: the first is the default.

    Raises `PalpateError` for sizes that are no sizes, a grid of more than 4 million cells, more
    than 2,000 movables, and a movable that is wider or higher than the map.
    """

    name: str
    walls: BaseGeometry
    movables: Mapping[str, Movable]
    robot: Robot
    start: Pose
    goals: tuple[Pose, ...]
    bounds: tuple[float, float, float, float]
    cell_size: float
    margin: float

    def __post_init__(self) -> None:
        left, bottom, right, top = self.bounds
        width, height = right - left, top - bottom
        here = f"map {quote(self.name)}"
        if not all(abs(side) <= LARGEST for side in self.bounds) or width <= 0 or height <= 0:
            raise PalpateError(
                f"{here} has the bounds {self.bounds}: expected left, bottom, right, top in m, "
                "within 100 km, with left below right and bottom below top"
            )
        if not LEAST_CELL <= self.cell_size <= LARGEST_CELL:
            raise PalpateError(
                f"{here} has cells of {self.cell_size} m: expected a size of {LEAST_CELL:g} to "
                f"{LARGEST_CELL:g} m"
            )
        if not 0 <= self.margin < 1e3:
            raise PalpateError(
                f"{here} has a collision margin of {self.margin} m: expected 0 or more"
            )
        cells = width * height / self.cell_size**2
        if cells > MOST_CELLS:
            least = math.sqrt(width * height / MOST_CELLS)
            raise PalpateError(
                f"{here} of {width:.4g} m x {height:.4g} m has {cells:.3g} cells of "
                f"{self.cell_size:.3g} m: expected at most {MOST_CELLS:,}, that is cells of "
                f"{least:.2g} m or more"
            )
        if len(self.movables) > MOST_MOVABLES:
            raise PalpateError(
                f"{here} has {len(self.movables)} movables: expected at most {MOST_MOVABLES}"
            )
        for movable in self.movables.values():
            if 2 * movable.radius <= min(width, height):
                continue  # it fits however it is turned
            x_least, y_least, x_most, y_most = movable.polygon.bounds
            if x_most - x_least > width or y_most - y_least > height:
                raise PalpateError(
                    f"movable {quote(movable.name)} takes {x_most - x_least:.4g} m x "
                    f"{y_most - y_least:.4g} m where it stands, more than {here} of {width:.4g} m "
                    f"x {height:.4g} m has: expected one that fits, with its corners in m"
                )

    @cached_property
    def wall_edges(self) -> np.ndarray:
        """Every edge of a wall, as shapely lines."""
        return edges_of(self.walls)

    @property
    def clearance(self) -> float:
        """From the robot's centre to anything, m."""
        return self.robot.radius + self.margin

    @property
    def reach(self) -> float:
        """From the robot's disc to the face it holds, m."""
        return self.margin if self.robot.reach is None else self.robot.reach

    def moved(self, poses: Mapping[str, Pose | np.ndarray], start: Pose | None = None) -> "Map":
        """The same with objects, and if given the robot, elsewhere.

        Raises `PalpateError` for a name that is not on the map.
        """
        self.check_names(poses)
        movables = {
            name: movable.moved(poses[name]) if name in poses else movable
            for name, movable in self.movables.items()
        }
        changed = dataclasses.replace(self, movables=movables, start=start or self.start)
        if "wall_edges" in self.__dict__:  # walls stay where they are
            changed.__dict__["wall_edges"] = self.wall_edges
        return changed

    def check_names(self, names: Iterable[str]) -> None:
        """Raises `PalpateError` for a name that is not on the map."""
        unknown = sorted(set(names) - set(self.movables))
        if unknown:
            raise PalpateError(
                f"map {quote(self.name)} has no movable {quote(unknown[0])}; there are: "
                + list_names(map(quote, self.movables), 8)
            )

    @property
    def finer(self) -> "Map | None":
        """The same in cells of half the size; None where there would be too many or too small."""
        try:
            return dataclasses.replace(self, cell_size=self.cell_size / 2)
        except PalpateError:
            return None

    def check(self, goal: Pose | None = None) -> Pose:
        """The goal pose to plan to, after a look at whether it and the start are possible at all.

        Raises `PalpateError` where there is no goal, or the robot would stand in a wall or outside
        at its start or at the goal, or in an object at its start.
        """
        if goal is None:
            if not self.goals:
                raise PalpateError(
                    f"map {quote(self.name)} has no goal: give one as --goal x y theta, in m and "
                    "rad"
                )
            goal = self.goals[0]
        goal = check_pose(goal, "the goal")
        radius = self.robot.radius
        for place, pose in (("start", self.start), ("goal", goal)):
            x, y = pose[:2]
            left, bottom, right, top = self.bounds
            inside = min(x - left, right - x, y - bottom, top - y)
            if inside < radius:
                raise PalpateError(
                    f"the robot of radius {radius:.3g} m would not be inside map "
                    f"{quote(self.name)} at its {place} ({x:.3g}, {y:.3g}): expected a place at "
                    f"least that far inside x {left:.3g} to {right:.3g}, y {bottom:.3g} to "
                    f"{top:.3g}"
                )
            to_wall = shapely.distance(self.walls, shapely.Point(x, y))
            if to_wall < radius:  # NaN where there are no walls
                raise PalpateError(
                    f"the {place} ({x:.3g}, {y:.3g}) is in a wall or nearer to it than the robot's "
                    f"radius {radius:.3g} m ({to_wall:.3g} m): expected a free place"
                )
        for movable in self.movables.values():
            gap = movable.polygon.distance(shapely.Point(*self.start[:2]))
            if gap < radius - 1e-9:
                raise PalpateError(
                    f"the robot of radius {radius:.3g} m collides with {quote(movable.name)} "
                    f"at its start ({gap:.3g} m from its centre): expected a free start"
                )
        return goal


def as_pose(values: Iterable[Any]) -> Pose:
    """x, y, theta as floats."""
    x, y, theta = map(float, values)
    return x, y, theta


def map_of(
    name: str,
    *,
    walls: BaseGeometry,
    movables: list[Movable],
    robot: Robot,
    start: object,
    goals: list[Any],
    bounds: tuple[float, float, float, float],
    cell_size: float,
    margin: float | None = None,
) -> Map:
    """A `Map` from what a reader has found; the margin is the cell size if there is none.

    Raises `PalpateError` as `Map` does, and for two movables of one name.
    """
    named: dict[str, Movable] = {}
    for movable in movables:
        if movable.name in named:
            raise PalpateError(
                f"map {quote(name)} has two movables named {quote(movable.name)}: expected names "
                "that differ"
            )
        named[movable.name] = movable
    return Map(
        name,
        walls,
        named,
        robot,
        check_pose(start, "the robot's start"),
        tuple(check_pose(goal, "a goal") for goal in goals),
        bounds,
        cell_size,
        cell_size if margin is None else margin,
    )
