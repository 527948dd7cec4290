"""What the floor and wheels take from a body's velocity, in the body's own axes.

The floor carries a body on four feet, which share its weight as its centre of mass asks; each is
held by Coulomb's friction, so that a body that turns slides more easily (Goyal, Ruina and
Papadopoulos, Wear 143, 1991). A dry wheel whose friction is the symmetric tensor F takes the power

    |F v| = sqrt((along v_along)^2 + (across v_across)^2),

along and across it being the axes of F: an ellipse of forces, and of these the one that takes most.
Both are elements that take an impulse in proportion to the slope of a convex function of the size
of two rates, which is that size, and quadratic below `STICTION` (Huber's). The velocity at the end
of a step minimises the sum of all of them and of what is quadratic, by a Newton's method that
carries the pull of each element beside the velocity (Chan, Golub and Mulet, SIAM J. Sci. Comput.
20, 1999): away from zero a size has hardly any curvature to find the minimum by.

Arrays have one entry for each body, (bodies,), or one for each element of each body, (elements,
bodies), and after these any axes of models that are stepped side by side: last, where processors
take them together.
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
    and the radius (m) at which it resists turning. Of the feet, (feet, bodies): where they stand
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
    """Elements of dry friction, (elements, bodies): where they are, what they feel and take.

    `x` and `y` are from the centre of mass, in m, in the body's axes. The tensor times the velocity
    there is two rates, m/s of a foot and W of a wheel, in units of those below which they stick;
    the impulse of a step is by such a unit.
    """

    x: Array
    y: Array
    tensor: Tensor
    impulse: Array


class Pull(NamedTuple):
    """What each dry element takes along its two rates, in shares of the most: a disc (0: nothing).

    (elements, bodies) each.
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

    Smooth where the two eigenvalues meet, as their eigenvectors are not.
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


def resistance(bodies: Rolling, free: Triple, time_step: float) -> Resistance:
    """What resists in a step (s), of bodies that would leave it with the velocity `free`."""
    momentum = bodies.mass * free[0], bodies.mass * free[1], bodies.inertia * free[2]
    zero = jnp.zeros_like(bodies.mass)
    viscous = time_step * bodies.floor_viscosity
    shift = bodies.mass + viscous
    turning = bodies.inertia + viscous * jnp.square(bodies.floor_radius)
    entries: Entries = (shift, shift, turning, zero, zero, zero)
    nowhere = jnp.zeros_like(bodies.foot_x)
    here = nowhere + 1.0 / STICTION
    holding = time_step * STICTION * bodies.foot_friction
    feet = bodies.foot_x, bodies.foot_y, here, here, nowhere, holding
    elements: list[tuple[Array, ...]] = [feet]
    for wheel in bodies.wheels:
        log = wheel.log_friction
        friction = exponential(log)
        viscous = time_step * wheel.exists * (1.0 - wheel.dry)
        held = Tensor(*((viscous * entry)[None] for entry in friction))
        entries = _plus(entries, at_point(wheel.x[None], wheel.y[None], held))
        creep = least_power(log, friction)
        impulse = time_step * creep * wheel.exists * wheel.dry
        scaled = (entry / creep for entry in friction)
        elements.append(tuple(part[None] for part in (wheel.x, wheel.y, *scaled, impulse)))
    x, y, *tensor, impulse = (jnp.concatenate(parts) for parts in zip(*elements, strict=True))
    return Resistance(entries, momentum, Dry(x, y, Tensor(*tensor), impulse))


def at_point(x: Array, y: Array, tensor: Tensor) -> Entries:
    """J' T J of a tensor of the velocity at a point: how it resists the body's three rates."""
    turning_x = tensor.xy * x - tensor.xx * y
    turning_y = tensor.yy * x - tensor.xy * y
    turning = turning_y * x - turning_x * y
    return tensor.xx, tensor.yy, turning, tensor.xy, turning_x, turning_y


def pulls(resisting: Resistance, velocity: Triple) -> Pull:
    """What dry elements take at a velocity."""
    first, second = rates(resisting.dry, velocity)
    soft = inverse_size(first, second)
    return Pull(soft * first, soft * second)


def pulls_after(resisting: Resistance, velocity: Triple, pull: Pull, step: Triple) -> Pull:
    """What dry elements take after a step back from a velocity, to first order.

    s pull = rates is linearised, where s is their size, or one where they are smaller.
    """
    dry = resisting.dry
    soft, along = _directions(dry, velocity)
    first, second = rates(dry, step)
    growth = along.first * first + along.second * second
    now = pulls(resisting, velocity)
    first = now.first - soft * (first - pull.first * growth)
    second = now.second - soft * (second - pull.second * growth)
    within = inverse_size(first, second)
    return Pull(within * first, within * second)


def slope(resisting: Resistance, velocity: Triple) -> Triple:
    """Derivative of the cost by the velocity: momentum that is left over, zero at the end."""
    dry, pull = resisting.dry, pulls(resisting, velocity)
    tensor = dry.tensor
    force_x = dry.impulse * (tensor.xx * pull.first + tensor.xy * pull.second)
    force_y = dry.impulse * (tensor.xy * pull.first + tensor.yy * pull.second)
    taken = force_x, force_y, dry.x * force_y - dry.y * force_x
    linear = product(resisting.entries, velocity)
    x, y, turning = (
        a - p + jnp.sum(part, axis=0)
        for a, p, part in zip(linear, resisting.momentum, taken, strict=True)
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
    return _plus(resisting.entries, _weight(dry, dry.impulse * soft, Tensor(one, other, both)))


def _directions(dry: Dry, velocity: Triple) -> tuple[Array, Pull]:
    """One over the size of the rates, at most one, and where they point; zero for what sticks."""
    first, second = rates(dry, velocity)
    soft = inverse_size(first, second)
    sliding = jnp.where(soft < 1.0, soft, 0.0)
    return soft, Pull(sliding * first, sliding * second)


def as_viscous(resisting: Resistance, velocity: Triple) -> Entries:
    """The matrix of what resists when each dry element counts as a viscous one of the same force.

    With it a step takes energy whatever the velocity is that the forces are of.
    """
    dry = resisting.dry
    soft = inverse_size(*rates(dry, velocity))
    one = jnp.ones_like(soft)
    even = Tensor(one, one, jnp.zeros_like(soft))
    return _plus(resisting.entries, _weight(dry, dry.impulse * soft, even))


def _weight(dry: Dry, weight: Array, tensor: Tensor) -> Entries:
    """Entries of w J' T J of each element, for a tensor T of its two rates."""
    (xx, yy, xy), inner = dry.tensor, tensor
    first_x, first_y = inner.xx * xx + inner.xy * xy, inner.xx * xy + inner.xy * yy
    second_x, second_y = inner.xy * xx + inner.yy * xy, inner.xy * xy + inner.yy * yy
    outer = Tensor(
        weight * (xx * first_x + xy * second_x),
        weight * (xy * first_y + yy * second_y),
        weight * (xx * first_y + xy * second_y),
    )
    return at_point(dry.x, dry.y, outer)


def _plus(entries: Entries, more: tuple[Array, ...]) -> Entries:
    x, y, t, xy, xt, yt = (
        own + jnp.sum(added, axis=0) for own, added in zip(entries, more, strict=True)
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


def inverse_size(first: Array, second: Array) -> Array:
    """One over the size of two rates, or one where they are smaller."""
    return jax.lax.rsqrt(jnp.maximum(jnp.square(first) + jnp.square(second), 1.0))


def rates(dry: Dry, velocity: Triple) -> tuple[Array, Array]:
    """The two rates (elements, bodies) of each element at the velocities (bodies,)."""
    x, y, turning = velocity
    along, across = x - dry.y * turning, y + dry.x * turning
    tensor = dry.tensor
    return tensor.xx * along + tensor.xy * across, tensor.xy * along + tensor.yy * across


def product(entries: Entries, vector: Triple) -> Triple:
    """A symmetric 3 x 3 matrix of each body times a vector of it."""
    x, y, t, xy, xt, yt = entries
    a, b, c = vector
    return x * a + xy * b + xt * c, xy * a + y * b + yt * c, xt * a + yt * b + t * c
