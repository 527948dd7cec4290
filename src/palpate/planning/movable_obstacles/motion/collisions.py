"""Whether robot and object get along a motion without coming too near to anything else."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import shapely

from palpate.numerics.polygons import place_points, polygons
from palpate.planning.movable_obstacles.maps.occupancy import Space

TOUCHING = 1e-3  # m: what is nearer at the start touches, and may slide along
SHRUNK = 2e-3  # m: by which a touching object has to come nearer to count as hitting


@dataclass(frozen=True)
class Clearance:
    """What an object that is about to be moved has to keep.

    From whatever is nearer than the margin where it stands, as much as there is; from everything
    else the margin, and a little more, so that it is kept between steps of `step` m as well.
    """

    space: Space
    name: str
    step: float
    _obstacles: shapely.STRtree  # walls' edges and all other objects
    _near: np.ndarray  # (obstacles,): m where it stands, infinite beyond the margin

    @staticmethod
    def at_start(space: Space, name: str, step: float) -> "Clearance":
        """For the object where it stands in `space`."""
        others = [movable.polygon for other, movable in space.movables.items() if other != name]
        obstacles = shapely.STRtree([*space.wall_tree.geometries, *others])
        return Clearance(space, name, step, obstacles, np.empty(0)).between(step)

    def between(self, step: float) -> "Clearance":
        """The same for steps of another length, m."""
        polygon = self.space.movables[self.name].polygon
        margin = math.hypot(self.space.map.margin, step / 2)
        near = np.full(len(self._obstacles), math.inf)
        found = self._obstacles.query(polygon, predicate="dwithin", distance=margin)
        near[found] = shapely.distance(self._obstacles.geometries[found], polygon)
        return dataclasses.replace(self, step=step, _near=near)

    def steps(self, object_poses: np.ndarray, robot_poses: np.ndarray) -> int:
        """How many of the steps (steps, 3) are possible before the first that is not."""
        bad = self.hits(object_poses, robot_poses)
        return int(np.argmax(bad)) if bad.any() else len(bad)

    def hits(self, object_poses: np.ndarray, robot_poses: np.ndarray) -> np.ndarray:
        """(steps,): which of the poses (steps, 3) of object and robot are not possible."""
        world, count = self.space.map, len(robot_poses)
        corners = place_points(self.space.movables[self.name].outline, object_poses)
        left, bottom, right, top = world.bounds
        lowest, highest = np.array([left, bottom]), np.array([right, top])
        places, radius = robot_poses[:, :2], world.robot.radius
        bad = np.any((places < lowest + radius) | (places > highest - radius), axis=1)
        bad |= np.any((corners < lowest) | (corners > highest), axis=(1, 2))
        bodies = polygons(corners)
        # one question of the tree for all: its price is per question, not per shape
        shapes = np.concatenate([np.asarray(shapely.points(places), object), bodies])
        gap, margin = (
            math.hypot(least, self.step / 2) for least in (world.clearance, world.margin)
        )
        distance = np.repeat([gap, margin], count)
        which, others = self._obstacles.query(shapes, predicate="dwithin", distance=distance)
        gaps = np.where(which < count, math.inf, self._near[others])
        which = which % count
        bad[which[gaps == math.inf]] = True
        close = gaps < math.inf
        if close.any():
            which, gaps = which[close], gaps[close]
            others = self._obstacles.geometries[others[close]]
            touching = gaps < TOUCHING
            nearer = shapely.distance(bodies[which], others) < gaps - 1e-6
            if touching.any():
                shrunk = shapely.buffer(bodies[which[touching]], -SHRUNK)
                nearer[touching] = shapely.intersects(shrunk, others[touching])
            bad[which[nearer]] = True
        return bad
