"""One time step of a tree of links: implicit in damping, springs, dry friction and end stops.

Semi-implicit Euler, of first order: the velocity at the end of a step moves the positions. What
resists at a joint acts by the velocity and position at the end of the step, so that any damping,
spring, friction or stop is stable, and none of them ever adds energy beyond the step's own error.
Dry friction and stops depend on where the joint goes: the step is taken without them first, and
what they do there is solved for again, each time with the friction of the velocity found before. So
it is with a fingertip (`touch`).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models.articulated.dynamics import Bodies, Inertia, Motion, motion, solve
from palpate.models.articulated.kinematics import Among, Each, Joints, Vector
from palpate.models.articulated.touch import Face, Tip, touch_of

PASSES, TOUCHED = 2, 3  # over dry friction and stops, and over those and a fingertip


class Resistance(NamedTuple):
    """What resists at each joint: SI units of its kind, N m of a hinge and N of a slide."""

    armature: Each
    damping: Each
    friction: Each
    stiffness: Each
    rest: Each
    lower: Each
    upper: Each
    stop_stiffness: Each
    stop_damping: Each


class System(NamedTuple):
    """A tree as a step needs it. `fixed` is one for links that no joint moves."""

    joints: Joints
    bodies: Bodies
    resistance: Resistance
    carried: Among
    gravity: Float[Array, "3 #lanes"]
    fixed: Each


def acceleration(
    system: System,
    position: Each,
    velocity: Each,
    torque: Each,
    push: tuple[Vector, Vector] | None = None,
) -> Each:
    """Of the joints, rad/s^2 or m/s^2, without dry friction and stops."""
    resistance = system.resistance
    now = motion(
        system.joints, system.bodies, system.carried, system.gravity, position, velocity, push
    )
    force = torque - now.bias - resistance.damping * velocity
    force = force - resistance.stiffness * (position - resistance.rest)
    return solve(with_diagonal(now.matrix, resistance.armature + system.fixed), force)


def advance(
    system: System,
    position: Each,
    velocity: Each,
    torque: Each,
    push: tuple[Vector, Vector] | None,
    time_step: float,
    *,
    resisted: bool,
    slip: float,
    finger: tuple[Face, Tip] | None = None,
) -> tuple[Each, Each]:
    """Positions and velocities `time_step` (s) later.

    Without dry friction and stops unless `resisted`; friction is 0.7 of its size at `slip` (rad/s
    or m/s), below which a joint creeps. A `finger` is a tip that is against a face or near it.
    """
    resistance = system.resistance
    now: Motion = motion(
        system.joints, system.bodies, system.carried, system.gravity, position, velocity, push
    )
    stretched = position - resistance.rest
    yields = resistance.damping + time_step * resistance.stiffness
    own = resistance.armature + system.fixed
    inertia = with_diagonal(now.matrix, own)
    impulse = time_step * (torque - now.bias - resistance.stiffness * stretched)
    impulse = impulse + jnp.sum(inertia * velocity[None, :], axis=1)
    following = solve(with_diagonal(inertia, time_step * yields), impulse)
    touch = touch_of(*finger, system.joints, now.pose, system.carried) if finger else None
    if not resisted and touch is None:
        return position + time_step * following, following
    mass = jnp.diagonal(inertia, axis1=0, axis2=1).T + time_step * yields
    # a joint by itself would keep this much: the start of what all keep together
    speed = jnp.maximum(jnp.abs(following) - time_step * resistance.friction / mass, 0.0)
    ahead = position + time_step * following
    # N s/m of the finger: none before it is known how much a stiff one presses
    finger_rub = jnp.zeros_like(position[0])
    for number in range(PASSES if touch is None else TOUCHED):
        resisting, force = with_diagonal(inertia, time_step * yields), impulse
        if resisted:
            rub = resistance.friction / jnp.sqrt(jnp.square(speed) + slip**2)
            stop, push_back = stops(resistance, ahead, following, position, time_step)
            resisting = with_diagonal(resisting, time_step * (rub + stop))
            force = force + time_step * push_back
        if touch is not None:
            presses = touch.pressing(touch.motion(following)[0], time_step) > 0.0
            damping, given = touch.resistance(presses, finger_rub, time_step)
            resisting, force = resisting + time_step * damping, force + time_step * given
        following = solve(resisting, force)
        speed = jnp.abs(following)
        if touch is not None:
            deeper, sliding = touch.motion(following)
            most = touch.face.friction * touch.pressing(deeper, time_step)
            slides = jnp.sqrt(jnp.sum(jnp.square(sliding), axis=0) + slip**2)
            if number == 0:  # what friction would take of it, as of a joint by itself
                drag = jnp.sum(touch.moves * (sliding / slides)[:, None], axis=0)
                lost = time_step * most * jnp.sum(drag * solve(resisting, drag), axis=0)
                slides = jnp.maximum(slides - lost, slip)
            finger_rub = most / slides
    return position + time_step * following, following


def stops(
    resistance: Resistance, ahead: Each, velocity: Each, position: Each, time_step: float
) -> tuple[Each, Each]:
    """What an end stop adds to the damping, and the force it has at no velocity.

    A spring beyond the limit, with a damper that acts inwards only: it never pulls.
    """
    above, below = ahead > resistance.upper, ahead < resistance.lower
    outwards = (above & (velocity > 0.0)) | (below & (velocity < 0.0))
    beyond = jnp.where(above, position - resistance.upper, 0.0)
    beyond = jnp.where(below, position - resistance.lower, beyond)
    stiffness = jnp.where(above | below, resistance.stop_stiffness, 0.0)
    damping = jnp.where(outwards, resistance.stop_damping, 0.0)
    return damping + time_step * stiffness, -stiffness * beyond


def with_diagonal(matrix: Inertia, entries: Each) -> Inertia:
    """The matrix with these numbers added on its diagonal."""
    own = jnp.eye(matrix.shape[0], dtype=matrix.dtype)[:, :, None]
    return matrix + own * entries[:, None]
