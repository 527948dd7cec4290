"""What the floor and wheels take from a body's velocity, in the body's own axes.

The floor carries a body on four feet, which share its weight as its centre of mass asks; each is
held by Coulomb's friction, so that a body that turns slides more easily (Goyal, Ruina and
Papadopoulos, Wear 143, 1991). A dry wheel whose friction is the symmetric tensor F takes the power

    |F v| = sqrt((along v_along)^2 + (across v_across)^2),

along and across it being the axes of F: an ellipse of forces, and of these the one that takes most.
Both are elements that take an impulse in proportion to the slope of a convex function of the size
of two rates, which is that size, and quadratic below `STICTION` (Huber's). The velocity at the end
of a step minimises the sum of all of them and of what is quadratic. Newton's method for it carries
the pull of each element beside the velocity (Chan, Golub and Mulet, SIAM J. Sci. Comput. 20, 1999):
a size has hardly any curvature away from zero, and without the pulls a step across an ellipse of
1 : 60 goes astray again and again.
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


class Tensor(NamedTuple):
    """A symmetric 2 x 2 matrix, its entries of any shape."""

    xx: Array
    yy: Array
    xy: Array


class Wheel(NamedTuple):
    """One wheel of every body: where it stands, and the logarithm of its friction.

    `x` and `y` (bodies,) are from the centre of mass, in m, in the body's axes, as the tensor is:
    of friction in N (`dry` = 1) or N s/m (`dry` = 0). A wheel that does not exist (`exists` = 0)
    has some friction and no weight, so that its derivatives are finite.
    """

    x: Array
    y: Array
    log_friction: Tensor
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


class Pull(NamedTuple):
    """What each dry element takes along its two rates, in shares of the most: a disc (0: nothing).

    (bodies, elements) each.
    """

    first: Array
    second: Array


class Resistance(NamedTuple):
    """What a body's velocity v costs in a step: v' A v / 2 - momentum' v + sum of what is dry."""

    entries: Entries
    momentum: Triple
    dry: Dry


def exponential(log: Tensor) -> Tensor:
    """The exponential of symmetric matrices.

    Smooth where the two eigenvalues meet, as their eigenvectors are not: a wheel that resists alike
    in all directions has none to be told.
    """
    mean, half = 0.5 * (log.xx + log.yy), 0.5 * (log.xx - log.yy)
    squared = jnp.square(half) + jnp.square(log.xy)
    small = squared < 0.1
    radius = jnp.sqrt(jnp.where(small, 1.0, squared))
    # Power series of cosh r and sinh r / r: the root of zero has no derivative.
    cosine = jnp.where(small, _series(squared, 2), jnp.cosh(radius))
    sine = jnp.where(small, _series(squared, 3), jnp.sinh(radius) / radius)
    size = jnp.exp(mean)
    even, uneven = size * cosine, size * sine
    return Tensor(even + uneven * half, even - uneven * half, uneven * log.xy)


def _series(squared: Array, factor: int) -> Array:
    """1 + s / n(n - 1) (1 + s / (n + 2)(n + 1) (1 + ...)) from `factor` n on, exact below 0.1."""
    total = jnp.ones_like(squared)
    for n in range(factor + 10, factor - 1, -2):
        total = 1.0 + squared / (n * (n - 1)) * total
    return total


def wheel_rows(wheel: Wheel, friction: Tensor) -> tuple[Triple, Triple]:
    """F J: rows that map a body's velocity to a tensor times the velocity of its wheel."""
    first = friction.xx, friction.xy, wheel.x * friction.xy - wheel.y * friction.xx
    second = friction.xy, friction.yy, wheel.x * friction.yy - wheel.y * friction.xy
    return first, second


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
        log = wheel.log_friction
        weight = time_step * wheel.exists * (1.0 - wheel.dry)
        # v' F v is the square of F's root times v.
        for row in wheel_rows(wheel, exponential(Tensor(*(0.5 * entry for entry in log)))):
            entries = add_row(entries, row, weight)
        friction = exponential(log)
        creep = least_power(log, friction)
        one, other = wheel_rows(wheel, friction)
        first.append(scaled(one, 1.0 / creep))
        second.append(scaled(other, 1.0 / creep))
        impulse.append((time_step * creep * wheel.exists * wheel.dry)[:, None])

    def joined(rows: list[Triple]) -> Triple:
        x, y, turning = (jnp.concatenate(parts, axis=1) for parts in zip(*rows, strict=True))
        return x, y, turning

    dry = Dry(joined(first), joined(second), jnp.concatenate(impulse, axis=1))
    return Resistance(entries, momentum, dry)


def pulls(resisting: Resistance, velocity: Triple) -> Pull:
    """What dry elements take at a velocity."""
    first, second = rates(resisting.dry.first, velocity), rates(resisting.dry.second, velocity)
    soft = softened(first, second)
    return Pull(soft * first, soft * second)


def pulls_after(resisting: Resistance, velocity: Triple, pull: Pull, step: Triple) -> Pull:
    """What dry elements take after a step back from a velocity, by its linearisation.

    That of s pull = rates, where s is their size, or one where they are smaller.
    """
    dry = resisting.dry
    soft, along = _directions(dry, velocity)
    first, second = rates(dry.first, step), rates(dry.second, step)
    growth = along.first * first + along.second * second
    now = pulls(resisting, velocity)
    first = now.first - soft * (first - pull.first * growth)
    second = now.second - soft * (second - pull.second * growth)
    within = softened(first, second)
    return Pull(within * first, within * second)


def slope(resisting: Resistance, velocity: Triple) -> Triple:
    """Derivative of the cost by the velocity: momentum that is left over, zero at the end."""
    dry, pull = resisting.dry, pulls(resisting, velocity)
    first, second = dry.impulse * pull.first, dry.impulse * pull.second
    linear = product(resisting.entries, velocity)
    x, y, turning = (
        a - p + jnp.sum(first * f + second * s, axis=1)
        for a, p, f, s in zip(linear, resisting.momentum, dry.first, dry.second, strict=True)
    )
    return x, y, turning


def curvature(resisting: Resistance, velocity: Triple, pull: Pull) -> Entries:
    """Second derivative of the cost by the velocity, for elements that pull so; positive definite.

    It is the cost's own where they pull as they do at that velocity, and more than that where they
    pull less.
    """
    dry = resisting.dry
    soft, along = _directions(dry, velocity)
    one = 1.0 - pull.first * along.first
    other = 1.0 - pull.second * along.second
    both = -0.5 * (pull.first * along.second + pull.second * along.first)
    return _plus(resisting.entries, _weighted(dry, dry.impulse * soft, Tensor(one, other, both)))


def _directions(dry: Dry, velocity: Triple) -> tuple[Array, Pull]:
    """One over the size of the rates, at most one, and where they point; zero for what sticks."""
    first, second = rates(dry.first, velocity), rates(dry.second, velocity)
    soft = softened(first, second)
    sliding = jnp.where(soft < 1.0, soft, 0.0)
    return soft, Pull(sliding * first, sliding * second)


def as_viscous(resisting: Resistance, velocity: Triple) -> Entries:
    """The matrix of what resists when each dry element counts as a viscous one of the same force.

    With it a step takes energy whatever the velocity is that the forces are of.
    """
    dry = resisting.dry
    soft = softened(rates(dry.first, velocity), rates(dry.second, velocity))
    one = jnp.ones_like(soft)
    even = Tensor(one, one, jnp.zeros_like(soft))
    return _plus(resisting.entries, _weighted(dry, dry.impulse * soft, even))


def _weighted(dry: Dry, weight: Array, tensor: Tensor) -> tuple[Array, ...]:
    """Entries of w J' T J of each element, for a tensor T of its two rates."""

    def entry(i: int, j: int) -> Array:
        (a, b), (c, d) = (dry.first[i], dry.second[i]), (dry.first[j], dry.second[j])
        return weight * (tensor.xx * a * c + tensor.yy * b * d + tensor.xy * (a * d + b * c))

    return entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2)


def _plus(entries: Entries, more: tuple[Array, ...]) -> Entries:
    x, y, t, xy, xt, yt = (
        own + jnp.sum(added, axis=1) for own, added in zip(entries, more, strict=True)
    )
    return x, y, t, xy, xt, yt


def least_power(log: Tensor, friction: Tensor) -> Array:
    """Power (W) below which a wheel of this friction sticks, never zero.

    In proportion to its lesser friction, so that neither direction starts to slide later than the
    other: the root of the harmonic mean of squares, twice det(F)^2 over the squares of F's entries.
    """
    squares = jnp.square(friction.xx) + jnp.square(friction.yy) + 2.0 * jnp.square(friction.xy)
    mean = 2.0 * jnp.exp(2.0 * (log.xx + log.yy)) / (squares + 1e-12)
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
