"""From outlines to a planar model: convex parts, extents, padded structure."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import shapely
from jaxtyping import Float
from numpy.typing import ArrayLike
from shapely.geometry.polygon import orient

from palpate.errors import PalpateError
from palpate.models.planar.planar import Planar
from palpate.parameters import as_floating, axes_of, parameters_of

LAWS = {"coulomb": 1.0, "viscous": 0.0}
OFF_CENTRE = 1e-3  # of a body's extent: how far its centroid may lie from its frame's origin


def furniture(
    outlines: Sequence[Any],
    walls: Sequence[ArrayLike] = (),
    *,
    wheels: int = 1,
    law: Literal["coulomb", "viscous"] = "coulomb",
    pivots: Mapping[int, int | None] | None = None,
    distances: Mapping[int, int | None] | None = None,
    bolted: Iterable[int] = (),
    poses: ArrayLike | None = None,
    **fields: Any,
) -> Planar:
    """A planar model of bodies with these outlines.

    `outlines` has, for each body, a polygon (corners, 2) in m in the body's frame, whose origin is
    the centroid (`centre_outline` puts it there), or a list of such polygons that make up the body;
    `walls` are polygons in the world. Polygons may be concave: they are cut into convex parts.
    Each body gets `wheels` wheels under the given `law`. `pivots` and `distances` map a body to
    the body that a point of it is joined to, None for the world, as it stands at `poses`
    (bodies, 3). Bodies in `bolted` do not move from there.

    `fields` are values of parameters by name, broadcast to all bodies, and `control_period` (s),
    `substeps`, `iterations`; a parameter that is not given has the centre of its prior.

    Raises `PalpateError` for outlines that cross themselves, have no area or are not about their
    centroid, for links or bolts of bodies that do not exist, and for any without `poses`.
    """
    shapes = [_shape(outline, f"outline {index}") for index, outline in enumerate(outlines)]
    barriers = [_shape(wall, f"wall {index}") for index, wall in enumerate(walls)]
    count = len(shapes)
    if not count:
        raise PalpateError("a planar model needs at least one body, got no outlines")
    if law not in LAWS:
        raise PalpateError(f"unknown wheel law '{law}'; there are: {', '.join(LAWS)}")
    parts = [convex_parts(shape) for shape in shapes]
    wall_parts = [part for barrier in barriers for part in convex_parts(barrier)]
    extent, gyration = np.zeros((count, 2)), np.zeros(count)
    for index, (shape, pieces) in enumerate(zip(shapes, parts, strict=True)):
        low, high = np.reshape(shape.bounds, (2, 2))
        extent[index] = 0.5 * (high - low)
        centroid = shapely.get_coordinates(shape.centroid)[0]
        if np.max(np.abs(centroid)) > OFF_CENTRE * np.max(extent[index]):
            raise PalpateError(
                f"the centroid of outline {index} lies at ({centroid[0]:.4g}, {centroid[1]:.4g}) "
                "m: expected at the origin of the body's frame (`centre_outline` moves it there)"
            )
        gyration[index] = even_gyration(pieces)
    bolts = np.zeros(count)
    for body in bolted:
        bolts[_existing(body, count)] = 1.0
    fields |= _links(count, pivots or {}, distances or {})
    fields |= {
        "outline": _pad([_pad(pieces) for pieces in parts]),
        "walls": _pad(wall_parts) if wall_parts else np.zeros((0, 3, 2)),
        "half_extent": extent,
        "even_gyration": gyration,
        "bolted": bolts,
        "bolted_pose": np.zeros((count, 3)) if poses is None else poses,
        "wheel": np.ones((count, wheels)),
        "dry": np.full((count, wheels), LAWS[law]),
        "pairs": _pairs([len(pieces) for pieces in parts], len(wall_parts), pivots or {}),
    }
    sizes = {"bodies": count, "wheels": wheels, "links": fields["pivot"].shape[1]}
    axes = axes_of(Planar)
    for name, declared in parameters_of(Planar).items():
        centre, shape = declared.prior.centre, tuple(sizes.get(axis, 2) for axis in axes[name])
        value = fields.get(name, 0.0 if centre is None else centre)
        try:
            fields[name] = np.broadcast_to(np.asarray(value, dtype=float), shape).copy()
        except ValueError as error:
            came = np.shape(value)
            raise PalpateError(f"{name} must fit the shape {shape}, got {came}") from error
    model, linked = Planar(**fields), fields["pivot"].size
    if poses is None and (linked or bolts.any()):
        raise PalpateError("links and bolts need the poses (bodies, 3) at which they hold")
    return model.linked_at(as_floating(poses)) if linked else model


def rectangle(width: float, depth: float) -> Float[np.ndarray, "4 2"]:
    """The outline of a box, width along x and depth along y in m, about its centre."""
    return 0.5 * np.array([[-width, -depth], [width, -depth], [width, depth], [-width, depth]])


def centre_outline(
    outline: ArrayLike,
) -> tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, "2"]]:
    """A polygon (corners, 2) moved so that its centroid is the origin, and the centroid, in m."""
    centroid = _shape(outline, "the outline").centroid
    place = np.array([centroid.x, centroid.y])
    return np.asarray(outline, dtype=float) - place, place


def convex_parts(shape: Any) -> list[Float[np.ndarray, "corners 2"]]:
    """Convex polygons, counter-clockwise, that make up a shapely polygon or several.

    Triangles of a constrained Delaunay triangulation, joined again while the union stays convex.
    """
    if _is_convex(shape):
        return [_corners(shape)]
    pieces = [
        piece
        for polygon in getattr(shape, "geoms", [shape])
        for piece in shapely.constrained_delaunay_triangles(polygon).geoms
        if piece.area > 0.0
    ]
    while True:
        for first, second in itertools.combinations(range(len(pieces)), 2):
            both = pieces[first].union(pieces[second])
            if _is_convex(both):
                pieces[first] = both
                del pieces[second]
                break
        else:
            return [_corners(piece) for piece in pieces]


def even_gyration(parts: Sequence[Float[np.ndarray, "corners 2"]]) -> float:
    """Radius of gyration (m) about the origin of convex polygons filled evenly."""
    area, moment = 0.0, 0.0
    for part in parts:
        following = np.roll(part, -1, axis=0)
        cross = part[:, 0] * following[:, 1] - part[:, 1] * following[:, 0]
        squares = np.sum(part**2 + part * following + following**2, axis=1)
        area += 0.5 * np.sum(cross)
        moment += np.sum(cross * squares) / 12.0
    return float(np.sqrt(moment / area))


def _shape(outline: Any, name: str) -> Any:
    """The shapely polygon of one polygon, or of the several that make up a body."""
    several = np.ndim(outline[0]) == 2
    polygons = []
    for polygon in outline if several else [outline]:
        corners = np.asarray(polygon, dtype=float)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise PalpateError(
                f"{name} must be a polygon of shape (at least 3 corners, 2), got {corners.shape}"
            )
        if not np.all(np.isfinite(corners)):
            raise PalpateError(f"{name} has corners that are not finite")
        shape = shapely.Polygon(corners)
        if not shape.is_valid or not shape.area > 0.0:
            raise PalpateError(
                f"{name} crosses itself or has no area ({shapely.is_valid_reason(shape)}): "
                "expected the corners of a simple polygon in order"
            )
        polygons.append(shape)
    return shapely.unary_union(polygons) if several else polygons[0]


def _is_convex(shape: Any) -> bool:
    return shape.geom_type == "Polygon" and shape.area > (1.0 - 1e-9) * shape.convex_hull.area


def _corners(polygon: Any) -> Float[np.ndarray, "corners 2"]:
    """The corners of a convex polygon, counter-clockwise, without those on a straight edge."""
    hull = shapely.remove_repeated_points(polygon.convex_hull.simplify(0.0))
    return np.asarray(orient(hull).exterior.coords)[:-1]


def _pad(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Stacked, all as long as the longest: the last row again where one is shorter."""
    shape = np.max([array.shape for array in arrays], axis=0)
    return np.stack(
        [
            np.pad(array, [(0, more) for more in shape - array.shape], mode="edge")
            for array in arrays
        ]
    )


def _pairs(parts: Sequence[int], walls: int, pivots: Mapping[int, int | None]) -> np.ndarray:
    """(pairs, 4): body and part on the one side, body and part on the other; -1 for a wall.

    Bodies that a pivot joins do not touch: they overlap about it.
    """
    places = [(body, part) for body, count in enumerate(parts) for part in range(count)]
    joined = {frozenset(pair) for pair in pivots.items()}
    pairs = [(*a, *b) for a in places for b in places if a[0] < b[0] and {a[0], b[0]} not in joined]
    pairs += [(*a, -1, wall) for a in places for wall in range(walls)]
    return np.asarray(pairs, dtype=np.int32).reshape(-1, 4)


def _existing(body: int, count: int) -> int:
    if not 0 <= body < count:
        raise PalpateError(f"there is no body {body}: bodies are numbered 0 to {count - 1}")
    return body


def _links(
    count: int, pivots: Mapping[int, int | None], distances: Mapping[int, int | None]
) -> dict[str, np.ndarray]:
    """Structure of the links: padded to as many as one body has."""
    size = max((int(b in pivots) + int(b in distances) for b in range(count)), default=0)
    pivot, distance = np.zeros((count, size)), np.zeros((count, size))
    link_to = np.full((count, size), -1, dtype=np.int32)
    taken = [0] * count
    for kind, wanted in ((pivot, pivots), (distance, distances)):
        for body, other in wanted.items():
            place = taken[_existing(body, count)]
            kind[body, place] = 1.0
            if other is not None:
                if other == body:
                    raise PalpateError(f"body {body} cannot be linked to itself")
                link_to[body, place] = _existing(other, count)
            taken[body] += 1
    pose = np.zeros((count, size, 3))
    return {"pivot": pivot, "distance": distance, "link_to": link_to, "link_pose": pose}
