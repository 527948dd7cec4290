"""What the floor and wheels take from a body's velocity, in the body's own axes.

The floor carries a body on four feet, which share its weight as its centre of mass asks; each is
held by Coulomb's friction, so that a body that turns slides more easily (Goyal, Ruina and
Papadopoulos, Wear 143, 1991). A dry wheel takes the power

    sqrt((along v_along)^2 + (across v_across)^2):

an ellipse of forces, and of these the one that takes most. Both are elements that take an impulse
in proportion to the slope of a convex function of the size of two rates, which is that size, and
quadratic below `STICTION` (Huber's). The velocity at the end of a step minimises the sum of all of
them and of what is quadratic, which Newton's method finds.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

STICTION = 5e-3  # m/s: what sticks creeps no faster

# A body's velocity along its own axes and its turning, or what belongs to it; one array for each:
# components side by side would be cut out and put together again in every derivative.
Triple = tuple[Array, Array, Array]
Entries = tuple[Array, Array, Array, Array, Array, Array]  # x, y, t, xy, xt, yt of symmetric 3 x 3


class Wheel(NamedTuple):
    """One wheel of every body: rows that map a body's velocity to that of the wheel, friction.

    Friction in N (`dry` = 1) or N s/m (`dry` = 0), never zero: a wheel that does not exist
    (`exists` = 0) has some and no weight, so that its derivatives are finite. All are (bodies,).
    """

    along: Triple
    across: Triple
    along_friction: Array
    across_friction: Array
    dry: Array
    exists: Array


class Rolling(NamedTuple):
    """Inertia of every body and what it rolls on, all (bodies,).

    Mass in kg, inertia in kg m^2 about the centre of mass, viscous friction of the floor in N s/m
    and the radius (m) at which it resists turning. Of the feet, (bodies, feet): where they stand
    from the centre of mass in m, in the body's axes, and the friction of each in N.
    """

    mass: Array
    inertia: Array
    foot_x: Array
    foot_y: Array
    foot_friction: Array
    floor_viscosity: Array
    floor_radius: Array
    wheels: tuple[Wheel, ...]


class Dry(NamedTuple):
    """Elements of dry friction, (bodies, elements): rows of two rates, and what they take.

    The rates, m/s of a foot and W of a wheel, are in units of those below which they stick, and the
    impulse of a step is by such a unit.
    """

    first: Triple
    second: Triple
    impulse: Array


class Resistance(NamedTuple):
    """What a body's velocity v costs in a step: v' A v / 2 - momentum' v + sum of what is dry."""

    entries: Entries
    momentum: Triple
    dry: Dry


def wheel_axes(x: Array, y: Array, direction: Array) -> tuple[Triple, Triple]:
    """Velocity of a wheel along and across it from its body's velocity.

    `x` and `y` are where the wheel stands from the centre of mass, in m, in the body's axes.
    """
    cosine, sine = jnp.cos(direction), jnp.sin(direction)
    along = (cosine, sine, x * sine - y * cosine)
    across = (-sine, cosine, x * cosine + y * sine)
    return along, across


def resistance(bodies: Rolling, free: Triple, time_step: float) -> Resistance:
    """What resists in a step (s), of bodies that would leave it with the velocity `free`."""
    momentum = bodies.mass * free[0], bodies.mass * free[1], bodies.inertia * free[2]
    zero = jnp.zeros_like(bodies.mass)
    viscous = time_step * bodies.floor_viscosity
    shift = bodies.mass + viscous
    entries: Entries = (
        shift,
        shift,
        bodies.inertia + viscous * jnp.square(bodies.floor_radius),
        zero,
        zero,
        zero,
    )
    nowhere = jnp.zeros_like(bodies.foot_x)
    here = nowhere + 1.0 / STICTION
    first = [(here, nowhere, -here * bodies.foot_y)]
    second = [(nowhere, here, here * bodies.foot_x)]
    impulse = [time_step * STICTION * bodies.foot_friction]
    for wheel in bodies.wheels:
        weight = time_step * wheel.exists * (1.0 - wheel.dry)
        entries = add_row(entries, wheel.along, weight * wheel.along_friction)
        entries = add_row(entries, wheel.across, weight * wheel.across_friction)
        creep = least_power(wheel)
        first.append(scaled(wheel.along, wheel.along_friction / creep))
        second.append(scaled(wheel.across, wheel.across_friction / creep))
        impulse.append((time_step * creep * wheel.exists * wheel.dry)[:, None])

    def joined(rows: list[Triple]) -> Triple:
        x, y, turning = (jnp.concatenate(parts, axis=1) for parts in zip(*rows, strict=True))
        return x, y, turning

    dry = Dry(joined(first), joined(second), jnp.concatenate(impulse, axis=1))
    return Resistance(entries, momentum, dry)


def slope(resisting: Resistance, velocity: Triple) -> Triple:
    """Derivative of the cost by the velocity: momentum that is left over, zero at the end."""
    dry = resisting.dry
    first, second = rates(dry.first, velocity), rates(dry.second, velocity)
    taken = dry.impulse * softened(first, second)
    first, second = taken * first, taken * second
    linear = product(resisting.entries, velocity)
    x, y, turning = (
        a - p + jnp.sum(first * f + second * s, axis=1)
        for a, p, f, s in zip(linear, resisting.momentum, dry.first, dry.second, strict=True)
    )
    return x, y, turning


def curvature(resisting: Resistance, velocity: Triple) -> Entries:
    """Second derivative of the cost by the velocity, positive definite."""
    dry = resisting.dry
    first, second = rates(dry.first, velocity), rates(dry.second, velocity)
    soft = softened(first, second)
    weight = dry.impulse * soft
    fading = jnp.where(soft < 1.0, weight * jnp.square(soft), 0.0)
    x, y, turning = (first * p + second * q for p, q in zip(dry.first, dry.second, strict=True))
    faded = (
        fading * x * x,
        fading * y * y,
        fading * turning * turning,
        fading * x * y,
        fading * x * turning,
        fading * y * turning,
    )
    return _plus(resisting.entries, _weighted(dry, weight), faded)


def as_viscous(resisting: Resistance, velocity: Triple) -> Entries:
    """The matrix of what resists when each dry element counts as a viscous one of the same force.

    With it a step takes energy whatever the velocity is that the forces are of.
    """
    dry = resisting.dry
    soft = softened(rates(dry.first, velocity), rates(dry.second, velocity))
    every = _weighted(dry, dry.impulse * soft)
    return _plus(resisting.entries, every, (jnp.zeros_like(soft),) * 6)


def _weighted(dry: Dry, weight: Array) -> tuple[Array, ...]:
    """Entries of w J'J of each element."""
    a, b, c = dry.first
    d, e, f = dry.second
    return (
        weight * (a * a + d * d),
        weight * (b * b + e * e),
        weight * (c * c + f * f),
        weight * (a * b + d * e),
        weight * (a * c + d * f),
        weight * (b * c + e * f),
    )


def _plus(entries: Entries, more: tuple[Array, ...], less: tuple[Array, ...]) -> Entries:
    x, y, t, xy, xt, yt = (
        own + jnp.sum(added - taken, axis=1)
        for own, added, taken in zip(entries, more, less, strict=True)
    )
    return x, y, t, xy, xt, yt


def least_power(wheel: Wheel) -> Array:
    """Power (W) below which a wheel sticks.

    In proportion to its lesser friction, so that neither direction starts to slide later than the
    other: the root of twice the harmonic mean of squares. Never zero, for wheels without friction.
    """
    along_squared, across_squared = (
        jnp.square(wheel.along_friction),
        jnp.square(wheel.across_friction),
    )
    mean = 2.0 * along_squared * across_squared / (along_squared + across_squared + 1e-12)
    return STICTION * jnp.sqrt(1e-8 + mean)


def softened(first: Array, second: Array) -> Array:
    """One over the size of two rates, or one where they are smaller."""
    return jax.lax.rsqrt(jnp.maximum(jnp.square(first) + jnp.square(second), 1.0))


def scaled(row: Triple, factor: Array) -> Triple:
    """The row (bodies,) times a factor of each body, as that of one element (bodies, 1)."""
    x, y, turning = row
    return (factor * x)[:, None], (factor * y)[:, None], (factor * turning)[:, None]


def rates(row: Triple, velocity: Triple) -> Array:
    """Rates J v (bodies, elements) of the velocities (bodies,)."""
    x, y, turning = (part[:, None] for part in velocity)
    return row[0] * x + row[1] * y + row[2] * turning


def product(entries: Entries, vector: Triple) -> Triple:
    """A symmetric 3 x 3 matrix of each body times a vector of it."""
    x, y, t, xy, xt, yt = entries
    a, b, c = vector
    return x * a + xy * b + xt * c, xy * a + y * b + yt * c, xt * a + yt * b + t * c


def add_row(entries: Entries, row: Triple, weight: Array) -> Entries:
    """Entries of A + w J'J; `row` and `weight` are (bodies,)."""
    x, y, t, xy, xt, yt = entries
    first, second, third = row
    by_first, by_second = weight * first, weight * second
    return (
        x + by_first * first,
        y + by_second * second,
        t + weight * third * third,
        xy + by_first * second,
        xt + by_first * third,
        yt + by_second * third,
    )
