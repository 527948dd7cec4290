"""Trained policies of a rope's tasks, and what makes their features of markers that are seen."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from palpate.models.rope import Rope, RopeState
from palpate.networks import CommandPolicy
from palpate.numerics.arrays import as_array
from palpate.perception.rope.marker_observer import MarkerObserver
from palpate.perception.rope.nodes import at_nodes, smooth_lengths
from palpate.perception.velocity import VelocityEstimator
from palpate.tasks.rope import RopeStabilization
from palpate.tasks.rope.stabilization import HangingRopeTask
from palpate.trials.controller import FeedbackController
from palpate.worlds.rope.rope import RopeObservation


class RopeObserver:
    """Markers as a camera sees them to states of a model with that many segments.

    The nodes lie among the markers as `at_nodes` says, with lengths as `smooth_lengths` has them.
    Where the gripper is, its encoder says better than its marker. What is carried is a window of
    positions (frames, worlds, nodes, 3) in m, from which velocities are estimated.
    """

    def __init__(self, segments: int, period: float):
        self._segments, self._period = segments, period
        self.estimator = VelocityEstimator(period)

    def start(self, observation: RopeObservation) -> np.ndarray:
        """The window of ropes that have been at rest."""
        return np.repeat(self.positions(observation)[None], self.estimator.frames, axis=0)

    def update(
        self, window: np.ndarray, observation: RopeObservation
    ) -> tuple[np.ndarray, RopeState]:
        """The next window, and the states (worlds, nodes, 3); once for each new observation."""
        positions = smooth_lengths(window[-1], self.positions(observation), self._period)
        window = np.concatenate([window[1:], positions[None]])
        weights = self.estimator.weights.astype(np.float32)
        return window, RopeState(as_array(positions), jnp.tensordot(weights, window, axes=1))

    def positions(self, observation: RopeObservation) -> np.ndarray:
        """Of the nodes as they are seen, (worlds, nodes, 3) in m; raises as `at_nodes`."""
        positions = at_nodes(observation.markers, self._segments + 1).astype(np.float32)
        positions[:, 0] = observation.gripper_position
        return positions


class LearnedController(FeedbackController):
    """A policy, fed with what it was trained on: features of the states of a model's nodes.

    What is carried: the observer's window, the policy's own carry, and how many steps were taken.
    """

    def __init__(self, policy: CommandPolicy, task: HangingRopeTask):
        self.policy, self.period = policy, policy.period
        # 3 coordinates and 3 velocities of each node, beside what is seen of the goal.
        segments = (policy.mean.shape[0] - task.goal_features) // 6
        self.observer = RopeObserver(segments, policy.period)

        @eqx.filter_jit
        def act(policy, memory, state, goal, step):
            ahead: Any = task.goal_at(goal, step)
            return policy(memory, task.features(state, ahead), ahead, None)

        self._act = act

    def start(self, command: Any, observation: RopeObservation, goal: Any) -> Any:
        memory = self.policy.initial_carry(jnp.asarray(command, jnp.float32)[:, None])
        return self.observer.start(observation), memory, 0

    def decide(self, carry: Any, observation: RopeObservation, goal: Any) -> tuple[Any, np.ndarray]:
        window, memory, step = carry
        window, state = self.observer.update(window, observation)
        memory, action = self._act(self.policy, memory, state, goal, jnp.asarray(step))
        return (window, memory, step + 1), np.asarray(action)[:, 0]

    def follow(self, carry: Any, observation: RopeObservation, command: np.ndarray) -> Any:
        """The next carry while somebody else commands (worlds, 3) m/s for one control period."""
        window, _, step = carry
        window, _ = self.observer.update(window, observation)
        memory = self.policy.initial_carry(jnp.asarray(command, jnp.float32)[:, None])
        return window, memory, step + 1


class ObservedController(LearnedController):
    """A policy for ropes of any length, seen late and seldom, all of them at the same instants.

    How long a rope is, is measured in the first observation. `model` is driven by velocity at node
    0: the rope that the policy was made for. `noise`: of the markers, m.
    """

    def __init__(
        self, policy: CommandPolicy, task: RopeStabilization, model: Rope, noise: float
    ) -> None:
        super().__init__(policy, task)
        self._model, self._noise = model, noise

        @eqx.filter_jit
        def decide(policy, carry, state, size):
            length, velocity = size[:, None, None], jnp.sqrt(size)[:, None, None]
            alike = RopeState(state.position / length, state.velocity / velocity)
            return policy.similar(carry, task.features(alike, None), size)

        self._decide_alike = decide

    def start(self, command: np.ndarray, observation: RopeObservation, goal: None) -> Any:
        positions = jnp.asarray(self.observer.positions(observation))
        length = jnp.sum(jnp.linalg.norm(jnp.diff(positions, axis=1), axis=-1), axis=1)
        size = length / jnp.sum(self._model.rest_length)
        rest_length = self._model.rest_length * size[:, None]
        models = eqx.tree_at(lambda rope: rope.rest_length, self._model, rest_length).constrain()
        memory = self.policy.initial_carry(jnp.asarray(command, jnp.float32)[:, None])
        return MarkerObserver(models, self._noise), size, None, memory

    def decide(
        self, carry: Any, observation: RopeObservation, goal: None
    ) -> tuple[Any, np.ndarray]:
        observer, size, command, memory = carry
        positions = jnp.asarray(self.observer.positions(observation))
        if command is None:
            state = observer.begin(positions, observation.time)
        else:
            state = observer.step(command, positions, observation.time)
        memory, command = self._decide_alike(self.policy, memory, state, size)
        return (observer, size, command, memory), np.asarray(command)[:, 0]
