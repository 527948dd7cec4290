"""Planners that bring a MuJoCo rope to rest, or lead its tip, through an identified model of it."""

import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.models.rope import Rope, RopeState
from palpate.planning.command_curve import CurvePlanner, StageLoss
from palpate.planning.gradient import GradientPlanner
from palpate.planning.sampling import Cem, Mppi, SamplingPlanner
from palpate.tasks.rope import RopeStabilization, RopeTracking
from palpate.tasks.rope.paths import DesiredPath
from palpate.tasks.rope.stabilization import LEAST_ENERGY, STABILISED, HangingRopeTask
from palpate.tasks.rope.tracking import hanging_rope
from palpate.trials.controller import FeedbackController
from palpate.trials.rope.learned import RopeObserver
from palpate.worlds.rope.rope import RopeObservation


# Tried on one or two ropes of seed 7100, which no evaluation uses, of 10 bodies each, from two or
# four start poses. Gradient MPC with one iteration, mean time to 1 % in periods: with the energy
# itself for a loss 0.765, log(1 + e / 0.1) 0.700, log(1 + e / 0.01) 0.675, 0.671 and 0.664 with
# speed weights of 0.02, 0.1 and 0.5; with a weight of 0.1, knots 7 x 10 0.691, 12 x 10 0.684. MPPI
# with 300 samples: a deviation of 0.1 leaves the gripper trembling at 0.04 m/s after 2.5 s; 0.3
# leaves 0.15 m/s after 1.6 s, with a temperature of 0.03 0.19 m/s, and 0.6 with that 0.39 m/s. CEM
# with as many in three iterations: 0.08 m/s after 1.6 s from 0.3, 0.26 m/s from 0.6.
@dataclass(frozen=True)
class Tuning:
    """How they plan."""

    knots: int = 9
    spacing: int = 10  # control periods: 0.8 s ahead
    speed_weight: float = 0.5  # s^2/m^2
    deviation: Mapping[str, float] = field(default_factory=lambda: {"mppi": 0.1, "cem": 0.3})
    iterations: Mapping[str, int] = field(default_factory=lambda: {"mppi": 1, "cem": 3})
    temperature: float = 0.1


TUNING = Tuning()
# Of both sampling planners: the best of a dozen settings (deviation 0.05 to 0.6, temperature 0.02
# to 0.4, knots 0.1 or 0.2 s apart) on one rope and each path, seed 7000, which no evaluation uses.
FOLLOWING = Tuning(deviation={"mppi": 0.05, "cem": 0.1})


def stabilising_planner(method: str, model: Rope, size: int) -> CurvePlanner:
    """MPPI ("mppi"), CEM ("cem") or gradient MPC ("gradient") for the rope's rest.

    Within the limits of the task. `size` are the samples of all iterations together, or the
    iterations of gradient MPC.
    """
    shared = _shared(RopeStabilization(), model, energy_and_speed(model), TUNING)
    if method == "gradient":
        return GradientPlanner(**shared, iterations=size)
    return _sampling_planner(method, shared, TUNING, size)


def following_planner(
    method: str, model: Rope, samples: int, iterations: int | None = None
) -> SamplingPlanner:
    """MPPI ("mppi") or CEM ("cem") for the tip's squared distance from the path.

    `samples` are those of all iterations together, which are by default those of `FOLLOWING`.
    """
    shared = _shared(RopeTracking(), model, squared_distance, FOLLOWING)
    return _sampling_planner(method, shared, FOLLOWING, samples, iterations)


def _shared(
    task: HangingRopeTask, model: Rope, stage_loss: StageLoss, tuning: Tuning
) -> dict[str, Any]:
    return {
        "model": model,
        "stage_loss": stage_loss,
        "limit": task.action_limit,
        "rate_limit": task.action_rate_limit,
        "knots": tuning.knots,
        "spacing": tuning.spacing,
    }


def _sampling_planner(
    method: str,
    shared: Mapping[str, Any],
    tuning: Tuning,
    samples: int,
    iterations: int | None = None,
) -> SamplingPlanner:
    iterations = iterations or tuning.iterations[method]
    return SamplingPlanner(
        **shared,
        rule=Cem() if method == "cem" else Mppi(tuning.temperature),
        samples=max(2, samples // iterations),
        iterations=iterations,
        deviation=tuning.deviation[method],
    )


def energy_and_speed(model: Rope) -> StageLoss:
    """log(1 + e / 0.01) + weight v^2 of many ropes at once, dimensionless.

    e is a rope's energy as a share of the goal (J), that at the start, and v the gripper's speed.
    The logarithm is that of the loss in `RopeStabilization`.
    """

    def loss(
        states: RopeState, commands: Float[Array, "plans 1 3"], start: Array
    ) -> Float[Array, " plans"]:
        share = model.energy(states) / start
        speed_squared = jnp.sum(commands**2, axis=(1, 2))
        return jnp.log1p(share / STABILISED) + TUNING.speed_weight * speed_squared

    return loss


def squared_distance(
    states: RopeState, commands: Array, goal: Float[Array, "3"]
) -> Float[Array, " samples"]:
    """Of the tips from where they should be, m^2."""
    return jnp.sum((states.position[:, -1] - goal) ** 2, axis=-1)


class PlannedController(FeedbackController):
    """A planner that decides anew in every control period, for one world after another.

    `spent` are the seconds of all its decisions. What is carried: the observer's window, what was
    learnt from the first observation, a plan for each world, and how many steps were taken.
    """

    def __init__(self, planner: CurvePlanner, seed: int):
        assert isinstance(planner.model, Rope)
        self._model, self._planner, self._seed = planner.model, planner, seed
        self.period = planner.model.control_period
        self._observer = RopeObserver(planner.model.nodes - 1, self.period)
        self.spent: list[float] = []

    def start(self, command: Any, observation: RopeObservation, goal: Any) -> Any:
        window = self._observer.start(observation)
        window, states = self._observer.update(window, observation)  # at rest: the same window
        keys = jax.random.split(jax.random.key(self._seed), len(command))
        plans = [self._planner.init(jnp.zeros((1, 3)), key) for key in keys]
        return window, self.prepare(states), plans, 0

    def decide(self, carry: Any, observation: RopeObservation, goal: Any) -> tuple[Any, np.ndarray]:
        window, prepared, plans, step = carry
        window, states = self._observer.update(window, observation)
        planners, states, ahead = self.problems(prepared, states, goal, step)
        commands, following = [], []
        for world, (planner, plan) in enumerate(zip(planners, plans, strict=True)):
            state, goals = jax.tree.map(lambda leaf, i=world: leaf[i], (states, ahead))
            began = time.perf_counter()
            replanned, command = planner(plan, state, goals)
            commands.append(np.asarray(command)[0])
            self.spent.append(time.perf_counter() - began)
            following.append(replanned)
        return (window, prepared, following, step + 1), np.stack(commands)

    @abstractmethod
    def prepare(self, states: RopeState) -> Any:
        """What is to be known of ropes that are seen for the first time, (worlds, nodes, 3)."""

    @abstractmethod
    def problems(
        self, prepared: Any, states: RopeState, goal: Any, step: int
    ) -> tuple[Sequence[CurvePlanner], RopeState, Any]:
        """Each world's planner, the states as its model can have them, and what to reach ahead.

        The last as leaves (worlds, horizon, ...).
        """


class PlannedStabiliser(PlannedController):
    """A planner that is asked for the rope's rest, whatever the energy it starts with."""

    def __init__(self, planner: CurvePlanner, seed: int):
        super().__init__(planner, seed)
        self._adapted = eqx.filter_jit(as_of_model)

    def prepare(self, states: RopeState) -> Float[Array, " worlds"]:
        """The energy at the start (J), or for ropes all but at rest that of a small swing."""
        model = self._model
        weight = jnp.sum(model.node_mass) * model.gravity
        least = LEAST_ENERGY * weight * jnp.sum(model.rest_length)
        return jnp.maximum(model.energy(self._adapted(model, states)), least)

    def problems(
        self, prepared: Float[Array, " worlds"], states: RopeState, goal: None, step: int
    ) -> tuple[Sequence[CurvePlanner], RopeState, Float[Array, "worlds horizon"]]:
        """See `PlannedController.problems`; what is to be reached is a share of the energy."""
        ahead = jnp.broadcast_to(prepared[:, None], (len(prepared), self._planner.horizon))
        return [self._planner] * len(prepared), self._adapted(self._model, states), ahead


class PlannedFollower(PlannedController):
    """One that follows paths, and knows how long each rope is: it is measured as a trial begins."""

    def __init__(self, planner: CurvePlanner, seed: int):
        super().__init__(planner, seed)
        self._adapted = eqx.filter_jit(eqx.filter_vmap(as_of_model))

    def prepare(self, states: RopeState) -> tuple[Sequence[CurvePlanner], Rope]:
        """The planner for each rope, and their models, stacked."""
        model = self._model
        sizes = _length(states) / _length(hanging_rope(model))
        models = [
            eqx.tree_at(lambda rope: rope.rest_length, model, model.rest_length * size).constrain()
            for size in sizes
        ]
        planners = [
            eqx.tree_at(lambda planner: planner.model, self._planner, model) for model in models
        ]
        return planners, jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)

    def problems(
        self, prepared: Any, states: RopeState, goal: DesiredPath, step: int
    ) -> tuple[Sequence[CurvePlanner], RopeState, Float[Array, "worlds horizon 3"]]:
        """See `PlannedController.problems`: where the tips should be, from one period from now."""
        planners, models = prepared
        steps = jnp.arange(self._planner.horizon)
        return planners, self._adapted(models, states), goal.ahead(steps, step + 1)


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


def _length(state: RopeState) -> Float[Array, "*worlds"]:
    """Of the polygon through the nodes, m."""
    return jnp.sum(jnp.linalg.norm(jnp.diff(state.position, axis=-2), axis=-1), axis=-1)


def decision_about(planner: CurvePlanner, goal: Float[Array, "*goal"]) -> Callable[[], Any]:
    """A function that takes one decision about a hanging rope and a goal that stays."""
    assert isinstance(planner.model, Rope)
    plan = planner.init(jnp.zeros((1, 3)), jax.random.key(0))
    goals = jnp.broadcast_to(goal, (planner.horizon, *goal.shape))
    state = hanging_rope(planner.model)
    return lambda: planner(plan, state, goals)
