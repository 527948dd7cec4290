"""What the floor and wheels take from a body's velocity, in the body's own axes.

The floor carries a body on four feet, which share its weight as its centre of mass asks; each is
held by Coulomb's friction, so that a body that turns slides more easily (Goyal, Ruina and
Papadopoulos, Wear 143, 1991). A dry wheel takes the power

    sqrt((along v_along)^2 + (across v_across)^2):

an ellipse of forces, and of these the one that takes most. In a system of equations either has a
weight, force over speed. The speed is what its own force leaves of that which the body would have
without it: each iteration removes the force of the last one and takes a new one off in closed
form. What acts alone is solved at once, and what acts together is solved when nothing changes.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

AT_REST = 1e-7  # m/s: a speed has a slope down to here
STICTION = 5e-4  # m/s: what sticks creeps no faster

# A body's velocity along its own axes and its turning, or what belongs to it; one array for each:
# components side by side would be cut out and put together again in every derivative.
Triple = tuple[Array, Array, Array]


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


class Slip(NamedTuple):
    """What dry friction leaves: speed of feet (bodies, feet) in m/s, power of wheels in W."""

    feet: Array
    wheels: tuple[Array, ...]


class Weights(NamedTuple):
    """What resists in the system of equations: h times force per velocity (kg).

    Of the feet (bodies, feet), of viscous friction, and along and across each wheel (bodies,).
    """

    feet: Array
    floor: Array
    wheels: tuple[tuple[Array, Array], ...]


def wheel_axes(x: Array, y: Array, direction: Array) -> tuple[Triple, Triple]:
    """Velocity of a wheel along and across it from its body's velocity.

    `x` and `y` are where the wheel stands from the centre of mass, in m, in the body's axes.
    """
    cosine, sine = jnp.cos(direction), jnp.sin(direction)
    along = (cosine, sine, x * sine - y * cosine)
    across = (-sine, cosine, x * cosine + y * sine)
    return along, across


def first_slip(bodies: Rolling, free: Triple, time_step: float) -> Slip:
    """Where each element leaves the body when it acts on it alone; `free` is without any."""

    def left(row: Triple, friction: Array) -> Array:
        yielding = 1.0 / bodies.mass + jnp.square(row[2]) / bodies.inertia
        return remaining(size(along(row, free)), time_step * yielding * friction)

    speed, taken = foot_speeds(bodies, free, time_step)
    return Slip(
        remaining(speed, taken),
        tuple(
            jnp.sqrt(
                jnp.square(w.along_friction * left(w.along, w.along_friction))
                + jnp.square(w.across_friction * left(w.across, w.across_friction))
                + least_power(w)
            )
            for w in bodies.wheels
        ),
    )


def next_slip(bodies: Rolling, velocity: Triple, slip: Slip, time_step: float) -> Slip:
    """Slip for the next iteration, from the velocity that the last one's gave."""
    speed, taken = foot_speeds(bodies, velocity, time_step)
    feet = remaining(speed * (1.0 + taken / slip.feet), taken)
    wheels = []
    for wheel, before in zip(bodies.wheels, slip.wheels, strict=True):
        along_power = jnp.square(wheel.along_friction * along(wheel.along, velocity))
        across_power = jnp.square(wheel.across_friction * along(wheel.across, velocity))
        smallest = least_power(wheel)
        squared = along_power + across_power + 1e-6 * smallest
        # what turns gives way more, unless something else holds it: then this would overshoot
        taken = jnp.square(wheel.along_friction) * along_power
        taken = taken + jnp.square(wheel.across_friction) * across_power
        taken = time_step * taken / (squared * bodies.mass)
        power = jnp.sqrt(squared)
        wheels.append(remaining(power * (1.0 + taken / before), taken, smallest))
    return Slip(feet, tuple(wheels))


def weights(bodies: Rolling, slip: Slip, time_step: float) -> Weights:
    """Weights of the floor and the wheels."""
    wheels = []
    for wheel, power in zip(bodies.wheels, slip.wheels, strict=True):
        step = time_step * wheel.exists
        dry, viscous = step * wheel.dry / power, step * (1.0 - wheel.dry)
        wheels.append(
            (
                dry * jnp.square(wheel.along_friction) + viscous * wheel.along_friction,
                dry * jnp.square(wheel.across_friction) + viscous * wheel.across_friction,
            )
        )
    feet = time_step * bodies.foot_friction / slip.feet
    return Weights(feet, time_step * bodies.floor_viscosity, tuple(wheels))


def foot_speeds(bodies: Rolling, velocity: Triple, time_step: float) -> tuple[Array, Array]:
    """Speed of each foot, and how much of it all feet together can take in a step, m/s."""
    x, y, turning = (part[:, None] for part in velocity)
    squared = jnp.square(x - turning * bodies.foot_y) + jnp.square(y + turning * bodies.foot_x)
    radius = jnp.square(bodies.foot_x) + jnp.square(bodies.foot_y)
    by_turning = jnp.square(turning) * radius
    by_sliding = jnp.square(x) + jnp.square(y) + AT_REST**2
    # turning is slowed by radius^2 / gyration^2 as much as sliding is
    ratio = radius * (bodies.mass / bodies.inertia)[:, None]
    share = 1.0 + by_turning / (by_turning + by_sliding) * (ratio - 1.0)
    every = jnp.sum(bodies.foot_friction, axis=-1) / bodies.mass
    return jnp.sqrt(squared + AT_REST**2), time_step * share * every[:, None]


def least_power(wheel: Wheel) -> Array:
    """Square of the power (W^2) below which a wheel sticks.

    In proportion to its lesser friction, so that neither direction starts to slide later than the
    other: twice the harmonic mean of squares. Never zero, for wheels without friction.
    """
    along_squared, across_squared = (
        jnp.square(wheel.along_friction),
        jnp.square(wheel.across_friction),
    )
    return STICTION**2 * (
        1e-8 + 2.0 * along_squared * across_squared / (along_squared + across_squared + 1e-12)
    )


def size(speed: Array) -> Array:
    """How large a speed is, m/s; its slope at rest is zero."""
    return jnp.sqrt(jnp.square(speed) + AT_REST**2)


def along(row: Triple, velocity: Triple) -> Array:
    """Velocity J v along a row, m/s."""
    return row[0] * velocity[0] + row[1] * velocity[1] + row[2] * velocity[2]


def remaining(speed: Array, taken: Array, least_squared: Array | float = STICTION**2) -> Array:
    """What is left of a speed (m/s) from which some is taken, smoothly, and at least a little."""
    left = speed - taken
    left = 0.5 * (left + jnp.sqrt(jnp.square(left) + 4.0 * least_squared))
    return jnp.sqrt(jnp.square(left) + least_squared)
