"""Whether a twin moves like the appliance that it is of: the judge, who pulls at both.

Each part that was found is pulled by a force that it has not felt before, at another place, in the
appliance and in the twin; the twin is not told what came of it (open loop).
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from palpate.identification.interactive.forces.dynamics import Dynamics
from palpate.identification.interactive.twin import Twin
from palpate.models.articulated.articulated import ACTION, Articulated
from palpate.models.articulated.parameters import ArticulatedState
from palpate.models.model import Model, rollout
from palpate.trials.appliance.score import Score, real_labels
from palpate.worlds.appliance.appliance import HOLD, ApplianceWorld, HandAction
from palpate.worlds.appliance.design import MOST_FORCE

SECONDS = 2.0  # of a motion
LASTING = 0.3, 1.5  # s, least and most: of a pull that rises and falls as half a sine does
LEAST, MOST = 1.0 / 3.0, 2.0 / 3.0  # of its range that a part moves, drawn between them
ROOM = 0.9  # of the way to the end of its range that it moves at most
FIRST, GROWTH = 0.5, 1.05  # N: the force that is tried first, and each that follows over the last
DRAWS = 100
WITHIN = 0.05, 0.95
PLACE = 3e-3  # rad or m: how well a twin knows where a part is
ATTEMPTS = 20  # at taking hold


@dataclasses.dataclass(frozen=True)
class Motion:
    """How far a twin's motion is off, as shares of the part's range.

    `error` and `still` are root mean squares over the motion, of the twin and of one that stands
    still; `corrected` is that of the twin with a network on top, None without one. `covered` is the
    share of moments in which 90 % of the draws hold the truth. `inside` says of friction, damping
    and inertia whether their 90 % intervals do.
    """

    error: float
    still: float
    corrected: float | None
    covered: float
    inside: tuple[bool, bool, bool]


def motions(
    twin: Twin,
    dynamics: Dynamics,
    world: ApplianceWorld,
    found: Score,
    seed: int,
    corrected: Model | None = None,
) -> list[Motion | None]:
    """Of each real part that was found with its kind of joint; `corrected` is its model with a
    network on top.

    None of one that no force of the hand moves as far as was drawn, or that is hidden. The
    world is as it was in the twin's last look, and is left as it is.
    """
    random = np.random.default_rng([seed, 11])
    labels, points = real_labels(twin, world), twin.looks[-1].points
    result: list[Motion | None] = []
    for real, part in enumerate(found.part):
        if found.type_right[real] != 1.0:
            continue
        seen = points[labels == real]
        result.append(
            _motion(twin, dynamics, corrected, world, real, int(part), seen, random, seed)
            if len(seen)
            else None
        )
    return result


def _motion(
    twin: Twin,
    dynamics: Dynamics,
    corrected: Model | None,
    world: ApplianceWorld,
    real: int,
    part: int,
    seen: Float[np.ndarray, "n 3"],
    random: np.random.Generator,
    seed: int,
) -> Motion | None:
    truth, own = world.truth(), world.parts[real]
    axis, anchor = truth.axis[real], truth.anchor[real]
    along = np.broadcast_to(axis, seen.shape)
    if own.joint == "revolute":
        along = np.cross(axis, seen - anchor)
    lever = np.linalg.norm(along, axis=1)
    chosen = random.choice(np.flatnonzero(lever >= np.quantile(lever, 0.7)))
    open_share = (truth.position[real] - own.low) / own.range
    opens = 1.0 if open_share < 0.5 else -1.0
    far = random.uniform(LEAST, max(min(MOST, ROOM * max(open_share, 1.0 - open_share)), LEAST))
    direction = opens * along[chosen] / lever[chosen]
    times = world.control_period * np.arange(round(SECONDS / world.control_period))
    lasting = random.uniform(*LASTING)
    shape = np.where(times < lasting, np.sin(math.pi * times / lasting), 0.0)
    force, real_way = FIRST, None
    while force < MOST_FORCE:
        real_way = _real(world, truth.position, real, seen[chosen], force * shape, direction, seed)
        if real_way is not None and np.abs(real_way).max() > far * own.range:
            break
        force, real_way = force * GROWTH, None
    if real_way is None:
        return None
    look = len(twin.looks) - 1
    link = dynamics.parts.index(part)
    hold = twin.pose(part, look).inverse.at(seen[chosen][None])[0] - twin.parts[part].screw.point
    acts = np.zeros((len(times), len(dynamics.parts), ACTION), np.float32)
    acts[:, link, 1:4] = force * shape[:, None] * direction
    acts[:, link, 4:] = hold
    start = np.array([twin.parts[one].positions[look] for one in dynamics.parts])
    models = dynamics.draws(DRAWS, seed)
    ways = np.asarray(_roll(models, jnp.asarray(start), jnp.asarray(acts)))[:, :, link]
    sign = 1.0 if twin.screw(part, look).axis @ axis > 0.0 else -1.0
    gone = sign * real_way
    noise = PLACE * random.standard_normal(ways.shape)
    low, high = np.quantile(ways - start[link] + noise, WITHIN, axis=0)

    def error_of(model: Model) -> float:
        way = np.asarray(_roll_alone(model, jnp.asarray(start), jnp.asarray(acts)))[:, link]
        return float(np.sqrt(np.mean(np.square((way - start[link] - gone) / own.range))))

    return Motion(
        error=error_of(dynamics.model),
        still=float(np.sqrt(np.mean(np.square(gone / own.range)))),
        corrected=None if corrected is None else error_of(corrected),
        covered=float(np.mean((gone >= low) & (gone <= high))),
        inside=_inside(dynamics, link, world, real),
    )


def _real(
    world: ApplianceWorld,
    position: Float[np.ndarray, " parts"],
    part: int,
    point: Float[np.ndarray, "3"],
    forces: Float[np.ndarray, " times"],
    direction: Float[np.ndarray, "3"],
    seed: int,
) -> Float[np.ndarray, " times"] | None:
    """How far a part of the same appliance moves under forces at a point; None without a hold."""
    other = ApplianceWorld(world.source, sensor=world.sensor, views=len(world.cameras))
    other.reset(seed, position=position)
    other.cameras = world.cameras
    for _ in range(ATTEMPTS):
        if other.step(HandAction(HOLD, point)).holding:
            break
        other.step(HandAction())
    else:
        return None
    start, way = other.truth().position[part], []
    for force in forces:
        other.step(HandAction(HOLD, point, force * direction))
        way.append(other.truth().position[part] - start)
    return np.array(way)


@eqx.filter_jit
def _roll(
    models: Articulated, start: Float[jax.Array, " links"], acts: Float[jax.Array, "time links 7"]
) -> Float[jax.Array, "draws time links"]:
    count = models.mass.shape[0]
    position = jnp.broadcast_to(start, (count, *start.shape)).astype(models.mass.dtype)
    state = ArticulatedState(position, jnp.zeros_like(position))
    repeated = jnp.broadcast_to(acts, (count, *acts.shape))
    return rollout(models, state, repeated).position


@eqx.filter_jit
def _roll_alone(
    model: Model, start: Float[jax.Array, " links"], acts: Float[jax.Array, "time links 7"]
) -> Float[jax.Array, "time links"]:
    position = start.astype(acts.dtype)
    state = ArticulatedState(position, jnp.zeros_like(position))
    return model.observe(rollout(model, state, acts))


def _inside(
    dynamics: Dynamics, link: int, world: ApplianceWorld, real: int
) -> tuple[bool, bool, bool]:
    """Whether friction, damping and inertia are in their 90 % intervals."""
    own, resists = dynamics.resistance[link], world.parts[real]
    if own is None:
        return False, False, False
    wide = 1.645 * own.deviation
    inertia = dynamics.inertia[link]
    return (
        bool(abs(own.friction - resists.friction) < wide[2]),
        bool(abs(own.damping - resists.damping) < wide[1]),
        bool(abs(inertia - world.truth().inertia[real]) < wide[0] / own.mass_share * inertia),
    )
