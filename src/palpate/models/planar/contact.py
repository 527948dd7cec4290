"""What contacts of a step do to velocities, and to positions within it.

The course of each gap within the step, at constant acceleration, says when it closes. What closes
leaves with the restitution times the speed it came with (Newton's law), and the position takes the
jump at the time of the impact, so that a bounce is right at any step. Other contacts may not close
by the end of the step. Friction is Coulomb's, with the normal load of the last iteration, so that
each iteration stays a convex problem (Kaufman et al., "Staggered projections", 2008).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models.planar.geometry import nearest, pick
from palpate.models.planar.system import System

SLOWEST = 1e-4  # m/s: friction of a contact that slides more slowly is viscous
STIFFNESS = 3e3  # of a contact, in the mass it feels
SLOTS = 3  # pairs of parts that a step looks at for each body
SOFT_APPROACH = 0.02  # m/s: slower impacts do not bounce, twice as fast ones in full
RECOVERY = 0.2  # share of an overlap that is made up for in one step
SLOP = 2e-4  # m: overlap that is left alone
AT_REST = 1e-7  # m/s: a sliding speed has a slope down to here
GRAZING = 1e-4  # m/s: keeps the slope of the time of impact finite
FASTEST_RECOVERY = 0.3  # m/s


class Contacts(NamedTuple):
    """Contacts of a step: geometry, and what their laws need.

    Two parts touch in two points, whose normal impulses differ, and share one friction. `normal`
    and `tangent` map the velocities of all bodies to how fast gaps open and slide. `target` is the
    least opening speed (m/s), `mass` and `sliding_mass` what a contact feels along the normal and
    across it (where nothing can turn: to think it lighter would overshoot), and `delay` (s) how
    much later than in the middle of the step impulses act.
    """

    normal: Float[Array, "points bodies 3"]
    target: Float[Array, " points"]
    mass: Float[Array, " points"]
    delay: Float[Array, " points"]
    tangent: Float[Array, "contacts bodies 3"]
    sliding_mass: Float[Array, " contacts"]
    friction: Float[Array, " contacts"]
    sliding_delay: Float[Array, " contacts"]


def contacts(
    system: System,
    pose: Float[Array, "bodies 3"],
    centre: Float[Array, "bodies 2"],
    ahead: Float[Array, " bodies"],
    start: Float[Array, "bodies 3"],
    free: Float[Array, "bodies 3"],
    time_step: float,
) -> Contacts:
    """The contacts of a step: the nearest pairs, `SLOTS` for each body.

    `pose` is that of the bodies' frames, `centre` where the centres of mass are in the world.
    Velocities at the `start` of the step, and `free` of contacts at its end, are in the bodies'
    axes when turned by `ahead`. A wall has the restitution and friction of what touches it.
    """
    shapes, restitution, friction = system.shapes, system.restitution, system.contact_friction
    assert shapes is not None
    mass, inertia = system.bodies.mass, system.bodies.inertia
    inverse_mass = 1.0 / jnp.stack([mass, mass, inertia], axis=-1)
    near = nearest(shapes, pose)
    slots = min(near.gap.shape[0], SLOTS * pose.shape[0])
    closest = jnp.min(near.gap, axis=1)
    pair = jax.lax.top_k(jax.lax.stop_gradient(-closest), slots)[1]
    gap, point = pick(near.gap, pair).reshape(-1), pick(near.point, pair).reshape(-1, 2)
    pair = jnp.repeat(pair, 2)
    sign = pick(near.sign, pair)
    normal = pick(near.normal, pair) * sign[:, None]  # pushes the first body away
    tangent = jnp.stack([-normal[:, 1], normal[:, 0]], axis=-1)
    first, second = shapes.pairs[pair, 0], shapes.pairs[pair, 2]
    either = jnp.where(second < 0, first, second)
    bounce = _mean(pick(restitution, first), pick(restitution, either))
    cosine, sine = jnp.cos(ahead), jnp.sin(ahead)

    def row(direction: Array, first_moment: Array, second_moment: Array) -> Array:
        def of(body: Array, moment: Array) -> Array:
            side = jax.nn.one_hot(body, centre.shape[0], dtype=gap.dtype)  # none for a wall
            c, s = side @ cosine, side @ sine
            x = c * direction[:, 0] + s * direction[:, 1]
            y = c * direction[:, 1] - s * direction[:, 0]
            lever = point - side @ centre
            turning = lever[:, 0] * direction[:, 1] - lever[:, 1] * direction[:, 0] + moment
            return side[:, :, None] * jnp.stack([x, y, turning], axis=-1)[:, None, :]

        return of(first, first_moment) - of(second, second_moment)

    none = jnp.zeros_like(gap)
    opening, sliding = row(normal, none, none), row(tangent, none, none)
    was = jnp.sum(opening * start, axis=(1, 2))
    slid = jnp.sum(sliding * start, axis=(1, 2))
    drawn = jnp.sum(opening * free, axis=(1, 2))
    target, end, moment = _course(gap, was, drawn, bounce, time_step)
    # by then the corner has moved along the edge that it meets
    on_first = 0.5 * (1.0 - sign) * moment  # where the edge is the first body's
    on_second = on_first - moment
    opening = row(normal, on_first * slid, on_second * slid)
    sliding = row(tangent, -on_first * was, -on_second * was)
    kicked = jnp.maximum(target - drawn, 1e-6)
    delay = (end - gap - 0.5 * time_step * (was + target)) / kicked
    delay = jnp.clip(delay, -time_step, time_step)
    later = gap[1::2] < gap[::2]

    def nearer(values: Array) -> Array:
        mask = later.reshape(-1, *(1,) * (values.ndim - 1))
        return jnp.where(mask, values[1::2], values[::2])

    sliding = nearer(sliding)
    return Contacts(
        normal=opening,
        target=target,
        mass=1.0 / jnp.sum(jnp.square(opening) * inverse_mass, axis=(1, 2)),
        delay=delay,
        tangent=sliding,
        sliding_mass=1.0 / jnp.sum(jnp.square(sliding[..., :2]) * inverse_mass[:, :2], axis=(1, 2)),
        friction=_mean(pick(friction, first), pick(friction, either))[::2],
        sliding_delay=nearer(delay),
    )


def _course(
    gap: Array, was: Array, drawn: Array, bounce: Array, time_step: float
) -> tuple[Array, Array, Array]:
    """How a gap goes on that opens at `was` now and, untouched, would at `drawn` a step later.

    Returns the opening speed after the step, the gap then, and when it closes. Between them it
    moves at constant acceleration: it closes after 2 gap / (sqrt(was^2 - 2 gap a) - was).
    """
    pull = (drawn - was) / time_step
    open_gap = jnp.maximum(gap, 0.0)
    squared = jnp.square(was) - 2.0 * pull * open_gap
    reaches = squared > 0.0
    root = jnp.sqrt(jnp.where(reaches, squared, 0.0) + GRAZING**2)
    nearing = root - was
    closes = reaches & (nearing > 1e-9)
    moment = 2.0 * open_gap / jnp.where(closes, nearing, 1.0)
    hits = (closes & (moment < time_step)) | (gap <= 0.0)
    moment = jnp.where(hits & (gap > 0.0), moment, 0.0)

    speed = jnp.maximum(-(was + pull * moment), 0.0)
    lively = jnp.clip(speed / SOFT_APPROACH - 1.0, 0.0, 1.0)
    leaving = bounce * lively * speed
    left = time_step - moment
    back = jnp.minimum(pull, 0.0) * left  # what draws it on draws it back
    rebound = jnp.maximum(leaving + back, 0.0)
    height = jnp.maximum((leaving + 0.5 * back) * left, 0.0)
    overlap = jnp.maximum(-gap - SLOP, 0.0)
    recovery = jnp.minimum(RECOVERY * overlap / time_step, FASTEST_RECOVERY)
    rebound = jnp.maximum(rebound, recovery)
    height = jnp.maximum(height, time_step * recovery) + jnp.minimum(gap, 0.0)
    target = jnp.where(hits, rebound, -2.0 * open_gap / time_step - was)
    return target, jnp.where(hits, height, 0.0), moment


def _mean(one: Array, other: Array) -> Array:
    """Geometric mean; its slope at zero is cut off."""
    return jnp.sqrt(one * other + 1e-12)


def weights(
    found: Contacts, velocity: Float[Array, "bodies 3"], before: Float[Array, " rows"] | None
) -> Float[Array, " rows"]:
    """Weights (kg) of all normals, then of all tangents, for the last iteration's velocity.

    `before` are those of the last iteration. In the first one no load is known: it is what would
    stop each contact on its own.
    """
    lacking = jnp.maximum(found.target - jnp.sum(found.normal * velocity, axis=(1, 2)), 0.0)
    sliding = jnp.sum(found.tangent * velocity, axis=(1, 2))
    stiffness = STIFFNESS * found.mass
    if before is None:
        load, bearing = jnp.max((found.mass * lacking).reshape(-1, 2), axis=1), 0.0
    else:
        load = jnp.sum((stiffness * lacking).reshape(-1, 2), axis=1)
        bearing = before[lacking.shape[0] :]
    held = found.friction * load
    speed = size(sliding) * (1.0 + bearing / found.sliding_mass)
    weight = held / remaining_speed(speed, held / found.sliding_mass)
    return jnp.concatenate([jnp.where(lacking > 0.0, stiffness, 0.0), weight])


def delayed_impulse(
    found: Contacts, weight: Float[Array, " rows"], velocity: Float[Array, "bodies 3"]
) -> Float[Array, "bodies 3"]:
    """Impulse times the delay by which it counts in positions, on each body (kg m, kg m^2).

    `weight` gave this velocity.
    """
    count = found.target.shape[0]
    pushed = weight[:count] * (found.target - jnp.sum(found.normal * velocity, axis=(1, 2)))
    rubbed = -weight[count:] * jnp.sum(found.tangent * velocity, axis=(1, 2))
    moved = jnp.sum((pushed * found.delay)[:, None, None] * found.normal, axis=0)
    return moved + jnp.sum((rubbed * found.sliding_delay)[:, None, None] * found.tangent, axis=0)


def size(speed: Array) -> Array:
    """How large a speed is, m/s; its slope at rest is zero."""
    return jnp.sqrt(jnp.square(speed) + AT_REST**2)


def remaining_speed(speed: Array, taken: Array) -> Array:
    """What is left of a speed (m/s) from which some is taken, smoothly, and at least a little."""
    left = speed - taken
    left = 0.5 * (left + jnp.sqrt(jnp.square(left) + 4.0 * SLOWEST**2))
    return jnp.sqrt(jnp.square(left) + SLOWEST**2)
