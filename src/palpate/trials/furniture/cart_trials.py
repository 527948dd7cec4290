"""An agent at work: 1,000 decisions in one world, by one planner, and what they earned."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from jaxtyping import Array, Float

from palpate.models.model import Model
from palpate.models.planar import Planar, PlanarState, furniture
from palpate.parameters import with_values
from palpate.planning.sampling import Mppi, SamplingPlanner
from palpate.recordings import Aligned
from palpate.tasks.furniture.cart import HEADING_WEIGHT, CartTask, Turns
from palpate.trials.furniture.cart_agents import (
    FRAMES,
    Agent,
    Decision,
    Episode,
    Handled,
    Knowing,
    PhysicsAgent,
    piece_model,
)
from palpate.worlds.furniture.furniture import CONTROL_PERIOD, FurnitureWorld, Piece
from palpate.worlds.furniture.handling import record_handling
from palpate.worlds.furniture.scene import GRAVITY

ESTIMATED = 5  # frames that velocities are estimated from
VISIBLE = 0.02  # m or rad, in a decision: what moves by more has moved
SHARES = 1.0, 0.0, 1.0, 0.5  # of the plan that samples are about: forces may cancel
CLOSE = 0.02  # m: what is nearer is taken as touching
HANDLED, TOSSED, PRACTISED = 15.0, 2, 4  # s, three times; and episodes: of TRUE
HANDLING, PRACTICE, TOSSING = 10_000, 20_000, 30_000  # episodes' numbers, unlike those that count


@dataclasses.dataclass(frozen=True)
class Planning:
    """The same for every agent, as in `SamplingPlanner`; `spacing` is counted in decisions.

    The horizon is (knots - 1) spacing decisions.
    """

    samples: int = 128
    knots: int = 7
    spacing: int = 3
    deviation: float = 1.0
    iterations: int = 1
    temperature: float = 0.1


def stage_loss(
    states: PlanarState, actions: Float[Array, "plans 3"], goal: Float[Array, "bodies 3"]
) -> Float[Array, " plans"]:
    """Minus the reward of a decision, and a little for effort so that what is done is not noise."""
    off = states.pose - goal
    heading = jnp.abs(off[..., 2] - 2 * jnp.pi * jnp.round(off[..., 2] / (2 * jnp.pi)))
    distance = jnp.sqrt(jnp.sum(off[..., :2] ** 2, axis=-1) + 1e-8)
    effort = 0.03 * jnp.sum(actions**2, axis=-1)
    return jnp.mean(distance + HEADING_WEIGHT * heading, axis=-1) + effort


@dataclasses.dataclass
class Trial:
    """One agent in one world, from the first decision on."""

    task: CartTask
    agent: Agent
    planning: Planning
    seed: int
    idle: bool = False  # does nothing where it has nothing to plan with, instead of anything
    first_episode: int = 0  # with the seed draws starts and noise

    def __post_init__(self) -> None:
        self._world = self.task.world()
        self._random = np.random.default_rng([self.seed, 7, self.first_episode])
        self._starts = np.random.default_rng([self.seed, 8, self.first_episode])
        self._turns = Turns(self.task)
        self._tracker = furniture(self.task.outlines, control_period=CONTROL_PERIOD)
        self._shapes = [shapely.Polygon(outline) for outline in self.task.outlines]
        self._walls = shapely.MultiPolygon([shapely.Polygon(wall) for wall in self.task.walls])
        self.episodes: list[Episode] = []

    def decide(self) -> float:
        """Take one decision and learn from it; the reward is of where the pieces truly are."""
        if not self.episodes or len(self.episodes[-1].decisions) == self.task.episode:
            self._begin()
        held = self._turns.held(self._frames[-1])
        before = self._state()
        model = self.agent.believed(held)
        action = self._unplanned() if model is None else self._planned(model, held, before)
        handled = self._handled(self._tracker if model is None else model, held)
        wrench = np.asarray(_wrench(handled, before.pose, jnp.asarray(action)))
        seen = [self._world.step(wrench) for _ in range(FRAMES)]
        poses = np.array([one.poses for one in seen])
        moved = np.abs(poses[-1] - self._frames[-1]).max(axis=-1) > VISIBLE
        moved[held] = True
        touched = self._touching(poses[-1]) | self._touching(self._frames[-1])
        self._frames = [*self._frames, *poses][-ESTIMATED:]
        self.episodes[-1].decisions.append(
            Decision(
                poses,
                np.array([one.wrench for one in seen]),
                before,
                self._state(),
                wrench,
                held,
                moved,
                touched,
            )
        )
        self.agent.learn(self.episodes)
        return float(self.task.reward(self._world.truth().poses))

    def _begin(self) -> None:
        start = self.task.start(self._starts)
        number = self.first_episode + len(self.episodes)
        first = self._world.reset(self.seed, episode=number, poses=start).poses
        self.episodes.append(Episode(first))
        self._frames = [first] * ESTIMATED  # at rest, as everybody knows
        self._turns.begin()
        self._plan = None
        self._planned_for = -1

    def _state(self) -> PlanarState:
        return _estimated(self._tracker, jnp.asarray(np.array(self._frames), jnp.float32))

    def _unplanned(self) -> np.ndarray:
        """Anything within the ball of actions, or nothing."""
        if self.idle:
            return np.zeros(3, np.float32)
        direction = self._random.normal(size=3)
        size = self._random.uniform() ** (1 / 3) / np.linalg.norm(direction)
        return np.asarray(size * direction, np.float32)

    def _planned(self, model: Model, held: int, state: PlanarState) -> np.ndarray:
        options = self.planning
        planner = SamplingPlanner(
            model=self._handled(model, held),
            stage_loss=stage_loss,
            limit=1.0,
            rate_limit=None,
            knots=options.knots,
            spacing=options.spacing,
            rule=Mppi(options.temperature),
            samples=options.samples,
            iterations=options.iterations,
            deviation=options.deviation,
            shares=SHARES,
        )
        if self._plan is None or held != self._planned_for:
            key = jax.random.key(int(self._random.integers(2**31)))
            self._plan, self._planned_for = planner.init(jnp.zeros(3), key), held
        goals = jnp.broadcast_to(
            jnp.asarray(self.task.goals, jnp.float32), (planner.horizon, *self.task.goals.shape)
        )
        self._plan, action = planner(self._plan, state, goals)
        return np.asarray(action)

    def _handled(self, model: Model, held: int) -> Handled:
        dtype = jnp.zeros(()).dtype
        return Handled(
            inner=model,
            held=jnp.asarray(held),
            strength=jnp.asarray(self.task.strength, dtype),
            handle=jnp.asarray(self.task.handles, dtype),
        )

    def _touching(self, poses: np.ndarray) -> np.ndarray:
        """Which pieces (bodies,) are near another or a wall."""
        placed = [
            shapely.Polygon(np.asarray(shape.exterior.coords)[:-1] @ _rotation(angle).T + (x, y))
            for shape, (x, y, angle) in zip(self._shapes, poses, strict=True)
        ]
        return np.array(
            [
                min([self._walls.distance(one), *(one.distance(o) for o in placed if o is not one)])
                < CLOSE
                for one in placed
            ]
        )


def best_scene(task: CartTask, planning: Planning, seed: int) -> Planar:
    """The planar model that explains most of what it meets in this task: what TRUE is told.

    Of the same pieces, of the same hidden parameters: as they stand apart, without walls, and each
    is wiggled for three times `HANDLED`; as anything is done with them for `TOSSED` episodes; and
    as an agent that learnt from this brings them to their places for `PRACTISED` episodes of the
    task, from other starts than those that count. The search begins at the hidden constants: from
    elsewhere it may end at a table that is too heavy to be moved, is believed, and so never seen to
    move. Nor does wiggling tell at what force a caster gives way that holds more than that takes.
    """
    stretches = _wiggled(task, seed)
    tossed = Trial(task, Knowing(None), planning, seed, first_episode=TOSSING)
    for _ in range(TOSSED * task.episode):
        tossed.decide()
    for body, handled in enumerate(stretches):
        handled += [one for episode in tossed.episodes for one in episode.handling(body)]
    agent = PhysicsAgent(task, seed, stretches, _told(task, seed))
    agent.search()
    trial = Trial(task, agent, planning, seed, first_episode=PRACTICE)
    for _ in range(PRACTISED * task.episode):
        trial.decide()
    return agent.search()


def _told(task: CartTask, seed: int) -> list[Planar]:
    """Each piece with the hidden constants that mean the same in a planar model."""
    world = task.world()
    world.reset(seed)
    truth, pieces = world.truth(), []
    for body, hidden in enumerate(truth.parameters):
        piece = piece_model(task, body)
        extent, centre = np.asarray(piece.half_extent)[0], truth.centres[body]
        feet = all(mount.type == "foot" for mount in truth.kinds[body].mounts)
        gyration = np.sqrt(truth.inertias[body] / hidden.mass) / np.asarray(piece.even_gyration)
        values = {
            "mass": [hidden.mass],
            "centre_of_mass": [centre / extent],
            "gyration": gyration,
            "floor_friction": [hidden.friction if feet else hidden.rolling_resistance],
        }
        for place, angle in zip(truth.wheel_places[body], hidden.locked, strict=True):
            if angle is not None:
                share = np.prod(1 + centre * place / place**2) / 4  # of the weight, on this wheel
                drag = hidden.friction * hidden.mass * GRAVITY * share
                values |= {
                    "wheel_position": [[place / extent]],
                    "wheel_along": [[drag]],
                    "wheel_across": [[drag]],
                }
        told = {path: jnp.asarray(value, piece.mass.dtype) for path, value in values.items()}
        pieces.append(with_values(piece, told))
    return pieces


def _wiggled(task: CartTask, seed: int) -> list[list[tuple[Aligned, bool]]]:
    """Handling of each piece, that begins at rest, as `Episode.handling` has it."""
    apart = [(4.0 * index, 0.0, 0.0) for index in range(len(task.kinds))]
    world = FurnitureWorld(
        [Piece(kind, pose) for kind, pose in zip(task.kinds, apart, strict=True)]
    )
    stretches: list[list[tuple[Aligned, bool]]] = [[] for _ in task.kinds]
    for repetition in range(3):
        first = HANDLING + 10 * repetition
        for body, trial in enumerate(record_handling(world, seed, HANDLED, first).trials):
            poses = trial.channels["pose"].values[:, body : body + 1]
            wrenches = trial.channels["wrench"].values[:, body : body + 1]
            aligned = Aligned(CONTROL_PERIOD, poses[None], wrenches[None], np.array([len(poses)]))
            stretches[body].append((aligned, True))
    return stretches


def _rotation(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@jax.jit
def _estimated(tracker: Planar, frames: Array) -> PlanarState:
    return tracker.initial_state(frames)


@jax.jit
def _wrench(handled: Handled, pose: Array, action: Array) -> Array:
    return handled.wrench(pose, action)
