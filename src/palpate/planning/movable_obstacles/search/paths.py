"""Ways of the base: shortest over the grid, then pulled straight with exact distances."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from palpate.numerics.polygons import lines
from palpate.planning.movable_obstacles.maps.occupancy import Space, Window

_STEPS = [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)]
_LENGTHS = np.array([math.hypot(*step) for step in _STEPS])  # cells
_SLACK = 1e-6  # m: of distances that are compared
_LINKS = 6  # cells nearest to a place that it may be joined to


@dataclass(frozen=True)
class Distances:
    """How far it is from a place to every cell of a window; infinite where no way leads.

    `lengths` (rows, columns) of the window, in m. `path_to` gives the way.
    """

    space: Space
    window: Window
    source: np.ndarray
    lengths: np.ndarray
    _predecessors: np.ndarray
    _allowed: "Allowed"

    def at(self, points: np.ndarray) -> np.ndarray:
        """Lengths at points (*batch, 2); infinite outside the window."""
        rows, columns = self.space.cells(points)
        rows, columns = rows - self.window[0].start, columns - self.window[1].start
        height, width = self.lengths.shape
        known = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        clipped = self.lengths[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
        return np.where(known, clipped, np.inf)

    def to(self, point: np.ndarray, nearby: dict[str, float] | None = None) -> float:
        """How far it is to a place that need not be a cell's middle."""
        link = self._link(point, nearby or {})
        return math.inf if link is None else link[1]

    def path_to(
        self, point: np.ndarray, nearby: dict[str, float] | None = None
    ) -> np.ndarray | None:
        """The way (points, 2) from the source to `point`, pulled straight; None if there is none.

        `nearby` is the clearance (m) that is enough to an object by name, where less than the
        usual one is wanted at that end.
        """
        link = self._link(point, nearby or {})
        if link is None:
            return None
        cells = []
        node, last = link[0], self.lengths.size
        while node != last and node >= 0:
            cells.append(node)
            node = self._predecessors[node]
        rows, columns = np.divmod(np.array(cells[::-1]), self.lengths.shape[1])
        middles = self.space.centres(rows + self.window[0].start, columns + self.window[1].start)
        points = np.vstack([self.source, middles, np.asarray(point, float)[:2]])
        allowed = allowed_at(self.space, point, nearby)
        return straighten(self.space, points, self._allowed, allowed)

    def _link(self, point: np.ndarray, nearby: dict[str, float]) -> tuple[int, float] | None:
        allowed = allowed_at(self.space, point, nearby)
        joined = links(self.space, self.window, point, self.lengths < np.inf, allowed)
        ways = [(node, float(self.lengths.flat[node]) + gap) for node, gap in joined]
        return min(ways, key=lambda way: way[1], default=None)


def distances(
    space: Space,
    window: Window,
    source: np.ndarray,
    free: np.ndarray | None = None,
    nearby: dict[str, float] | None = None,
    *,
    standing: bool = False,
    limit: float = math.inf,
) -> Distances:
    """Shortest ways from `source` (2,) over the free cells of a window, eight neighbours each.

    `free` (rows, columns) of the window stands in for what is free now. `nearby` as in
    `Distances.path_to`, for the source's end; `standing`: the robot is there already, and may
    leave from beside an object that is nearer than the clearance. What is farther than `limit` m
    counts as not reached.
    """
    nearby = nearby or {}
    if free is None:
        free = space.free[window]
    height, width = free.shape
    size = free.size
    # row by row of the graph, on a grid with a border that is never free
    across = width + 2
    padded = np.zeros((height + 2, across), bool)
    padded[1:-1, 1:-1] = free
    node = np.flatnonzero(free)
    at = (node // width + 1) * across + node % width + 1
    beside = padded.ravel()[at[:, None] + [down * across + right for down, right in _STEPS]]
    offsets = np.array([down * width + right for down, right in _STEPS])
    counts = np.zeros(size, np.int32)
    counts[node] = beside.sum(axis=1)
    allowed = allowed_at(space, source, nearby, standing=standing)
    joined = links(space, window, source, free, allowed)
    columns = (node[:, None] + offsets)[beside]
    weights = np.broadcast_to(_LENGTHS * space.cell, beside.shape)[beside]
    columns = np.concatenate([columns, np.array([n for n, _ in joined], int)])
    values = np.concatenate([weights, np.array([max(gap, 1e-9) for _, gap in joined])])
    ends = np.concatenate([[0], np.cumsum(counts), [len(columns)]])
    graph = csr_matrix((values, columns, ends), shape=(size + 1, size + 1))
    lengths, predecessors = dijkstra(
        graph, indices=size, return_predecessors=True, limit=max(limit, 0.0)
    )
    source, lengths = np.asarray(source, float)[:2], lengths[:-1].reshape(height, width)
    return Distances(space, window, source, lengths, predecessors, allowed)


def links(
    space: Space, window: Window, point: np.ndarray, free: np.ndarray, allowed: "Allowed"
) -> list[tuple[int, float]]:
    """Free cells of the window that a straight way joins to `point`: their nodes and lengths, m.

    The nearest ones, with the exceptions `allowed`.
    """
    point = np.asarray(point, float)[:2]
    around = math.ceil((space.map.margin + 1e-9) / space.cell) + 2
    row, column = space.cell_at(point)
    row, column = row - window[0].start, column - window[1].start
    low, left = max(0, row - around), max(0, column - around)
    found = free[low : max(0, row + around + 1), left : max(0, column + around + 1)]
    rows, columns = np.nonzero(found)
    if not len(rows):
        return []
    rows, columns = rows + low, columns + left
    middles = space.centres(rows + window[0].start, columns + window[1].start)
    gaps = np.hypot(*(middles - point).T)
    nearest = np.argsort(gaps)[: 4 * _LINKS]
    ends = np.empty((len(nearest), 2, 2))
    ends[:, 0], ends[:, 1] = point, middles[nearest]
    joined = nearest[clear(space, lines(ends), allowed)][:_LINKS]
    nodes = rows[joined] * free.shape[1] + columns[joined]
    return list(zip(nodes.tolist(), gaps[joined].tolist(), strict=True))


@dataclass(frozen=True)
class Allowed:
    """Exceptions to the usual clearance: by index of a wall's edge, and by name of an object."""

    walls: dict[int, float]
    objects: dict[str, float]


_NOTHING = Allowed({}, {})


def allowed_at(
    space: Space,
    point: np.ndarray,
    nearby: dict[str, float] | None = None,
    *,
    standing: bool = False,
) -> Allowed:
    """What may come nearer than the clearance on the straight way to or from `point`.

    A wall may stay as near as it is there, because it cannot be moved; so may objects if the robot
    is `standing` there. Nothing may come nearer than the robot's radius.
    """
    clearance, radius = space.map.clearance, space.map.robot.radius
    walls, objects = {}, dict(nearby or {})
    for index, gap in _within(space.wall_tree, point, clearance):
        if gap >= radius - _SLACK:
            walls[index] = gap
    if standing:
        for index, gap in _within(space.movable_tree, point, clearance):
            if gap >= radius - _SLACK:
                name = space.names[index]
                objects[name] = min(gap, objects.get(name, gap))
    return Allowed(walls, objects)


def _within(tree: shapely.STRtree, point: np.ndarray, most: float) -> Iterator[tuple[int, float]]:
    """What is nearer to a place than `most` m, by index, and how near."""
    place = shapely.points(np.asarray(point, float)[:2])
    found = tree.query(place, predicate="dwithin", distance=most)
    gaps = shapely.distance(tree.geometries[found], place) if len(found) else found
    return zip(found.tolist(), gaps.tolist(), strict=True)


def clear(space: Space, ways: np.ndarray, allowed: Allowed = _NOTHING) -> np.ndarray:
    """Which of the robot's straight ways (ways,) keep the clearance from walls and objects."""
    clearance = space.map.clearance - _SLACK
    good = np.ones(len(ways), bool)
    names = {name: index for index, name in enumerate(space.names)} if allowed.objects else {}
    objects = {names[name]: gap for name, gap in allowed.objects.items() if name in names}
    for tree, gaps in ((space.wall_tree, allowed.walls), (space.movable_tree, objects)):
        way, obstacle = tree.query(ways, predicate="dwithin", distance=clearance)
        excepted = np.isin(obstacle, list(gaps)) if gaps and len(way) else np.zeros(len(way), bool)
        if excepted.any():
            near = shapely.distance(ways[way[excepted]], tree.geometries[obstacle[excepted]])
            least = np.array([gaps[index] for index in obstacle[excepted]]) - _SLACK
            fine = np.flatnonzero(excepted)[near >= least]
            way = np.delete(way, fine)
        good[way] = False
    return good


def straighten(space: Space, points: np.ndarray, first: Allowed, last: Allowed) -> np.ndarray:
    """A shorter way (points, 2) with the same ends: from each point to the farthest one in sight.

    `first` and `last` are the exceptions at its two ends. Done twice, the second time between
    points set half a cell apart, because corners are passed most closely between cells' middles.
    """
    for finer in (False, True):
        if finer:
            points = _resample(points, space.cell / 2)
        kept, here = [0], 0
        while here < len(points) - 1:
            ahead = np.arange(here + 1, len(points))
            ways = np.stack([np.broadcast_to(points[here], (len(ahead), 2)), points[ahead]], axis=1)
            straight = lines(ways)
            begin = first if here == 0 else _NOTHING
            seen = clear(space, straight, begin)
            seen[-1] |= clear(space, straight[-1:], _join(begin, last))[0]
            here = int(ahead[seen][-1]) if seen.any() else here + 1
            kept.append(here)
        points = points[kept]
    return points


def _join(one: Allowed, other: Allowed) -> Allowed:
    """What either of them allows."""
    walls = {k: min(gap, one.walls.get(k, gap)) for k, gap in other.walls.items()}
    objects = {k: min(gap, one.objects.get(k, gap)) for k, gap in other.objects.items()}
    return Allowed(one.walls | walls, one.objects | objects)


def _resample(points: np.ndarray, spacing: float) -> np.ndarray:
    """The corners and points between them, at most `spacing` apart."""
    parts = [points[:1]]
    for begin, end in pairwise(points):
        pieces = max(1, math.ceil(float(np.linalg.norm(end - begin)) / spacing))
        parts.append(begin + (end - begin) * (np.arange(1, pieces + 1) / pieces)[:, None])
    return np.concatenate(parts)
