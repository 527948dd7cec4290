"""Whether robot and object get along a motion without coming too near to anything else."""

import math
from dataclasses import dataclass

import numpy as np
import shapely

from palpate.planning.movable_obstacles.geometry import placed, polygons
from palpate.planning.movable_obstacles.occupancy import Space

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
    _near: dict[tuple[int, int], float]

    @staticmethod
    def at_start(space: Space, name: str, step: float) -> "Clearance":
        """For the object where it stands in `space`."""
        margin = math.hypot(space.map.margin, step / 2)
        near: dict[tuple[int, int], float] = {}
        polygon = space.movables[name].polygon
        for kind, tree in enumerate((space.wall_tree, space.movable_tree)):
            for index in tree.query(polygon, predicate="dwithin", distance=margin):
                near[kind, int(index)] = float(shapely.distance(tree.geometries[index], polygon))
        return Clearance(space, name, step, near)

    def steps(self, object_poses: np.ndarray, robot_poses: np.ndarray) -> int:
        """How many of the steps (steps, 3) are possible before the first that is not."""
        bad = self._robot_hits(robot_poses[:, :2]) | self._object_hits(object_poses)
        return int(np.argmax(bad)) if bad.any() else len(bad)

    def _robot_hits(self, places: np.ndarray) -> np.ndarray:
        world = self.space.map
        left, bottom, right, top = world.bounds
        radius = world.robot.radius
        x, y = places.T
        hit = (
            (x < left + radius) | (x > right - radius) | (y < bottom + radius) | (y > top - radius)
        )
        points = shapely.points(places)
        gap = math.hypot(world.clearance, self.step / 2)
        which, _ = self.space.wall_tree.query(points, predicate="dwithin", distance=gap)
        hit[which] = True
        which, others = self.space.movable_tree.query(points, predicate="dwithin", distance=gap)
        hit[which[others != self.space.names.index(self.name)]] = True
        return hit

    def _object_hits(self, poses: np.ndarray) -> np.ndarray:
        world = self.space.map
        corners = placed(self.space.movables[self.name].outline, poses)
        left, bottom, right, top = world.bounds
        x, y = corners[..., 0], corners[..., 1]
        hit = np.asarray(((x < left) | (x > right) | (y < bottom) | (y > top)).any(axis=1))
        bodies = polygons(corners)
        margin = math.hypot(world.margin, self.step / 2)
        own = self.space.names.index(self.name)
        for kind, tree in enumerate((self.space.wall_tree, self.space.movable_tree)):
            which, others = tree.query(bodies, predicate="dwithin", distance=margin)
            if kind == 1:
                which, others = which[others != own], others[others != own]
            gaps = np.array([self._near.get((kind, int(index)), math.inf) for index in others])
            hit[which[gaps == math.inf]] = True
            close = np.flatnonzero(gaps < math.inf)
            if len(close):
                near, obstacles = bodies[which[close]], tree.geometries[others[close]]
                touching = gaps[close] < TOUCHING
                nearer = shapely.distance(near, obstacles) < gaps[close] - 1e-6
                if touching.any():
                    shrunk = shapely.buffer(near[touching], -SHRUNK)
                    nearer[touching] = shapely.intersects(shrunk, obstacles[touching])
                hit[which[close][nearer]] = True
        return hit
