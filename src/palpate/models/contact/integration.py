"""One step of a mass on an impedance between springs that only push, with dry friction.

The springs are integrated by the trapezoidal rule, implicitly: stable for any stiffness, of second
order, and without damping of its own. A spring that is met or left within the step counts for the
share of the step that it is met in: it then gives back no more than it took. Friction is implicit,
on the velocity at the end: it stops the tip, and never turns it round.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

Vector = Float[Array, "*batch 2"]
Numbers = Float[Array, "*batch walls"]


class Surfaces(NamedTuple):
    """Walls as the integration needs them.

    `normal` is outward; a tip at x is pressed in by `place` - normal . x, in m.
    """

    normal: Float[Array, "*batch walls 2"]
    place: Numbers
    stiffness: Numbers  # N/m
    damping: Numbers  # N s/m
    friction: Numbers
    mass: Numbers  # kg, of a plate, which moves with the tip while they touch
    recovery: Numbers  # 1/s, at which a plate that is left comes back
    # s, in which one that is met takes on the tip's velocity. At once, what a sensor shows would
    # jump as a parameter moves the impact from one step to another, and log-likelihoods by 30.
    impact: Float[Array, "*batch 1"]


class PlateState(NamedTuple):
    """How far each is pressed in, in m, and what share of its mass moves with the tip."""

    depth: Numbers
    carried: Numbers


class Impedance(NamedTuple):
    """What pulls the tip: mass in kg, set-point in m, stiffness in N/m, damping in N s/m.

    The controller acts on the position and velocity that the tip had `delay` s ago. `friction` is
    the dry friction of the arm itself, N, of three quarters of it at the velocity `creep`, m/s.
    """

    mass: Float[Array, "*batch 1"]
    delay: Float[Array, "*batch 1"]
    friction: Float[Array, "*batch"]
    creep: Float[Array, "*batch"]
    setpoint: Vector
    stiffness: Vector
    damping: Vector


def advance(
    surfaces: Surfaces,
    impedance: Impedance,
    plates: PlateState,
    position: Vector,
    velocity: Vector,
    time: float,
    slip: float,
) -> tuple[PlateState, Vector, Vector, Vector, Vector]:
    """Plates, position and velocity `time` s later, and the walls' force on the tip till then.

    Of that the mean in N, and in N s the first moment about the middle of the step: a wall that is
    met late in the step pushes late. `slip` (m/s) is the sliding velocity at which a wall's
    friction is three quarters there.
    """
    normal, mass = surfaces.normal, impedance.mass
    walls = _contacts(surfaces, plates, mass, position, velocity, time)

    # Of first order, K x and D v of a moment ago are K (x - delay v) and D (v - delay a): less
    # damping and less inertia, here in a form that stays positive.
    lightened = mass / (1.0 + impedance.delay * impedance.damping / mass)
    # Mean velocity w: (2 m / h + D + K h / 2 + sum of n n' yielding) w = 2 m / h v + forces.
    held = 2.0 * lightened / time
    diagonal = held + impedance.damping + (0.5 * time - impedance.delay) * impedance.stiffness
    pull = impedance.stiffness * (impedance.setpoint - position)
    inverse = _inverse(diagonal, normal, walls.yielding)
    right = held * velocity + pull + jnp.sum(normal * walls.push[..., None], axis=-2)
    mean = _product(inverse, right)
    force = jnp.maximum(walls.push - walls.yielding * _along(normal, mean), 0.0)
    total = jnp.sum(normal * force[..., None], axis=-2)
    jolt = walls.struck * jnp.maximum(-_along(normal, 2.0 * mean - velocity), 0.0)
    jolt = jnp.clip(jolt / (force + 1e-9), 0.0, 1.0)
    later = (1.0 - jolt) * walls.middle + jolt * walls.impact
    late = jnp.sum(normal * (later * force)[..., None], axis=-2)

    # Friction as a further force, of the size that the velocity at the end asks for: of one wall
    # after the other, as in a corner each acts on the rest. Of the arm last: where a wall holds the
    # tip, nothing is left for the arm to hold, and the sensor feels all of it.
    for wall in range(normal.shape[-2]):
        tangent = jnp.broadcast_to(_turn(normal[..., wall, :]), mean.shape)
        most = (surfaces.friction * force)[..., wall]
        mean, rubbing = _rub(mean, velocity, tangent, most, inverse, slip)
        total = total - tangent * rubbing[..., None]
        late = late - tangent * (later[..., wall] * rubbing)[..., None]
    sliding = 2.0 * mean - velocity
    speed = jnp.sqrt(jnp.sum(jnp.square(sliding), axis=-1) + 1e-18)
    along = sliding / speed[..., None]
    mean, _ = _rub(mean, velocity, along, impedance.friction, inverse, impedance.creep)
    position = position + time * mean
    within = jnp.maximum(surfaces.place - _along(normal, position), 0.0)
    plates = PlateState(jnp.where(walls.carried > 0.0, within, walls.free), walls.carried)
    return plates, position, 2.0 * mean - velocity, total, late


class _Contacts(NamedTuple):
    """What each wall does in a step: its force is `push` less `yielding` times the mean velocity.

    `struck` is by how much mass over time (kg/s) the plate grows that moves with the tip; `impact`
    and `middle` are how much later than the middle of the step that and all else happen, s. At the
    end the share `carried` of a plate's mass moves with the tip; one that is left is at `free`, m.
    """

    push: Numbers  # N
    yielding: Numbers  # N s/m
    struck: Numbers
    impact: Numbers
    middle: Numbers
    carried: Numbers
    free: Numbers


def _contacts(
    surfaces: Surfaces,
    plates: PlateState,
    mass: Array,
    position: Vector,
    velocity: Vector,
    time: float,
) -> _Contacts:
    normal, place, stiffness, damping, _, plate, recovery, impact = surfaces
    depth = place - _along(normal, position)
    rate = -_along(normal, velocity)
    pressed = jnp.maximum(depth, 0.0)
    touched = (plates.carried > 0.0) & (depth > 0.0)
    # A plate that is left comes back by itself, and may be met, or meet the tip, before it is back.
    begun = jnp.where(touched, depth, plates.depth)
    free = begun * jnp.exp(-time * recovery)
    over = depth - jnp.where(touched, 0.0, begun)
    # How deep it will be, by the energy that is in the spring and in the velocity.
    leaving = jnp.sqrt(jnp.square(rate) + stiffness * jnp.square(pressed) / mass + 1e-12) - rate
    after = depth + jnp.where(touched, -0.5 * time * leaving, time * rate - free)
    share = jnp.maximum(over, 0.0) + jnp.maximum(after, 0.0)
    share = share / (jnp.abs(over) + jnp.abs(after) + 1e-12)
    begun = jnp.where(touched, depth, free + share * (begun - free))
    # A wall that recovers more slowly than the tip leaves it does not pull it back.
    share = jnp.where(stiffness * begun + damping * rate >= 0.0, share, 0.0)
    lasting = (after > 0.0) & (share > 0.0)
    implicit = jnp.where(lasting, 0.5 * share, 0.0)
    explicit = jnp.where(touched, 0.5 * share, implicit)
    spring = stiffness * (explicit * begun + implicit * depth)
    # A plate is at rest when it is met, and takes on the tip's velocity: that loses energy.
    carried = jnp.clip(plates.carried + share * time / impact, 0.0, 1.0)
    carried = jnp.where(lasting, carried, 0.0)
    inertia = plate * carried / time
    kept = plate * jnp.minimum(plates.carried, carried) / time
    idle = time * (1.0 - share)
    before = jnp.where(touched, 0.0, idle)
    return _Contacts(
        push=spring - (inertia + kept) * rate,
        yielding=time * stiffness * implicit + damping * share + 2.0 * inertia,
        struck=inertia - kept,
        impact=before + 0.5 * (jnp.minimum(impact, time - before) - time),
        middle=before - 0.5 * idle,
        carried=carried,
        free=free,
    )


def _rub(
    mean: Array,
    velocity: Array,
    along: Array,
    most: Array,
    inverse: tuple[Array, ...],
    slip: Array | float,
) -> tuple[Array, Array]:
    """The mean velocity with dry friction of at most `most` N `along` a direction, and its force.

    `inverse` is by how much a force changes the mean velocity; that at the end twice as much.
    """
    answer = _product(inverse, along)
    sliding = jnp.sum(along * (2.0 * mean - velocity), axis=-1)
    rest = velocity_after_friction(sliding, 2.0 * jnp.sum(along * answer, axis=-1) * most, slip)
    force = most * grip(rest, slip)
    return mean - answer * force[..., None], force


def velocity_after_friction(
    sliding: Float[Array, "*#batch"], most: Float[Array, "*#batch"], slip: Array | float
) -> Float[Array, "*_"]:
    """The velocity u that dry friction leaves: u + `most` `grip(u, slip)` = `sliding`."""
    speed, ratio = jnp.abs(sliding), most / slip
    creeps = speed < most + 2.0 * slip
    root = jnp.sqrt(1.0 + ratio * jnp.maximum(2.0 + ratio - speed / slip, 0.0))
    slides = 1.0 - most / jnp.where(creeps, most + 1.0, speed)
    return sliding * jnp.where(creeps, 2.0 / (1.0 + ratio + root), slides)


def grip(velocity: Array, slip: Array | float) -> Array:
    """The share of dry friction that is there: x - x |x| / 4 of x = v / `slip`, and all from 2 on.

    Smooth, and as a hyperbolic tangent within 0.04, but solved for in closed form.
    """
    share = jnp.clip(velocity / slip, -2.0, 2.0)
    return share * (1.0 - 0.25 * jnp.abs(share))


def _along(normal: Array, vector: Array) -> Array:
    """The part of a vector along each normal."""
    return jnp.sum(normal * vector[..., None, :], axis=-1)


def _turn(normal: Array) -> Array:
    """A quarter of a turn to the left."""
    return jnp.stack([-normal[..., 1], normal[..., 0]], axis=-1)


def _inverse(diagonal: Array, normal: Array, weight: Array) -> tuple[Array, ...]:
    """The inverse of diag + sum over walls of weight n n': its xx, xy and yy."""
    x, y = normal[..., 0], normal[..., 1]
    a = diagonal[..., 0] + jnp.sum(weight * x * x, axis=-1)
    b = jnp.sum(weight * x * y, axis=-1)
    d = diagonal[..., 1] + jnp.sum(weight * y * y, axis=-1)
    determinant = a * d - b * b
    return d / determinant, -b / determinant, a / determinant


def _product(matrix: tuple[Array, ...], vector: Array) -> Array:
    """A symmetric matrix (xx, xy, yy) times a vector."""
    xx, xy, yy = matrix
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([xx * x + xy * y, xy * x + yy * y], axis=-1)
