"""Which push tells the most about an appliance: where, and which way.

A surface that nobody has tried moves with some probability; if it does, a joint is found. A part
that is known is pushed where it makes its joint more certain. Both are information, in nats.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from palpate.identification.interactive.handling import Handling, Push
from palpate.identification.interactive.refinement import way_information
from palpate.identification.interactive.twin import Twin
from palpate.perception.clouds import Cloud

JOINT = 4.0  # nats that a joint is worth which was not known
ON_SURFACE, WITH_HANDLE, ON_PART = 0.25, 0.7, 0.05  # probability that a surface moves by itself
ASKANCE = 0.4  # of it is left of a surface that the cameras see from the side
REVEALED = 0.3  # of it is left of what was not seen at first: the inside of what was opened
TRIED = 0.3  # of it is left after each try that failed
SMALLEST = 0.004  # m^2: less is no surface of a part
NEIGHBOURS = 8
SEEDS, AROUND = 250, 60  # that planes grow from, and the points that are the first of each
FLAT = 0.8  # cosine between a normal and that of its surface
STEP = 0.004  # m from a surface, beside noise
STANDS_OFF = 0.01, 0.08  # m: what is so far before a surface may be its handle
BESIDE = 0.05  # m from a surface at which a hand was still on it
ASIDE = 0.7  # how much to the side of the normal a hand pulls that tries a surface
TURN = 0.25  # rad and m: scales of what is not known of a joint before anything is

Choice = Callable[[Twin, np.random.Generator], Push]


@dataclasses.dataclass(frozen=True, eq=False)
class Surface:
    """A flat piece of a look, where one would take hold of it, and the part that it is of."""

    members: Int[np.ndarray, " n"]
    normal: Float[np.ndarray, "3"]
    centre: Float[np.ndarray, "3"]
    area: float  # m^2
    handle: Float[np.ndarray, "3"] | None
    part: int


def surfaces(
    cloud: Cloud, labels: Int[np.ndarray, " points"], random: np.random.Generator
) -> list[Surface]:
    """The flat pieces of a look that are large enough to be a part's, with their handles.

    Planes grow from seeds: what is near the plane of a seed, faces as it does and hangs together
    with it is one piece, whose plane is then fitted again.
    """
    neighbours = cloud.tree.query(cloud.points, NEIGHBOURS + 1)[1]
    size = float(np.median(cloud.tree.query(cloud.points[::50], 2)[0][:, 1])) ** 2
    room = STEP + 2.0 * cloud.deviation
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
            members = _connected(near, neighbours, seed)
        if len(members) * size >= SMALLEST:
            taken[members] = True
            pieces.append(members)
    loose, found = cloud.points[~taken], []
    for members in pieces:
        points = cloud.points[members]
        centre, normal = _plane(points, cloud.normals[members])
        handle = _handle(points, normal, centre, loose, cloud.points)
        area, part = len(members) * size, int(labels[members[0]])
        found.append(Surface(members, normal, centre, area, handle, part))
    return found


def _plane(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The middle of points and the normal of their plane, on the side of theirs."""
    centre = points.mean(axis=0)
    around = points - centre
    normal = np.linalg.eigh(around.T @ around)[1][:, 0]
    return centre, normal * (1.0 if normals.mean(axis=0) @ normal > 0.0 else -1.0)


def _connected(near: np.ndarray, neighbours: np.ndarray, seed: int | np.integer) -> np.ndarray:
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


def _handle(
    points: np.ndarray, normal: np.ndarray, centre: np.ndarray, loose: np.ndarray, whole: np.ndarray
) -> np.ndarray | None:
    """Where something small stands off a surface within its outline, if anything does.

    What goes on further out is no handle, but something else before the surface.
    """
    height = (loose - centre) @ normal
    level = loose[(height > STANDS_OFF[0]) & (height < STANDS_OFF[1])]
    flat = points - np.outer((points - centre) @ normal, normal)
    if not len(level):
        return None
    fallen = level - np.outer((level - centre) @ normal, normal)
    gap = np.linalg.norm(fallen[:, None] - flat[None, ::7], axis=2).min(axis=1)
    inside = level[gap < 0.03]
    if len(inside) < 3:
        return None
    height = (whole - centre) @ normal
    beyond = whole[(height > STANDS_OFF[1]) & (height < 2.5 * STANDS_OFF[1])]
    if len(beyond):
        away = beyond[:, None] - inside[None, :60]
        flat = away - (away @ normal)[..., None] * normal
        if np.sum(np.linalg.norm(flat, axis=2).min(axis=1) < 0.03) > 3:
            return None
    return inside[np.argmin(np.linalg.norm(inside - np.median(inside, axis=0), axis=1))]


def most_informative(twin: Twin, random: np.random.Generator) -> Push:
    """The push of which most is expected."""
    look = len(twin.looks) - 1
    options = [*_tries(twin, look, random), *_repeats(twin, look, random)]
    return max(options, key=lambda one: one[0])[1]


def at_random(twin: Twin, random: np.random.Generator) -> Push:
    """Any point that was seen, any way out of its surface or into it."""
    cloud = twin.looks[-1]
    index = int(random.integers(len(cloud.points)))
    aside = random.standard_normal(3)
    way = random.choice([-1.0, 1.0]) * cloud.normals[index] + 0.5 * aside / np.linalg.norm(aside)
    return Push(cloud.points[index], way / np.linalg.norm(way))


def _tries(twin: Twin, look: int, random: np.random.Generator) -> list[tuple[float, Push]]:
    """Of every surface, one push that would show whether it moves."""
    cloud, found = twin.looks[look], []
    for surface in surfaces(cloud, twin.labels[look], random):
        failed = [
            one for one in twin.handled if one.held and not one.moved and _at(one, surface, cloud)
        ]
        missed = sum(1 for one in twin.handled if not one.held and _at(one, surface, cloud))
        chance = WITH_HANDLE if surface.handle is not None else ON_SURFACE
        if surface.part >= 0:
            chance = ON_PART * (3.0 if surface.handle is not None and surface.area < 0.1 else 1.0)
        chance *= TRIED ** (len(failed) + 0.3 * missed)
        chance *= min(1.0, 4.0 * math.sqrt(surface.area))
        chance *= float(np.clip((_faces(cloud, surface) - 0.2) / 0.6, ASKANCE, 1.0))
        first, _ = twin.looks[0].surfaces(cloud.points[surface.members], 3.0)
        if surface.part < 0 and first.mean() < 0.5:
            chance *= REVEALED
        sign = -1.0 if len(failed) % 2 else 1.0
        aside = np.cross(surface.normal, [0.0, 0.0, 1.0])
        if np.linalg.norm(aside) < 0.5:  # a lid: along its longer edge
            spread = cloud.points[surface.members] - surface.centre
            aside = np.linalg.svd(spread[::5], full_matrices=False)[2][0]
        way = surface.normal + ASIDE * aside / np.linalg.norm(aside)
        point = surface.handle
        if point is None or len(failed) > 1:
            point = _away_from(
                cloud.points[surface.members], [one.push.point for one in failed], random
            )
        push = Push(point, sign * way / np.linalg.norm(way))
        found.append((_entropy(chance) + chance * JOINT, push))
    return found


def _faces(cloud: Cloud, surface: Surface) -> float:
    """Cosine of the angle at which the cameras look at a surface: they were put up before it."""
    toward = np.mean([image.pinhole.position for image in cloud.images], axis=0) - surface.centre
    return float(surface.normal @ toward / np.linalg.norm(toward))


def _at(one: Handling, surface: Surface, cloud: Cloud) -> bool:
    """Whether a handling was at a surface, or at what stands off it there."""
    away = one.push.point - surface.centre
    height = float(away @ surface.normal)
    if not -0.03 < height < STANDS_OFF[1]:
        return False
    below = one.push.point - height * surface.normal
    return float(np.linalg.norm(cloud.points[surface.members] - below, axis=1).min()) < BESIDE


def _away_from(
    points: np.ndarray, tried: list[np.ndarray], random: np.random.Generator
) -> np.ndarray:
    """A point of a surface, far from where it was tried and not at its edge."""
    centre = points.mean(axis=0)
    kept = points[np.linalg.norm(points - centre, axis=1) < 0.85 * np.ptp(points, axis=0).max()]
    options = kept[random.integers(len(kept), size=30)]
    if not tried:
        return options[0]
    gap = np.min([np.linalg.norm(options - one, axis=1) for one in tried], axis=0)
    return options[np.argmax(gap)]


def _repeats(twin: Twin, look: int, random: np.random.Generator) -> list[tuple[float, Push]]:
    """Of every part that is known, the push that would make its joint most certain."""
    cloud, found = twin.looks[look], []
    for number, part in enumerate(twin.parts):
        members = np.flatnonzero(twin.labels[look] == number)
        if len(members) < 10:
            continue
        screw = twin.screw(number, look)
        options = cloud.points[random.choice(members, min(len(members), 40), replace=False)]
        if screw.joint == "revolute":
            arms = np.linalg.norm(np.cross(options - screw.point, screw.axis), axis=1)
            point = options[np.argsort(arms)[int(0.85 * len(arms))]]
            along = np.cross(screw.axis, point - screw.point)
        else:
            point, along = options[0], screw.axis
        low, high = part.range
        # away from the end that it is nearer to
        sign = 1.0 if part.positions[look] - low <= high - part.positions[look] else -1.0
        failed = sum(
            1 for one in twin.handled[-3:] if one.held and not one.moved
            and np.linalg.norm(one.push.point - point) < 0.1
        )  # fmt: skip
        if failed % 2:
            sign = -sign
        along = along / max(float(np.linalg.norm(along)), 1e-9)
        reach = 0.3 / max(float(np.linalg.norm(np.cross(screw.axis, point - screw.point))), 0.1)
        gone = np.linspace(0.0, sign * (reach if screw.joint == "revolute" else 0.3), 25)
        way = np.array([screw.pose(one).at(point[None])[0] for one in gone])
        before = np.linalg.inv(part.estimate.covariance + 1e-10 * np.eye(4))
        more = way_information(screw, way)
        gain = 0.5 * (np.linalg.slogdet(before + more)[1] - np.linalg.slogdet(before)[1])
        found.append((float(gain) * 0.6**failed, Push(point, sign * along)))
    return found


def _entropy(chance: float) -> float:
    other = 1.0 - chance
    return -sum(one * math.log(one) for one in (chance, other) if one > 0.0)


CHOICES: dict[str, Choice] = {"information": most_informative, "random": at_random}
