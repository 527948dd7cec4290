"""Where the links of a tree are, and which velocity each joint gives to what it carries.

What moves a point x is written as a matrix and a vector, x -> A x + a: a pose (rotation, origin),
and a velocity field (its gradient, antisymmetric; its value at the world's origin), both in the
world's axes. Joining two is a product, and there is no case or cross product anywhere (Park, Bobrow
and Ploen, "A Lie group formulation of robot dynamics", IJRR 1995).

Arrays are (links, 3, 3, lanes), (links, 3, lanes) or (links, lanes), without the first axis of one
link. A lane is one of many trees of one structure; lanes lie side by side in memory, so that every
operation runs over them, and what all have in common may have one only. Who hangs on whom is data:
another tree of as many links does not compile anew.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from palpate.numerics.trigonometry import cosine_and_sine

Each = Float[Array, "*links #lanes"]
Vector = Float[Array, "*links 3 #lanes"]
Matrix = Float[Array, "*links 3 3 #lanes"]
Among = Float[Array, "links links"]


class Affine(NamedTuple):
    """x -> matrix x + vector, of each link."""

    matrix: Matrix
    vector: Vector


class Joints(NamedTuple):
    """Link i turns or slides along an axis in a frame that its parent carries.

    At a position q the link is in its parent's frame, the world's for a parent of -1, at the
    rotation `still` + `sine` sin q + `versine` (1 - cos q) and at `origin` + `slide` q. Its own
    velocity field there is `spin` x + `shift` per rad/s or m/s, in its own frame. Both are nothing
    for a link that is fixed.
    """

    parent: Int[Array, " links"]
    still: Matrix
    sine: Matrix
    versine: Matrix
    origin: Vector
    slide: Vector
    spin: Matrix
    shift: Vector


def joints_of(
    parent: Int[Array, " links"],
    rotation: Matrix,
    origin: Vector,
    axis: Vector,
    revolute: Each,
    prismatic: Each,
) -> Joints:
    """From frames in the parents' (m), unit vectors in these, and ones for the kind of joint."""
    zero = jnp.zeros_like(axis[:, 0])
    x, y, z = axis[:, 0], axis[:, 1], axis[:, 2]
    rows = (zero, -z, y), (z, zero, -x), (-y, x, zero)
    turning = jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)
    spin, shift = turning * revolute[:, None, None], axis * prismatic[:, None]
    sine = product(rotation, spin)
    return Joints(
        parent, rotation, sine, product(sine, spin), origin, apply(rotation, shift), spin, shift
    )


def product(a: Matrix, b: Matrix) -> Matrix:
    """a b."""
    terms = [a[..., :, k, None, :] * b[..., None, k, :, :] for k in range(3)]
    return terms[0] + terms[1] + terms[2]


def product_transposed(a: Matrix, b: Matrix) -> Matrix:
    """a b'."""
    terms = [a[..., :, k, None, :] * b[..., None, :, k, :] for k in range(3)]
    return terms[0] + terms[1] + terms[2]


def apply(a: Matrix, v: Vector) -> Vector:
    """a v."""
    terms = [a[..., :, k, :] * v[..., None, k, :] for k in range(3)]
    return terms[0] + terms[1] + terms[2]


def outer(a: Vector, b: Vector) -> Matrix:
    """a b'."""
    return a[..., :, None, :] * b[..., None, :, :]


def carriers(parent: Int[Array, " links"], dtype: jnp.dtype) -> Among:
    """One where the joint of the column moves the link of the row: itself and its ancestors."""
    links = parent.shape[0]
    above = (parent[:, None] == jnp.arange(links)[None, :]).astype(dtype)
    matrix = jnp.eye(links, dtype=dtype) + above
    for _ in range((links - 1).bit_length()):
        matrix = jnp.minimum(matrix @ matrix, 1.0)
    return matrix


def outwards(parent: Int[Array, " links"], step: Callable[..., Any], world: Any, of: Any) -> Any:
    """`step(what the parent has, what is of this link)` for each link, from the world's own on.

    `of` has the links' axis first. A loop over links, which are read and written in place.
    """
    links = parent.shape[0]

    def visit(known: Any, each: Any) -> tuple[Any, None]:
        index, above, own = each
        found = step(jax.tree.map(lambda array: row(array, above + 1), known), own)
        return jax.tree.map(lambda a, value: with_row(a, value, index + 1), known, found), None

    start = jax.tree.map(
        lambda one: jnp.zeros((links + 1, *one.shape), one.dtype).at[0].set(one), world
    )
    known, _ = jax.lax.scan(visit, start, (jnp.arange(links), parent, of))
    return jax.tree.map(lambda array: array[1:], known)


def inwards(parent: Int[Array, " links"], of: Any, use: Callable[[Any, Any], Any], own: Any) -> Any:
    """`use(the sum of `of` over a link and all that it carries, what is of this link)` of each.

    `of` and `own` have the links' axis first, and so has the result.
    """

    def visit(total: Any, each: Any) -> tuple[Any, Any]:
        index, above, own = each
        whole = jax.tree.map(lambda array: row(array, index + 1), total)

        def added(array: Array, one: Array) -> Array:
            return with_row(array, row(array, above + 1) + one, above + 1)

        return jax.tree.map(added, total, whole), use(whole, own)

    start = jax.tree.map(lambda array: jnp.concatenate([jnp.zeros_like(array[:1]), array]), of)
    each = jnp.arange(len(parent)), parent, own
    return jax.lax.scan(visit, start, each, reverse=True)[1]


def row(array: Array, index: Array) -> Array:
    """One link's: as a slice, which is faster than an index, and its derivative much faster."""
    return jax.lax.dynamic_index_in_dim(array, index, keepdims=False)


def with_row(array: Array, value: Array, index: Array) -> Array:
    """The array with this link's replaced."""
    return jax.lax.dynamic_update_index_in_dim(array, value, index, axis=0)


def local_poses(joints: Joints, position: Each) -> Affine:
    """Parent from link, from joint positions (rad or m)."""
    cosine, sine = cosine_and_sine(position)
    versine = 1.0 - cosine
    turn = joints.sine * sine[:, None, None] + joints.versine * versine[:, None, None]
    return Affine(joints.still + turn, joints.origin + joints.slide * position[:, None])


def poses(joints: Joints, position: Each) -> Affine:
    """World from link, from joint positions (rad or m)."""

    def joined(above: Affine, own: Affine) -> Affine:
        vector = above.vector + apply(above.matrix, own.vector)
        return Affine(product(above.matrix, own.matrix), vector)

    lanes = position.shape[1:]
    origin = jnp.zeros((3, *lanes), position.dtype)
    upright = jnp.broadcast_to(jnp.eye(3, dtype=position.dtype)[..., None], (3, 3, *lanes))
    local = local_poses(joints, position)
    return outwards(joints.parent, joined, Affine(upright, origin), local)


def fields(joints: Joints, pose: Affine) -> Affine:
    """Velocity of the points that each joint carries, per rad/s or m/s."""
    matrix = product_transposed(product(pose.matrix, joints.spin), pose.matrix)
    vector = apply(pose.matrix, joints.shift) - apply(matrix, pose.vector)
    return Affine(matrix, vector)


def axial(matrix: Matrix) -> Vector:
    """The vector w of an antisymmetric matrix: matrix x = w x x (a cross product)."""
    return jnp.stack([matrix[:, 2, 1], matrix[:, 0, 2], matrix[:, 1, 0]], axis=1)
