"""Whether the robot gets by once one object is put down somewhere else, and how far it then is."""

import math
from functools import cached_property

import numpy as np
import shapely
from scipy import ndimage

from palpate.numerics.polygons import place_points, polygons
from palpate.planning.movable_obstacles.maps.occupancy import Footprint, Space, Window
from palpate.planning.movable_obstacles.motion.manipulation import Motion
from palpate.planning.movable_obstacles.search.paths import distances
from palpate.planning.movable_obstacles.search.transfers import Move

_STRIDE = 4  # steps between looks whether the way is open
_EIGHT = np.ones((3, 3), int)


class Passage:
    """The way on to where a move leads, past its object wherever that is put.

    It is open when the robot, once it has let go, gets to `towards` without the objects in
    `ignored`, which are to be moved later, and the object stands outside `keep_out`.
    """

    def __init__(self, space: Space, window: Window, move: Move) -> None:
        name = move.name
        self._space, self._window, self._name = space, window, name
        self._keep_out, self._towards = move.keep_out, np.array(move.towards)
        self._ignored = set(move.ignored) - {name}
        self._passed = dict.fromkeys(self._ignored, 0.0)
        self._base = space.free_without({name, *move.ignored}, window)
        nearby = {**self._passed, name: 0.0}
        self._lengths = distances(space, window, self._towards, self._base, nearby).lengths
        self._movable = space.movables[name]
        self._footprint = Footprint(self._movable, space.inflation, space.cell)
        world = space.map
        self._held = {**self._passed, name: world.robot.radius + world.reach}

    def beyond(self, poses: np.ndarray) -> np.ndarray:
        """At least how far it is from robot poses (steps, 3) to the aim, with the object gone."""
        lengths = self._nearest
        down, right = self._window[0].start, self._window[1].start
        corner = self._space.origin + self._space.cell * np.array([right, down])
        place = (poses[:, :2] - corner) / self._space.cell
        known = np.all((place >= 0) & (place < lengths.shape[::-1]), axis=1)
        columns, rows = np.where(known[:, None], place, 0).astype(int).T
        return np.where(known, lengths[rows, columns], np.inf)

    def first_open(self, motion: Motion, limits: np.ndarray, begin: int, stop: int) -> int | None:
        """The first step from `begin` to `stop` at which the way is open, as far as looks show.

        Ways that are certainly longer than `limits` (steps,), m, are not looked for.
        """
        looks = np.arange(begin + _STRIDE - 1, stop, _STRIDE)
        if stop > begin and (not len(looks) or looks[-1] != stop - 1):
            looks = np.append(looks, stop - 1)
        open_at = self._first_opening(motion, limits, looks)
        if open_at is None:
            return None
        between = np.arange(max(begin, open_at - _STRIDE + 1), open_at)
        earlier = self._first_opening(motion, limits, between)
        return open_at if earlier is None else earlier

    def onward(self, object_pose: np.ndarray, robot_pose: np.ndarray, limit: float) -> float:
        """How far it is to the aim from where the robot lets go, m; infinite beyond `limit`.

        Only where a way of less than the limit could lead is looked.
        """
        space, window = self._space, self._window
        after = space.moved(self._name, object_pose)
        near = self._worth(robot_pose, limit)
        rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
        if not len(rows):
            return math.inf
        part = (
            slice(window[0].start + int(rows[0]), window[0].start + int(rows[-1]) + 1),
            slice(window[1].start + int(columns[0]), window[1].start + int(columns[-1]) + 1),
        )
        free = after.free_without(self._ignored, part)
        free &= near[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        ways = distances(after, part, robot_pose, free, self._held, standing=True, limit=limit)
        return ways.to(self._towards, self._passed)

    def _first_opening(self, motion: Motion, limits: np.ndarray, looks: np.ndarray) -> int | None:
        """The first of the steps `looks` at which free cells join the robot's place to the aim."""
        if not len(looks):
            return None
        poses = motion.object_poses[looks]
        x, y = self._towards
        blocked = self._footprint.at(poses, np.array([x]), np.array([y]))[:, 0, 0]
        if self._keep_out is not None:
            bodies = polygons(place_points(self._movable.outline, poses))
            blocked |= shapely.intersects(bodies, self._keep_out)
        looks, poses = looks[~blocked], poses[~blocked]
        if not len(looks):
            return None
        (left, bottom), (right, top) = poses[:, :2].min(axis=0), poses[:, :2].max(axis=0)
        grown = self._footprint.extent
        rows, columns = (
            slice(max(part.start, whole.start), max(min(part.stop, whole.stop), whole.start))
            for part, whole in zip(
                self._space.window_of(left - grown, bottom - grown, right + grown, top + grown),
                self._window,
                strict=True,
            )
        )
        covered = self._footprint.at(poses, self._space.xs[columns], self._space.ys[rows])
        local = (
            slice(rows.start - self._window[0].start, rows.stop - self._window[0].start),
            slice(columns.start - self._window[1].start, columns.stop - self._window[1].start),
        )
        aim = self._around(self._towards, 1)
        own = math.ceil(self._space.map.margin / self._space.cell) + 2
        for look, cover in zip(looks, covered, strict=True):
            robot = motion.robot_poses[look]
            # a look stands for the steps before it as well, of which some may be allowed more
            limit = float(limits[max(0, look - _STRIDE + 1) : look + 1].max())
            free = self._base & self._worth(robot, limit)
            free[local] &= ~cover
            labels, _ = ndimage.label(free, _EIGHT)
            beside = set(labels[self._around(robot, own)].ravel().tolist())
            if not beside.isdisjoint(labels[aim][labels[aim] > 0].tolist()):
                return int(look)
        return None

    def _worth(self, robot_pose: np.ndarray, limit: float) -> np.ndarray:
        """(rows, columns) of the window: where a way to the aim of less than `limit` m may lead."""
        x, y = robot_pose[:2]
        xs, ys = self._space.xs[self._window[1]], self._space.ys[self._window[0]]
        straight = np.sqrt((xs - x) ** 2 + ((ys - y) ** 2)[:, None])
        return self._nearest + straight <= limit + 2 * self._space.cell

    @cached_property
    def _nearest(self) -> np.ndarray:
        """Lengths to the aim from each cell, or from one beside it, at least."""
        around = 2 * self._space.cell * math.sqrt(2)
        return np.maximum(ndimage.minimum_filter(self._lengths, 3) * 0.92 - around, 0.0)

    def _around(self, point: np.ndarray, cells: int) -> Window:
        """The cells within so many of a place, as a window in this one."""
        row, column = self._space.cell_at(point)
        row, column = row - self._window[0].start, column - self._window[1].start
        height, width = self._base.shape
        return (
            slice(max(0, row - cells), max(0, min(height, row + cells + 1))),
            slice(max(0, column - cells), max(0, min(width, column + cells + 1))),
        )
