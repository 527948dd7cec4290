"""Deep deterministic policy gradient (Lillicrap et al., arXiv 1509.02971)."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, PRNGKeyArray

from palpate.learning.off_policy.agent import Batch, adam, copy_arrays, descend, follow
from palpate.networks.actor import Critic, DeterministicActor


class DeterministicPolicyGradientState(eqx.Module):
    """Networks, the slower ones that targets come from, and the optimisers' moments."""

    actor: DeterministicActor
    critic: Critic
    target_actor: DeterministicActor
    target_critic: Critic
    actor_moments: optax.OptState
    critic_moments: optax.OptState


@dataclass(frozen=True)
class DeterministicPolicyGradient:
    """Maximises the discounted reward; explores by Gaussian noise of deviation `noise`."""

    learning_rate: float = 3e-4
    discount: float = 0.99
    target_rate: float = 0.005
    noise: float = 0.1
    width: int = 256
    depth: int = 2

    def init(
        self, key: PRNGKeyArray, observation: int, action: int
    ) -> DeterministicPolicyGradientState:
        """See `Agent.init`."""
        keys, shape = jax.random.split(key), (observation, action, self.width, self.depth)
        actor = DeterministicActor.create(keys[0], *shape)
        critic = Critic.create(keys[1], *shape, members=1)
        moments = [adam(self.learning_rate).init(network) for network in (actor, critic)]
        targets = copy_arrays(actor), copy_arrays(critic)
        return DeterministicPolicyGradientState(actor, critic, *targets, *moments)

    def propose(
        self,
        state: DeterministicPolicyGradientState,
        observation: Array,
        key: PRNGKeyArray | None,
    ) -> Array:
        """See `Agent.propose`."""
        action = state.actor.mean(observation)
        if key is None:
            return action
        noise = jax.random.normal(key, action.shape, action.dtype)
        return jnp.clip(action + self.noise * noise, -1.0, 1.0)

    def guard(
        self, state: DeterministicPolicyGradientState, observation: Array, proposed: Array
    ) -> Array:
        """What was proposed."""
        return proposed

    def update(
        self,
        state: DeterministicPolicyGradientState,
        batch: Batch,
        key: PRNGKeyArray,
        penalty: Callable[[Array, Array], Array] | None = None,
    ) -> tuple[DeterministicPolicyGradientState, dict[str, Array]]:
        """See `Agent.update`; the actor also lowers `penalty(observation, action)`, (batch,)."""
        lived, optimiser = batch.task, adam(self.learning_rate)
        after = state.target_actor.mean(lived.next_observation)
        value = state.target_critic(lived.next_observation, after)[0]
        target = lived.reward + self.discount * (1.0 - lived.terminated) * value

        def critic_loss(critic: Critic) -> Array:
            return jnp.mean((critic(lived.observation, lived.action)[0] - target) ** 2)

        def actor_loss(actor: DeterministicActor, critic: Critic) -> Array:
            action = actor.mean(lived.observation)
            loss = -critic(lived.observation, action)[0]
            return jnp.mean(loss if penalty is None else loss + penalty(lived.observation, action))

        lost, gradient = jax.value_and_grad(critic_loss)(state.critic)
        critic, of_critic = descend(optimiser, gradient, state.critic_moments, state.critic)
        gradient = jax.grad(actor_loss)(state.actor, critic)
        actor, of_actor = descend(optimiser, gradient, state.actor_moments, state.actor)
        followed = (
            follow(state.target_actor, actor, self.target_rate),
            follow(state.target_critic, critic, self.target_rate),
        )
        moments = of_actor, of_critic
        state = DeterministicPolicyGradientState(actor, critic, *followed, *moments)
        return state, {"critic_loss": lost, "value": jnp.mean(target)}
