"""A trained policy of a rope's task, and what makes its features of the markers that are seen."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from palpate.errors import PalpateError
from palpate.models.rope import RopeState
from palpate.networks import CommandPolicy
from palpate.perception.velocity import VelocityEstimator
from palpate.tasks.rope import RopeStabilization, RopeTracking
from palpate.trials.controller import FeedbackController
from palpate.worlds.rope.rope import RopeObservation


class RopeObserver:
    """Markers as a camera sees them to states of a model with that many segments.

    The nodes are the markers, or every second of them, and so on. Where the gripper is, its encoder
    says better than its marker. What is carried is a window of positions (frames, worlds, nodes, 3)
    in m, from which velocities are estimated.
    """

    def __init__(self, segments: int, period: float):
        self._segments = segments
        self.estimator = VelocityEstimator(period)

    def start(self, observation: RopeObservation) -> np.ndarray:
        """The window of ropes that have been at rest."""
        return np.repeat(self.positions(observation)[None], self.estimator.frames, axis=0)

    def update(
        self, window: np.ndarray, observation: RopeObservation
    ) -> tuple[np.ndarray, RopeState]:
        """The next window, and the states (worlds, nodes, 3); once for each new observation."""
        positions = self.positions(observation)
        window = np.concatenate([window[1:], positions[None]])
        weights = self.estimator.weights.astype(np.float32)
        return window, RopeState(jnp.asarray(positions), jnp.tensordot(weights, window, axes=1))

    def positions(self, observation: RopeObservation) -> np.ndarray:
        """Of the nodes, (worlds, nodes, 3) in m; `PalpateError` if they fall on no markers."""
        markers = observation.markers.shape[1]
        every, rest = divmod(markers - 1, self._segments)
        if rest:
            raise PalpateError(
                f"a controller for {self._segments + 1} nodes needs a multiple of "
                f"{self._segments} markers and one more, not {markers}"
            )
        positions = observation.markers[:, ::every].astype(np.float32)
        positions[:, 0] = observation.gripper_position
        return positions


class LearnedController(FeedbackController):
    """A policy, fed with what it was trained on: features of the states of a model's nodes.

    What is carried: the observer's window, the policy's own carry, and how many steps were taken.
    """

    def __init__(self, policy: CommandPolicy, task: RopeStabilization | RopeTracking):
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
        """See `FeedbackController.start`."""
        memory = self.policy.initial_carry(jnp.asarray(command, jnp.float32)[:, None])
        return self.observer.start(observation), memory, 0

    def decide(self, carry: Any, observation: RopeObservation, goal: Any) -> tuple[Any, np.ndarray]:
        """See `FeedbackController.decide`."""
        window, memory, step = carry
        window, state = self.observer.update(window, observation)
        memory, action = self._act(self.policy, memory, state, goal, jnp.asarray(step))
        return (window, memory, step + 1), np.asarray(action)[:, 0]
