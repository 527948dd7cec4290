"""Forces of the mass-spring-damper rope and their integration: the inner loop.

Node positions p and velocities v; per segment i the edge e_i = p_{i+1} - p_i of length l_i, its
direction relative to rest u_i = e_i / l0_i, and its relative velocity w_i; per joint the bend
d = u_{i+1} - u_i. Energies and dissipation:

    stretch    1/2 k_s (l - l0)^2                   1/2 c_s (w . e / l)^2
    bend       1/2 k_b |d - d0|^2                   1/2 c_b |d' - m (m . d') / |m|^2|^2,
               d' the rate of d and m = u_i + u_{i+1}: the rate at which the material bends, seen
               in a frame that turns with the tangent but does not spin about it, because the
               grip holds the rope; a bent rope that swings as a whole bends only where its
               tangent lies along the axis of the swing
    grip       1/2 k_g |u_0 - down|^2               1/2 c_g |u_0'|^2,  on the first segment
    twist      1/2 k_t t^2 / ((s_a + S)(s_b + S)),  t = u_0 . (u_1 x u_2), s = |u_i x u_{i+1}|^2 at
               a joint, S = 0.01: 1/2 k_t sin^2(psi) for the torsion angle psi between successive
               binormals, faded out where a joint is straight and psi has no meaning
    air        linear and quadratic drag of each node's velocity

A rope stretches little, so u is a unit vector but for that little, |d|^2 = 2 (1 - cos beta) is
beta^2 to fourth order, and there is neither an arc cosine nor a singularity where the rope is
straight. Dividing by l0 and not by l keeps bending linear: a crumpled rope is as stable as a
straight one. Seed 1 (SPiD); Lv et al. 2017 for stretch, bend and twist; their twist force is
singular on a straight rope, this energy is not.

Layout: a block of `lanes` ropes is kept as flat arrays, one per axis, of nodes x lanes elements
with the lanes innermost, so that the neighbour of every element stands `lanes` further on and
every operation is a loop over contiguous memory. The loop over the time steps of one control
period then fits in the first-level cache.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

TWIST_FADE = 0.01  # S above: twist counts half at joints of 0.1 rad
COINCIDENT = 1e-12  # m^2, added to l^2, which vanishes where two nodes meet
FOLDED = 1e-3  # added to |m|^2, which vanishes where the rope is folded back on itself

Flat = Float[Array, " _"]  # of any length
Axes = tuple[Flat, ...]  # x, y and z


class Coefficients(eqx.Module):
    """What the forces need, in SI units: (*batch, elements), and flat in the functions below."""

    rest_length: Float[Array, "..."]
    stretch_stiffness: Float[Array, "..."]
    stretch_damping: Float[Array, "..."]
    bend_stiffness: Float[Array, "..."]
    bend_damping: Float[Array, "..."]
    grip_stiffness: Float[Array, "..."]  # per segment, zero for all but the first
    grip_damping: Float[Array, "..."]
    twist_stiffness: Float[Array, "..."]
    linear_drag: Float[Array, "..."]
    quadratic_drag: Float[Array, "..."]
    step_per_mass: Float[Array, "..."]  # time step / node mass; zero: no force moves a driven node
    step_gravity: Float[Array, "..."]  # time step x gravity, downwards; zero for driven nodes


def integrate(
    position: Axes,
    velocity: Axes,
    increment: Axes,
    rest_bend: Axes | None,
    coefficients: Coefficients,
    *,
    lanes: int,
    steps: int,
    time_step: float,
) -> tuple[Axes, Axes]:
    """Symplectic Euler over one control period, air drag implicit.

    Shapes: flat (nodes x lanes,) in m and m/s; `increment` is added to the velocity at every step
    and moves the driven nodes (zero for the others); `rest_bend` (joints x lanes,) is d0, None for
    a rope that is straight at rest.
    """

    def advance(state: tuple[Axes, Axes]) -> tuple[Axes, Axes]:
        position, velocity = state
        velocity = _moved_by_forces(position, velocity, rest_bend, coefficients, lanes)
        velocity = tuple(v + i for v, i in zip(velocity, increment, strict=True))
        return (
            tuple(p + time_step * v for p, v in zip(position, velocity, strict=True)),
            velocity,
        )

    # Only the states between time steps are kept for the reverse sweep: computing forces again
    # costs less than reading their intermediates back from memory.
    advance = jax.checkpoint(advance, prevent_cse=False)
    state, _ = jax.lax.scan(
        lambda state, _: (advance(state), None), (position, velocity), None, length=steps
    )
    return state


def _moved_by_forces(
    position: Axes, velocity: Axes, rest_bend: Axes | None, c: Coefficients, lanes: int
) -> Axes:
    """Each node's velocity one time step later.

    Drag, linear in the new velocity at the old speed, divides: it cannot reverse a velocity, so
    that neither coefficient is bounded by the time step.
    """
    force = edge_forces(position, velocity, rest_bend, c, lanes)
    speed = jnp.sqrt(_dot(velocity, velocity) + 1e-12)
    slowing = 1.0 / (1.0 + c.step_per_mass * (c.linear_drag + c.quadratic_drag * speed))
    x, y, z = (
        v + c.step_per_mass * (_pad(f, 0, 1, lanes) - _pad(f, 1, 0, lanes))
        for f, v in zip(force, velocity, strict=True)
    )
    return slowing * x, slowing * y, slowing * (z - c.step_gravity)


def edge_forces(
    position: Axes, velocity: Axes, rest_bend: Axes | None, c: Coefficients, lanes: int
) -> Axes:
    """dE/de plus dissipation per segment: the force (N) on its first node, minus on its second.

    Shapes: flat (nodes x lanes,) to flat (segments x lanes,).
    """
    edge = tuple(_difference(p, lanes) for p in position)
    relative = tuple(_difference(v, lanes) for v in velocity)
    per_length = 1.0 / jnp.sqrt(_dot(edge, edge) + COINCIDENT)
    stretch = c.stretch_stiffness * (1.0 - c.rest_length * per_length)
    stretch = stretch + c.stretch_damping * _dot(relative, edge) * per_length * per_length
    per_rest_length = 1.0 / c.rest_length
    direction = tuple(e * per_rest_length for e in edge)
    turning = tuple(w * per_rest_length for w in relative)
    bend = tuple(_difference(u, lanes) for u in direction)
    bend_rate = tuple(_difference(u, lanes) for u in turning)
    mean = tuple(_drop(u, -1, lanes) + _drop(u, 1, lanes) for u in direction)
    turned = _dot(mean, bend_rate) / (_dot(mean, mean) + FOLDED)
    gradient = _twist(direction, bend, c, lanes)
    if rest_bend is not None:
        bend = tuple(b - rest for b, rest in zip(bend, rest_bend, strict=True))
    force = []
    for axis in range(3):
        bending = bend_rate[axis] - turned * mean[axis]
        moment = c.bend_stiffness * bend[axis] + c.bend_damping * bending
        turn = _pad(moment, 1, 0, lanes) - _pad(moment, 0, 1, lanes) + gradient[axis]
        from_down = direction[axis] + 1.0 if axis == 2 else direction[axis]
        turn = turn + c.grip_stiffness * from_down + c.grip_damping * turning[axis]
        force.append(stretch * edge[axis] + turn * per_rest_length)
    return force[0], force[1], force[2]


def _twist(direction: Axes, bend: Axes, c: Coefficients, lanes: int) -> Axes:
    """Gradient of the twist energy to each direction.

    With binormals b_j = u_j x u_{j+1}, s = |b|^2 and t = u_0 . b_2: dt/du_0 = b_2, and what the
    energy gains per binormal, g_j, turns into u_{j+1} x g_j for u_j and g_j x u_j for u_{j+1}.
    """
    earlier = tuple(_drop(u, -1, lanes) for u in direction)
    later = tuple(_drop(u, 1, lanes) for u in direction)
    binormal = _cross(later, bend)
    fade = 1.0 / (_dot(binormal, binormal) + TWIST_FADE)
    second = tuple(_drop(b, 1, lanes) for b in binormal)
    first_direction = tuple(_drop(u, -2, lanes) for u in direction)
    triple = _dot(first_direction, second)
    response = c.twist_stiffness * triple * _drop(fade, -1, lanes) * _drop(fade, 1, lanes)
    twice_energy = response * triple
    fading = (_pad(twice_energy, 0, 1, lanes) + _pad(twice_energy, 1, 0, lanes)) * fade
    per_binormal = tuple(
        _pad(response * first_direction[axis], 1, 0, lanes) - fading * binormal[axis]
        for axis in range(3)
    )
    to_earlier, to_later = _cross(later, per_binormal), _cross(per_binormal, earlier)
    x, y, z = (
        _pad(response * second[axis], 0, 2, lanes)
        + _pad(to_earlier[axis], 0, 1, lanes)
        + _pad(to_later[axis], 1, 0, lanes)
        for axis in range(3)
    )
    return x, y, z


def _dot(a, b) -> Flat:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Axes, b: Axes) -> Axes:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def _difference(values: Flat, lanes: int) -> Flat:
    """Next element minus this one."""
    return values[lanes:] - values[:-lanes]


def _drop(values: Flat, count: int, lanes: int) -> Flat:
    """Without the first `count` elements, or the last where it is negative."""
    return values[count * lanes :] if count > 0 else values[: count * lanes]


def _pad(values: Flat, before: int, after: int, lanes: int) -> Flat:
    return jnp.pad(values, (before * lanes, after * lanes))
