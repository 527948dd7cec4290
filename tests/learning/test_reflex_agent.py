"""What a reflex learns from pieces of decisions, and that its training resumes to the bit."""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import safe_open

from palpate.errors import PalpateError
from palpate.learning.off_policy import (
    Motion,
    OffPolicyTraining,
    ReflexAgent,
    SafetyCritic,
    SoftActorCritic,
    collect,
    train_off_policy,
)
from palpate.learning.off_policy.agent import Batch
from palpate.learning.off_policy.buffer import ReplayBuffer
from palpate.learning.off_policy.loop import Compiled
from palpate.learning.off_policy.recovery import RecoveryState
from palpate.runs import Run as Folder
from palpate.safety.reflex import Reflex
from palpate.worlds.gymnasium import GymnasiumWorlds, features_of
from runway import PERIODS, Run, Runway
from small_environments import Bandit, side_by_side

DISCOUNT, LENGTH = 0.7, 5
CRITIC = SafetyCritic(DISCOUNT, learning_rate=3e-3, target_rate=0.05, width=32)
AGENT = ReflexAgent(
    SoftActorCritic(width=16, depth=1), SafetyCritic(DISCOUNT, width=16, depth=1), threshold=0.5
)
SHORT = OffPolicyTraining(96, warm_up=32, batch=16, capacity=900, pretraining=20, log_every=16,
                          evaluate_every=16, checkpoint_every=48)  # fmt: skip


def runways(law: Reflex | None) -> GymnasiumWorlds:
    return GymnasiumWorlds([Runway() for _ in range(4)], Run(), law, PERIODS)


def watched() -> GymnasiumWorlds:
    return runways(Reflex(None, partial(features_of, Run()), 2))


class Backwards(SoftActorCritic):
    """A task's agent that always decides for -1."""

    def propose(self, state, observation, key):
        return -jnp.ones((len(observation), 1))


def test_risk_is_that_of_going_on_until_the_decision_ends():
    places = np.eye(LENGTH, dtype=np.float32)
    here, there = np.arange(LENGTH), np.append(np.arange(1, LENGTH), LENGTH - 1)
    ones, nothing = np.ones(LENGTH, np.float32), np.zeros(LENGTH, np.float32)
    over = (here == LENGTH - 1).astype(np.float32)  # from the last place over the edge
    holds = (here != 1).astype(np.float32)  # at place 2 there is a new decision

    def pieces(action, cost, terminated) -> Motion:
        done = action * ones[:, None]
        return Motion(places[here], done, done, nothing, cost, places[there], terminated,
                      0.5 * ones, holds, ones - holds)  # fmt: skip

    lived = jax.tree.map(
        lambda *parts: jnp.concatenate(parts), pieces(1.0, over, over), pieces(-1.0, nothing, ones)
    )
    agent = ReflexAgent(Backwards(), CRITIC, 0.5)
    state = RecoveryState(None, CRITIC.init(jax.random.key(0), LENGTH, 1))
    batch = Batch(lived, lived, jnp.ones(2 * LENGTH), jnp.zeros(()))

    def update(_, state):
        return agent.pretrain(state, batch, jax.random.key(0))[0]

    state = jax.jit(lambda state: jax.lax.fori_loop(0, 2000, update, state))(state)
    risk = state.safety.guard.risk(lived.observation, lived.executed)
    going_on = [0.0, 0.0, DISCOUNT**1.5, DISCOUNT, DISCOUNT**0.5]  # half a decision each
    np.testing.assert_allclose(risk[:LENGTH], going_on, atol=0.04)
    np.testing.assert_allclose(risk[LENGTH:], 0.0, atol=0.04)
    assert (state.safety.guard.recover(lived.observation)[2:] < 0.0).all()


def at_random(seen, fresh, random):
    return random.uniform(-1.0, 1.0, seen.shape)


def trained(folder: Path, killed_after: int = 0):
    def evaluation(step: int, state) -> dict[str, float]:
        if step == killed_after:
            raise RuntimeError("killed")
        return {"evaluated": float(step)}

    environments = watched()
    offline = collect(watched(), at_random, 40, seed=9)
    with Folder.open(folder, {}) as run:
        more: dict[str, Any] = {"offline": offline, "evaluation": evaluation}
        state = train_off_policy(environments, AGENT, SHORT, 0, run, **more)
        last = sorted((folder / "checkpoints").iterdir())[-1]
        with safe_open(last, framework="numpy") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return state, arrays, [line | {"time": 0} for line in run.metrics()], offline


def test_a_killed_training_resumes_to_the_same_bits_pieces_and_all(tmp_path: Path, monkeypatch):
    made: list[Any] = []
    monkeypatch.setattr(
        "palpate.learning.off_policy.loop.Compiled",
        lambda *given: made.append(Compiled(*given)) or made[-1],
    )
    state, arrays, lines, offline = trained(tmp_path / "whole")
    assert made[0].learn._cache_size() == 1
    # Those of before are pieces, of which the last of a decision count.
    assert isinstance(offline, Motion)
    assert len(offline.cost) > 4 * 40 == 4 * offline.whole.sum()
    assert arrays["motions.kept"] == len(offline.cost)
    assert arrays["buffer.kept"] == 0
    assert arrays["buffer.added"] == SHORT.steps
    lived = slice(len(offline.cost), arrays["motions.added"])
    pieces = {n: arrays[f"motions.transitions.{n}"][lived] for n in ("cost", "last", "holds")}
    assert pieces["holds"].any()  # something was interrupted
    assert (pieces["cost"] * pieces["last"]).sum() == lines[-1]["violations"]
    assert pieces["last"].sum() == SHORT.steps
    for step in (32, 64):
        with pytest.raises(RuntimeError, match="killed"):
            trained(tmp_path / "cut", killed_after=step)
    again, again_arrays, again_lines, _ = trained(tmp_path / "cut")
    assert lines == again_lines
    assert arrays.keys() == again_arrays.keys()
    for name, values in arrays.items():
        np.testing.assert_array_equal(values, again_arrays[name], err_msg=name)
    weights = [jax.tree.leaves(one.safety.guard) for one in (state, again)]
    for one, other in zip(*weights, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_reflex_that_learns_keeps_a_training_from_the_edge(tmp_path: Path):
    task = SoftActorCritic(width=32, learning_rate=3e-3)
    agent = ReflexAgent(task, dataclasses.replace(CRITIC, discount=0.5), threshold=0.4)
    settings = OffPolicyTraining(1200, warm_up=400, batch=64, capacity=8000, pretraining=1500)
    offline = collect(watched(), at_random, 1000, seed=3)
    with Folder.open(tmp_path, {}) as run:
        train_off_policy(watched(), agent, settings, 0, run, offline=offline)
        violations = run.metrics()[-1]["violations"]
    assert np.sum(offline.cost * offline.whole) > 80  # of 1000 decisions
    assert violations < 10


def test_only_the_first_of_a_batch_are_added():
    zeros, ones = np.zeros((4, 1), np.float32), np.ones(4, np.float32)
    batch = Motion(zeros, zeros, zeros, np.arange(4.0), ones, zeros, ones, ones, ones, ones)
    buffer = ReplayBuffer.create(1, 1, 6, kind=Motion)
    for _ in range(3):
        buffer = buffer.add(batch, 3)
    assert buffer.added == buffer.violated == 9
    np.testing.assert_array_equal(buffer.transitions.reward, [0, 1, 2, 0, 1, 2])


def test_environments_and_pieces_that_do_not_fit_are_refused():
    with pytest.raises(PalpateError, match="whose law is a Reflex"):
        train_off_policy(side_by_side(Bandit, 2), AGENT, SHORT, 0)
    with pytest.raises(PalpateError, match="whose law is a Reflex"):
        train_off_policy(runways(None), AGENT, SHORT, 0)
    whole = collect(runways(None), at_random, 8, seed=0)
    with pytest.raises(PalpateError, match="are Transitions: expected pieces of decisions"):
        train_off_policy(watched(), AGENT, SHORT, 0, offline=whole)
