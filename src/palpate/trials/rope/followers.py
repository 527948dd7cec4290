"""What moves the gripper of a MuJoCo rope so that the tip follows a path: learned, planned, blind.

Each is a `rope_trials.Controller` made for the paths of the trials that run side by side: (worlds,
samples, 3) in m, world frame, one sample a control period, the first at the start.
"""

import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.models.rope import Rope, RopeState
from palpate.networks import CommandPolicy
from palpate.perception.velocity import VelocityEstimator
from palpate.planning.command_curve import CurvePlanner, Plan
from palpate.planning.sampling import Cem, Mppi, SamplingPlanner
from palpate.tasks.rope import RopeTracking
from palpate.tasks.rope.paths import DesiredPath
from palpate.tasks.rope.tracking import PREVIEW, grip_of_chain, hanging_rope
from palpate.trials.rope.baselines import HeldStill
from palpate.trials.rope.trials import Controller, Seen
from palpate.worlds.rope.rope import RopeConfiguration

# Of both sampling planners: the best of a dozen settings (deviation 0.05 to 0.6, temperature 0.02
# to 0.4, knots 0.1 or 0.2 s apart) on one rope and each path, seed 7000, which no evaluation uses.
KNOTS, SPACING = 9, 10  # 0.8 s ahead
DEVIATION = {"mppi": 0.05, "cem": 0.1}
ITERATIONS = {"mppi": 1, "cem": 3}
TEMPERATURE = 0.1


class OpenLoop:
    """The gripper moves as was laid down before the start, whatever the rope does.

    Moving as the path does, a rope's length above it, is right for a path that takes forever.
    """

    def __init__(self, gripper: np.ndarray, period: float):
        """`gripper`: displacements (worlds, samples, 3) in m, one a `period` (s)."""
        self._velocity, self.period = np.diff(gripper, axis=1) / period, period

    @classmethod
    def of_chain(cls, paths: np.ndarray, period: float, length: float) -> "OpenLoop":
        """As would suit a limp chain of that `length` (m) without damping: `grip_of_chain`."""
        away = jnp.asarray(paths - paths[:, :1], jnp.float32)
        return cls(np.asarray(grip_of_chain(away, length, 9.81, period)), period)

    def begin(self, seen: Seen) -> None:
        """See `Controller.begin`."""
        self._step = 0

    def command(self, seen: Seen) -> np.ndarray:
        """See `Controller.command`."""
        self._step += 1
        return self._velocity[:, self._step - 1]


def blind_followers(base: RopeConfiguration) -> dict[str, Callable[[np.ndarray], Controller]]:
    """What needs no eyes, by name: nothing at all, and two ways of laying a motion down."""
    period = base.control_period
    return {
        "held still": lambda paths: HeldStill(),
        "as the path": lambda paths: OpenLoop(paths, period),
        "as a chain": lambda paths: OpenLoop.of_chain(paths, period, base.length),
    }


class RopeObserver:
    """Markers as a camera sees them to states of a model with that many segments.

    The nodes are the markers, or every second of them, and so on. Where the gripper is, its encoder
    says better than its marker.
    """

    def __init__(self, segments: int, period: float):
        self._segments = segments
        self._estimator = VelocityEstimator(period)

    def begin(self, seen: Seen) -> None:
        """The ropes have been at rest."""
        self._window = np.repeat(self._positions(seen)[None], self._estimator.frames, axis=0)

    def state(self, seen: Seen) -> RopeState:
        """(worlds, nodes, 3), once for each new observation."""
        positions = self._positions(seen)
        self._window = np.concatenate([self._window[1:], positions[None]])
        weights = self._estimator.weights.astype(np.float32)
        return RopeState(jnp.asarray(positions), jnp.tensordot(weights, self._window, axes=1))

    def _positions(self, seen: Seen) -> np.ndarray:
        markers = seen.markers.shape[1]
        every, rest = divmod(markers - 1, self._segments)
        if rest:
            raise PalpateError(
                f"a controller for {self._segments + 1} nodes needs a multiple of "
                f"{self._segments} markers and one more, not {markers}"
            )
        positions = seen.markers[:, ::every].astype(np.float32)
        positions[:, 0] = seen.gripper_position
        return positions


class LearnedFollower:
    """A policy of `RopeTracking`, fed with what it was trained on."""

    def __init__(self, policy: CommandPolicy, task: RopeTracking, paths: np.ndarray):
        self._policy, self.period = policy, policy.period
        self._goal = DesiredPath(jnp.asarray(paths, jnp.float32), policy.period)
        # 3 coordinates and 3 velocities of each node, 3 coordinates of each instant seen ahead.
        segments = (policy.mean.shape[0] - 3 * len(PREVIEW)) // 6
        self._observer = RopeObserver(segments, policy.period)

        @eqx.filter_jit
        def decide(policy, carry, state, goal, step):
            goal = task.goal_at(goal, step)
            return policy(carry, task.features(state, goal), goal, None)

        self._decide = decide

    def begin(self, seen: Seen) -> None:
        """See `Controller.begin`."""
        self._observer.begin(seen)
        self._carry = self._policy.initial_carry(jnp.zeros((len(seen.markers), 1, 3)))
        self._step = 0

    def command(self, seen: Seen) -> np.ndarray:
        """See `Controller.command`."""
        state, step = self._observer.state(seen), jnp.asarray(self._step)
        self._carry, action = self._decide(self._policy, self._carry, state, self._goal, step)
        self._step += 1
        return np.asarray(action)[:, 0]


class PlannedController:
    """A planner that decides anew in every control period, for one world after another.

    `spent` are the seconds of all its decisions.
    """

    def __init__(self, planner: CurvePlanner, seed: int):
        assert isinstance(planner.model, Rope)
        self._planner, self._seed, self.period = planner, seed, planner.model.control_period
        self._observer = RopeObserver(planner.model.nodes - 1, self.period)
        self.spent: list[float] = []

    def begin(self, seen: Seen) -> None:
        """See `Controller.begin`."""
        self._observer.begin(seen)
        keys = jax.random.split(jax.random.key(self._seed), len(seen.markers))
        self._planners = [self._planner] * len(keys)
        self._plans: list[Plan] = [self._planner.init(jnp.zeros((1, 3)), key) for key in keys]
        self._step = 0

    def command(self, seen: Seen) -> np.ndarray:
        """See `Controller.command`."""
        self._step += 1
        states = self.states(seen)
        ahead = self.goals_ahead(states)
        commands = []
        for world, plan in enumerate(self._plans):
            state, goals = jax.tree.map(lambda leaf, i=world: leaf[i], (states, ahead))
            began = time.perf_counter()
            self._plans[world], command = self._planners[world](plan, state, goals)
            commands.append(np.asarray(command)[0])
            self.spent.append(time.perf_counter() - began)
        return np.stack(commands)

    def states(self, seen: Seen) -> RopeState:
        """What the planner takes the ropes to be in, (worlds, nodes, 3)."""
        return self._observer.state(seen)

    @abstractmethod
    def goals_ahead(self, states: RopeState) -> Any:
        """What the planner is to reach, each leaf (worlds, horizon, ...)."""


def as_of_model(model: Rope, states: RopeState) -> RopeState:
    """Ropes seen, (worlds, nodes, 3), as the model can have them: its segments, as long as hanging.

    Directions and turning rates of the segments are kept. How much a segment is longer than the
    model's is noise, or another rope's length: the model's stiff springs would take a millimetre of
    it for a force as large as the rope's weight, and plan for the recoil.
    """
    hanging = hanging_rope(model).position
    length = jnp.linalg.norm(jnp.diff(hanging, axis=0), axis=-1, keepdims=True)
    edge = jnp.diff(states.position, axis=-2)
    seen_length = jnp.linalg.norm(edge, axis=-1, keepdims=True)
    direction = edge / seen_length
    turning = jnp.diff(states.velocity, axis=-2) / seen_length
    turning = turning - direction * jnp.sum(turning * direction, axis=-1, keepdims=True)

    def from_grip(grip: Array, steps: Array) -> Array:
        return jnp.concatenate([grip, grip + jnp.cumsum(steps, axis=-2)], axis=-2)

    return RopeState(
        from_grip(states.position[..., :1, :], length * direction),
        from_grip(states.velocity[..., :1, :], length * turning),
    )


class PlannedFollower(PlannedController):
    """One that follows paths, and knows how long each rope is: it is measured as a trial begins."""

    def __init__(self, planner: CurvePlanner, paths: np.ndarray, seed: int):
        super().__init__(planner, seed)
        self._goal = DesiredPath(jnp.asarray(paths, jnp.float32), self.period)
        self._adapted = eqx.filter_jit(eqx.filter_vmap(as_of_model))

    def begin(self, seen: Seen) -> None:
        """See `Controller.begin`."""
        super().begin(seen)
        model = self._planner.model
        assert isinstance(model, Rope)
        sizes = _length(super().states(seen)) / _length(hanging_rope(model))
        models = [
            eqx.tree_at(lambda rope: rope.rest_length, model, model.rest_length * size).constrain()
            for size in sizes
        ]
        self._planners = [
            eqx.tree_at(lambda planner: planner.model, self._planner, model) for model in models
        ]
        self._models = jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)

    def states(self, seen: Seen) -> RopeState:
        """See `PlannedController.states` and `as_of_model`."""
        return self._adapted(self._models, super().states(seen))

    def goals_ahead(self, states: RopeState) -> Any:
        """Where the tips should be, from one control period from now."""
        return self._goal.ahead(jnp.arange(self._planner.horizon), self._step)


def decision_times(planned: Mapping[str, Sequence[PlannedController]]) -> dict[str, list[float]]:
    """Median and 99th percentile of each planner's decisions in this process, ms."""
    spent = {name: np.concatenate([one.spent for one in some]) for name, some in planned.items()}
    return {
        name: (1e3 * np.quantile(values, (0.5, 0.99))).tolist()
        for name, values in spent.items()
        if len(values)
    }


def _length(state: RopeState) -> Float[Array, "*worlds"]:
    """Of the polygon through the nodes, m."""
    return jnp.sum(jnp.linalg.norm(jnp.diff(state.position, axis=-2), axis=-1), axis=-1)


def planner(method: str, model: Rope, samples: int, iterations: int | None = None):
    """MPPI ("mppi") or CEM ("cem") for the tip's squared distance from the path.

    `samples` are those of all iterations together, which are by default `ITERATIONS`.
    """
    task = RopeTracking()
    iterations = ITERATIONS[method] if iterations is None else iterations
    return SamplingPlanner(
        model=model,
        stage_loss=squared_distance,
        rule=Cem() if method == "cem" else Mppi(TEMPERATURE),
        limit=task.action_limit,
        rate_limit=task.action_rate_limit,
        samples=max(2, samples // iterations),
        iterations=iterations,
        knots=KNOTS,
        spacing=SPACING,
        deviation=DEVIATION[method],
    )


def squared_distance(
    states: RopeState, commands: Array, goal: Float[Array, "3"]
) -> Float[Array, " samples"]:
    """Of the tips from where they should be, m^2."""
    return jnp.sum((states.position[:, -1] - goal) ** 2, axis=-1)
