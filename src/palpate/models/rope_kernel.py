"""Forces of the mass-spring-damper rope and their integration: the inner loop.

Node positions p and velocities v; per segment i the edge e_i = p_{i+1} - p_i of length l_i and
direction u_i, with relative velocity w_i; per joint d = u_{i+1} - u_i. Energies and dissipation:

    stretch    1/2 k_s (l - l0)^2                   1/2 c_s (w . u)^2
    bend       1/2 k_b |d|^2                        1/2 c_b |d'|^2,  d' the rate of d
    twist      1/2 k_t t^2 / ((s_a + S)(s_b + S)),  t = u_0 . (u_1 x u_2), s = sin^2 of a joint's
               angle, S = 0.01: 1/2 k_t sin^2(psi) for the torsion angle psi between successive
               binormals, faded out where a joint is straight and psi has no meaning
    air        linear and quadratic drag of each node's velocity

|d|^2 = 2 (1 - cos beta) is beta^2 to fourth order and has neither an arc cosine nor a singularity
where the rope is straight. All forces on a segment's direction are collected as G = dE/du and
projected once: the edge force is T u + (G - (G . u) u) / l. Seed 1 (SPiD); Lv et al. 2017 for
stretch, bend and twist; their twist force is singular on a straight rope, this energy is not.

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

Flat = Float[Array, " _"]  # of any length
Axes = tuple[Flat, Flat, Flat]


class Coefficients(eqx.Module):
    """What the forces need, in SI units: (*batch, elements), and flat in the functions below."""

    rest_length: Float[Array, "..."]
    stretch_stiffness: Float[Array, "..."]
    stretch_damping: Float[Array, "..."]
    bend_stiffness: Float[Array, "..."]
    bend_damping: Float[Array, "..."]
    twist_stiffness: Float[Array, "..."]
    linear_drag: Float[Array, "..."]
    quadratic_drag: Float[Array, "..."]
    step_per_mass: Float[Array, "..."]  # time step / node mass; zero: no force moves a driven node
    step_gravity: Float[Array, "..."]  # time step x gravity, downwards; zero for driven nodes


def integrate(
    position: Axes,
    velocity: Axes,
    increment: Axes,
    coefficients: Coefficients,
    *,
    lanes: int,
    steps: int,
    time_step: float,
) -> tuple[Axes, Axes]:
    """Symplectic Euler over one control period, air drag implicit.

    Shapes: flat (nodes x lanes,) in m and m/s; `increment` is added to the velocity at every step
    and moves the driven nodes (zero for the others).
    """

    def advance(state: tuple[Axes, Axes]) -> tuple[Axes, Axes]:
        position, velocity = state
        velocity = _moved_by_forces(position, velocity, coefficients, lanes)
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


def _moved_by_forces(position: Axes, velocity: Axes, c: Coefficients, lanes: int) -> Axes:
    """Each node's velocity one time step later.

    Drag, linear in the new velocity at the old speed, divides: it cannot reverse a velocity, so
    that neither coefficient is bounded by the time step.
    """
    force = edge_forces(position, velocity, c, lanes)
    speed = jnp.sqrt(_dot(velocity, velocity) + 1e-12)
    slowing = 1.0 / (1.0 + c.step_per_mass * (c.linear_drag + c.quadratic_drag * speed))
    x, y, z = (
        v + c.step_per_mass * (_pad(f, 0, 1, lanes) - _pad(f, 1, 0, lanes))
        for f, v in zip(force, velocity, strict=True)
    )
    return slowing * x, slowing * y, slowing * (z - c.step_gravity)


def edge_forces(position: Axes, velocity: Axes, c: Coefficients, lanes: int) -> Axes:
    """dE/de plus dissipation per segment: the force (N) on its first node, minus on its second.

    Shapes: flat (nodes x lanes,) to flat (segments x lanes,).
    """
    edge = tuple(_difference(p, lanes) for p in position)
    relative = tuple(_difference(v, lanes) for v in velocity)
    squared = _dot(edge, edge)
    per_length = 1.0 / jnp.sqrt(squared)
    direction = tuple(e * per_length for e in edge)
    rate = _dot(relative, direction)
    tension = (
        c.stretch_stiffness * (squared * per_length - c.rest_length) + c.stretch_damping * rate
    )
    turning = tuple((w - u * rate) * per_length for w, u in zip(relative, direction, strict=True))
    bend = tuple(_difference(u, lanes) for u in direction)
    bend_rate = tuple(_difference(u, lanes) for u in turning)
    twist, softening = _twist(direction, bend, c, lanes)
    stiffness = c.bend_stiffness - softening
    gradient = []
    for axis in range(3):
        moment = stiffness * bend[axis] + c.bend_damping * bend_rate[axis]
        gradient.append(_pad(moment, 1, 0, lanes) - _pad(moment, 0, 1, lanes) + twist[axis])
    along = _dot(gradient, direction)
    tension = tension - along * per_length
    return tuple(tension * u + g * per_length for g, u in zip(gradient, direction, strict=True))


def _twist(direction: Axes, bend: Axes, c: Coefficients, lanes: int) -> tuple[Axes, Flat]:
    """Gradient of the twist energy to each direction, and what it takes off bend stiffness.

    With binormals b_j = u_j x u_{j+1} (s = |b|^2) and t = u_0 . b_2:
    dt/du_0 = b_2, dt/du_2 = b_1 and, across u_1, dt/du_1 = d_1 x d_2 - b_1 - b_2;
    ds/du at a joint points along -2 cos(beta) of the other direction, which acts like bending.
    """
    later = tuple(_drop(u, 1, lanes) for u in direction)
    binormal = _cross(later, bend)
    sine_squared = _dot(binormal, binormal)
    before = tuple(_drop(b, -1, lanes) for b in binormal)
    after = tuple(_drop(b, 1, lanes) for b in binormal)
    triple = _dot(tuple(_drop(u, -2, lanes) for u in direction), after)
    fade = 1.0 / (sine_squared + TWIST_FADE)
    response = c.twist_stiffness * triple * _drop(fade, -1, lanes) * _drop(fade, 1, lanes)
    twice_energy = response * triple
    cosine = 1.0 - 0.5 * _dot(bend, bend)
    softening = (_pad(twice_energy, 0, 1, lanes) + _pad(twice_energy, 1, 0, lanes)) * fade * cosine
    across = _cross(
        tuple(_drop(d, -1, lanes) for d in bend), tuple(_drop(d, 1, lanes) for d in bend)
    )
    gradient = tuple(
        _pad(response * after[axis], 0, 2, lanes)
        + _pad(response * (across[axis] - before[axis] - after[axis]), 1, 1, lanes)
        + _pad(response * before[axis], 2, 0, lanes)
        for axis in range(3)
    )
    return gradient, softening


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
