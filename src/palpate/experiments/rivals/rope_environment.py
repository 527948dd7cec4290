"""Bringing a rope to rest, as reinforcement learning asks for it: many episodes side by side.

Inside is the identified model, drawn anew for each episode within the spreads of its parameters,
from the start states, with the sensors' noise and the limits that our own policy is trained with:
what an agent is told and may do is the same. A MuJoCo rope of the evaluation gives some 300 steps a
second on a core, the model some 10,000.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.learning import Training
from palpate.models.rope import Rope, RopeState
from palpate.networks import CommandPolicy
from palpate.parameters import randomise
from palpate.perception.velocity import VelocityEstimator
from palpate.tasks import Start
from palpate.tasks.rope import RopeStabilization
from palpate.tasks.task import draw_starts


class Actor(CommandPolicy):
    """A `CommandPolicy` whose network has ReLU units and says an action in [-1, 1]^3.

    The action, shortened to the length 1, is the rate of the command as a share of its limit:
    what a squashed Gaussian policy has for its mean (SAC, Haarnoja et al., arXiv 1812.05905).
    """

    @classmethod
    def untrained(
        cls, key: PRNGKeyArray, observations: Float[Array, "samples features"], **sizes: Any
    ) -> "Actor":
        """Arguments as of `CommandPolicy.create`."""
        actor: Any = cls.create(key, observations, **sizes)  # an `Actor`, as this class is
        of = actor.network
        network = eqx.nn.MLP(
            of.in_size, of.out_size, of.width_size, of.depth, jax.nn.relu, jnp.tanh, key=key
        )
        return dataclasses.replace(actor, network=network)

    def inputs(
        self, command: Float[Array, "*batch driven 3"], features: Float[Array, "*batch features"]
    ) -> Float[Array, "*batch inputs"]:
        """What the network is given: scaled features, and the command as a share of its limit."""
        scaled = (features - self.mean) / self.scale
        return jnp.concatenate([scaled, self.shares(command, features)], axis=-1)

    def moved(
        self, command: Float[Array, "*batch driven 3"], action: Float[Array, "*batch outputs"]
    ) -> Float[Array, "*batch driven 3"]:
        """The next command (m/s) after an action in [-1, 1]^3."""
        return self._move(command, _within_ball(action.reshape(command.shape)))

    def _direction(self, carry: Array, observation: Array) -> Array:
        network = jax.vmap(self.network) if observation.ndim == 2 else self.network
        return _within_ball(network(self.inputs(carry, observation)).reshape(carry.shape))


def _within_ball(action: Array) -> Array:
    return action / jnp.maximum(1.0, jnp.linalg.norm(action, axis=-1, keepdims=True))


class Situation(eqx.Module):
    """Where episodes side by side are; every leaf but the key leads with the same batch axis.

    (Of `models` those leaves do that are drawn.)
    """

    models: Rope
    start: Start
    state: RopeState
    command: Float[Array, "batch driven 3"]  # m/s
    window: Float[Array, "frames batch nodes 3"]  # m, the positions last seen
    key: PRNGKeyArray


class Episodes(eqx.Module):
    """Many episodes side by side, as pure functions. Made by `Episodes.of`.

    The reward of a step is minus the task's loss of an episode that would be that one instant:

        -(final_weight e + settling_weight log(1 + e / 0.01) + rest_weight v)

    with the energy e as a share of the start's and the gripper's speed v. Unlike the loss of a
    whole episode it does not ask what time it is, which an agent is not told.
    """

    task: RopeStabilization
    model: Rope
    actor: Actor  # untrained: how it is told the state, and what its actions do
    pool: Start
    noise: float = eqx.field(static=True)  # m, standard deviation of what is seen

    @classmethod
    def of(
        cls, task: RopeStabilization, model: Rope, training: Training, key: PRNGKeyArray
    ) -> "Episodes":
        """With as many start states, as much noise and as large a network as in `training`.

        Raises `PalpateError` for a rope that the task cannot use.
        """
        for_starts, for_actor = jax.random.split(key)
        pool = draw_starts(task, model, for_starts, training.starts)
        actor = Actor.untrained(
            for_actor,
            task.features(pool.state, pool.goal),
            actions=task.action_channels(model),
            period=model.control_period,
            width=training.width,
            depth=training.depth,
        )
        return cls(task, model, actor, pool, training.observation_noise)

    @property
    def length(self) -> int:
        """Steps of an episode."""
        return round(self.task.duration / self.model.control_period)

    @eqx.filter_jit
    def begin(self, key: PRNGKeyArray, count: int) -> tuple[Situation, Float[Array, "batch seen"]]:
        """`count` new episodes, drawn by the key: where they are, and what is seen there."""
        keys = jax.random.split(key, 5)
        models = randomise(self.model, keys[0], 1.0, count)
        chosen = jax.random.randint(keys[1], (count,), 0, self.pool.command.shape[0])
        start = jax.tree.map(lambda leaf: leaf[chosen], self.pool)
        start = self.task.adapt(self.task.augment(start, keys[2]), models)
        # What was seen before: the start's motion, continued backwards.
        position = models.observe(start.state)
        moved = models.observe(models.step(start.state, start.command)) - position
        back = jnp.arange(-self._estimator.frames, 0, dtype=position.dtype).reshape(-1, 1, 1, 1)
        window = position + back * moved
        window = window + self.noise * jax.random.normal(keys[3], window.shape)
        return self._see(Situation(models, start, start.state, start.command, window, keys[4]))

    @eqx.filter_jit
    def step(
        self, situation: Situation, actions: Float[Array, "batch outputs"]
    ) -> tuple[Situation, Float[Array, "batch seen"], Float[Array, " batch"]]:
        """One control period later; with what is seen then, and the rewards."""
        models = situation.models
        command = self.actor.moved(situation.command, actions)
        state = models.step(situation.state, command)
        instant = jax.tree.map(lambda leaf: leaf[:, None], state)
        reward = -self.task.loss(models, situation.start, instant, command[:, None])
        following = dataclasses.replace(situation, state=state, command=command)
        return *self._see(following), reward

    @property
    def _estimator(self) -> VelocityEstimator:
        return VelocityEstimator(self.model.control_period)

    def _see(self, situation: Situation) -> tuple[Situation, Array]:
        key, for_noise = jax.random.split(situation.key)
        position = situation.models.observe(situation.state)
        position = position + self.noise * jax.random.normal(for_noise, position.shape)
        window, velocity = self._estimator.update(situation.window, position)
        features = self.task.features(RopeState(position, velocity), None)
        seen = self.actor.inputs(situation.command, features)
        return dataclasses.replace(situation, window=window, key=key), seen
