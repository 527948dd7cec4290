"""Costs in an agent's problem: as a price on the reward, or as a limit with a multiplier."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.learning.off_policy.agent import Agent, Batch, adam, copy_arrays, descend, follow
from palpate.networks.actor import Critic


@runtime_checkable
class PricedAgent(Agent, Protocol):
    """An agent whose actor can be made to lower something besides its own loss."""

    def update(
        self,
        state: Any,
        batch: Batch,
        key: PRNGKeyArray,
        penalty: Callable[[Array, Array], Array] | None = None,
    ) -> tuple[Any, dict[str, Array]]:
        """See `Agent.update`; `penalty(observation, action)` gives (batch,)."""
        ...


@dataclass(frozen=True)
class Penalty:
    """An agent of whose reward `weight` times the cost is taken (Recovery RL's "RP")."""

    agent: Agent
    weight: float

    def init(self, key: PRNGKeyArray, observation: int, action: int) -> Any:
        """See `Agent.init`."""
        return self.agent.init(key, observation, action)

    def propose(self, state: Any, observation: Array, key: PRNGKeyArray | None) -> Array:
        """See `Agent.propose`."""
        return self.agent.propose(state, observation, key)

    def guard(self, state: Any, observation: Array, proposed: Array) -> Array:
        """See `Agent.guard`."""
        return self.agent.guard(state, observation, proposed)

    def update(self, state: Any, batch: Batch, key: PRNGKeyArray) -> tuple[Any, dict[str, Array]]:
        """See `Agent.update`."""
        lowered = batch.task.reward - self.weight * batch.task.cost
        return self.agent.update(
            state, eqx.tree_at(lambda batch: batch.task.reward, batch, lowered), key
        )


class LagrangianState(eqx.Module):
    """Of the agent; the critic of costs, the multiplier, and the optimisers' moments."""

    agent: Any
    critic: Critic
    target: Critic
    multiplier: Float[Array, ""]
    critic_moments: optax.OptState
    multiplier_moments: optax.OptState
    updates: Int[Array, ""]


@dataclass(frozen=True)
class Lagrangian:
    """An agent whose actor also lowers multiplier x Q_c(s, a), the discounted cost it expects.

    The multiplier rises, by Adam and never below 0, while the cost is above `limit`: that of an
    episode where `episodic` (mean of the last ones; as SAC-Lag of OmniSafe), else the discounted
    cost of the actor's own actions on the batch (Recovery RL's "LR"). It is held for the first
    `patience` updates, and until an episode has ended.

    Without `relief` what ends an episode ends no costs: those to come are expected as if it went
    on. Else whoever pays much for going on learns to break off, where that costs nothing.
    """

    agent: PricedAgent
    limit: float
    episodic: bool = True
    learning_rate: float = 3e-4
    discount: float = 0.99
    target_rate: float = 0.005
    multiplier: float = 1e-3  # in the beginning
    multiplier_rate: float = 1e-5
    patience: int = 0
    relief: bool = True
    width: int = 256
    depth: int = 2

    def __post_init__(self) -> None:
        if not self.limit >= 0.0 or not self.multiplier >= 0.0:
            raise PalpateError(
                f"expected a limit and a multiplier of at least 0, got {self.limit} and "
                f"{self.multiplier}"
            )

    def init(self, key: PRNGKeyArray, observation: int, action: int) -> LagrangianState:
        """See `Agent.init`."""
        keys = jax.random.split(key)
        critic = Critic.create(keys[1], observation, action, self.width, self.depth, members=1)
        multiplier = jnp.asarray(self.multiplier, jnp.float32)
        return LagrangianState(
            self.agent.init(keys[0], observation, action),
            critic,
            copy_arrays(critic),
            multiplier,
            adam(self.learning_rate).init(critic),
            adam(self.multiplier_rate).init(multiplier),
            jnp.zeros((), jnp.int32),
        )

    def propose(
        self, state: LagrangianState, observation: Array, key: PRNGKeyArray | None
    ) -> Array:
        """See `Agent.propose`."""
        return self.agent.propose(state.agent, observation, key)

    def guard(self, state: LagrangianState, observation: Array, proposed: Array) -> Array:
        """See `Agent.guard`."""
        return self.agent.guard(state.agent, observation, proposed)

    def update(
        self, state: LagrangianState, batch: Batch, key: PRNGKeyArray
    ) -> tuple[LagrangianState, dict[str, Array]]:
        """See `Agent.update`."""
        lived, (for_agent, for_cost, for_now) = batch.task, jax.random.split(key, 3)
        after = self.agent.propose(state.agent, lived.next_observation, for_cost)
        later = state.target(lived.next_observation, after)[0]
        goes_on = 1.0 - lived.terminated if self.relief else 1.0
        wanted = lived.cost + self.discount * goes_on * later

        def critic_loss(critic: Critic) -> Array:
            return jnp.mean((critic(lived.observation, lived.action)[0] - wanted) ** 2)

        lost, gradient = jax.value_and_grad(critic_loss)(state.critic)
        optimiser = adam(self.learning_rate)
        critic, of_critic = descend(optimiser, gradient, state.critic_moments, state.critic)

        def price(observation: Array, action: Array) -> Array:
            return state.multiplier * critic(observation, action)[0]

        agent, figures = self.agent.update(state.agent, batch, for_agent, price)
        cost = batch.episode_cost
        if not self.episodic:
            now = self.agent.propose(agent, lived.observation, for_now)
            cost = jnp.mean(critic(lived.observation, now)[0])
        above = cost - self.limit
        moved, moments = descend(
            adam(self.multiplier_rate), -above, state.multiplier_moments, state.multiplier
        )
        waits = (state.updates < self.patience) | ~jnp.isfinite(above)
        before = state.multiplier, state.multiplier_moments
        multiplier, of_multiplier = jax.tree.map(
            lambda old, new: jnp.where(waits, old, new), before, (jnp.maximum(moved, 0.0), moments)
        )
        followed = follow(state.target, critic, self.target_rate)
        moments = of_critic, of_multiplier
        state = LagrangianState(agent, critic, followed, multiplier, *moments, state.updates + 1)
        return state, figures | {"cost_loss": lost, "multiplier": multiplier}
