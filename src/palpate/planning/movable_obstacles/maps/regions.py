"""The map as an abstract graph: free regions, and what objects cover, as its nodes.

Cells that the same objects cover (none: free) and that hang together are one node. To go from a
node to the next one, the objects that cover the next and not this one have to be moved: that is
"open a way from region i to region j with object o". Everything is found with the grid, at a cost
linear in its cells and in the objects, each in a window of its own.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from palpate.planning.movable_obstacles.maps.occupancy import Space

_EIGHT = np.ones((3, 3), int)


@dataclass(frozen=True)
class Border:
    """Where the node `source` meets the node `target`: a cell of the source beside it."""

    source: int
    target: int
    point: np.ndarray  # (2,), m


@dataclass(frozen=True)
class Regions:
    """`node` (rows, columns) is each cell's node, -1 in walls; `objects` what covers each node.

    The first `free` nodes are free regions. `borders` holds both directions.
    """

    node: np.ndarray
    objects: tuple[frozenset[str], ...]
    borders: tuple[Border, ...]
    free: int

    def at(self, space: Space, point: np.ndarray) -> int:
        """The node of the cell that `point` (2,) lies in; -1 in a wall."""
        return int(self.node[space.cell_at(point)])


def regions_of(space: Space) -> Regions:
    """The abstract graph of an arrangement."""
    node = np.full(space.shape, -1, np.int64)
    labels, free = ndimage.label(space.free, _EIGHT)
    node[labels > 0] = labels[labels > 0] - 1
    objects: list[frozenset[str]] = [frozenset()] * free
    open_cells = ~space.static
    # Which objects cover a cell: one alone is found in its own window, several by their names.
    for name, cover in space.covers.items():
        alone = cover.mask & (space.count[cover.window] == 1) & open_cells[cover.window]
        parts, count = ndimage.label(alone, _EIGHT)
        view = node[cover.window]
        view[parts > 0] = parts[parts > 0] - 1 + len(objects)
        objects += [frozenset([name])] * count
    shared = open_cells & (space.count > 1)
    if shared.any():
        _add_shared(space, shared, node, objects)
    return Regions(node, tuple(objects), _borders(space, node), free)


def _add_shared(
    space: Space, shared: np.ndarray, node: np.ndarray, objects: list[frozenset[str]]
) -> None:
    """Number the cells that several objects cover."""
    bits = np.random.default_rng(0).integers(1, 2**63, len(space.covers), dtype=np.int64)
    signature = np.zeros(space.shape, np.int64)
    for bit, cover in zip(bits, space.covers.values(), strict=True):
        signature[cover.window] ^= np.where(cover.mask, bit, 0)
    rows, columns = np.nonzero(shared)
    _, first, which = np.unique(signature[rows, columns], return_index=True, return_inverse=True)
    for index in range(len(first)):
        row, column = rows[first[index]], columns[first[index]]
        own = which == index
        window = (
            slice(rows[own].min(), rows[own].max() + 1),
            slice(columns[own].min(), columns[own].max() + 1),
        )
        mask = np.zeros(tuple(part.stop - part.start for part in window), bool)
        mask[rows[own] - window[0].start, columns[own] - window[1].start] = True
        parts, count = ndimage.label(mask, _EIGHT)
        view = node[window]
        view[parts > 0] = parts[parts > 0] - 1 + len(objects)
        objects += [frozenset(_covering(space, int(row), int(column)))] * count


def _covering(space: Space, row: int, column: int) -> list[str]:
    found = []
    for name, (window, mask) in ((n, (c.window, c.mask)) for n, c in space.covers.items()):
        down, right = row - window[0].start, column - window[1].start
        if 0 <= down < mask.shape[0] and 0 <= right < mask.shape[1] and mask[down, right]:
            found.append(name)
    return found


def _borders(space: Space, node: np.ndarray) -> tuple[Border, ...]:
    """Both directions of every pair of nodes with neighbouring cells."""
    sources, targets, places = [], [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        height, width = node.shape
        one = node[: height - down, max(0, -right) : width - max(0, right)]
        two = node[down:, max(0, right) : width + min(0, right)]
        rows, columns = np.nonzero((one != two) & (one >= 0) & (two >= 0))
        columns = columns + max(0, -right)
        a, b = node[rows, columns], node[rows + down, columns + right]
        here, there = rows * width + columns, (rows + down) * width + columns + right
        sources, targets, places = [*sources, a, b], [*targets, b, a], [*places, here, there]
    source, target, place = (np.concatenate(part) for part in (sources, targets, places))
    if not len(source):
        return ()
    key = source * (node.max() + 1) + target
    order = np.argsort(key, kind="stable")
    begins = np.flatnonzero(np.diff(key[order], prepend=-1))
    borders = []
    for begin, end in zip(begins, [*begins[1:], len(order)], strict=True):
        own = place[order[begin:end]]
        points = space.centres(*np.divmod(own, node.shape[1]))
        middle = points[np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1))]
        at = order[begin]
        borders.append(Border(int(source[at]), int(target[at]), middle))
    return tuple(borders)
