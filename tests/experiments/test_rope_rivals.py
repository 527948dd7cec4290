"""Rivals on a small rope; identification and training are stood in for."""

import sys
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.experiments.rope import nominal
from palpate.experiments.rope import rivals as rope_rivals
from palpate.experiments.rope.nominal import Size
from palpate.learning import Training
from palpate.models.rope import Rope, RopeState
from palpate.networks import CommandPolicy
from palpate.runs.result import read_result
from palpate.runs.storage import write_json
from palpate.tasks.rope.tracking import hanging_rope
from palpate.trials.controller import HeldStill
from palpate.trials.rope import stabilization
from palpate.trials.rope.planners import (
    PlannedStabiliser,
    as_of_model,
    energy_and_speed,
    stabilising_planner,
)
from palpate.trials.rope.stabilization import StabilizationTrial
from palpate.trials.trial import run_trials
from palpate.worlds.rope.rope import RopeConfiguration
from small_rope import SMALL, VELOCITY

TINY = Size(2, (1, 1, 1), Training(iterations=8, width=4), 1, dict.fromkeys(
    ("recording", "identification", "training", "evaluation"), 1
))  # fmt: skip


def small_model(length: float = 1.0) -> Rope:
    return Rope.uniform(length, 0.1, 6, drive="velocity", substeps=4, bend_stiffness=1e-4)


def untrained(seed: int) -> CommandPolicy:
    seen, key = jnp.ones((2, 30)), jax.random.key(seed)  # of six nodes
    return CommandPolicy.create(key, seen, VELOCITY, period=0.01, width=4)


def test_a_rope_of_another_length_is_taken_for_the_models() -> None:
    """Its segments' directions and turning rates stay, and hanging it is the model at rest."""
    model, other = small_model(), small_model(0.9)
    as_of_small = eqx.filter_jit(as_of_model)
    shift = jnp.array([0.1, -0.2, 1.5])
    hanging = hanging_rope(other)
    rest = as_of_small(model, RopeState(hanging.position[None] + shift, hanging.velocity[None]))
    assert float(jnp.abs(model.energy(rest)[0])) < 1e-5
    turn = jnp.array([0.0, 2.0, 0.0])  # rad/s about the grip, which moves
    tilt = jnp.array([0.6, 0.0, -0.8]) * jnp.linspace(0, 0.9, 6)[:, None]
    swinging = RopeState(tilt[None] + shift, jnp.cross(turn, tilt)[None] + 0.3)
    taken = as_of_small(model, swinging)
    length = np.linalg.norm(np.diff(np.asarray(taken.position[0]), axis=0), axis=-1)
    np.testing.assert_allclose(
        length, np.linalg.norm(np.diff(hanging_rope(model).position, axis=0), axis=-1), rtol=1e-5
    )
    arm = taken.position[0] - taken.position[0, :1]
    np.testing.assert_allclose(jnp.cross(arm, tilt), 0.0, atol=1e-6)  # as before
    np.testing.assert_allclose(taken.velocity[0], jnp.cross(turn, arm) + 0.3, atol=1e-5)
    np.testing.assert_allclose(taken.position[0, 0], shift, atol=1e-6)


def test_the_loss_counts_energy_and_speed() -> None:
    model = small_model()
    loss = energy_and_speed(model)
    rest = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), hanging_rope(model))
    moving = RopeState(rest.position, rest.velocity.at[1].add(1.0))
    still, fast = jnp.zeros((2, 1, 3)), jnp.ones((2, 1, 3))
    np.testing.assert_allclose(loss(rest, still, jnp.array(0.5)), 0.0, atol=1e-3)
    of_moving = loss(moving, still, jnp.array(0.5))
    assert float(of_moving[1]) == pytest.approx(np.log1p(0.5 * 0.1 * 3 / 0.5 / 0.01), rel=1e-3)
    assert float(loss(rest, fast, jnp.array(0.5))[0]) == pytest.approx(1.5, rel=1e-2)


@pytest.mark.parametrize(("method", "size"), [("gradient", 1), ("mppi", 96)])
def test_planners_calm_a_rope_that_is_not_quite_the_models(method, size) -> None:
    configuration = RopeConfiguration(**SMALL, length=1.05)
    trials, steps = [StabilizationTrial(configuration, "straight", 0)], 60
    planned = PlannedStabiliser(stabilising_planner(method, small_model(), size), 0)
    energy = run_trials(trials, planned, steps).energy
    still = run_trials(trials, HeldStill(), steps).energy
    assert energy[0, -1] < 0.6 * still[0, -1]
    assert len(planned.spent) == steps


@pytest.fixture
def calls(monkeypatch):
    """Everything small, and what was asked of identification and training, in order."""
    made = []

    def identify(start, aligned, settings, run):
        made.append(("identify", start, aligned))
        return start

    def train(task, model, training, seed, run):
        made.append(("train", model, training))
        return untrained(seed)

    monkeypatch.setattr(nominal, "BASE", RopeConfiguration(**SMALL))
    monkeypatch.setattr(nominal, "identify", identify)
    monkeypatch.setattr(nominal, "NODES", 6)
    monkeypatch.setattr(nominal, "RECORDED_DURATION", 0.2)
    monkeypatch.setattr("palpate.commands.train.train", train)
    monkeypatch.setattr(stabilization, "TRIAL_PERIODS", 0.02)
    monkeypatch.setattr(rope_rivals, "SMALL", TINY)
    monkeypatch.setattr(rope_rivals, "UNHURRIED", {"gradient": 2})
    monkeypatch.setattr(nominal, "shipped_policy", lambda: (untrained(9), {"seed": 9}))

    def too_slow(*_):
        raise PalpateError("one iteration already takes 20 ms")

    methods = {"mppi": lambda *_: (16, 0.001), "gradient": too_slow}
    monkeypatch.setattr(rope_rivals, "METHODS", methods)
    monkeypatch.setattr(rope_rivals, "sac_installed", lambda: False)
    return made


def test_stages_hand_on_what_they_made(calls, monkeypatch, tmp_path, capsys) -> None:
    result = rope_rivals.reproduce(tmp_path, quick=True, seed=3)
    (_, first, seen), (_, limp, again), (_, trained, training) = calls
    assert (first.drive, limp.drive, trained.drive) == ("position", "position", "velocity")
    np.testing.assert_array_equal(again.observation, seen.observation)
    for model in (limp, trained):
        assert not np.any(model.bend_damping)
        assert not np.any(model.air_drag)
    assert training == TINY.training
    assert result.settings["within_10_ms"] == {"mppi": 16, "gradient": 0}
    printed = capsys.readouterr().out
    assert "gradient has no place within 0.01 s: one iteration already" in printed
    assert printed.count("not run: it needs the package stable-baselines3") == 2  # and in the table
    assert "palpate[sac]" in result.settings["SAC"]
    names = {row.name for row in result.figures}
    assert {
        "success_rate.policy",
        "time_to_1pct_periods.undamped_policy",
        "success_rate.mppi_10_ms",
        "success_rate.gradient_unhurried",
        "success_rate.policy_same_trials",
        "decision_ms_median.mppi_10_ms",
        "decision_ms_p99.gradient_unhurried",
    } <= names
    assert "success_rate.gradient_10_ms" not in names
    values = {row.name: row.value for row in result.figures}
    assert values["success_rate.sac"] is None
    assert values["simulated_steps.undamped_policy"] == 8 * 128 * 150
    assert all(row.bar is None for row in result.figures)
    write_json(tmp_path / "result.json", result.to_dict())
    read_result(tmp_path / "result.json")
    repeated = rope_rivals.reproduce(tmp_path, quick=True, seed=3)
    assert len(calls) == 3
    assert repeated.figures == result.figures
    with pytest.raises(PalpateError, match="seed was 3, now 4"):
        rope_rivals.reproduce(tmp_path, quick=True, seed=4)
    capsys.readouterr()
    asked = install_sac(monkeypatch)
    more = rope_rivals.reproduce(tmp_path, quick=True, seed=3)
    assert len(calls) == 3  # the other stages stay
    assert asked == [("train-sac", "velocity", TINY.training, rope_rivals.FEW_ROUNDS, 3)]
    values = {row.name: row.value for row in more.figures}
    assert values["success_rate.sac"] == 0.0  # untrained
    assert values["simulated_steps.sac"] == 640
    assert values["training_s.sac"] == 2.0
    assert more.settings["SAC"]["environment_steps"] == 640
    assert "not run" not in capsys.readouterr().out


def install_sac(monkeypatch) -> list[tuple]:
    """Let SAC be there, stood in for; what it is asked for."""
    asked = []

    def trained_actor(path, model, training, sac, seed):
        asked.append((path.name, model.drive, training, sac.rounds, seed))
        return untrained(seed), {"environment_steps": 640, "wall_time_s": 2.0}

    stand_in = SimpleNamespace(
        Sac=lambda rounds: SimpleNamespace(rounds=rounds), trained_actor=trained_actor
    )
    monkeypatch.setitem(sys.modules, "palpate.experiments.rivals.soft_actor_critic", stand_in)
    monkeypatch.setattr(rope_rivals, "sac_installed", lambda: True)
    return asked


def test_a_part_of_the_episodes_keeps_its_failures() -> None:
    energy = np.arange(8.0).reshape(4, 2)
    whole = stabilization.Episodes(energy, -energy, np.zeros((1, 2, 11, 3)), {2: "lost", 3: "too"})
    part = whole.part([0, 2])
    np.testing.assert_array_equal(part.energy, energy[[0, 2]])
    assert part.failures == {1: "lost"}
