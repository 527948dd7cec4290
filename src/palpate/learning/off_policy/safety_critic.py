"""What is risky, and what to do about it: learnt beside a task, from all that was ever executed.

Recovery RL (Thananjeyan et al., arXiv 2010.15920), as SRL-VIC has it (arXiv 2406.13744).
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.learning.off_policy.agent import adam, copy_arrays, descend, follow
from palpate.learning.off_policy.buffer import Transition
from palpate.networks.actor import Critic, DeterministicActor
from palpate.networks.guarded import Guard, untrained_guard


class SafetyCriticState(eqx.Module):
    """The guard, the critic that its targets come from, and the optimisers' moments."""

    guard: Guard
    target: Critic
    critic_moments: optax.OptState
    recovery_moments: optax.OptState


@dataclass(frozen=True)
class SafetyCritic:
    """Learns the discounted probability of a violation, twice, and the actor that makes it least.

        y = c + (1 - c) (1 - terminated) discount max_i Q_target_i(s', a')

    with c whether the decision violated a constraint: nothing counts beyond a violation. a' is
    what would be done at s'. The critics' outputs are squashed into [0, 1] and follow
    y by its cross-entropy; the greater of the two is the risk. It has its minimum where least
    squares have theirs, which the papers take, but its gradient does not vanish where risks are
    small: on 150,000 decisions of a maze, of which 344 violate the limit, the tenth with the
    greatest risk holds 77 % of the violations not learnt from instead of 47 %. Critic and recovery
    see the numbers `seen` of an observation (None: all).
    """

    discount: float = 0.8
    learning_rate: float = 3e-4
    target_rate: float = 0.005
    seen: tuple[int, ...] | None = None
    width: int = 256
    depth: int = 2

    def init(self, key: PRNGKeyArray, observation: int, action: int) -> SafetyCriticState:
        """Untrained, for so many numbers seen and done.

        Raises `PalpateError` for `seen` that are not among those.
        """
        seen = self.seen
        if seen is not None and not (seen and 0 <= min(seen) <= max(seen) < observation):
            raise PalpateError(
                f"the safety critic sees the numbers {seen} of {observation}: expected some in "
                f"0 ... {observation - 1}"
            )
        features, layers = observation if seen is None else len(seen), (self.width,) * self.depth
        guard = untrained_guard(key, features, action, layers, seen)
        optimiser = adam(self.learning_rate)
        moments = optimiser.init(guard.critic), optimiser.init(guard.recovery)
        return SafetyCriticState(guard, copy_arrays(guard.critic), *moments)

    def update(
        self,
        state: SafetyCriticState,
        lived: Transition,
        following: Float[Array, "n actions"],
        weight: float | Float[Array, " n"] = 1.0,
        duration: Float[Array, " n"] | None = None,
    ) -> tuple[SafetyCriticState, dict[str, Array]]:
        """After one update from transitions (n, ...), and figures to log.

        `following` is what the acting policy would do at their next observations, and `weight` how
        much each counts for the critic. A `duration`, as a share of a decision, is over at those:
        then all of y is discounted, by it.
        """
        guard, optimiser = state.guard, adam(self.learning_rate)
        seen, after = guard.part(lived.observation), guard.part(lived.next_observation)
        later = jnp.max(jax.nn.sigmoid(state.target(after, following)), axis=0)
        violated = (lived.cost > 0).astype(later.dtype)
        goes_on = (1.0 - violated) * (1.0 - lived.terminated)
        if duration is None:
            wanted = violated + self.discount * goes_on * later
        else:
            wanted = self.discount**duration * (violated + goes_on * later)

        def critic_loss(critic: Critic) -> Array:
            lost = optax.sigmoid_binary_cross_entropy(critic(seen, lived.executed), wanted)
            return jnp.sum(jnp.mean(weight * lost, axis=-1))

        def recovery_loss(recovery: DeterministicActor, critic: Critic) -> Array:
            return jnp.mean(jnp.max(jax.nn.sigmoid(critic(seen, recovery.mean(seen))), axis=0))

        lost, gradient = jax.value_and_grad(critic_loss)(guard.critic)
        critic, of_critic = descend(optimiser, gradient, state.critic_moments, guard.critic)
        risk, gradient = jax.value_and_grad(recovery_loss)(guard.recovery, critic)
        recovery, of_recovery = descend(optimiser, gradient, state.recovery_moments, guard.recovery)
        followed = follow(state.target, critic, self.target_rate)
        changed = Guard(critic, recovery, guard.seen)
        state = SafetyCriticState(changed, followed, of_critic, of_recovery)
        return state, {"risk_loss": lost, "risk": jnp.mean(wanted), "recovered_risk": risk}
