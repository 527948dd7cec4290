"""Where convex polygons are nearest to each other: two points, the gaps there, and a normal.

The edge of either polygon that the other lies furthest outside of (or least inside) is the
reference; the edge of the other that faces it is cut off beside it, and its two ends are the
points (separating axes and clipping, as in Catto, "Computing distance", GDC 2010).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from palpate.models.planar.links import turn

SHORTEST = 1e-6  # m: a shorter edge is padding
FAR = 1e6  # m


class Shapes(NamedTuple):
    """Convex parts that may touch: corners from the frames' origins, walls' in the world (m).

    Corners go round counter-clockwise, the last one again where a part has fewer. `pairs` names
    body and part on the one side, and on the other, where body -1 is a wall.
    """

    outline: Float[Array, "bodies parts corners 2"]
    walls: Float[Array, "walls corners 2"]
    pairs: Int[Array, "pairs 4"]


class Near(NamedTuple):
    """Points of one side near an edge of the other, in the world: two for each pair.

    The normal points from the edge to the points; `sign` is 1 where they belong to the first side
    of the pair, and -1 where they belong to the second.
    """

    gap: Float[Array, "pairs 2"]
    point: Float[Array, "pairs 2 2"]
    normal: Float[Array, "pairs 2"]
    sign: Float[Array, " pairs"]


def nearest(shapes: Shapes, pose: Float[Array, "bodies 3"]) -> Near:
    """The nearest points of each pair when the bodies' frames are at these poses."""
    cosine, sine = jnp.cos(pose[:, 2]), jnp.sin(pose[:, 2])
    x, y = turn(
        shapes.outline[..., 0], shapes.outline[..., 1], cosine[:, None, None], sine[:, None, None]
    )
    placed = jnp.stack([x, y], axis=-1) + pose[:, None, None, :2]
    parts = placed.shape[1]
    placed = placed.reshape(-1, *placed.shape[2:])
    first = pick(placed, parts * shapes.pairs[:, 0] + shapes.pairs[:, 1])
    second = pick(placed, jnp.maximum(parts * shapes.pairs[:, 2] + shapes.pairs[:, 3], 0))
    if shapes.walls.shape[0]:
        first, second, walls = _as_long(first, second, shapes.walls[shapes.pairs[:, 3]])
        second = jnp.where((shapes.pairs[:, 2] < 0)[:, None, None], walls, second)
    return jax.vmap(nearest_points)(first, second)


def nearest_points(first: Float[Array, "corners 2"], second: Float[Array, "corners 2"]) -> Near:
    """The nearest points of two convex polygons."""
    ours, theirs = _furthest_edge(first, second), _furthest_edge(second, first)
    swapped = theirs[0] > ours[0]
    reference = jnp.where(swapped, second, first)
    facing = jnp.where(swapped, first, second)
    edge = jnp.where(swapped, theirs[1], ours[1])
    outward = pick(_outward(reference)[0], edge)
    start = pick(reference, edge)
    length = jnp.linalg.norm(pick(jnp.roll(reference, -1, axis=0), edge) - start)
    along = jnp.stack([-outward[1], outward[0]])

    normals, exists = _outward(facing)
    opposite = jnp.argmin(jnp.where(exists, normals @ outward, FAR))
    ends = jnp.stack([pick(facing, opposite), pick(jnp.roll(facing, -1, axis=0), opposite)])
    place = (ends - start) @ along
    span = place[1] - place[0]
    upright = jnp.abs(span) < SHORTEST
    by = jnp.where(upright, 1.0, span)
    share = jnp.where(upright, jnp.array([0.0, 1.0]), (jnp.stack([length, 0.0]) - place[0]) / by)
    share = jnp.clip(share, 0.0, 1.0)
    point = ends[0] + share[:, None] * (ends[1] - ends[0])
    return Near(
        gap=(point - start) @ outward,
        point=point,
        normal=outward,
        sign=jnp.where(swapped, 1.0, -1.0).astype(point.dtype),
    )


def pick(values: Array, index: Array) -> Array:
    """`values[index]` along the first axis, as a product.

    The derivative of an index is a loop over its elements, the derivative of this is a product.
    """
    chosen = jax.nn.one_hot(index, values.shape[0], dtype=values.dtype)
    return jnp.tensordot(chosen, values, axes=1)


def _furthest_edge(polygon: Array, other: Array) -> tuple[Array, Array]:
    """How far outside of one edge of the polygon all of the other lies at most, and which edge."""
    outward, exists = _outward(polygon)
    offset = other[:, None, :] - polygon[None, :, :]
    distance = jnp.min(jnp.sum(offset * outward, axis=-1), axis=0)
    distance = jnp.where(exists, distance, -FAR)
    return jnp.max(distance), jnp.argmax(distance)


def _outward(polygon: Float[Array, "corners 2"]) -> tuple[Array, Array]:
    """Outward unit normal of each edge from its corner, and whether the edge exists."""
    edge = jnp.roll(polygon, -1, axis=0) - polygon
    squared = jnp.sum(jnp.square(edge), axis=-1)
    exists = squared > SHORTEST**2
    inverse = jax.lax.rsqrt(jnp.where(exists, squared, 1.0))
    return jnp.stack([edge[:, 1], -edge[:, 0]], axis=-1) * inverse[:, None], exists


def _as_long(*polygons: Float[Array, "pairs _ 2"]) -> list[Array]:
    """Polygons with equally many corners, the last one again where there were fewer."""
    most = max(polygon.shape[1] for polygon in polygons)
    return [
        jnp.concatenate([p, jnp.repeat(p[:, -1:], most - p.shape[1], axis=1)], axis=1)
        for p in polygons
    ]
