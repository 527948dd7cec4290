"""Soft actor-critic (Haarnoja et al., arXiv 1812.05905)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.learning.off_policy.agent import Batch, adam, copy_arrays, descend, follow
from palpate.networks.actor import Critic, GaussianActor


class SoftActorCriticState(eqx.Module):
    """Networks, the temperature's logarithm, and the optimisers' moments."""

    actor: GaussianActor
    critic: Critic
    target: Critic
    log_temperature: Float[Array, ""]
    moments: dict[str, optax.OptState]


@dataclass(frozen=True)
class SoftActorCritic:
    """Maximises the discounted reward and, times the temperature, the entropy of its actions.

    The temperature follows from `target_entropy` (None: less the number of actions); a number for
    `temperature` fixes it instead. Actor and temperature move in one update of `actor_every`.
    """

    learning_rate: float = 3e-4
    discount: float = 0.99
    target_rate: float = 0.005
    temperature: float | None = None
    target_entropy: float | None = None
    actor_every: int = 1
    width: int = 256
    depth: int = 2

    def init(self, key: PRNGKeyArray, observation: int, action: int) -> SoftActorCriticState:
        """See `Agent.init`."""
        keys, shape = jax.random.split(key), (observation, action, self.width, self.depth)
        actor, critic = GaussianActor.create(keys[0], *shape), Critic.create(keys[1], *shape)
        temperature = 1.0 if self.temperature is None else self.temperature
        log_temperature = jnp.log(jnp.asarray(temperature, jnp.float32))
        learned = {"actor": actor, "critic": critic, "temperature": log_temperature}
        moments = {name: adam(self.learning_rate).init(one) for name, one in learned.items()}
        return SoftActorCriticState(actor, critic, copy_arrays(critic), log_temperature, moments)

    def propose(
        self, state: SoftActorCriticState, observation: Array, key: PRNGKeyArray | None
    ) -> Array:
        """See `Agent.propose`."""
        if key is None:
            return state.actor.mean(observation)
        return state.actor.sample(observation, key)[0]

    def guard(self, state: SoftActorCriticState, observation: Array, proposed: Array) -> Array:
        """What was proposed."""
        return proposed

    def update(
        self,
        state: SoftActorCriticState,
        batch: Batch,
        key: PRNGKeyArray,
        penalty: Callable[[Array, Array], Array] | None = None,
    ) -> tuple[SoftActorCriticState, dict[str, Array]]:
        """See `Agent.update`; the actor also lowers `penalty(observation, action)`, (batch,)."""
        lived, optimiser = batch.task, adam(self.learning_rate)
        for_next, for_actor = jax.random.split(key)
        temperature = jnp.exp(state.log_temperature)
        after, density = state.actor.sample(lived.next_observation, for_next)
        value = jnp.min(state.target(lived.next_observation, after), axis=0)
        value = self.discount * (1.0 - lived.terminated) * (value - temperature * density)
        target = lived.reward + value

        def critic_loss(critic: Critic) -> Array:
            error = critic(lived.observation, lived.action) - target
            return jnp.sum(jnp.mean(error**2, axis=-1))

        def actor_loss(actor: GaussianActor, critic: Critic) -> tuple[Array, Array]:
            action, density = actor.sample(lived.observation, for_actor)
            loss = temperature * density - jnp.min(critic(lived.observation, action), axis=0)
            if penalty is not None:
                loss = loss + penalty(lived.observation, action)
            return jnp.mean(loss), -jnp.mean(density)

        before = state.moments
        lost, gradient = jax.value_and_grad(critic_loss)(state.critic)
        critic, of_critic = descend(optimiser, gradient, before["critic"], state.critic)

        def improved() -> tuple[Any, ...]:
            gradient, entropy = jax.grad(actor_loss, has_aux=True)(state.actor, critic)
            moved = descend(optimiser, gradient, before["actor"], state.actor)
            return *moved, *self._cool(state, entropy, optimiser)

        if self.actor_every == 1:
            acting = improved()
        else:
            held = state.actor, before["actor"], state.log_temperature, before["temperature"]
            due = optax.tree.get(before["critic"], "count") % self.actor_every == 0
            acting = jax.lax.cond(due, improved, lambda: held)
        actor, of_actor, log_temperature, of_temperature = acting
        moments = {"actor": of_actor, "critic": of_critic, "temperature": of_temperature}
        followed = follow(state.target, critic, self.target_rate)
        state = SoftActorCriticState(actor, critic, followed, log_temperature, moments)
        figures = {"critic_loss": lost, "entropy": -jnp.mean(density), "temperature": temperature}
        return state, {**figures, "value": jnp.mean(target)}

    def _cool(
        self, state: SoftActorCriticState, entropy: Array, optimiser: optax.GradientTransformation
    ) -> tuple[Array, optax.OptState]:
        """Cooler where the actions are more random than they should be."""
        before, moments = state.log_temperature, state.moments["temperature"]
        if self.temperature is not None:
            return before, moments
        actions = state.actor.network.sizes[-1] // 2
        wanted = -actions if self.target_entropy is None else self.target_entropy
        return descend(optimiser, entropy - wanted, moments, before)
