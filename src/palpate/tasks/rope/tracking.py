"""Follow a path with the tip of a hanging rope by moving its other end.

SPiD (Long et al., arXiv 2602.03623), the talk's second task.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.models.model import rollout
from palpate.models.rope import Rope, RopeState
from palpate.networks import Channel
from palpate.tasks.rope.paths import DesiredPath, random_paths
from palpate.tasks.rope.stabilization import HangingRopeTask, at_times
from palpate.tasks.task import Start

# What is seen of the path, s ahead. A hanging chain's grip has to know where its tip should be
# 2 sqrt(L / g) later, 0.64 s for 1 m: see `grip_of_chain`. The rest is for longer ropes.
PREVIEW = tuple(np.round(np.arange(0.0, 0.81, 0.08), 2).tolist())
GOOD = 0.03  # m, the mean error of a success

MOTION = 3.0  # s, in which starts are drawn from a motion along a path
STATES_PER_MOTION = 16
AT_THE_BEGINNING = 0.2  # of the starts: at rest, where the path starts softly
MOST_MIXED = 0.5  # share of the path itself in how the gripper moves before the others


class RopeTracking(HangingRopeTask):
    """The tip of a hanging rope follows a path that is seen some way ahead.

    The goal is a `DesiredPath` in the world frame. With the tip at p_N and the path at g, the loss
    is the seed document's,

        sum_t discount^(T - t) |p_N(t) - g(t)|^2

    over the sum of its weights and over the square of `GOOD`: 1 where the error is 3 cm.
    """

    name: ClassVar[str] = "rope-tracking"
    goal_features: ClassVar[int] = 3 * len(PREVIEW)
    outcome_units: ClassVar[Mapping[str, str]] = {
        "mean_tip_error": "cm",
        "rms_tip_error": "cm",
        "worst_tip_error": "cm",
    }
    stages: ClassVar[tuple[float, ...]] = (0.25, 0.5, 1.0)
    # What follows a path most closely moves the gripper most sharply: with a lag of 15 ms, a policy
    # that was trained without one shook long ropes apart within seconds, of 0.4 cm otherwise.
    action_lag: ClassVar[float] = 0.03
    duration: float = eqx.field(static=True, default=6.0)
    discount: float = eqx.field(static=True, default=0.99)  # per control period

    def starts(self, model: Rope, key: PRNGKeyArray, count: int) -> Start:
        """Near random paths: a fifth at rest where one begins, the others on their way along it.

        On the way there the gripper moved as would suit a hanging chain (`grip_of_chain`), or
        up to half as the path itself: the tip is where it should be, or some centimetres away.
        The goal reaches over twice the duration of an episode.

        Raises `PalpateError` when the rope is not driven by velocity at its first node.
        """
        self.check_driven(model)
        period = model.control_period
        motions = max(1, -(-count // STATES_PER_MOTION))
        for_path, for_mix, for_time = jax.random.split(key, 3)
        before, after = round(MOTION / period), round((2 * self.duration + PREVIEW[-1]) / period)
        path = random_paths(for_path, motions, before + after + 1, period)

        still = hanging_rope(model)
        still = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (motions, *leaf.shape)), still)
        mix = MOST_MIXED * jax.random.uniform(for_mix, (motions, 1, 1))
        length = jnp.sum(model.rest_length)
        gripper = mix * path + (1.0 - mix) * grip_of_chain(path, length, model.gravity, period)
        # Averages of the path over time: slower and smoother than it is, so within its bounds.
        commands = jnp.diff(gripper[:, : before + 1], axis=1) / period
        states = rollout(model, still, commands[:, :, None, :])
        states, commands = jax.tree.map(
            lambda first, rest: jnp.concatenate([first[:, None], rest], axis=1),
            (still, jnp.zeros_like(commands[:, 0])),
            (states, commands),
        )
        tip = still.position[:, -1:] + path
        chance = jax.random.uniform(for_time, (motions, STATES_PER_MOTION))
        share = jnp.maximum(chance - AT_THE_BEGINNING, 0.0) / (1.0 - AT_THE_BEGINNING)
        time = jnp.round(share * before).astype(int)
        states, commands = at_times((states, commands), time, count)
        position = at_times(tip, time[..., None] + jnp.arange(after + 1), count)
        return Start(states, commands[:, None, :], DesiredPath(position, period))

    def adapt(self, start: Start, models: Rope) -> Start:
        """The same shapes with each rope's own segment lengths; paths move along with the tips."""
        adapted = super().adapt(start, models)
        moved = adapted.state.position[:, -1:] - start.state.position[:, -1:]
        return eqx.tree_at(lambda s: s.goal.position, adapted, start.goal.position + moved)

    def goal_at(self, goal: DesiredPath, step: Array) -> DesiredPath:
        """The path from then on, as far as it is seen."""
        steps = jnp.arange(round(PREVIEW[-1] / goal.period) + 1)
        return DesiredPath(goal.ahead(steps, step), goal.period)

    def features(self, state: RopeState, goal: DesiredPath) -> Float[Array, "*batch features"]:
        """Nodes and path relative to the gripper (m), and the nodes' velocities (m/s).

        Exactly the same wherever rope and path are together.
        """
        steps = np.round(np.array(PREVIEW) / goal.period).astype(int)
        path = goal.ahead(jnp.asarray(steps)) - state.position[..., :1, :]
        seen = super().features(state)
        return jnp.concatenate([seen, path.reshape(*path.shape[:-2], -1)], axis=-1)

    def feature_channels(self, model: Rope) -> tuple[Channel, ...]:
        instants = ", ".join(f"{instant:g}" for instant in PREVIEW)
        ahead = f"desired tip position relative to the gripper, {instants} s ahead"
        return (*super().feature_channels(model), Channel(ahead, (len(PREVIEW), 3), "m"))

    @staticmethod
    def measure(observation: Any, truth: Any) -> dict[str, np.ndarray]:
        """What a `RopeObservation` is judged by: the place of the tip, (3,) m, with noise."""
        return {"tips": observation.markers[-1]}

    def loss(
        self, models: Rope, start: Start, states: RopeState, actions: Array
    ) -> Float[Array, " b"]:
        """See the class; dimensionless."""
        squared = jnp.sum(self._offsets(start, states) ** 2, axis=-1)
        weights = self.discount ** np.arange(squared.shape[1])[::-1]
        return squared @ jnp.asarray(weights / weights.sum(), squared.dtype) / GOOD**2

    def outcome(
        self, models: Rope, start: Start, states: RopeState, actions: Array
    ) -> dict[str, Float[Array, " b"]]:
        """Gives "success" and the tip's mean, root-mean-square and worst distance, in cm.

        Success: the mean is at most 3 cm.
        """
        error = jnp.linalg.norm(self._offsets(start, states), axis=-1)
        mean = jnp.mean(error, axis=1)
        return {
            "success": (mean <= GOOD).astype(error.dtype),
            "mean_tip_error": 100 * mean,
            "rms_tip_error": 100 * jnp.sqrt(jnp.mean(error**2, axis=1)),
            "worst_tip_error": 100 * jnp.max(error, axis=1),
        }

    def _offsets(self, start: Start, states: RopeState) -> Float[Array, "b time 3"]:
        """From where the tip should be to where it is, after each action: m."""
        tip = states.position[..., -1, :]
        return tip - start.goal.ahead(jnp.arange(1, tip.shape[1] + 1))


def hanging_rope(model: Rope) -> RopeState:
    """At rest below a grip at the origin, each segment stretched by the weight of what is below."""
    below = jnp.cumsum(model.node_mass[::-1])[::-1][1:]
    length = model.rest_length + below * model.gravity / model.stretch_stiffness
    depth = jnp.concatenate([jnp.zeros(1), jnp.cumsum(length)])
    position = depth[:, None] * jnp.array([0.0, 0.0, -1.0])
    return RopeState(position, jnp.zeros_like(position))


def grip_of_chain(
    path: Float[Array, "*batch samples 3"],
    length: Array | float,
    gravity: Array | float,
    period: float,
) -> Float[Array, "*batch samples 3"]:
    """How the upper end of a hanging chain moves where its lower end follows a `path`.

    Both as displacements (m), one sample a `period` (s); `length` in m, `gravity` in m/s^2. A limp
    chain without damping is flat: for small angles the upper end is the mean of the path over
    what was and what will be (Petit and Rouchon 2001, SIAM J. Control Optim. 40:475-495),

        x(t) = 1 / (2 pi) int_0^2pi y(t + 2 sqrt(L / g) sin(angle)) d(angle)

    that is, with weights of the arcsine distribution. Before its first sample a path is at rest
    there, and after its last. Lags beyond `PREVIEW` are left out.
    """
    last = round(PREVIEW[-1] / period)
    lag = 2.0 * jnp.sqrt(length / gravity)
    edges = jnp.clip((jnp.arange(-last, last + 2) - 0.5) * period / lag, -1.0, 1.0)
    weights = jnp.diff(jnp.arcsin(edges))
    weights = (weights / jnp.sum(weights))[:, None]
    still = [(0, 0)] * (path.ndim - 2)
    padded = jnp.pad(path, [*still, (last, last), (0, 0)], mode="edge")
    weights = weights.reshape((1,) * len(still) + weights.shape)
    return jax.scipy.signal.convolve(padded, weights, mode="valid")
