"""A move that the planner wants, and how the search below it would open the way."""

from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import LineString
from shapely.geometry.base import BaseGeometry

from palpate.numerics.polygons import place_points
from palpate.planning.movable_obstacles.maps.map import Movable
from palpate.planning.movable_obstacles.motion.manipulation import Grasp, Primitive


@dataclass(frozen=True)
class Move:
    """An object to be moved so that the robot gets on `towards` (2,); `ignored` are moved later.

    `beyond` (m) is the least length from the border to `towards`, which later actions count.
    `keep_out` is where the object must not be left, because another is to be carried through.
    """

    action: int
    name: str
    towards: tuple[float, float]
    ignored: frozenset[str]
    beyond: float
    keep_out: BaseGeometry | None = None


@dataclass(frozen=True)
class Carry:
    """One part of a transfer as simulated: poses (steps, 3), m and rad."""

    primitive: Primitive
    object_poses: np.ndarray
    robot_poses: np.ndarray


@dataclass(frozen=True)
class Opening:
    """How to open a way, and how sure that is.

    `probability` is the share of the belief's draws in which it succeeds, `cost` (m) the mean over
    these of driving to the grasp, handling, carrying and driving on to the goal of the search;
    `parts` are those of the first draw that succeeds. `energy` in J is the mean.
    """

    name: str
    grasp: Grasp
    way: np.ndarray  # (points, 2): to the grasp, m
    approach: float
    cost: float
    probability: float
    energy: float
    parts: tuple[Carry, ...]

    @property
    def robot_poses(self) -> np.ndarray:
        """(steps, 3) of all parts, from the grasp to where the robot lets go."""
        return np.vstack([p.robot_poses[k > 0 :] for k, p in enumerate(self.parts)])

    @property
    def object_poses(self) -> np.ndarray:
        """(steps, 3) of all parts, to where the object is left."""
        return np.vstack([p.object_poses[k > 0 :] for k, p in enumerate(self.parts)])

    def room(self, movable: Movable, radius: float, margin: float) -> BaseGeometry:
        """What robot and object pass over, and the margin (m) around it."""
        bodies = np.concatenate([place_points(movable.outline, p.object_poses) for p in self.parts])
        pairs = np.concatenate([bodies[:-1], bodies[1:]], axis=1)
        driven = np.concatenate([self.way, *(part.robot_poses[:, :2] for part in self.parts)])
        way = LineString(driven).buffer(radius + margin)
        hulls = shapely.convex_hull(np.asarray(shapely.multipoints(pairs), object))
        swept = shapely.union_all(hulls).buffer(margin)
        return swept.union(way)
