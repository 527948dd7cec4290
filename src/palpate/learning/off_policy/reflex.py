"""An agent whose motions are interrupted where they become risky (Bresa, arXiv 2503.21989)."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.learning.off_policy.agent import Batch
from palpate.learning.off_policy.buffer import Motion
from palpate.learning.off_policy.recovery import RecoveryAgent, RecoveryState
from palpate.networks.guarded import Guard


@dataclass(frozen=True)
class ReflexAgent(RecoveryAgent):
    """A task's agent that decides, and a guard that interrupts what it decided.

    Its environments hold the guard (`palpate.safety.reflex.Reflex`), which looks in every control
    period, the first one of a decision included. The critic learns from `Motion`s: its risk is
    that of going on with an action until the decision's end, and then as the agent acts;
    a violation counts discount^(time until then), in decisions.
    """

    def guard(self, state: RecoveryState, observation: Array, proposed: Array) -> Array:
        """What was proposed: it is interrupted where it is executed."""
        return proposed

    def reflex(self, state: RecoveryState) -> tuple[Guard, float]:
        """What interrupts the motions, and from which risk on."""
        return state.safety.guard, self.threshold

    def pretrain(
        self, state: RecoveryState, batch: Batch, key: PRNGKeyArray
    ) -> tuple[RecoveryState, dict[str, Array]]:
        """Critic and recovery alone. Raises `PalpateError` for a batch of whole decisions."""
        lived = batch.risk
        if not isinstance(lived, Motion):
            raise PalpateError("a reflex learns from pieces of decisions, not from whole ones")
        decided = self.acting(state, lived.next_observation, key)
        following = jnp.where(lived.holds[:, None] > 0, lived.executed, decided)
        weight = batch.risk_weight
        safety, figures = self.safety.update(state.safety, lived, following, weight, lived.duration)
        return RecoveryState(state.task, safety), figures
