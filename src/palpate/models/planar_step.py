"""One implicit time step of rigid bodies in the plane: friction, wheels, links and contacts.

The velocity at the end of a step minimises a convex potential,

    1/2 (v - v*)' M (v - v*) + h sum_i psi_i(J_i v),    v* = v + h M^-1 (applied wrench),

where psi_i is half the power that a viscous element takes, or all that dry friction takes
(maximum dissipation; Moreau, "Unilateral contact and dry friction in finite freedom dynamics",
1988). It is found by reweighting: dry friction counts as a viscous element of its last force over
its last speed, so that every iteration is one symmetric positive definite system which takes
energy and never adds any, however stiff a wheel is. Three iterations leave the error of the
smoothing alone (`planar_friction`); where bodies touch there are more.

Positions take half a step before and half a step after (drift, kick, drift), which makes free
motion under a constant wrench exact. All of it happens in each body's axes about its centre of
mass, where its wheels stand still and its inertia is diagonal.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models import planar_contact
from palpate.models.planar_contact import Contacts
from palpate.models.planar_friction import Rolling, Slip, Triple, first_slip, next_slip, weights
from palpate.models.planar_geometry import Shapes
from palpate.models.planar_links import Links, Rows, link_rows, no_rows, turn

GRAVITY = 9.81  # m/s^2
MORE_ITERATIONS = 2  # where bodies touch
BOLTED = 1e6  # how many times as heavy a bolted body is


class System(NamedTuple):
    """What a step needs to know; centres of mass in m from the frames' origins."""

    bodies: Rolling
    centre: tuple[Array, Array]
    links: Links
    shapes: Shapes
    restitution: Float[Array, " bodies"]
    contact_friction: Float[Array, " bodies"]


def advance(
    system: System,
    pose: Float[Array, "bodies 3"],
    rates: Float[Array, "bodies 3"],
    wrench: Float[Array, "bodies 3"],
    time_step: float,
    iterations: int,
) -> tuple[Float[Array, "bodies 3"], Float[Array, "bodies 3"]]:
    """Poses and velocities of the bodies' frames one time step (s) later."""
    half = 0.5 * time_step
    centre_x, centre_y = system.centre
    rate = rates[:, 2]
    angle = pose[:, 2]
    lever_x, lever_y = turn(centre_x, centre_y, jnp.cos(angle), jnp.sin(angle))
    start_x = rates[:, 0] - rate * lever_y
    start_y = rates[:, 1] + rate * lever_x
    begin_x, begin_y = pose[:, 0] + lever_x, pose[:, 1] + lever_y
    x, y = begin_x + half * start_x, begin_y + half * start_y
    angle = angle + half * rate
    lever_x, lever_y = turn(centre_x, centre_y, jnp.cos(angle), jnp.sin(angle))
    torque = wrench[:, 2] - (lever_x * wrench[:, 1] - lever_y * wrench[:, 0])

    # The new velocity serves from the middle of this step to the middle of the next: what a wheel
    # does not let through is told at the end of this one, or a body on a locked wheel would leave
    # it along tangents.
    ahead = angle + half * rate
    cosine, sine = jnp.cos(ahead), jnp.sin(ahead)
    force_x, force_y = turn(wrench[:, 0], wrench[:, 1], cosine, -sine)
    start = turn(start_x, start_y, cosine, -sine)
    bodies = system.bodies
    free = (
        start[0] + time_step * force_x / bodies.mass,
        start[1] + time_step * force_y / bodies.mass,
        rate + time_step * torque / bodies.inertia,
    )
    links = no_rows(pose.shape[0], pose.dtype)
    if system.links.to.shape[1]:
        middle = jnp.stack([x, y, angle], axis=-1)
        centre = jnp.stack(system.centre, axis=-1)
        links = link_rows(system.links, bodies.mass, centre, middle, ahead, time_step)
    velocity, slip = solve_velocity(bodies, free, links, time_step, iterations)
    if system.shapes.pairs.shape[0]:
        contacts = planar_contact.contacts(
            system.shapes,
            system.restitution,
            system.contact_friction,
            pose,
            jnp.stack([begin_x, begin_y], axis=-1),
            ahead,
            jnp.stack([*start, rate], axis=-1),
            jnp.stack(velocity, axis=-1),
            1.0 / jnp.stack([bodies.mass, bodies.mass, bodies.inertia], axis=-1),
            time_step,
        )
        velocity, late = solve_contacts(
            bodies, free, velocity, slip, links, contacts, time_step, iterations
        )
        late_x, late_y = turn(late[0], late[1], cosine, sine)
        x, y, angle = x + late_x, y + late_y, angle + late[2]

    end_along, end_across, rate = velocity
    end_x, end_y = turn(end_along, end_across, cosine, sine)
    angle = angle + half * rate
    lever_x, lever_y = turn(centre_x, centre_y, jnp.cos(angle), jnp.sin(angle))
    pose = jnp.stack([x + half * end_x - lever_x, y + half * end_y - lever_y, angle], axis=-1)
    return pose, jnp.stack([end_x + rate * lever_y, end_y - rate * lever_x, rate], axis=-1)


def solve_velocity(
    bodies: Rolling, free: Triple, links: Rows, time_step: float, iterations: int
) -> tuple[Triple, Slip]:
    """Velocity at the end of a step without contacts, and the slip of the last iteration.

    `free` is the velocity without resistance.
    """
    momentum = bodies.mass * free[0], bodies.mass * free[1], bodies.inertia * free[2]
    slip = first_slip(bodies, free, time_step)
    velocity = solve_bodies(*resisting(bodies, slip, time_step), momentum, links)
    for _ in range(iterations - 1):
        slip = next_slip(bodies, velocity, slip, time_step)
        velocity = solve_bodies(*resisting(bodies, slip, time_step), momentum, links)
    return velocity, slip


def solve_contacts(
    bodies: Rolling,
    free: Triple,
    velocity: Triple,
    slip: Slip,
    links: Rows,
    contacts: Contacts,
    time_step: float,
    iterations: int,
) -> tuple[Triple, Triple]:
    """Velocity at the end of a step, and how far the times of impacts within it move the bodies.

    `velocity` and `slip` are those without contacts.
    """
    momentum = bodies.mass * free[0], bodies.mass * free[1], bodies.inertia * free[2]
    joined = Rows(
        jnp.concatenate([links.jacobian, contacts.normal, contacts.tangent]),
        jnp.concatenate([links.target, contacts.target, jnp.zeros_like(contacts.friction)]),
        links.weight,
    )

    def iterate(velocity: Triple, slip: Slip, touching: Array | None) -> tuple[Triple, Slip, Array]:
        touching = planar_contact.weights(contacts, jnp.stack(velocity, axis=-1), touching)
        rows = joined._replace(weight=jnp.concatenate([links.weight, touching]))
        slip = next_slip(bodies, velocity, slip, time_step)
        velocity = solve_bodies(*resisting(bodies, slip, time_step), momentum, rows)
        return velocity, slip, touching

    # a loop, and not written out: derivatives of what is written out take minutes to compile
    carry, _ = jax.lax.scan(
        lambda carry, _: (iterate(*carry), None),
        iterate(velocity, slip, None),
        length=iterations + MORE_ITERATIONS - 1,
    )
    velocity, slip, touching = carry
    delayed = planar_contact.delayed(contacts, touching, jnp.stack(velocity, axis=-1))
    held = Rows(links.jacobian, jnp.zeros_like(links.target), links.weight)
    impulse = (delayed[:, 0], delayed[:, 1], delayed[:, 2])
    return velocity, solve_bodies(*resisting(bodies, slip, time_step), impulse, held)


def resisting(
    bodies: Rolling, slip: Slip, time_step: float
) -> tuple[tuple[Array, ...], list[tuple[Triple, Array]]]:
    """Entries of inertia and floor (see `add_rows`), and the rows of the wheels with weights."""
    resist = weights(bodies, slip, time_step)
    feet, x, y = resist.feet, bodies.foot_x, bodies.foot_y
    shift = bodies.mass + resist.floor + jnp.sum(feet, axis=-1)
    turning = bodies.inertia + resist.floor * jnp.square(bodies.floor_radius)
    turning = turning + jnp.sum(feet * (jnp.square(x) + jnp.square(y)), axis=-1)
    coupling = -jnp.sum(feet * y, axis=-1), jnp.sum(feet * x, axis=-1)
    rows = [
        row
        for wheel, (along, across) in zip(bodies.wheels, resist.wheels, strict=True)
        for row in ((wheel.along, along), (wheel.across, across))
    ]
    return (shift, shift, turning, jnp.zeros_like(shift), *coupling), rows


def solve_bodies(
    entries: tuple[Array, ...], wheels: list[tuple[Triple, Array]], momentum: Triple, rows: Rows
) -> Triple:
    """Velocities v of (A + sum w J'J) v = momentum + sum w J' target.

    Bodies that nothing joins are solved side by side; else all in one.
    """
    bodies = momentum[0].shape[0]
    entries = add_rows(entries, wheels)
    if not rows.weight.size:
        return solve_three(entries, momentum)
    x, y, t, xy, xt, yt = entries
    size = 3 * bodies
    jacobian = rows.jacobian.reshape(-1, size)
    pulled = rows.weight[:, None] * jacobian
    joined, pull = jacobian.T @ pulled, rows.target @ pulled
    right = jnp.stack(momentum, axis=-1) + pull.reshape(bodies, 3)
    if bodies == 1:
        entries = (
            x + joined[0, 0],
            y + joined[1, 1],
            t + joined[2, 2],
            xy + joined[0, 1],
            xt + joined[0, 2],
            yt + joined[1, 2],
        )
        return solve_three(entries, (right[:, 0], right[:, 1], right[:, 2]))
    blocks = jnp.stack([x, xy, xt, xy, y, yt, xt, yt, t], axis=-1).reshape(bodies, 3, 3)
    matrix = jnp.eye(bodies, dtype=x.dtype)[:, None, :, None] * blocks[:, :, None, :]
    solved = solve_symmetric(matrix.reshape(size, size) + joined, right.reshape(size))
    solved = solved.reshape(bodies, 3)
    return solved[:, 0], solved[:, 1], solved[:, 2]


def solve_symmetric(
    matrix: Float[Array, "size size"], right: Float[Array, " size"]
) -> Float[Array, " size"]:
    """Solve a symmetric positive definite system; derivatives solve once more with its factor."""
    factor = jax.scipy.linalg.cho_factor(jax.lax.stop_gradient(matrix), lower=True)
    return jax.lax.custom_linear_solve(
        lambda v: matrix @ v,
        right,
        lambda _, b: jax.scipy.linalg.cho_solve(factor, b),
        symmetric=True,
    )


def add_rows(entries: tuple[Array, ...], rows: list[tuple[Triple, Array]]) -> tuple[Array, ...]:
    """The entries x, y, t, xy, xt, yt of symmetric 3 x 3 matrices (bodies,) plus sum w J'J.

    Each J is a triple of (bodies,), each w is (bodies,); three entries are a diagonal.
    """
    zero = jnp.zeros_like(entries[0])
    x, y, t, xy, xt, yt = (*entries, zero, zero, zero)[:6]
    for (first, second, third), weight in rows:
        by_first, by_second = weight * first, weight * second
        x, xy, xt = x + by_first * first, xy + by_first * second, xt + by_first * third
        y, yt = y + by_second * second, yt + by_second * third
        t = t + weight * third * third
    return x, y, t, xy, xt, yt


def solve_three(entries: tuple[Array, ...], right: Triple) -> Triple:
    """Solve symmetric 3 x 3 systems by LDL', one for each body.

    Written out: a library call for each of thousands of 3 x 3 systems costs more than its sums.
    Derivatives solve once more and do not differentiate the elimination.
    """
    x, y, t, xy, xt, yt = entries

    def product(v: Triple) -> Triple:
        a, b, c = v
        return x * a + xy * b + xt * c, xy * a + y * b + yt * c, xt * a + yt * b + t * c

    def solve(_: Any, right: Triple) -> Triple:
        lower_y, lower_t = xy / x, xt / x
        pivot_y = y - lower_y * xy
        rest = yt - lower_y * xt
        last = rest / pivot_y
        pivot_t = t - lower_t * xt - last * rest
        a = right[0]
        b = right[1] - lower_y * a
        c = (right[2] - lower_t * a - last * b) / pivot_t
        b = b / pivot_y - last * c
        return a / x - lower_y * b - lower_t * c, b, c

    return jax.lax.custom_linear_solve(product, right, solve, symmetric=True)
