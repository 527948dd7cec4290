"""One implicit time step of rigid bodies in the plane: friction, wheels, links and contacts.

The velocity at the end of a step minimises a convex potential,

    1/2 (v - v*)' M (v - v*) + h sum_i psi_i(J_i v),    v* = v + h M^-1 (applied wrench),

where psi_i is half the power that a viscous element takes, or all that dry friction takes
(maximum dissipation; Moreau, "Unilateral contact and dry friction in finite freedom dynamics",
1988). Newton's method for velocity and friction together finds it in a few iterations, more where
bodies touch (`contact`). At last every dry element counts as a viscous one of the same force, which
changes nothing at the minimum, and short of it takes energy and never adds any. Derivatives are
the implicit function theorem's: no iteration is differentiated.

Positions take half a step before and half a step after (drift, kick, drift), which makes free
motion under a constant wrench exact. All of it happens in each body's axes about its centre of
mass, where its wheels stand still and its inertia is diagonal.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

from palpate.models.model import KEPT
from palpate.models.planar import contact
from palpate.models.planar.contact import Contacts
from palpate.models.planar.friction import (
    Entries,
    Pull,
    Resistance,
    Triple,
    as_viscous,
    curvature,
    product,
    pulls,
    pulls_after,
    resistance,
    slope,
)
from palpate.models.planar.links import Rows, link_rows, no_rows, turn
from palpate.models.planar.system import System
from palpate.numerics.small_systems import cholesky, solve
from palpate.numerics.trigonometry import cosine_and_sine

MORE_ITERATIONS = 2  # where bodies touch


def advance(
    system: System,
    pose: Float[Array, "bodies 3 *lanes"],
    rates: Float[Array, "bodies 3 *lanes"],
    wrench: Float[Array, "bodies 3 *lanes"],
    time_step: float,
    iterations: int,
) -> tuple[Float[Array, "bodies 3 *lanes"], Float[Array, "bodies 3 *lanes"]]:
    """Poses and velocities of the bodies' frames one time step (s) later.

    Where links or shapes couple bodies there are no lanes.
    """
    half = 0.5 * time_step
    centre_x, centre_y = system.centre
    rate = rates[:, 2]
    angle = pose[:, 2]
    lever_x, lever_y = turn(centre_x, centre_y, *cosine_and_sine(angle))
    start_x = rates[:, 0] - rate * lever_y
    start_y = rates[:, 1] + rate * lever_x
    begin_x, begin_y = pose[:, 0] + lever_x, pose[:, 1] + lever_y
    x, y = begin_x + half * start_x, begin_y + half * start_y
    angle = angle + half * rate
    lever_x, lever_y = turn(centre_x, centre_y, *cosine_and_sine(angle))
    torque = wrench[:, 2] - (lever_x * wrench[:, 1] - lever_y * wrench[:, 0])

    # The new velocity serves from the middle of this step to the middle of the next: a wheel's axes
    # are those at the end of this one, or a body on a locked wheel would leave it along tangents.
    ahead = angle + half * rate
    cosine, sine = cosine_and_sine(ahead)
    force_x, force_y = turn(wrench[:, 0], wrench[:, 1], cosine, -sine)
    start = turn(start_x, start_y, cosine, -sine)
    bodies = system.bodies
    free = (
        start[0] + time_step * force_x / bodies.mass,
        start[1] + time_step * force_y / bodies.mass,
        rate + time_step * torque / bodies.inertia,
    )
    links = no_rows(pose.shape[0], pose.dtype)
    if system.links is not None:
        middle = jnp.stack([x, y, angle], axis=-1)
        centre = jnp.stack(system.centre, axis=-1)
        links = link_rows(system.links, bodies.mass, centre, middle, ahead, time_step)
    resisting = resistance(bodies, free, time_step)
    velocity = solve_velocity(resisting, (start[0], start[1], rate), links, iterations)
    if system.shapes is not None:
        middle = jnp.stack([begin_x, begin_y], axis=-1)
        before, after = jnp.stack([*start, rate], axis=-1), jnp.stack(velocity, axis=-1)
        contacts = contact.contacts(system, pose, middle, ahead, before, after, time_step)
        velocity, late = solve_contacts(resisting, velocity, links, contacts, iterations)
        late_x, late_y = turn(late[0], late[1], cosine, sine)
        x, y, angle = x + late_x, y + late_y, angle + late[2]

    end_along, end_across, rate = velocity
    end_x, end_y = turn(end_along, end_across, cosine, sine)
    angle = angle + half * rate
    lever_x, lever_y = turn(centre_x, centre_y, *cosine_and_sine(angle))
    pose = jnp.stack([x + half * end_x - lever_x, y + half * end_y - lever_y, angle], axis=1)
    return pose, jnp.stack([end_x + rate * lever_y, end_y - rate * lever_x, rate], axis=1)


def solve_velocity(resisting: Resistance, start: Triple, links: Rows, iterations: int) -> Triple:
    """Velocity at the end of a step without contacts, from the velocity at its start."""
    fixed = jax.lax.stop_gradient((resisting, links))
    velocity = jax.lax.stop_gradient(start)
    nothing = jax.tree.map(jnp.zeros_like, pulls(fixed[0], velocity))
    # a loop: written out it compiles for twice as long and runs slower
    (velocity, _), _ = jax.lax.scan(
        lambda carry, _: (newton(*fixed, *carry), None), (velocity, nothing), length=iterations
    )
    velocity = resisted_velocity(*fixed, velocity)
    velocity = jax.tree.map(lambda part: checkpoint_name(part, KEPT), velocity)
    # the slope is zero and stays so: its derivative says how the velocity follows what it is of
    left = leftover(resisting, links, velocity)
    change = tuple(part - jax.lax.stop_gradient(part) for part in left)
    return minus(velocity, solve_bodies(own_curvature(fixed[0], velocity), change, fixed[1]))


def solve_contacts(
    resisting: Resistance, velocity: Triple, links: Rows, contacts: Contacts, iterations: int
) -> tuple[Triple, Triple]:
    """Velocity at the end of a step, and how far the times of impacts within it move the bodies.

    `velocity` is that without contacts.
    """
    joined = Rows(
        jnp.concatenate([links.jacobian, contacts.normal, contacts.tangent]),
        jnp.concatenate([links.target, contacts.target, jnp.zeros_like(contacts.friction)]),
        links.weight,
    )

    def iterate(velocity: Triple, pull: Pull, touching: Array | None) -> tuple[Triple, Pull, Array]:
        touching = contact.weights(contacts, jnp.stack(velocity, axis=-1), touching)
        rows = joined._replace(weight=jnp.concatenate([links.weight, touching]))
        return *newton(resisting, rows, velocity, pull), touching

    (velocity, _, touching), _ = jax.lax.scan(
        lambda carry, _: (iterate(*carry), None),
        iterate(velocity, pulls(resisting, velocity), None),
        length=iterations + MORE_ITERATIONS - 1,
    )
    rows = joined._replace(weight=jnp.concatenate([links.weight, touching]))
    velocity = resisted_velocity(resisting, rows, velocity)
    delayed = contact.delayed_impulse(contacts, touching, jnp.stack(velocity, axis=-1))
    impulse = (delayed[:, 0], delayed[:, 1], delayed[:, 2])
    return velocity, solve_bodies(own_curvature(resisting, velocity), impulse, links)


def newton(resisting: Resistance, rows: Rows, velocity: Triple, pull: Pull) -> tuple[Triple, Pull]:
    """A step of velocity and friction towards the least cost."""
    left = leftover(resisting, rows, velocity)
    step = solve_bodies(curvature(resisting, velocity, pull), left, rows)
    return minus(velocity, step), pulls_after(resisting, velocity, pull, step)


def own_curvature(resisting: Resistance, velocity: Triple) -> Entries:
    """Second derivative of the cost by the velocity."""
    return curvature(resisting, velocity, pulls(resisting, velocity))


def resisted_velocity(resisting: Resistance, rows: Rows, velocity: Triple) -> Triple:
    """The velocity that the forces at a velocity leave: the same where that is the least cost.

    Elsewhere too it has less energy than a step without resistance. It is solved for as a
    correction: a wheel holds a million times as much across as along, which costs digits.
    """
    left = leftover(resisting, rows, velocity)
    return minus(velocity, solve_bodies(as_viscous(resisting, velocity), left, rows))


def leftover(resisting: Resistance, rows: Rows, velocity: Triple) -> Triple:
    """Momentum that neither what resists nor the rows take, zero at the end of a step."""
    x, y, turning = slope(resisting, velocity)
    if rows.weight.size:
        off = jnp.einsum("rbi,bi->r", rows.jacobian, jnp.stack(velocity, axis=-1)) - rows.target
        pull = jnp.einsum("r,rbi->bi", rows.weight * off, rows.jacobian)
        x, y, turning = x + pull[:, 0], y + pull[:, 1], turning + pull[:, 2]
    return x, y, turning


def minus(one: Triple, other: tuple[Array, ...]) -> Triple:
    """Difference of each body's."""
    return one[0] - other[0], one[1] - other[1], one[2] - other[2]


def solve_bodies(entries: Entries, right: tuple[Array, ...], rows: Rows) -> Triple:
    """Solve (A + sum w J'J) v = `right`.

    Bodies that nothing joins are solved side by side; else all in one.
    """
    first, second, third = right
    bodies = first.shape[0]
    if not rows.weight.size:
        return solve_three(entries, (first, second, third))
    x, y, t, xy, xt, yt = entries
    size = 3 * bodies
    jacobian = rows.jacobian.reshape(-1, size)
    joined = jacobian.T @ (rows.weight[:, None] * jacobian)
    if bodies == 1:
        places = (0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)
        x, y, t, xy, xt, yt = (
            entry + joined[place] for entry, place in zip(entries, places, strict=True)
        )
        return solve_three((x, y, t, xy, xt, yt), (first, second, third))
    blocks = jnp.stack([x, xy, xt, xy, y, yt, xt, yt, t], axis=-1).reshape(bodies, 3, 3)
    matrix = jnp.eye(bodies, dtype=x.dtype)[:, None, :, None] * blocks[:, :, None, :]
    stacked = jnp.stack([first, second, third], axis=-1).reshape(size)
    solved = solve_symmetric(matrix.reshape(size, size) + joined, stacked).reshape(bodies, 3)
    return solved[:, 0], solved[:, 1], solved[:, 2]


def solve_symmetric(
    matrix: Float[Array, "size size"], right: Float[Array, " size"]
) -> Float[Array, " size"]:
    """Solve a symmetric positive definite system; derivatives solve once more with its factor."""
    root = cholesky(jax.lax.stop_gradient(matrix))
    return jax.lax.custom_linear_solve(
        lambda v: matrix @ v, right, lambda _, b: solve(root, b), symmetric=True
    )


def solve_three(entries: Entries, right: Triple) -> Triple:
    """Solve symmetric 3 x 3 systems by LDL', one for each body.

    Written out: a library call for each of thousands of 3 x 3 systems costs more than its sums.
    Derivatives solve once more. A pivot of which rounding would leave nothing is bounded below: the
    next iteration corrects the error.
    """
    x, y, t, xy, xt, yt = entries
    least = 4.0 * jnp.finfo(x.dtype).eps

    def solve(_: Any, right: Triple) -> Triple:
        lower_y, lower_t = xy / x, xt / x
        pivot_y = jnp.maximum(y - lower_y * xy, least * y)
        rest = yt - lower_y * xt
        last = rest / pivot_y
        pivot_t = jnp.maximum(t - lower_t * xt - last * rest, least * t)
        a = right[0]
        b = right[1] - lower_y * a
        c = (right[2] - lower_t * a - last * b) / pivot_t
        b = b / pivot_y - last * c
        return a / x - lower_y * b - lower_t * c, b, c

    return jax.lax.custom_linear_solve(lambda v: product(entries, v), right, solve, symmetric=True)
