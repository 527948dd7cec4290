"""Pivots and distances between bodies, or to the world, as rows of a system of equations."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from palpate.numerics.small_systems import cholesky, solve

STIFFNESS = 3e3  # of a link, in masses of its body: it gives way by 1/3000 of a free step
FASTEST = 1.0  # m/s: how fast a link makes up for what it is off by
CORRECTIONS = 2  # of a pose that links do not allow: the second is of the first's curvature
SINGULAR = 1e-6  # of a row's own weight: what is not there, or cannot move, has none
COINCIDENT = 1e-12  # m^2: anchors nearer than 1e-6 m have no direction between them


class Links(NamedTuple):
    """Links of bodies: anchors on both sides from the frames' origins (m), the distance kept (m).

    `to` is the other body, -1 for the world; `pivot` and `distance` say which kind it is, if any.
    """

    anchor: Float[Array, "bodies links 2"]
    other_anchor: Float[Array, "bodies links 2"]
    length: Float[Array, "bodies links"]
    to: Int[Array, "bodies links"]
    pivot: Float[Array, "bodies links"]
    distance: Float[Array, "bodies links"]


class Rows(NamedTuple):
    """Constraints that couple bodies: velocities J v (m/s), held at a target by a weight (kg)."""

    jacobian: Float[Array, "rows bodies 3"]
    target: Float[Array, " rows"]
    weight: Float[Array, " rows"]


def no_rows(bodies: int, dtype: jnp.dtype) -> Rows:
    """Nothing that couples bodies."""
    return Rows(jnp.zeros((0, bodies, 3), dtype), jnp.zeros(0, dtype), jnp.zeros(0, dtype))


def turn(x: Array, y: Array, cosine: Array, sine: Array) -> tuple[Array, Array]:
    """A vector's components after it was turned by an angle."""
    return cosine * x - sine * y, sine * x + cosine * y


def link_rows(
    links: Links,
    mass: Float[Array, " bodies"],
    centre: Float[Array, "bodies 2"],
    pose: Float[Array, "bodies 3"],
    ahead: Float[Array, " bodies"],
    time_step: float,
) -> Rows:
    """Two rows for each link, along and across: a pivot needs both, a distance the first.

    They are of velocities in the bodies' axes. `pose` is that of the centres of mass in the middle
    of the step, `ahead` the angles at its end. What a link is off by is made up until the middle of
    the next.
    """
    bodies, count = links.to.shape
    # who a link holds, as products: the derivative of an index is a loop
    here = jnp.repeat(jnp.eye(bodies, dtype=pose.dtype)[:, None], count, axis=1)
    there = jax.nn.one_hot(links.to, bodies, dtype=pose.dtype)  # none for the world
    own, others = links.anchor - here @ centre, links.other_anchor - there @ centre

    def placed(lever: Array, who: Array) -> tuple[Array, Array]:
        angle = who @ pose[:, 2]
        x, y = turn(lever[..., 0], lever[..., 1], jnp.cos(angle), jnp.sin(angle))
        return x + who @ pose[:, 0], y + who @ pose[:, 1]

    own_x, own_y = placed(own, here)
    other_x, other_y = placed(others, there)  # a point of the world stays as it is
    gap_x, gap_y = own_x - other_x, own_y - other_y
    length = jnp.sqrt(jnp.square(gap_x) + jnp.square(gap_y) + COINCIDENT)
    # a pivot's rows are the world's axes, a distance's first row points from anchor to anchor
    along_x = 1.0 + links.distance * (gap_x / length - 1.0)
    along_y = links.distance * gap_y / length
    off_along = gap_x + links.distance * (length - links.length - gap_x)
    off_across = (1.0 - links.distance) * gap_y
    off = jnp.stack([off_along, off_across]).reshape(-1)

    def row(x: Array, y: Array) -> Array:
        """Rate of the gap in direction (x, y) of the world from all velocities."""

        def of(lever: Array, who: Array) -> Array:
            angle = who @ ahead
            a, b = turn(x, y, jnp.cos(angle), -jnp.sin(angle))
            side = jnp.stack([a, b, lever[..., 0] * b - lever[..., 1] * a], axis=-1)
            return who[..., None] * side[..., None, :]

        return of(own, here) - of(others, there)

    stiff = STIFFNESS * mass[:, None]
    return Rows(
        jacobian=jnp.stack([row(along_x, along_y), row(-along_y, along_x)]).reshape(-1, bodies, 3),
        target=jnp.clip(-off / time_step, -FASTEST, FASTEST),
        weight=jnp.stack([stiff * (links.pivot + links.distance), stiff * links.pivot]).reshape(-1),
    )


def project_onto_links(
    links: Links,
    gyration: Float[Array, " bodies"],
    loose: Float[Array, " bodies"],
    pose: Float[Array, "bodies 3"],
    velocity: Float[Array, "bodies 3"],
) -> tuple[Float[Array, "bodies 3"], Float[Array, "bodies 3"]]:
    """The nearest poses (m, m, rad) and velocities of the frames' origins that the links allow.

    Nearest in the metric of bodies of radii of `gyration` (m) and of one mass, of which those that
    are not `loose` stay: it does not depend on what is not known of them. A step would make up for
    what a measured pose is off by with an impulse, which turns the body from then on.
    """
    ease = loose[:, None] / jnp.stack([jnp.ones_like(gyration)] * 2 + [gyration**2], axis=1)
    origin = jnp.zeros_like(pose[:, :2])

    def moved(pose: Array, velocity: Array | None = None) -> Array:
        """What a pose, or a velocity there, has to change by."""
        rows = link_rows(links, jnp.ones_like(gyration), origin, pose, pose[:, 2], 1.0)
        exists = rows.weight > 0
        cosine, sine = jnp.cos(pose[:, 2]), jnp.sin(pose[:, 2])
        x, y = turn(rows.jacobian[..., 0], rows.jacobian[..., 1], cosine, sine)
        jacobian = jnp.stack([x, y, rows.jacobian[..., 2]], axis=-1) * exists[:, None, None]
        wanted = rows.target * exists
        if velocity is not None:
            wanted = -jnp.einsum("rbi,bi->r", jacobian, velocity)
        matrix = jnp.einsum("rbi,bi,sbi->rs", jacobian, ease, jacobian)
        root = cholesky(matrix + SINGULAR * jnp.eye(len(matrix), dtype=matrix.dtype))
        return ease * jnp.einsum("rbi,r->bi", jacobian, solve(root, wanted))

    for _ in range(CORRECTIONS):
        pose = pose + moved(pose)
    return pose, velocity + moved(pose, velocity)
