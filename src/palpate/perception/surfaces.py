"""The pieces of a cloud that may move: where each lies, and what stands off it.

Planes grow from seeds: what is near the plane of a seed, faces as it does and hangs together with
it is one piece, whose plane is then fitted again.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from palpate.perception.clouds import Cloud, extent_of

# m^2, and of the square of the scene's extent: less is no surface of a part
SMALLEST = 0.007, 0.017
NEIGHBOURS = 8
SEEDS, AROUND = 250, 60  # that planes grow from, and the points that are the first of each
FLAT = 0.8  # cosine between a normal and that of its surface
STEP = 0.004  # m from a surface, beside noise
STANDS_OFF = 0.01, 0.08  # m: what is so far before a surface may be a handle on it
OUTLINE = 0.03  # m beside a surface's points: what stands off there stands on it
TOGETHER = 0.05  # m between points of one handle
BAR = 2.4  # of the side of the smallest surface: how long a bar is at least
TOUCHING = 2.4  # of the distance between points of the cloud: points of one bar

Vector = Float[np.ndarray, "3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Surface:
    """A flat piece of a cloud, in the smallest rectangle that holds it.

    `sides` are unit vectors along the rectangle's edges; `low` and `high` (m) its ends along them,
    from `centre`. `part` is the label of its points and `handles` are points of what stands off it.
    """

    members: Int[np.ndarray, " n"]
    normal: Vector
    centre: Vector
    sides: Float[np.ndarray, "2 3"]
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]
    area: float  # m^2
    part: int
    handles: Float[np.ndarray, "handles 3"]


def surfaces(
    cloud: Cloud, labels: Int[np.ndarray, " points"], random: np.random.Generator
) -> list[Surface]:
    """The flat pieces of a cloud that are large enough to be a part's, each of one label."""
    distance, neighbours = cloud.tree.query(cloud.points, NEIGHBOURS + 1)
    # of a point: the circle through the last of its neighbours holds these and itself
    size = math.pi * float(np.median(distance[:, NEIGHBOURS])) ** 2 / (NEIGHBOURS + 1)
    room = STEP + 2.0 * cloud.deviation
    smallest = min(SMALLEST[0], SMALLEST[1] * extent_of(cloud.points) ** 2)
    taken, pieces = np.zeros(len(cloud.points), bool), []
    for seed in random.permutation(len(cloud.points))[:SEEDS]:
        if taken[seed]:
            continue
        members = cloud.tree.query(cloud.points[seed], AROUND)[1]
        members = members[~taken[members] & (labels[members] == labels[seed])]
        for _ in range(3):
            if len(members) < NEIGHBOURS:
                break
            centre, normal = _plane(cloud.points[members], cloud.normals[members])
            near = np.abs((cloud.points - centre) @ normal) < room
            near &= (cloud.normals @ normal > FLAT) & ~taken & (labels == labels[seed])
            members = _connected_to(near, neighbours, seed)
        if len(members) * size >= smallest:
            taken[members] = True
            pieces.append(members)
    found = [_surface(cloud, members, labels, size, ~taken) for members in pieces]
    held = np.concatenate([one.handles for one in found] or [np.empty((0, 3))])
    bars = _bars(cloud, labels, ~taken, BAR * math.sqrt(smallest), TOUCHING * math.sqrt(size))
    return found + [
        _surface(cloud, members, labels, size, ~taken)
        for members in bars
        if not len(held) or cKDTree(cloud.points[members]).query(held)[0].min() > TOGETHER
    ]


def _bars(
    cloud: Cloud, labels: np.ndarray, loose: np.ndarray, shortest: float, together: float
) -> list[np.ndarray]:
    """What is of no flat piece and hangs together over a length (m): levers, bars and taps.

    So do points that are `together` (m).
    """
    found = []
    for label in np.unique(labels[loose]):
        rest = np.flatnonzero(loose & (labels == label))
        for piece in _pieces(cloud.points[rest], together):
            if extent_of(cloud.points[rest[piece]]) > shortest and len(piece) > NEIGHBOURS:
                found.append(rest[piece])
    return found


def _surface(
    cloud: Cloud, members: np.ndarray, labels: np.ndarray, size: float, loose: np.ndarray
) -> Surface:
    points = cloud.points[members]
    centre, normal = _plane(points, cloud.normals[members])
    sides, low, high = smallest_rectangle(points - centre, normal)
    handles = _handles(points, normal, centre, cloud.points[loose], cloud.points)
    return Surface(
        members, normal, centre, sides, low, high, len(members) * size, int(labels[members[0]]),
        handles,
    )  # fmt: skip


def _plane(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The middle of points and the normal of their plane, on the side of theirs."""
    centre = points.mean(axis=0)
    around = points - centre
    normal = np.linalg.eigh(around.T @ around)[1][:, 0]
    return centre, normal * (1.0 if normals.mean(axis=0) @ normal > 0.0 else -1.0)


def smallest_rectangle(
    around: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The sides of the smallest rectangle about points of a plane, and its ends along them."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    best, least = None, math.inf
    for angle in np.radians(np.arange(0.0, 90.0, 5.0)):
        cosine, sine = math.cos(angle), math.sin(angle)
        sides = np.stack([cosine * first + sine * second, cosine * second - sine * first])
        low, high = np.quantile(around @ sides.T, (0.02, 0.98), axis=0)
        if (area := float(np.prod(high - low))) < least:
            best, least = (sides, low, high), area
    assert best is not None
    return best


def _connected_to(near: np.ndarray, neighbours: np.ndarray, seed: int | np.integer) -> np.ndarray:
    """Which of these points hang together with the seed, or with most of them without it."""
    chosen = np.flatnonzero(near)
    place = np.full(len(near), -1)
    place[chosen] = np.arange(len(chosen))
    ends = place[neighbours[chosen]]
    rows = np.repeat(np.arange(len(chosen)), ends.shape[1])
    kept = ends.ravel() >= 0
    rows, ends = rows[kept], ends.ravel()[kept]
    graph = coo_matrix((np.ones(len(rows)), (rows, ends)), [len(chosen)] * 2)
    piece = connected_components(graph, directed=False)[1]
    if not len(piece):
        return chosen
    wanted = piece[place[seed]] if near[seed] else np.argmax(np.bincount(piece))
    return chosen[piece == wanted]


def _handles(
    points: np.ndarray, normal: np.ndarray, centre: np.ndarray, loose: np.ndarray, whole: np.ndarray
) -> np.ndarray:
    """A point of each small thing that stands off a surface within its outline.

    What goes on further out is no handle, but something else before the surface.
    """
    flat = cKDTree(points[::3] - np.outer((points[::3] - centre) @ normal, normal))

    def above(others: np.ndarray, low: float, high: float) -> np.ndarray:
        height = (others - centre) @ normal
        level = others[(height > low) & (height < high)]
        fallen = level - np.outer((level - centre) @ normal, normal)
        return level[flat.query(fallen)[0] < OUTLINE] if len(level) else level

    inside = above(loose, *STANDS_OFF)
    beyond = above(whole, STANDS_OFF[1], 2.5 * STANDS_OFF[1])
    found = []
    for members in _pieces(inside, TOGETHER):
        piece = inside[members]
        if len(piece) < 3:
            continue
        if len(beyond) and np.sum(cKDTree(piece).query(beyond)[0] < 3.0 * STANDS_OFF[1]) > 3:
            away = beyond[:, None] - piece[None, :60]
            flat_away = away - (away @ normal)[..., None] * normal
            if np.sum(np.linalg.norm(flat_away, axis=2).min(axis=1) < OUTLINE) > 3:
                continue
        found.append(piece[np.argmin(np.linalg.norm(piece - np.median(piece, axis=0), axis=1))])
    return np.array(found).reshape(-1, 3)


def _pieces(points: np.ndarray, together: float) -> list[np.ndarray]:
    """The numbers of points in groups, each point no further (m) than that from another of its."""
    if not len(points):
        return []
    pairs = cKDTree(points).query_pairs(together, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), [len(points)] * 2)
    piece = connected_components(graph, directed=False)[1]
    return [np.flatnonzero(piece == one) for one in range(piece.max() + 1)]
