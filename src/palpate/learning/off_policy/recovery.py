"""An agent that is overruled where its action is risky (Recovery RL, arXiv 2010.15920)."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.learning.off_policy.agent import Agent, Batch
from palpate.learning.off_policy.safety_critic import SafetyCritic, SafetyCriticState


class RecoveryState(eqx.Module):
    """Of the task's agent and of the safety critic."""

    task: Any
    safety: SafetyCriticState


@dataclass(frozen=True)
class RecoveryAgent:
    """A task's agent whose action gives way to a recovery where its risk is above `threshold`.

    The task's agent remembers what it proposed, with what came of the action executed in its place;
    critic and recovery learn from what was executed.
    """

    task: Agent
    safety: SafetyCritic
    threshold: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.threshold <= 1.0:
            raise PalpateError(f"the threshold is {self.threshold}: expected a risk in [0, 1]")

    def init(self, key: PRNGKeyArray, observation: int, action: int) -> RecoveryState:
        """See `Agent.init`."""
        keys = jax.random.split(key)
        task = self.task.init(keys[0], observation, action)
        return RecoveryState(task, self.safety.init(keys[1], observation, action))

    def propose(self, state: RecoveryState, observation: Array, key: PRNGKeyArray | None) -> Array:
        """What the task's agent proposes."""
        return self.task.propose(state.task, observation, key)

    def guard(
        self,
        state: RecoveryState,
        observation: Float[Array, "n features"],
        proposed: Float[Array, "n actions"],
    ) -> Float[Array, "n actions"]:
        """The proposed actions, or the recovery's where they are risky."""
        return state.safety.guard.overrule(observation, proposed, self.threshold)

    def update(
        self, state: RecoveryState, batch: Batch, key: PRNGKeyArray
    ) -> tuple[RecoveryState, dict[str, Array]]:
        """See `Agent.update`: the task from its own batch, the critic from that of risks."""
        for_task, for_safety = jax.random.split(key)
        task, figures = self.task.update(state.task, batch, for_task)
        state, found = self.pretrain(RecoveryState(task, state.safety), batch, for_safety)
        return state, figures | found

    def acting(self, state: RecoveryState, observation: Array, key: PRNGKeyArray) -> Array:
        """What is done next, of which later risks are learnt: the proposal under its guard.

        Recovery RL learns those of the proposal alone. Where a task's policy is not yet good they
        make every action before it look risky, so that none is done and it never becomes good.
        """
        proposed = self.task.propose(state.task, observation, key)
        return state.safety.guard.overrule(observation, proposed, self.threshold)

    def pretrain(
        self, state: RecoveryState, batch: Batch, key: PRNGKeyArray
    ) -> tuple[RecoveryState, dict[str, Array]]:
        """Critic and recovery alone."""
        following = self.acting(state, batch.risk.next_observation, key)
        safety, figures = self.safety.update(state.safety, batch.risk, following, batch.risk_weight)
        return RecoveryState(state.task, safety), figures
