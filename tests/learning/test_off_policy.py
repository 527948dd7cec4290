"""The off-policy loop: it finds known optima, resumes to the bit, and compiles once."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from gymnasium.vector import SyncVectorEnv
from safetensors import safe_open

from palpate.errors import PalpateError
from palpate.learning.off_policy import (
    DeterministicPolicyGradient,
    Lagrangian,
    OffPolicyTraining,
    Penalty,
    RecoveryAgent,
    SafetyCritic,
    SoftActorCritic,
    Transition,
    collect,
    train_off_policy,
)
from palpate.learning.off_policy.buffer import ReplayBuffer
from palpate.learning.off_policy.loop import Compiled
from palpate.runs import Run
from small_environments import Bandit, Leaving, Priced, Regulator, side_by_side

SMALL = SoftActorCritic(width=32, learning_rate=3e-3, target_rate=0.02)
TINY = SoftActorCritic(width=16, depth=1)
RECOVERING = RecoveryAgent(TINY, SafetyCritic(width=16, depth=1), threshold=0.4)
SHORT = OffPolicyTraining(400, warm_up=100, batch=16, capacity=300, pretraining=20, log_every=50,
                          evaluate_every=80, checkpoint_every=200)  # fmt: skip


def greedy(agent, state, observation) -> np.ndarray:
    return np.asarray(agent.propose(state, jnp.asarray(observation, jnp.float32), None))


@pytest.mark.parametrize("actor_every", [1, 2])
def test_a_bandit_is_solved(actor_every: int) -> None:
    agent = dataclasses.replace(SMALL, actor_every=actor_every)
    settings = OffPolicyTraining(3000, warm_up=500, batch=64, capacity=3000, ratio=0.5)
    state = train_off_policy(side_by_side(Bandit, 8), agent, settings, 0)
    seen = np.linspace(-0.9, 0.9, 19)[:, None]
    assert np.abs(greedy(agent, state, seen) - 0.5 * seen).max() < 0.1
    counts = [int(optax.tree.get(state.moments[name], "count")) for name in ("critic", "actor")]
    assert counts == [1250, 1250 // actor_every]


DETERMINISTIC = DeterministicPolicyGradient(width=32, learning_rate=3e-3, noise=0.1)
PRICED = OffPolicyTraining(4000, warm_up=200, batch=64, capacity=1000, ratio=0.5)


def test_a_price_on_the_cost_moves_the_optimum() -> None:
    agent = Penalty(DETERMINISTIC, weight=3.0)
    state = train_off_policy(side_by_side(Priced, 8), agent, PRICED, 0)
    assert abs(greedy(agent, state, [[0.0]])[0, 0] - 0.25) < 0.07


@pytest.mark.parametrize("episodic", [True, False])
def test_a_limit_finds_its_price(episodic: bool) -> None:
    agent = Lagrangian(
        DETERMINISTIC, 0.25, episodic, 3e-3, multiplier_rate=3e-3, width=32, patience=200
    )
    state = train_off_policy(side_by_side(Priced, 8), agent, PRICED, 0)
    assert abs(greedy(agent, state, [[0.0]])[0, 0] - 0.5) < 0.07
    assert abs(state.multiplier - 1.0) < 0.3


@pytest.mark.parametrize("relief", [True, False])
def test_to_leave_is_a_way_out_of_costs_only_where_it_is_a_relief(relief: bool) -> None:
    agent = Lagrangian(
        SMALL, 0.0, learning_rate=3e-3, multiplier=1.0, multiplier_rate=0.0, width=32,
        target_rate=0.02, relief=relief,
    )  # fmt: skip
    state = train_off_policy(side_by_side(Leaving, 8), agent, PRICED, 0)
    assert (greedy(agent, state, [[0.0]])[0, 0] > 0.0) == relief


def test_a_regulator_comes_near_its_riccati_gain() -> None:
    settings = OffPolicyTraining(5000, warm_up=500, batch=64, capacity=5000, ratio=1.0)
    agent = SoftActorCritic(width=64, learning_rate=1e-3, target_rate=0.02, temperature=0.2)
    state = train_off_policy(side_by_side(Regulator, 8), agent, settings, 0)
    seen = np.linspace(-0.8, 0.8, 9)[:, None]
    executed = 2.0 * greedy(agent, state, seen)  # stretched onto the bounds
    assert np.abs(executed + Regulator.gain * seen).max() < 0.15


def trained(folder: Path, seed: int = 0, killed_after: int = 0):
    """What a short training leaves, recovery and all: its whole last checkpoint and its lines."""

    def evaluation(step: int, state) -> dict[str, float]:
        if step == killed_after:
            raise RuntimeError("killed")
        return {"evaluated": float(step)}

    def at_random(seen, fresh, random):
        return random.uniform(-1.0, 1.0, seen.shape)

    environments = side_by_side(Bandit, 4)
    offline = collect(environments, at_random, 50, seed=9)
    with Run.open(folder, {"seed": seed}) as run:
        more: dict[str, Any] = {"offline": offline, "evaluation": evaluation}
        train_off_policy(environments, RECOVERING, SHORT, seed, run, **more)
        last = sorted((folder / "checkpoints").iterdir())[-1]
        with safe_open(last, framework="numpy") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return arrays, [line | {"time": 0} for line in run.metrics()]


def test_a_killed_training_resumes_to_the_same_bits(tmp_path: Path) -> None:
    arrays, lines = trained(tmp_path / "whole")
    assert arrays["buffer.added"] == 50 + SHORT.steps > SHORT.capacity  # the ring has gone round
    for step in (160, 320):  # after the pretraining alone, and after a checkpoint on the way
        with pytest.raises(RuntimeError, match="killed"):
            trained(tmp_path / "cut", killed_after=step)
    again, again_lines = trained(tmp_path / "cut")
    assert lines == again_lines
    assert [line["step"] for line in lines][-2:] == [352, 400]
    assert arrays.keys() == again.keys()
    for name, values in arrays.items():
        np.testing.assert_array_equal(values, again[name], err_msg=name)
    other, _ = trained(tmp_path / "other", seed=1)
    assert not np.array_equal(
        arrays["buffer.transitions.action"], other["buffer.transitions.action"]
    )


def test_each_function_is_compiled_once(monkeypatch) -> None:
    made: list[Any] = []
    monkeypatch.setattr(
        "palpate.learning.off_policy.loop.Compiled",
        lambda *given: made.append(Compiled(*given)) or made[-1],
    )
    training = dataclasses.replace(SHORT, ratio=0.3, pretraining=0)
    train_off_policy(side_by_side(Bandit, 4), TINY, training, 0)
    assert made[0].act._cache_size() == made[0].learn._cache_size() == 1


def numbered(first: int, count: int, every: int = 0) -> Transition:
    """Transitions whose reward is their number; each of so many violates."""
    number = jnp.arange(first, first + count, dtype=jnp.float32)
    cost = (number % every == 0).astype(jnp.float32) if every else 0.0 * number
    seen, done = number[:, None], number[:, None]
    return Transition(seen, done, done, number, cost, seen, 0.0 * number)


def test_buffer_forgets_the_oldest_but_what_is_kept_and_what_violated() -> None:
    add = jax.jit(ReplayBuffer.add)
    sample = jax.jit(ReplayBuffer.sample, static_argnums=2)
    sample_violating = jax.jit(ReplayBuffer.sample_violating, static_argnums=(2, 3))
    buffer = add(ReplayBuffer.create(1, 1, capacity=30, violating=4), numbered(0, 10, every=5))
    buffer = buffer.keep()
    for first in range(10, 80, 10):
        buffer = add(buffer, numbered(first, 10))
    drawn = np.unique(sample(buffer, jax.random.key(0), 2000).reward)
    np.testing.assert_array_equal(drawn, np.arange(60, 80))  # 20 places beside the kept ones
    batch, weight = sample_violating(buffer, jax.random.key(1), 1000, 0.25)
    np.testing.assert_array_equal(np.unique(batch.reward[:250]), [0, 5])
    assert (batch.cost[:250] == 1).all()
    np.testing.assert_array_equal(np.unique(batch.reward[250:]), [*range(10), *range(60, 80)])
    for first in (100, 110, 120, 130, 140):
        buffer = add(buffer, numbered(first, 10, every=10))
    batch, _ = sample_violating(buffer, jax.random.key(2), 1000, 0.25)
    np.testing.assert_array_equal(np.unique(batch.reward[:250]), [110, 120, 130, 140])
    none = add(ReplayBuffer.create(1, 1, 10), numbered(1, 3))
    batch, weight = sample_violating(none, jax.random.key(0), 100, 0.5)
    assert set(np.unique(batch.reward)) == {1, 2, 3}
    assert (weight == 1).all()


def test_violations_drawn_too_often_weigh_less() -> None:
    buffer = ReplayBuffer.create(1, 1, 100).add(numbered(0, 100, every=10))
    batch, weight = buffer.sample_violating(jax.random.key(0), 20_000, 0.3)
    assert batch.cost.mean() == pytest.approx(0.37, abs=0.01)  # and a tenth of the other 70 %
    assert weight.mean() == pytest.approx(1.0, abs=0.01)
    assert (weight * batch.cost).mean() == pytest.approx(0.1, abs=0.003)
    even = np.mean(np.arange(100))
    assert (weight * batch.reward).mean() == pytest.approx(even, rel=0.02)


def test_environments_that_reset_a_step_later_are_refused() -> None:
    late = SyncVectorEnv([Bandit, Bandit])
    with pytest.raises(PalpateError, match="SAME_STEP"):
        train_off_policy(late, TINY, SHORT, 0)
