"""The room that a part takes, as boxes: what is around its points, less what was seen to be open.

Of the cells of a box around what was seen of a part those are its own that no look shows to be in
the open, or to be of something else, as the part stood then (space carving, Kutulakos and Seitz
2000). What nobody has seen stays: a drawer that was never opened is a block. Boxes of whole cells
fill that room, the largest first. Each is convex, closed, and has a true volume.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_cdt
from scipy.spatial import cKDTree

from palpate.identification.interactive.labels import TOLERANCE, distinguishing_looks
from palpate.identification.interactive.tree import FEWEST, PartTree
from palpate.models.articulated.description import Geometry, Place
from palpate.perception.surfaces import smallest_rectangle

CELL, MOST_CELLS = 0.01, 40  # m, and along an edge of the box
THINNEST = 0.01  # m
MUCH = 0.5  # of the points that the look has which shows most of a part
STRAY = 0.01  # of the points at each side of a box that may be outside of it
MOST_BOXES, FILLED = 64, 0.97  # of a part, and share of its room: enough
SEEDS = 8  # cells that a box is grown from, of which the largest one is taken
UP = np.array([0.0, 0.0, 1.0])

Points = Float[np.ndarray, "n 3"]


def boxes_of(tree: PartTree, part: int) -> list[Geometry]:
    """The room of a part (-1: of what stands still) in the frame that it is described in.

    None of what was hardly seen.
    """
    look = len(tree.looks) - 1
    places = np.array([one.positions for one in tree.parts]).reshape(-1, look + 1)
    looks = [look, *distinguishing_looks(places, look)] if look else [look]
    own = _points(tree, part)
    if len(own) < FEWEST:
        return []
    axes = _axes(own, UP if part < 0 else tree.parts[part].screw.axis)
    along = own @ axes.T
    low, high = np.quantile(along, (STRAY, 1.0 - STRAY), axis=0)
    room = np.maximum(THINNEST - (high - low), 0.0)
    low, high = low - 0.5 * room, high + 0.5 * room
    count = np.clip(np.ceil((high - low) / CELL), 1, MOST_CELLS).astype(int)
    size = (high - low) / count
    grid = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1)
    centres = (low + (grid.reshape(-1, 3) + 0.5) * size) @ axes
    reach = 0.5 * float(np.linalg.norm(size))
    seen = np.isfinite(cKDTree(own).query(centres, distance_upper_bound=reach)[0])
    taken = ~_open(tree, part, looks, centres, reach) | seen
    return [
        Geometry(
            "box",
            tuple(((last - first) * size).tolist()),
            Place((low + 0.5 * (first + last) * size) @ axes, axes.T),
        )
        for first, last in _fill(taken.reshape(tuple(count)))
    ]


def _points(tree: PartTree, part: int) -> Points:
    """What is seen of a part in the last look that shows `MUCH` of it, as the part is described."""
    look = len(tree.looks) - 1
    if part >= 0:
        counts = {one: len(chosen) for one, chosen in tree.parts[part].seen.items()}
        most = max(counts.values())
        look = max(one for one, count in counts.items() if count >= MUCH * most)
    labels = tree.probabilities(look).argmax(axis=0) - 1  # by all that is known now
    return tree.pose(part, look).inverse.at(tree.looks[look].points[labels == part])


def _axes(points: Points, first: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Directions of a box's edges, right-handed: the first is given, the others fit tightest."""
    sides, _, _ = smallest_rectangle(points[:: max(1, len(points) // 2000)], first)
    return np.stack([first, sides[0], np.cross(first, sides[0])])


def _open(
    tree: PartTree, part: int, looks: list[int], points: Points, reach: float
) -> Bool[np.ndarray, " n"]:
    """Which points a look shows in the open, or within reach of something else and not of it."""
    found = np.zeros(len(points), bool)
    for look in looks:
        cloud, there = tree.looks[look], tree.pose(part, look).at(points)
        found |= cloud.surfaces(there, TOLERANCE)[1]
        if look == len(tree.looks) - 1:  # labels of earlier looks are as they were known then
            near, index = cloud.tree.query(there, distance_upper_bound=reach)
            met = np.isfinite(near)
            found[met] |= tree.labels[look][index[met]] != part
    return found


def _fill(
    taken: Bool[np.ndarray, "_ _ _"],
) -> list[tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]]:
    """Boxes of whole cells that fill what is taken: their first cells, and those after the last.

    Each grows from a cell that is deepest in what is left, on the side on which it gains most.
    """
    left, total, found = taken.copy(), int(taken.sum()), []
    while len(found) < MOST_BOXES and left.sum() > (1.0 - FILLED) * total:
        padded = np.pad(left, 1)
        depth = distance_transform_cdt(padded, "chessboard")[1:-1, 1:-1, 1:-1]
        deepest = np.argwhere(depth == depth.max())
        seeds = deepest[:: math.ceil(len(deepest) / SEEDS)]
        boxes = [_grow(left, cell) for cell in seeds]
        first, last = max(boxes, key=lambda box: math.prod((box[1] - box[0]).tolist()))
        left[tuple(map(slice, first, last))] = False
        found.append((first, last))
    return found


def _grow(
    left: Bool[np.ndarray, "_ _ _"], cell: Int[np.ndarray, "3"]
) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
    first, last = cell.copy(), cell + 1
    while True:
        best, gain = None, 0
        for axis in range(3):
            for ahead in (False, True):
                low, high = first.copy(), last.copy()
                if ahead:
                    low[axis], high[axis] = last[axis], last[axis] + 1
                else:
                    low[axis], high[axis] = first[axis] - 1, first[axis]
                if low[axis] < 0 or high[axis] > left.shape[axis]:
                    continue
                layer = math.prod((high - low).tolist())
                if layer > gain and left[tuple(map(slice, low, high))].all():
                    best, gain = (axis, ahead), layer
        if best is None:
            return first, last
        axis, ahead = best
        if ahead:
            last[axis] += 1
        else:
            first[axis] -= 1
