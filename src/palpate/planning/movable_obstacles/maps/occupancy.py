"""Where the robot's centre may be: a grid of cells, and what covers each of them.

A cell is free when its centre is at least the clearance away from everything, and a little more
(`sqrt(clearance^2 + cell^2 / 2)`), so that the straight way between two free neighbours keeps the
clearance too, whatever sharp corner it passes.
"""

import copy
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from palpate.numerics.polygons import edges_of
from palpate.planning.movable_obstacles.maps.map import Map, Movable, Pose

_ARC = 8  # chords of a buffer's quarter circle
_OUTSIDE = 1 / math.cos(math.pi / (4 * _ARC))  # so that the chords lie outside the circle
Window = tuple[slice, slice]


@dataclass(frozen=True)
class Cover:
    """The cells that one object keeps the robot's centre out of: a window and a mask in it."""

    window: Window
    mask: np.ndarray


class Space:
    """The map's cells for one arrangement of the objects.

    `static` (rows, columns) is what walls and the border block; `count` how many objects cover a
    cell; row 0 is at the bottom. Objects in `fixed` count as walls.
    """

    def __init__(self, world: Map, fixed: Iterable[str] = ()) -> None:
        self.map = world
        self.cell = world.cell_size
        left, bottom, right, top = world.bounds
        self.shape = (
            max(1, math.ceil((top - bottom) / self.cell - 1e-9)),
            max(1, math.ceil((right - left) / self.cell - 1e-9)),
        )
        self.origin = np.array([left, bottom])
        self.xs = left + (np.arange(self.shape[1]) + 0.5) * self.cell
        self.ys = bottom + (np.arange(self.shape[0]) + 0.5) * self.cell
        self.inflation = math.hypot(world.clearance, self.cell / math.sqrt(2))
        fixed, self.movables = set(fixed), dict(world.movables)
        self.fixed = {name: self.movables.pop(name) for name in world.movables if name in fixed}
        walls = [world.walls, *(movable.polygon for movable in self.fixed.values())]
        edges = [edge for movable in self.fixed.values() for edge in edges_of(movable.polygon)]
        self.wall_tree = shapely.STRtree([*world.wall_edges, *edges])
        self.static = self._blocked_by(walls)
        self.count = np.zeros(self.shape, np.int16)
        self.covers: dict[str, Cover] = {}
        for name, movable in self.movables.items():
            self.covers[name] = cover = self.cover_of(movable)
            self.count[cover.window] += cover.mask
        self._tree: shapely.STRtree | None = None

    # --- arrangement --------------------------------------------------------------------------

    def moved(self, name: str, pose: Pose | np.ndarray) -> "Space":
        """The same with one object elsewhere."""
        after = copy.copy(self)
        movable = self.movables[name].moved(pose)
        after.movables = self.movables | {name: movable}
        old, new, after.count = self.covers[name], self.cover_of(movable), self.count.copy()
        after.count[old.window] -= old.mask
        after.count[new.window] += new.mask
        after.covers, after._tree = self.covers | {name: new}, None
        return after

    def without(self, names: Iterable[str]) -> "Space":
        """The same with some objects gone altogether."""
        after = copy.copy(self)
        after.movables, after.covers = dict(self.movables), dict(self.covers)
        after.count, after._tree = self.count.copy(), None
        for name in names:
            cover = after.covers.pop(name)
            after.count[cover.window] -= cover.mask
            del after.movables[name]
        return after

    @property
    def free(self) -> np.ndarray:
        """(rows, columns): where the robot's centre may be."""
        return ~self.static & (self.count == 0)

    def free_without(self, names: Iterable[str], window: Window | None = None) -> np.ndarray:
        """Where it might be if those objects were gone; in a window if one is given."""
        names = list(names)
        count = self.count.copy() if names else self.count
        for name in names:
            cover = self.covers[name]
            count[cover.window] -= cover.mask
        part = ... if window is None else window
        return ~self.static[part] & (count[part] == 0)

    def cover_of(self, movable: Movable) -> Cover:
        """The cells that an object covers where it stands."""
        grown = shapely.buffer(movable.polygon, self.inflation * _OUTSIDE, quad_segs=_ARC)
        window = self.window_of(*grown.bounds)
        return Cover(window, inside(grown, self.xs[window[1]], self.ys[window[0]]))

    @property
    def names(self) -> list[str]:
        """Of the objects, in the order of `movable_tree`."""
        return list(self.movables)

    @property
    def movable_tree(self) -> shapely.STRtree:
        """The objects' polygons where they stand."""
        if self._tree is None:
            self._tree = shapely.STRtree([movable.polygon for movable in self.movables.values()])
        return self._tree

    # --- places -------------------------------------------------------------------------------

    def cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the cells that points (*batch, 2) lie in, clipped to the grid."""
        index = np.floor((np.asarray(points)[..., :2] - self.origin) / self.cell).astype(int)
        index = np.maximum(np.minimum(index, (self.shape[1] - 1, self.shape[0] - 1)), 0)
        return index[..., 1], index[..., 0]

    def cell_at(self, point: np.ndarray) -> tuple[int, int]:
        """Row and column of one point (2 or more), clipped to the grid."""
        column = math.floor((float(point[0]) - self.map.bounds[0]) / self.cell)
        row = math.floor((float(point[1]) - self.map.bounds[1]) / self.cell)
        return min(max(row, 0), self.shape[0] - 1), min(max(column, 0), self.shape[1] - 1)

    def centres(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """(*batch, 2): the middles of cells, m."""
        return np.stack([self.xs[columns], self.ys[rows]], axis=-1)

    def window_of(self, left: float, bottom: float, right: float, top: float) -> Window:
        """The cells that a box in metres touches."""
        low_row, low_column = self.cell_at(np.array([left, bottom]))
        high_row, high_column = self.cell_at(np.array([right, top]))
        return slice(low_row, high_row + 1), slice(low_column, high_column + 1)

    def _blocked_by(self, walls: list[BaseGeometry]) -> np.ndarray:
        left, bottom, right, top = self.map.bounds
        radius = self.map.robot.radius
        columns = (self.xs >= left + radius) & (self.xs <= right - radius)
        rows = (self.ys >= bottom + radius) & (self.ys <= top - radius)
        blocked = ~(rows[:, None] & columns[None, :])
        for wall in walls:
            if not wall.is_empty:
                grown = wall.buffer(self.inflation * _OUTSIDE, quad_segs=_ARC)
                window = self.window_of(*grown.bounds)
                blocked[window] |= inside(grown, self.xs[window[1]], self.ys[window[0]])
        return blocked


class Footprint:
    """The cells that an object keeps the robot out of, at many poses at once.

    From a raster in body coordinates, four times as fine as the cells: right to an eighth of one.
    `extent` is how far from its centroid the object can matter, m.
    """

    def __init__(self, movable: Movable, inflation: float, cell: float) -> None:
        self.extent = movable.radius + inflation
        self._spacing = cell / 4
        count = math.ceil(self.extent / self._spacing) + 1
        along = self._spacing * np.arange(-count, count + 1)
        body = shapely.Polygon(movable.outline).buffer(inflation, quad_segs=_ARC)
        self._mask, self._middle = np.pad(inside(body, along, along), 1), count + 1

    def at(self, poses: np.ndarray, xs: np.ndarray, ys: np.ndarray) -> np.ndarray:
        """(poses, rows, columns): whether the points (xs, ys) are covered at poses (poses, 3)."""
        cos, sin = np.cos(poses[:, 2]) / self._spacing, np.sin(poses[:, 2]) / self._spacing
        right = (xs[None, :] - poses[:, :1])[:, None, :]
        up = (ys[None, :] - poses[:, 1:2])[:, :, None]
        cos, sin = cos[:, None, None], sin[:, None, None]
        most, half = len(self._mask) - 1, self._middle + 0.5
        column = (cos * right + sin * up + half).astype(np.int32)
        row = (cos * up - sin * right + half).astype(np.int32)
        # minimum and maximum, because clip looks up the bounds of its type each time
        row, column = (np.maximum(np.minimum(index, most), 0) for index in (row, column))
        return self._mask[row, column]


def inside(geometry: BaseGeometry, xs: np.ndarray, ys: np.ndarray) -> np.ndarray:
    """(rows, columns): which of the points (xs, ys) lie in polygons, holes taken out.

    By the parity of edges to the left, a row at a time: linear in edges x rows + cells.
    """
    rings = shapely.get_parts(shapely.boundary(geometry))
    points, ring = shapely.get_coordinates(rings, return_index=True)
    same = ring[1:] == ring[:-1]
    (x0, y0), (x1, y1) = points[:-1][same].T, points[1:][same].T
    low, high = np.searchsorted(ys, np.minimum(y0, y1)), np.searchsorted(ys, np.maximum(y0, y1))
    counts = high - low  # rows that an edge crosses
    edge = np.repeat(np.arange(len(counts)), counts)
    row = np.arange(len(edge)) + np.repeat(low - np.cumsum(counts) + counts, counts)
    x0, y0, x1, y1 = x0[edge], y0[edge], x1[edge], y1[edge]
    crossing = x0 + (ys[row] - y0) * (x1 - x0) / (y1 - y0)
    flips = np.zeros((len(ys), len(xs) + 1), np.int32)
    np.add.at(flips, (row, np.searchsorted(xs, crossing)), 1)
    return np.cumsum(flips[:, :-1], axis=1) % 2 == 1
