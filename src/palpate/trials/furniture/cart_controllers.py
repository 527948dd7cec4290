"""Who learns the Shopping-Cart and Apartment tasks online, and by what.

Each controller believes in some model of the scene whose step is a decision, and all plan through
theirs by the same sampling planner. Physics-based ones have a planar model of each piece, whose
posterior (`cart_posterior`) is climbed anew as data arrive, and after 1, 2, 4, ... episodes
searched all over, as that of a recording is: a climb may stay where a table is heavy that in truth
is held by its caster. Regressions have the transitions of decisions.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import shapely
from jaxtyping import Array, Float, Int

from palpate.identification.regression.locally_weighted import LocallyWeighted, locally_weighted
from palpate.identification.regression.model import Features, RegressedModel
from palpate.models.model import Model, Wrapper
from palpate.models.planar import Planar, PlanarState, furniture
from palpate.numerics.polygons import place_points
from palpate.parameters import Parameter, as_floating, declare, parameters_of, value_of, with_values
from palpate.planning.sampling import Mppi, SamplingPlanner
from palpate.recordings import Aligned
from palpate.tasks.furniture.cart import DECISION, HEADING_WEIGHT, CartTask, Turns
from palpate.trials.controller import FeedbackController
from palpate.trials.furniture.cart_posterior import PiecePosterior
from palpate.trials.furniture.planar_features import body_features
from palpate.worlds.furniture.furniture import CONTROL_PERIOD, FurnitureObservation

FRAMES = round(DECISION / CONTROL_PERIOD)  # observed in a decision
SUBSTEPS = 2  # of a decision, in planning
ESTIMATED = 5  # frames that velocities are estimated from
VISIBLE = 0.02  # m or rad, in a decision: what moves by more has moved
SHARES = 1.0, 0.0, 1.0, 0.5  # of the plan that samples are about: forces may cancel
CLOSE = 0.02  # m: what is nearer is taken as touching


@dataclasses.dataclass(frozen=True)
class Planning:
    """The same for every controller, as in `SamplingPlanner`; `spacing` is counted in decisions.

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


class Handled(Wrapper):
    """A scene in which one piece is held: an action is a share (along, across, turn) of its wrench.

    Forces act at the piece's handle, in its axes as it stands when the decision is taken, and keep
    their directions in the room until the next.
    """

    inner: Model  # its action is a wrench on each body, its step a decision
    held: Int[Array, ""]
    strength: Float[Array, "bodies 3"]
    handle: Float[Array, "bodies 2"]
    control_period: float = eqx.field(static=True, default=DECISION)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    @property
    def action_shape(self) -> tuple[int]:
        """(3,): along, across, turn."""
        return (3,)

    def wrench(self, pose: Array, action: Array) -> Float[Array, "*batch bodies 3"]:
        """What acts on each body, in the room's axes about the bodies' origins."""
        local = action * self.strength[self.held]
        lever = self.handle[self.held]
        angle = jnp.take(pose[..., 2], self.held, axis=-1)
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        along, across = local[..., 0], local[..., 1]
        torque = local[..., 2] + lever[0] * across - lever[1] * along
        x, y = cosine * along - sine * across, sine * along + cosine * across
        one = jnp.stack([x, y, torque], axis=-1)
        return one[..., None, :] * jax.nn.one_hot(self.held, pose.shape[-2])[:, None]

    def step(self, state: PlanarState, action: Array) -> PlanarState:
        return self.inner.step(state, self.wrench(state.pose, action))


@dataclasses.dataclass(frozen=True)
class Decision:
    """What was done in one decision and what was seen of it.

    `poses` and `wrenches` (periods, bodies, 3) as measured at the end of, and over, each control
    period; `before` and `after` the states as estimated; `wrench` (bodies, 3) as commanded. A piece
    that `moved` (bodies,) was held or moved visibly; one that `touched` had another or a wall near.
    """

    poses: np.ndarray
    wrenches: np.ndarray
    before: PlanarState
    after: PlanarState
    wrench: np.ndarray
    held: int
    moved: np.ndarray
    touched: np.ndarray


@dataclasses.dataclass(frozen=True)
class Episode:
    """The poses (bodies, 3) seen at its start, at rest, and its decisions so far."""

    first: np.ndarray
    decisions: list[Decision] = dataclasses.field(default_factory=list)

    def handling(self, body: int) -> list[tuple[Aligned, bool]]:
        """Stretches in which one piece moved and touched nothing, and whether each began at rest.

        As recordings of that piece alone.
        """
        alone = np.array([d.moved[body] and not d.touched[body] for d in self.decisions], int)
        edges = np.diff(alone, prepend=0, append=0)
        stretches = []
        for begin, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
            run = self.decisions[begin:end]
            start = self.first if begin == 0 else self.decisions[begin - 1].poses[-1]
            poses = np.concatenate([start[None], *(d.poses for d in run)])[:, body : body + 1]
            wrenches = np.concatenate([d.wrenches for d in run])[:, body : body + 1]
            length = np.array([len(poses)])
            aligned = Aligned(CONTROL_PERIOD, poses[None], wrenches[None], length)
            stretches.append((aligned, bool(begin == 0)))
        return stretches


class _Holding(NamedTuple):
    """A decision in force, and what was seen since it was taken."""

    held: int
    before: PlanarState
    wrench: np.ndarray
    seen: list[FurnitureObservation]


class CartController(FeedbackController):
    """Holds one piece after another, and decides how by planning through what it believes.

    It goes on from trial to trial, one at a time, each an episode of the task; this one believes in
    the `scene` that it is told, and never learns. Who believes in none takes any action, or does
    nothing if it is `idle`. `seed` and `first_episode` draw samples and actions.
    """

    period = CONTROL_PERIOD

    def __init__(
        self,
        task: CartTask,
        planning: Planning,
        seed: int,
        first_episode: int = 0,
        scene: Planar | None = None,
        idle: bool = False,
    ):
        self._task, self._planning, self._idle = task, planning, idle
        self.scene = scene
        self._random = np.random.default_rng([seed, 7, first_episode])
        self._tracker = furniture(task.outlines, control_period=CONTROL_PERIOD)
        self._walls = shapely.MultiPolygon([shapely.Polygon(wall) for wall in task.walls])
        self.episodes: list[Episode] = []

    def believed(self, held: int) -> Model | None:
        """The scene whose step is a decision, to plan for the piece that is held; None: nothing."""
        return None if self.scene is None else around(self.scene, held)

    def learn(self) -> None:
        """Take account of the newest decision of the last episode."""

    def start(self, command: Any, observation: FurnitureObservation, goal: Any) -> None:
        """See `FeedbackController`: a new episode."""
        first = observation.poses[0]
        self.episodes.append(Episode(first))
        self._frames = [first] * ESTIMATED  # at rest, as everybody knows
        self._turns = Turns(self._task)
        self._plan, self._planned_for = None, -1

    def decide(
        self, carry: _Holding | None, observation: FurnitureObservation, goal: Any
    ) -> tuple[_Holding | None, np.ndarray]:
        """See `FeedbackController`; nothing is done in the period that shows an episode's end."""
        if carry is not None:
            carry.seen.append(observation)
            if len(carry.seen) == FRAMES:
                self._finish(carry)
                carry = None
        if carry is None:
            if len(self.episodes[-1].decisions) == self._task.episode:
                return None, np.zeros_like(observation.wrench)
            carry = self._hold()
        return carry, carry.wrench[None]

    def _hold(self) -> _Holding:
        held = self._turns.held(self._frames[-1])
        before = self._state()
        model = self.believed(held)
        handled = Handled(
            inner=self._tracker if model is None else model,
            held=jnp.asarray(held),
            strength=as_floating(self._task.strength),
            handle=as_floating(self._task.handles),
        )
        action = self._act_without_plan() if model is None else self._planned(handled, before)
        wrench = _wrench(handled, before.pose, jnp.asarray(action))
        return _Holding(held, before, np.asarray(wrench), [])

    def _finish(self, decision: _Holding) -> None:
        poses = np.concatenate([one.poses for one in decision.seen])
        wrenches = np.concatenate([one.wrench for one in decision.seen])
        last = self._frames[-1]
        moved = np.abs(poses[-1] - last).max(axis=-1) > VISIBLE
        moved[decision.held] = True
        touched = self._touching(poses[-1]) | self._touching(last)
        self._frames = [*self._frames, *poses][-ESTIMATED:]
        done = decision.before, self._state(), decision.wrench, decision.held, moved, touched
        self.episodes[-1].decisions.append(Decision(poses, wrenches, *done))
        self.learn()

    def _state(self) -> PlanarState:
        return _estimated(self._tracker, jnp.asarray(np.array(self._frames), jnp.float32))

    def _act_without_plan(self) -> np.ndarray:
        """Anything within the ball of actions, or nothing."""
        if self._idle:
            return np.zeros(3, np.float32)
        direction = self._random.normal(size=3)
        size = self._random.uniform() ** (1 / 3) / np.linalg.norm(direction)
        return np.asarray(size * direction, np.float32)

    def _planned(self, handled: Handled, state: PlanarState) -> np.ndarray:
        options = {**vars(self._planning)}
        rule = Mppi(options.pop("temperature"))
        planner = SamplingPlanner(
            handled, stage_loss, limit=1.0, rate_limit=None, rule=rule, shares=SHARES, **options
        )
        held = int(handled.held)
        if self._plan is None or held != self._planned_for:
            key = jax.random.key(int(self._random.integers(2**31)))
            self._plan, self._planned_for = planner.init(jnp.zeros(3), key), held
        goals = jnp.asarray(self._task.goals, jnp.float32)
        goals = jnp.broadcast_to(goals, (planner.horizon, *goals.shape))
        self._plan, action = planner(self._plan, state, goals)
        return np.asarray(action)

    def _touching(self, poses: np.ndarray) -> np.ndarray:
        """Which pieces (bodies,) are near another or a wall."""
        shapes = [
            shapely.Polygon(place_points(outline, pose))
            for outline, pose in zip(self._task.outlines, poses, strict=True)
        ]
        others = [[self._walls, *(o for o in shapes if o is not one)] for one in shapes]
        pairs = zip(shapes, others, strict=True)
        return np.array([min(one.distance(o) for o in near) < CLOSE for one, near in pairs])


def piece_model(task: CartTask, body: int) -> Planar:
    """A piece alone, its parameters at their priors; contacts are not identified."""
    alone = furniture([task.outlines[body]], wheels=1, control_period=CONTROL_PERIOD)
    return declare(alone, restitution={"fixed": True}, contact_friction={"fixed": True})


def around(scene: Planar, held: int) -> Planar:
    """The scene with the contacts of the piece that is held alone: the others stand.

    Of as many pairs whichever it is, so that nothing is compiled anew.
    """
    pairs = np.asarray(scene.pairs)
    return dataclasses.replace(scene, pairs=pairs[(pairs[:, [0, 2]] == held).any(axis=1)])


def scene_model(task: CartTask, pieces: Sequence[Planar]) -> Planar:
    """All pieces in the room, each with the parameters it was found to have alone.

    Its step is a decision.
    """
    scene = furniture(
        task.outlines, task.walls, wheels=1, control_period=DECISION, substeps=SUBSTEPS
    )
    values = {
        path: jnp.concatenate([value_of(piece, path) for piece in pieces])
        for path in parameters_of(scene)
        if value_of(scene, path).size
    }
    return with_values(scene, values)


class PhysicsController(CartController):
    """Physics-based RL: plans through the most probable planar model of every piece so far.

    `handled` is what it saw of each piece before, if anything, and `begun` where to look first.
    """

    def __init__(
        self,
        task: CartTask,
        planning: Planning,
        seed: int,
        first_episode: int = 0,
        handled: Sequence[list[tuple[Aligned, bool]]] = (),
        begun: Sequence[Planar] = (),
    ):
        super().__init__(task, planning, seed, first_episode)
        self._pieces = [
            PiecePosterior(piece_model(task, body), 100 * seed + body, first)
            for body, first in enumerate(begun or [None] * len(task.kinds))
        ]
        self._models = [piece.model for piece in self._pieces]
        for piece, stretches in zip(self._pieces, handled, strict=False):
            piece.keep(stretches)
        self.scene = scene_model(task, self._models)
        self._learnt = [0] * len(self._pieces)  # decisions in which each was held

    def search(self) -> Planar:
        """Look for the modes of all pieces anew; the scene as they have it then."""
        for body, piece in enumerate(self._pieces):
            self._models[body] = piece.search() or self._models[body]
        self.scene = scene_model(self._task, self._models)
        return self.scene

    def learn(self) -> None:
        episode = self.episodes[-1]
        held = episode.decisions[-1].held
        self._learnt[held] += 1
        if due(self._learnt[held]):
            found = self._pieces[held].update(episode.handling(held))
            if found is not None:
                self._models[held] = found
                self.scene = scene_model(self._task, self._models)
        if len(episode.decisions) == self._task.episode:
            for body, piece in enumerate(self._pieces):
                piece.keep(episode.handling(body))
            if len(self.episodes).bit_count() == 1:
                self.search()


class RegressionController(CartController):
    """Plans through a regression of each piece's decisions; knows no piece before it was held.

    `kind` is "lwr" or "oo-lwr", as in `identification.regression.model`; `decisions` is the most
    that it will see.
    """

    def __init__(self, task: CartTask, planning: Planning, seed: int, kind: str, decisions: int):
        super().__init__(task, planning, seed)
        self._prototype = scene_model(task, [piece_model(task, b) for b in range(len(task.kinds))])
        features = body_features(task.outlines, task.walls)
        condition = features.condition if kind == "oo-lwr" else None
        self._features = dataclasses.replace(features, condition=condition)
        self._data: list[list[tuple[np.ndarray, ...]]] = [[] for _ in task.kinds]
        self._parts: list[LocallyWeighted | None] = [None] * len(task.kinds)
        self._capacity = decisions

    def learn(self) -> None:
        one = self.episodes[-1].decisions[-1]
        inputs, change, condition = map(
            np.asarray, _datum(self._features, one.before, jnp.asarray(one.wrench), one.after)
        )
        for body in np.flatnonzero(one.moved):
            self._data[body].append((inputs[body], change[body], condition[body]))
            if due(len(self._data[body])) or self._parts[body] is None:
                columns = [np.stack(column) for column in zip(*self._data[body], strict=True)]
                self._parts[body] = locally_weighted(*columns, capacity=self._capacity)

    def believed(self, held: int) -> Model | None:
        if self._parts[held] is None:
            return None
        # What was never held is believed to behave as this one: something has to be believed.
        parts = [part if part is not None else self._parts[held] for part in self._parts]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
        return RegressedModel(
            inner=self._prototype,
            regression=stacked,
            features=self._features,
            control_period=DECISION,
        )


def due(count: int) -> bool:
    """Whether to learn anew after that many decisions: the seldomer the more is known."""
    return count <= 10 or (count <= 50 and count % 5 == 0) or count % 50 == 0


@eqx.filter_jit
def _datum(features: Features, before: PlanarState, wrench: Array, after: PlanarState):
    inputs = features.inputs(before, wrench)
    condition = jnp.zeros((len(inputs), 0), bool)
    if features.condition is not None:
        condition = features.condition(before)
    return inputs, features.change(before, after), condition


_estimated, _wrench = jax.jit(Planar.initial_state), jax.jit(Handled.wrench)
