"""How a policy learns in an environment that is not known beforehand: one setting for all.

Chosen before the first training in any of them, from what is usual for tasks of a thousand steps;
nothing of it is fitted to one environment.
"""

from typing import Any

from palpate.learning.off_policy import Lagrangian, OffPolicyTraining, Penalty, SoftActorCritic
from palpate.learning.off_policy.agent import Agent
from palpate.networks import Channel
from palpate.networks.guarded import ActorPolicy

DISCOUNT, WIDTH = 0.99, 256  # of two layers; both as in soft actor-critic (arXiv 1812.05905)
BATCH, CAPACITY = 256, 1_000_000
RATIO = 0.25  # updates a step: the least that a comparison by steps asks for; they take longest
WARM_UP = 10_000  # random steps: ten episodes of a thousand, as OmniSafe's SAC-Lag has
# The multiplier moves as fast as every weight: in 250,000 updates up to 75, where a step that
# breaks the limit gains about 10. OmniSafe's 1e-5 is for four times as many updates.
MULTIPLIER_RATE = 3e-4
# Checkpoints begin all episodes anew, and hold all that is remembered: some hundreds of megabytes.
CHECKPOINT_EVERY, LOG_EVERY = 100_000, 4_000  # steps


def agent_of(method: str, cost_limit: float, price: float) -> Agent:
    """What learns: under a limit on an episode's cost, at a price in rewards, or regardless."""
    agent = SoftActorCritic(discount=DISCOUNT, width=WIDTH)
    if method == "penalty":
        return Penalty(agent, price)
    if method == "lagrangian":
        rate = MULTIPLIER_RATE
        return Lagrangian(agent, cost_limit, discount=DISCOUNT, multiplier_rate=rate, width=WIDTH)
    return agent


def training_of(steps: int) -> OffPolicyTraining:
    """So many steps, whatever the method."""
    return OffPolicyTraining(
        steps=steps,
        warm_up=min(WARM_UP, steps // 4),
        ratio=RATIO,
        batch=BATCH,
        capacity=min(CAPACITY, steps + 1),
        log_every=LOG_EVERY,
        checkpoint_every=CHECKPOINT_EVERY,
    )


def policy_of(agent: Agent, state: Any, period: float) -> ActorPolicy:
    """The controller of an agent's state, with a decision every `period` s."""
    actor = state.agent.actor if isinstance(agent, Lagrangian) else state.actor
    seen, *_, both = actor.network.sizes  # it gives means and deviations
    sees, does = Channel("observation", (seen,)), Channel("action", (both // 2,))
    return ActorPolicy(actor=actor, observations=(sees,), actions=(does,), period=period)
