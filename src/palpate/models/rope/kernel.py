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

A rope stretches little, so that |d|^2 = 2 (1 - cos beta) is beta^2 to fourth order: neither an arc
cosine nor a singularity where the rope is straight. Dividing by l0 and not by l keeps bending
linear: a crumpled rope is as stable as a straight one. Seed 1 (SPiD); Lv et al. 2017 for stretch,
bend and twist; their twist force is singular on a straight rope.

Layout: a block of `lanes` ropes is kept as flat arrays, one per axis, of nodes x lanes elements
with the lanes innermost, so that the neighbour of every element stands `lanes` further on and
every operation is a loop over contiguous memory. The loop over the time steps of one control
period then fits in the first-level cache.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.numerics.devices import compile_alone

TWIST_FADE = 0.01  # S above: twist counts half at joints of 0.1 rad
COINCIDENT = 1e-12  # m^2, added to l^2, which vanishes where two nodes meet
FOLDED = 1e-3  # added to |m|^2, which vanishes where the rope is folded back on itself

# Coefficients that are parameters of a rope as they stand.
PER_ELEMENT = (
    "rest_length", "stretch_stiffness", "stretch_damping",
    "bend_stiffness", "bend_damping", "twist_stiffness",
)  # fmt: skip

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
        velocity = _move_by_forces(position, velocity, rest_bend, coefficients, lanes)
        velocity = tuple(v + i for v, i in zip(velocity, increment, strict=True))
        position = tuple(p + time_step * v for p, v in zip(position, velocity, strict=True))
        return position, velocity

    # Only the states between time steps are kept for the reverse sweep: computing forces again
    # costs less than reading their intermediates back from memory.
    advance = jax.checkpoint(advance, prevent_cse=False)
    state, _ = jax.lax.scan(
        lambda state, _: (advance(state), None), (position, velocity), None, length=steps
    )
    return state


def _move_by_forces(
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
        v + c.step_per_mass * _difference(_pad(f, 1, 1, lanes), lanes)
        for f, v in zip(force, velocity, strict=True)
    )
    return slowing * x, slowing * y, slowing * (z - c.step_gravity)


def edge_forces(
    position: Axes, velocity: Axes, rest_bend: Axes | None, c: Coefficients, lanes: int
) -> Axes:
    """dE/de plus dissipation per segment: the force (N) on its first node, minus on its second.

    Shapes: flat (nodes x lanes,) to flat (segments x lanes,).
    """
    edge, direction, turning, stretch = _stretch(
        position, velocity, c.rest_length, c.stretch_stiffness, c.stretch_damping, lanes=lanes
    )
    earlier, later, bend, moment = _bending(
        direction, turning, rest_bend, c.bend_stiffness, c.bend_damping, lanes=lanes
    )
    to_earlier, to_later = _twist(earlier, later, bend, c.twist_stiffness, lanes=lanes)
    per_rest_length = 1.0 / c.rest_length
    force = []
    for axis in range(3):
        turn = _pad(to_earlier[axis] - moment[axis], 0, 1, lanes)
        turn = turn + _pad(to_later[axis] + moment[axis], 1, 0, lanes)
        from_down = direction[axis] + 1.0 if axis == 2 else direction[axis]
        turn = turn + c.grip_stiffness * from_down + c.grip_damping * turning[axis]
        force.append(stretch * edge[axis] + turn * per_rest_length)
    return force[0], force[1], force[2]


@compile_alone
def _stretch(
    position: Axes, velocity: Axes, rest_length: Flat, stiffness: Flat, damping: Flat, *, lanes: int
) -> tuple[Axes, Axes, Axes, Flat]:
    """Of each segment the edge, its direction, the rate of that, and the tension per length."""
    edge = tuple(_difference(p, lanes) for p in position)
    relative = tuple(_difference(v, lanes) for v in velocity)
    per_length = 1.0 / jnp.sqrt(_dot(edge, edge) + COINCIDENT)
    tension = stiffness * (1.0 - rest_length * per_length)
    tension = tension + damping * _dot(relative, edge) * per_length * per_length
    per_rest_length = 1.0 / rest_length
    direction = tuple(e * per_rest_length for e in edge)
    turning = tuple(w * per_rest_length for w in relative)
    return edge, direction, turning, tension


@compile_alone
def _bending(
    direction: Axes,
    turning: Axes,
    rest_bend: Axes | None,
    stiffness: Flat,
    damping: Flat,
    *,
    lanes: int,
) -> tuple[Axes, Axes, Axes, Axes]:
    """Of each joint the directions before and after it, its bend, and its moment."""
    earlier, later = _around_joints(direction, lanes)
    bend = _minus(later, earlier)
    mean = tuple(a + b for a, b in zip(earlier, later, strict=True))
    rate_before, rate_after = _around_joints(turning, lanes)
    bend_rate = _minus(rate_after, rate_before)
    turned = _dot(mean, bend_rate) / (_dot(mean, mean) + FOLDED)
    elastic = bend if rest_bend is None else _minus(bend, rest_bend)
    moment = tuple(
        stiffness * e + damping * (rate - turned * m)
        for e, rate, m in zip(elastic, bend_rate, mean, strict=True)
    )
    return earlier, later, bend, moment


@compile_alone
def _twist(
    earlier: Axes, later: Axes, bend: Axes, stiffness: Flat, *, lanes: int
) -> tuple[Axes, Axes]:
    """Gradient of the twist energy to the directions before and after each joint.

    With binormals b_j = u_j x u_{j+1}, s = |b|^2 and t = u_0 . b_2: dt/du_0 = b_2, and what the
    energy gains per binormal, g_j, turns into u_{j+1} x g_j for u_j and g_j x u_j for u_{j+1}.
    """
    binormal = _cross(later, bend)
    fade = 1.0 / (_dot(binormal, binormal) + TWIST_FADE)
    second = tuple(_drop(b, 1, lanes) for b in binormal)
    first_direction = tuple(_drop(u, -1, lanes) for u in earlier)
    triple = _dot(first_direction, second)
    response = stiffness * triple * _drop(fade, -1, lanes) * _drop(fade, 1, lanes)
    twice_energy = _pad(response * triple, 1, 1, lanes)
    fading = (_drop(twice_energy, 1, lanes) + _drop(twice_energy, -1, lanes)) * fade
    per_binormal = tuple(
        _pad(response * u, 1, 0, lanes) - fading * b
        for u, b in zip(first_direction, binormal, strict=True)
    )
    to_earlier = tuple(
        _pad(response * b, 0, 1, lanes) + turn
        for b, turn in zip(second, _cross(later, per_binormal), strict=True)
    )
    return to_earlier, _cross(per_binormal, earlier)


def _around_joints(values: Axes, lanes: int) -> tuple[Axes, Axes]:
    """What segments have before and after each joint.

    Taken once: a slice costs its reverse sweep a copy.
    """
    earlier = tuple(_drop(value, -1, lanes) for value in values)
    return earlier, tuple(_drop(value, 1, lanes) for value in values)


def _minus(a: Axes, b: Axes) -> Axes:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def _dot(a, b) -> Flat:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Axes, b: Axes) -> Axes:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _difference(values: Flat, lanes: int) -> Flat:
    """Next element minus this one."""
    return values[lanes:] - values[:-lanes]


def _drop(values: Flat, count: int, lanes: int) -> Flat:
    """Without the first `count` elements, or the last where it is negative."""
    return values[count * lanes :] if count > 0 else values[: count * lanes]


def _pad(values: Flat, before: int, after: int, lanes: int) -> Flat:
    return jnp.pad(values, (before * lanes, after * lanes))
