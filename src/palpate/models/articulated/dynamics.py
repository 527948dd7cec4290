"""Inertia matrix and forces of a tree of links, in the world's axes.

A body is known by its mass and by the first and second moments of its mass (its pseudo-inertia;
Wensing, Kim and Slotine, "Linear matrix inequalities for physically consistent inertial parameter
identification", RA-L 2018), which moving the body transforms like products of points: with the
velocity fields of `kinematics` d'Alembert's principle, sum of dm (acceleration) . (virtual
displacement), is a product of matrices. Shapes as there.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models.articulated.kinematics import (
    Affine,
    Among,
    Each,
    Joints,
    Matrix,
    Vector,
    apply,
    fields,
    inwards,
    outer,
    outwards,
    poses,
    product,
    product_transposed,
)

Inertia = Float[Array, "links links #lanes"]


class Bodies(NamedTuple):
    """Moments of each link's mass in its frame: mass (kg), first (kg m), second (kg m^2)."""

    mass: Each
    first: Vector
    second: Matrix


class Motion(NamedTuple):
    """What moves how: M a + bias = forces of the joints, at one position and velocity."""

    matrix: Inertia
    bias: Each
    pose: Affine


def motion(
    joints: Joints,
    bodies: Bodies,
    carried: Among,
    gravity: Float[Array, "3 #lanes"],
    position: Each,
    velocity: Each,
    push: tuple[Vector, Vector] | None = None,
) -> Motion:
    """Inertia matrix (kg m^2, kg m, kg) and bias (N m, N) of gravity and velocities.

    `push` is a force on each link (world's axes, N) at a point of its frame (m): what it does to
    the joints is taken off the bias.
    """
    pose = poses(joints, position)
    own = fields(joints, pose)
    mass, first, second = in_world(bodies, pose)

    def carried_along(above: tuple[Affine, Affine], each: Any) -> tuple[Affine, Affine]:
        """A link's velocity field and what of its acceleration its joints' motion makes."""
        (spin, flow), (turns, moves) = above
        own, rate = each
        spin, flow = spin + own.matrix * rate, flow + own.vector * rate
        # a field that is carried along by another changes by their commutator
        twice = product(spin, own.matrix)
        moved = apply(spin, own.vector) - apply(own.matrix, flow)
        turns = turns + (twice - jnp.swapaxes(twice, 0, 1)) * rate
        return Affine(spin, flow), Affine(turns, moves + moved * rate)

    at_rest = Affine(*(jnp.zeros(part.shape[1:], part.dtype) for part in pose))
    falling = Affine(at_rest.matrix, at_rest.vector - gravity)
    of = own, velocity
    rates, changes = outwards(joints.parent, carried_along, (at_rest, falling), of)
    gradient = changes.matrix + product(rates.matrix, rates.matrix)
    value = changes.vector + apply(rates.matrix, rates.vector)
    moment = product(gradient, second) + outer(value, first)  # sum of dm (acceleration) x'
    force = apply(gradient, first) + value * mass[:, None]
    if push is not None:
        acts, at = push
        moment = moment - outer(acts, pose.vector + apply(pose.matrix, at))
        force = force - acts

    def balanced(whole: Any, each: tuple[Affine, Array]) -> tuple[Array, Array]:
        """What a joint's own force has to be, and what the others' if this one accelerates."""
        moment, force, mass, first, second = whole
        field, below = each
        bias = work(field, moment, force)
        moment = product(field.matrix, second) + outer(field.vector, first)
        force = apply(field.matrix, first) + field.vector * mass
        return bias, work(own, moment, force) * below[:, None]

    of = moment, force, mass, first, second
    bias, lower = inwards(joints.parent, of, balanced, (own, carried))
    diagonal = jnp.eye(carried.shape[0], dtype=carried.dtype)[:, :, None]
    return Motion(lower + jnp.swapaxes(lower, 0, 1) * (1.0 - diagonal), bias, pose)


def work(field: Affine, moment: Array, force: Array) -> Array:
    """What forces do along velocity fields: sum of moment : gradient, and force . value.

    Either may be of one link and the other of all.
    """
    matrix, vector = field
    total = sum(
        (vector[..., i, :] * force[..., i, :] for i in (1, 2)),
        start=vector[..., 0, :] * force[..., 0, :],
    )
    for i, j in ((2, 1), (0, 2), (1, 0)):  # the gradient is antisymmetric
        total = total + matrix[..., i, j, :] * (moment[..., i, j, :] - moment[..., j, i, :])
    return total


def in_world(bodies: Bodies, pose: Affine) -> tuple[Each, Vector, Matrix]:
    """Mass, first and second moments of each link in the world's frame."""
    turned = apply(pose.matrix, bodies.first)
    shifted = bodies.mass[:, None] * pose.vector
    second = product_transposed(product(pose.matrix, bodies.second), pose.matrix)
    second = second + outer(pose.vector, turned) + outer(turned + shifted, pose.vector)
    return bodies.mass, turned + shifted, second


def solve(matrix: Inertia, right: Each) -> Each:
    """matrix^-1 right, of symmetric positive definite matrices of a few rows, over lanes.

    The derivative is the implicit one: nothing goes back through the elimination.
    """

    def times(x: Array) -> Array:
        return jnp.sum(matrix * x[None, :], axis=1)

    def eliminated(_: Callable[[Array], Array], b: Array) -> Array:
        return _substitute(_factors(jax.lax.stop_gradient(matrix)), b)

    return jax.lax.custom_linear_solve(times, right, eliminated, symmetric=True)


def _factors(matrix: Inertia) -> list[tuple[Array, Array]]:
    """L and D of L D L' = matrix: of each column what is below the diagonal, and 1 / D."""
    factors = []
    rest = matrix
    for _ in range(matrix.shape[0]):
        inverse = 1.0 / rest[0, 0]
        column = rest[1:, 0] * inverse
        factors.append((column, inverse))
        rest = rest[1:, 1:] - column[:, None] * rest[0, None, 1:]
    return factors


def _substitute(factors: list[tuple[Array, Array]], right: Array) -> Array:
    """(L D L')^-1 right."""
    halfway, rest = [], right
    for column, inverse in factors:
        halfway.append(rest[0] * inverse)
        rest = rest[1:] - column * rest[0]
    found = rest  # none yet: the last comes first
    for (column, _), own in zip(reversed(factors), reversed(halfway), strict=True):
        value = own - jnp.sum(column * found, axis=0)
        found = jnp.concatenate([value[None], found])
    return found
