"""What is risky is learnt as it is, and what is risky is not done."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.learning.off_policy import (
    OffPolicyTraining,
    RecoveryAgent,
    SafetyCritic,
    SoftActorCritic,
    Transition,
    at_its_best,
    collect,
    evaluate,
    train_off_policy,
)
from palpate.learning.off_policy.agent import Batch
from palpate.learning.off_policy.recovery import RecoveryState
from palpate.runs import Run
from small_environments import Cliff, side_by_side

DISCOUNT, LENGTH = 0.7, 5
CRITIC = SafetyCritic(DISCOUNT, learning_rate=3e-3, target_rate=0.05, width=32)
TASK = SoftActorCritic(width=32, learning_rate=3e-3)


def chain() -> Transition:
    """From each of five places to the next, violating on the last, after which it would go on.

    Besides two that see something of no consequence and end: without a violation, from the first
    place, which must not take over the risk of where it ended.
    """
    places = np.eye(LENGTH + 1, dtype=np.float32)
    here, there = [*range(LENGTH), LENGTH], [*range(1, LENGTH), LENGTH - 1, LENGTH - 1]
    count, zeros = len(here), np.zeros((len(here), 1), np.float32)
    cost = np.array([i == LENGTH - 1 for i in range(count)], np.float32)
    ended = np.array([i == LENGTH for i in range(count)], np.float32)
    nothing = np.zeros(count, np.float32)
    return Transition(places[here], zeros, zeros, nothing, cost, places[there], ended)


def learnt(critic: SafetyCritic, lived: Transition, updates: int):
    state = critic.init(jax.random.key(0), lived.observation.shape[1], lived.action.shape[1])
    lived = jax.tree.map(jnp.asarray, lived)

    def update(_, state):
        following = jnp.zeros_like(lived.action)
        return critic.update(state, lived, following)[0]

    return jax.jit(lambda state: jax.lax.fori_loop(0, updates, update, state))(state)


def test_risk_on_a_chain_is_the_discount_to_the_steps_before_the_cliff() -> None:
    lived = chain()
    state = learnt(CRITIC, lived, 2000)
    risk = state.guard.risk(jnp.asarray(lived.observation), jnp.asarray(lived.action))
    expected = [*(DISCOUNT**steps for steps in reversed(range(LENGTH))), 0.0]
    np.testing.assert_allclose(risk, expected, atol=0.04)


def test_nothing_counts_beyond_a_violation_or_an_end() -> None:
    lived = chain()
    state = CRITIC.init(jax.random.key(0), LENGTH + 1, 1)
    only = jax.tree.map(lambda leaf: jnp.asarray(leaf[LENGTH - 1 :]), lived)
    _, figures = jax.jit(CRITIC.update)(state, only, jnp.zeros((2, 1)))
    assert figures["risk"] == 0.5  # 1 of the violation, 0 of the end: nothing of what follows


def test_critic_sees_its_part_alone() -> None:
    critic = dataclasses.replace(CRITIC, seen=(0, 2))
    state = critic.init(jax.random.key(0), 3, 1)
    assert state.guard.critic.network.sizes[0] == 3
    one, other = jnp.array([[1.0, 2.0, 3.0]]), jnp.array([[1.0, -9.0, 3.0]])
    action = jnp.ones((1, 1))
    assert state.guard.risk(one, action) == state.guard.risk(other, action)
    np.testing.assert_array_equal(state.guard.recover(one), state.guard.recover(other))
    with pytest.raises(PalpateError, match=r"\(0, 3\) of 3: expected some in 0 ... 2"):
        dataclasses.replace(CRITIC, seen=(0, 3)).init(jax.random.key(0), 3, 1)


class Forwards(SoftActorCritic):
    """A task's agent that always proposes 1."""

    def propose(self, state, observation, key):
        return jnp.ones((len(observation), 1))


def test_what_will_be_overruled_makes_nothing_before_it_risky() -> None:
    """From a place to the edge: a step over it violates, one back does not."""
    places, one = np.eye(2, dtype=np.float32), np.ones(3, np.float32)
    done = np.array([[0.0], [1.0], [-1.0]], np.float32)
    cost, ended = np.array([0.0, 1.0, 0.0]), np.array([0.0, 1.0, 1.0])
    lived = Transition(places[[0, 1, 1]], done, done, 0 * one, cost, places[[1, 1, 1]], ended)
    batch = Batch(lived, lived, jnp.asarray(one), jnp.zeros(()))
    batch = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), batch)
    for threshold, expected in ((0.3, 0.0), (1.0, DISCOUNT)):  # overruled, and not
        agent = RecoveryAgent(Forwards(), CRITIC, threshold)
        state = RecoveryState(None, CRITIC.init(jax.random.key(0), 2, 1))

        def update(_, state, agent=agent):
            return agent.pretrain(state, batch, jax.random.key(0))[0]

        state = jax.jit(lambda state: jax.lax.fori_loop(0, 1500, update, state))(state)
        risk = state.safety.guard.risk(batch.risk.observation, batch.risk.executed)
        np.testing.assert_allclose(risk, [expected, 1.0, 0.0], atol=0.05)


def at_random(observation, fresh, random):
    return random.uniform(-1.0, 1.0, (len(observation), 1))


def test_recovery_keeps_a_training_from_the_cliff(tmp_path: Path) -> None:
    environments = side_by_side(Cliff, 4)
    offline = collect(environments, at_random, 1002, seed=3)
    assert offline.reward.shape == (1002,)
    np.testing.assert_array_equal(offline.cost > 0, offline.executed[:, 0] > 0)
    agent = RecoveryAgent(TASK, dataclasses.replace(CRITIC, discount=0.5), threshold=0.6)
    settings = OffPolicyTraining(1200, warm_up=400, batch=64, capacity=3000, pretraining=500)
    with Run.open(tmp_path, {}) as run:
        state = train_off_policy(environments, agent, settings, 0, run, offline=offline)
        violations = run.metrics()[-1]["violations"]
    # Of the warm-up's 400 proposals alone, half would have violated.
    assert violations < 30
    proposed = jnp.linspace(-0.9, 0.9, 10)[:, None]
    executed = agent.guard(state, jnp.zeros((10, 2)), proposed)
    np.testing.assert_array_equal(executed[:5], proposed[:5])
    assert (executed[5:] < 0.0).all()
    act = at_its_best(agent)
    found = evaluate(environments, lambda seen: act(state, seen), 30, seed=1)
    assert found["cost"].sum() == 0
    assert (found["length"] == 3).all()


def test_evaluation_counts_long_and_short_episodes_as_they_come() -> None:
    environments = side_by_side(Cliff, 250)
    random = np.random.default_rng(0)
    act = lambda seen: random.uniform(-1.0, 1.0, (250, 1))  # noqa: E731
    found = evaluate(environments, act, 501, seed=0)
    violated = found["end"] == "violation"
    # A fair coin each step: over after the first of three with 1/2, the mean is 1.75.
    # The first 501 of 250 to end would be shorter.
    assert abs(found["length"].mean() - 1.75) < 0.1
    assert abs(violated.mean() - 7 / 8) < 0.04
    np.testing.assert_array_equal(found["force"], 9.0 * violated)
    np.testing.assert_array_equal(found["cost"], violated)
    assert len(found["return"]) == 501
