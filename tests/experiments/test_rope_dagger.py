"""The stages of rope-dagger on a small rope; identification and training are stood in for."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.experiments.rope import dagger as rope_dagger
from palpate.experiments.rope import nominal
from palpate.experiments.rope.dagger import (
    TakeOver,
    WhirledTrial,
    Work,
    nominal_trials,
    watch,
    whirled_trials,
)
from palpate.learning import Training, dagger
from palpate.learning.loss_monitor import Alarm
from palpate.models.rope import Rope
from palpate.networks import CommandPolicy
from palpate.runs.result import read_result
from palpate.runs.storage import write_json
from palpate.trials.controller import HeldStill
from palpate.trials.rope import stabilization
from palpate.worlds.rope.rope import RopeConfiguration
from small_rope import SMALL, VELOCITY, commands, seen

TINY = Work(nominal.QUICK, Training(iterations=1, starts=20), 1, 2, 2, {"everything": 1})
MODEL = Rope.from_rest_lengths(np.full(5, 0.2), 0.1, drive="velocity", substeps=4)


def untrained() -> CommandPolicy:
    seen = jax.random.normal(jax.random.key(1), (8, 30))
    key = jax.random.key(0)
    return CommandPolicy.create(key, seen, VELOCITY, period=0.01, width=4)


@pytest.fixture
def small(monkeypatch):
    """A small rope, short trials, a policy nobody trained; returns the pools that were trained on.

    In the first round everything is collected, and nothing later.
    """
    pools, left = [], [True]

    def train(task, model, training, seed, run, *, policy, pool):
        pools.append(pool)
        return policy

    def collected(alarm, comparison):
        return np.full(comparison.observed.shape, bool(left and left.pop()))

    monkeypatch.setattr(nominal, "BASE", RopeConfiguration(**SMALL))
    monkeypatch.setattr(rope_dagger, "QUICK_WORK", TINY)
    monkeypatch.setattr(rope_dagger, "TRIAL_PERIODS", 0.6)
    monkeypatch.setattr(nominal, "identified_rope", lambda *_: MODEL)
    monkeypatch.setattr(nominal, "shipped_policy", lambda: (untrained(), {"seed": 0}))
    monkeypatch.setattr(dagger, "train", train)
    monkeypatch.setattr(Alarm, "collected", collected)
    return pools


def test_stages_hand_on_what_they_made(small, tmp_path, monkeypatch):
    result = rope_dagger.reproduce(tmp_path, quick=True, seed=3)
    mended, control = small
    assert len(mended.command) == 2 * len(control.command) == 40
    rows = {row.name: row for row in result.figures}
    assert {name: row.bar for name, row in rows.items() if row.bar is not None} == {
        "success_rate_before": 0.7,
        "success_rate_after": 0.95,
        "rounds": 3,
        "success_rate_nominal_after": rows["success_rate_nominal_before"].value,
    }
    assert rows["rounds"].value == 1
    assert {"success_rate_control", "success_rate_held_still"} <= set(rows)
    assert (tmp_path / "collected.png").read_bytes().startswith(b"\x89PNG")
    write_json(tmp_path / "result.json", result.to_dict())
    read_result(tmp_path / "result.json")
    (tmp_path / "result.json").unlink()

    monkeypatch.setattr(rope_dagger, "run_trials", None)
    monkeypatch.setattr("palpate.trials.trial.run_trials", None)
    monkeypatch.setattr(Alarm, "collected", lambda alarm, c: np.full(c.observed.shape, True))
    monkeypatch.setattr(rope_dagger, "ROUNDS", 1)
    again = rope_dagger.reproduce(tmp_path, quick=True, seed=3)
    assert again.figures[0] == result.figures[0]


def test_whirls_are_drawn_by_their_seed_within_the_limits():
    trials = whirled_trials(6, 7)
    whirl = WhirledTrial.goals(trials)
    np.testing.assert_array_equal(whirl, WhirledTrial.goals(whirled_trials(6, 7)))
    assert not np.array_equal(whirl, WhirledTrial.goals(whirled_trials(6, 8)))
    speed = np.linalg.norm(whirl, axis=-1)
    acceleration = np.linalg.norm(np.diff(whirl, axis=1), axis=-1) / 0.01
    assert 0.7 < speed[:, -1].min() <= speed.max() < 0.8
    assert acceleration.max() < trials[0].configuration.acceleration_limit
    turning = np.cross(whirl[:, -2], whirl[:, -1])[:, 2]
    assert turning.min() < 0 < turning.max()


def test_a_policy_takes_over_knowing_what_was_seen(monkeypatch):
    monkeypatch.setattr(nominal, "BASE", RopeConfiguration(**SMALL))
    monkeypatch.setattr(rope_dagger, "WHIRL_DURATION", 0.3)
    monkeypatch.setattr(rope_dagger, "TRIAL_PERIODS", 0.02)
    trials = whirled_trials(2, 5)
    whirl = WhirledTrial.goals(trials)
    seen = watch(untrained(), trials)
    assert seen.states.position.shape == (2, trials[0].steps - 30, 6, 3)
    np.testing.assert_allclose(seen.command[:, 0], whirl[:, -1], rtol=1e-5)
    # One control period changes a command by no more than its limit: it went on from the whirl's.
    change = jnp.linalg.norm(seen.actions[:, 0] - seen.command, axis=-1)
    assert float(change.max()) < 0.1 + 1e-4
    # Velocities are those that the policy saw: of the gripper, nearly what it was told.
    told = np.linalg.norm(whirl[:, -2], axis=-1)
    np.testing.assert_allclose(
        np.linalg.norm(seen.states.velocity[:, 0, 0], axis=-1), told, rtol=0.1
    )


def test_who_is_no_policy_takes_over_as_well():
    class Counting(HeldStill):
        asked = 0

        def __call__(self, *arguments):
            self.asked += 1
            return super().__call__(*arguments)

    controller = Counting()
    shown = [seen(np.zeros((1, 6, 3)), np.zeros((1, 3)))] * 5
    decided = commands(TakeOver(controller), shown, np.full((1, 3, 3), 0.1))
    assert [float(command.max()) for command in decided] == [0.1, 0.1, 0.1, 0.0, 0.0]
    assert controller.asked == 2


def test_nominal_trials_are_the_evaluations():
    trials = nominal_trials(2, 11)
    (steps,) = {trial.steps for trial in trials}
    assert {trial.steps - len(trial.whirl) for trial in whirled_trials(2, 3)} == {steps}
    usual = stabilization.evaluation_trials(nominal.BASE, 2, 11)
    assert [dataclasses.replace(trial, steps=None) for trial in trials] == [
        dataclasses.replace(trial, steps=None) for trial in usual
    ]
