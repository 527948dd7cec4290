"""Shapes of mazes: walls, the obstacle that has to be pushed away, entrance and goal.

Every maze has the same parts at places of its own, from left to right: the entrance, a thin wall
with a gap, a thick wall crossed by a narrow channel with a funnel before it, in which a block
stands, and a thin wall with a gap, behind which is the goal. The block has to be pushed out of the
channel's far end; there the tip gets out beside it.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import dijkstra

from palpate.errors import PalpateError

TIP_RADIUS = 0.01  # m

# Half the size of the arena in m; its left side has the entrance.
ARENA = (0.3, 0.25)
ENTRANCE_WIDTH = 0.08  # m
THICKNESS = 0.01  # m, of thin walls
GAP_WIDTH = 0.06  # m
LEFT_WALL, RIGHT_WALL = -0.18, 0.17  # m, the middles of the two thin walls
THICK_WALL = 0.07  # m, half its thickness; its middle is at x = 0
CHANNEL_WIDTH = 0.028  # m: 4 mm to spare on either side of the tip
FUNNEL_WIDTH = 0.05  # m, where the funnel begins; it narrows to the channel at 45 degrees
MOST_OFFSET = 0.15  # m by which gaps, channel, entrance and goal lie off the middle

BLOCK_HALF_SIZES = (0.01, 0.0135)  # m: half a millimetre short of the channel on either side
BLOCK_DEPTH = 0.02  # m from the channel's mouth to the block
# The end stop lets the block's far side 5 cm out of the channel: its near side then stands 3 cm
# out, where the tip (2 cm thick) comes out and passes beside it, and 4.5 cm are left behind it.
BLOCK_CLEARANCE = 0.05  # m

START_X, START_HALF_SIZES = -0.245, (0.025, 0.02)  # m: the place where the tip starts
GOAL_X, GOAL_RADIUS = 0.25, 0.03  # m
CELL = 0.005  # m, of the grid that distances are computed on
SCATTER = 0.015  # m, standard deviation of places beside the way to the goal
BEFORE_BLOCK = (0.015, 0.003)  # m: how far before the block, and off the channel's middle, at most


@dataclass(frozen=True)
class Wall:
    """A box seen from above: middle (x, y) m, half its sizes (x, y) m, turned by `yaw` rad."""

    position: tuple[float, float]
    half_sizes: tuple[float, float]
    yaw: float = 0.0


@dataclass(frozen=True)
class Obstacle:
    """A block that slides along x from `position` (its middle, m) by at most `travel` m."""

    position: tuple[float, float]
    half_sizes: tuple[float, float]
    travel: float


@dataclass(frozen=True)
class Layout:
    """One maze. `start` and `start_half_sizes` (x, y) m: the rectangle where the tip begins;
    whoever leaves to the left of x = `entrance` m is outside; `goal` (x, y) m and its radius, m.
    """

    name: str
    walls: tuple[Wall, ...]
    obstacle: Obstacle
    start: tuple[float, float]
    goal: tuple[float, float]
    start_half_sizes: tuple[float, float] = START_HALF_SIZES
    entrance: float = -ARENA[0]
    goal_radius: float = GOAL_RADIUS

    def distance(
        self, position: Float[np.ndarray, "*batch coordinates"]
    ) -> Float[np.ndarray, " *batch"]:
        """Length in m of the shortest way of the tip's middle from (x, y) to the goal's middle.

        Walls are grown by the tip's radius and the obstacle is left out. Interpolated on a grid of
        5 mm whose ways have 16 directions, so at most 2.7 % too long; within a wall it is that of
        the nearest free place and the way there, outside that of the nearest place on the grid.
        """
        table, low, _ = self._table
        place = (np.asarray(position, float)[..., :2] - low) / CELL
        place = np.clip(place, 0, np.array(table.shape) - 1.001)
        cell = place.astype(int)
        (i, j), (u, v) = np.moveaxis(cell, -1, 0), np.moveaxis(place - cell, -1, 0)
        below = (1 - u) * table[i, j] + u * table[i + 1, j]
        above = (1 - u) * table[i, j + 1] + u * table[i + 1, j + 1]
        return np.asarray((1 - v) * below + v * above)

    def drawn_place(self, random: np.random.Generator, pushed: float = 0.0) -> np.ndarray:
        """A place (2,) m near the way from start to goal, free of walls, goal and a pushed block.

        Even along that way, so that the narrow channel is drawn as often as its length asks for,
        and `SCATTER` m beside it. `pushed`: m by which the block has been.
        """
        way = self._table[2]
        way = way[np.linalg.norm(way - self.goal, axis=1) > 3 * self.goal_radius]
        place = way[random.integers(len(way))]
        while True:
            drawn = place + SCATTER * random.standard_normal(2)
            block = np.add(self.obstacle.position, (pushed, 0.0))
            beyond = np.abs(drawn - block) - self.obstacle.half_sizes
            if (
                self.clearance(drawn) >= TIP_RADIUS
                and beyond.max() > TIP_RADIUS
                and drawn[0] > self.entrance + TIP_RADIUS
                and math.dist(drawn, self.goal) > 2 * self.goal_radius
            ):
                return drawn

    def place_before_block(self, random: np.random.Generator, pushed: float) -> np.ndarray:
        """A place (2,) m in the channel, from which the block is reached at once; `pushed` in m."""
        x, y = self.obstacle.position
        before, aside = random.uniform((0, -1), 1) * BEFORE_BLOCK
        touches = x + pushed - self.obstacle.half_sizes[0] - TIP_RADIUS
        return np.array([touches - before, y + aside])

    def clearance(self, position: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, " *batch"]:
        """m from (x, y) to the nearest wall's surface, negative within one; no obstacle."""
        nearest = np.full(position.shape[:-1], np.inf)
        for wall in self.walls:
            c, s = math.cos(wall.yaw), math.sin(wall.yaw)
            inside = np.abs((position - wall.position) @ np.array([[c, -s], [s, c]]))
            beyond = inside - wall.half_sizes
            gap = np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)
            nearest = np.minimum(nearest, gap)
        return np.asarray(nearest)

    @cached_property
    def _table(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distances on the grid, the place of its first corner, and the way from start to goal."""
        low = -np.array(ARENA) - (4 * CELL, 0)
        shape = np.rint((np.array(ARENA) - low) / CELL).astype(int) + 1
        places = low + CELL * np.moveaxis(np.indices(tuple(shape)), 0, -1)
        free = self.clearance(places) >= TIP_RADIUS
        number = np.arange(free.size).reshape(free.shape)
        rows, columns, lengths = [], [], []
        for step in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
            here, there = _shift(step, free.shape)
            open_both = free[here] & free[there]
            rows.append(number[here][open_both])
            columns.append(number[there][open_both])
            lengths.append(np.full(len(rows[-1]), CELL * math.hypot(*step)))
        graph = scipy.sparse.csr_matrix(
            (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))),
            (free.size, free.size),
        )
        to_goal = np.where(free, np.linalg.norm(places - self.goal, axis=-1), np.inf)
        goal = int(np.argmin(to_goal))
        table, before = dijkstra(graph, directed=False, indices=goal, return_predecessors=True)
        table = table.reshape(free.shape)
        way = [
            int(np.ravel_multi_index(np.rint((self.start - low) / CELL).astype(int), free.shape))
        ]
        while way[-1] != goal:
            way.append(int(before[way[-1]]))
        reached = np.isfinite(table)
        away, nearest = distance_transform_edt(~reached, sampling=CELL, return_indices=True)
        return table[tuple(nearest)] + away, low, places.reshape(-1, 2)[way]


def _shift(step: tuple[int, int], shape: tuple[int, ...]) -> tuple[tuple, tuple]:
    """Slices of all cells that have a neighbour `step` away, and of those neighbours."""
    here = [slice(max(0, -s), n - max(0, s)) for s, n in zip(step, shape, strict=True)]
    there = [slice(max(0, s), n - max(0, -s)) for s, n in zip(step, shape, strict=True)]
    return tuple(here), tuple(there)


def make_layout(
    name: str, *, entrance: float, left_gap: float, channel: float, right_gap: float, goal: float
) -> Layout:
    """The maze whose parts lie at these y, in m."""
    width, depth = ARENA
    half = THICKNESS / 2
    # Squares on their corner, half sunk into the thick wall: their faces are the funnel's.
    corner = (FUNNEL_WIDTH - CHANNEL_WIDTH) / 2 / math.sqrt(2)
    block_x = -THICK_WALL + BLOCK_DEPTH + BLOCK_HALF_SIZES[0]
    end = THICK_WALL + BLOCK_CLEARANCE - BLOCK_HALF_SIZES[0]
    walls = [
        Wall((0.0, depth + half), (width + THICKNESS, half)),
        Wall((0.0, -depth - half), (width + THICKNESS, half)),
        Wall((width + half, 0.0), (half, depth)),
        *_barrier(-width - half, half, entrance, ENTRANCE_WIDTH),
        *_barrier(LEFT_WALL, half, left_gap, GAP_WIDTH),
        *_barrier(0.0, THICK_WALL, channel, CHANNEL_WIDTH),
        *_barrier(RIGHT_WALL, half, right_gap, GAP_WIDTH),
        *(
            Wall((-THICK_WALL, channel + side * FUNNEL_WIDTH / 2), (corner, corner), math.pi / 4)
            for side in (-1, 1)
        ),
    ]
    return Layout(
        name=name,
        walls=tuple(walls),
        obstacle=Obstacle((block_x, channel), BLOCK_HALF_SIZES, end - block_x),
        start=(START_X, entrance),
        goal=(GOAL_X, goal),
    )


def _barrier(x: float, half: float, gap: float, width: float) -> list[Wall]:
    """A wall across the arena at `x`, open over `width` around y = `gap`."""
    ends = (-ARENA[1], gap - width / 2), (gap + width / 2, ARENA[1])
    return [Wall((x, (low + high) / 2), (half, (high - low) / 2)) for low, high in ends]


def draw_layout(seed: int, name: str = "") -> Layout:
    """A maze whose parts lie at random y, evenly within `MOST_OFFSET` of the middle."""
    places = np.random.default_rng(seed).uniform(-MOST_OFFSET, MOST_OFFSET, 5)
    entrance, left_gap, channel, right_gap, goal = (round(float(y), 3) for y in places)
    return make_layout(
        name or f"drawn-{seed}", entrance=entrance, left_gap=left_gap, channel=channel,
        right_gap=right_gap, goal=goal,
    )  # fmt: skip


TRAINING = ("home", *(f"training-{number}" for number in range(1, 5)))
UNSEEN = tuple(f"unseen-{number}" for number in range(1, 13))
_MADE: dict[str, Layout] = {}


def find_layout(name: str) -> Layout:
    """The maze of this name, always the same one; raises `PalpateError` that lists all there are.

    "home" is where policies are trained; the "unseen" are kept for testing.
    """
    if name not in (*TRAINING, *UNSEEN):
        raise PalpateError(f"unknown maze '{name}'; there are: {', '.join((*TRAINING, *UNSEEN))}")
    if name not in _MADE:
        _MADE[name] = (
            make_layout(
                "home", entrance=0.0, left_gap=0.06, channel=-0.04, right_gap=0.05, goal=0.0
            )
            if name == "home"
            else draw_layout(zlib.crc32(name.encode()), name)
        )
    return _MADE[name]
