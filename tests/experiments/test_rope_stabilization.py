"""The stages of the experiments on a small rope; identification and training are stood in for."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.experiments.rope import ablation as rope_ablation
from palpate.experiments.rope import nominal
from palpate.experiments.rope import stabilization as rope_stabilization
from palpate.experiments.rope.nominal import Size, shipped_policy
from palpate.learning import Training
from palpate.models.rope import Rope
from palpate.networks import CommandPolicy, save_controller
from palpate.report.evidence import read_evidence
from palpate.runs.result import read_result
from palpate.runs.storage import write_json
from palpate.trials.rope import stabilization
from palpate.worlds.rope.rope import START_POSES, RopeConfiguration
from small_rope import SMALL, VELOCITY

TINY = Size(2, (1, 1, 1), Training(iterations=8, width=4), 1, dict.fromkeys(
    ("recording", "identification", "training", "evaluation"), 1
))  # fmt: skip


@pytest.fixture
def calls(monkeypatch):
    """Everything small, and what was asked of identification and training, in order."""
    made = []

    def identify(start, aligned, settings, run):
        made.append(("identify", start, aligned))
        return start

    def train(task, model, training, seed, run):
        made.append(("train", model, training))
        return untrained(6 * (model.nodes - 1), seed)

    monkeypatch.setattr(nominal, "BASE", RopeConfiguration(**SMALL))
    monkeypatch.setattr(nominal, "QUICK", TINY)
    monkeypatch.setattr(nominal, "FULL", TINY)
    monkeypatch.setattr(nominal, "NODES", 6)
    monkeypatch.setattr(nominal, "RECORDED_DURATION", 0.2)
    monkeypatch.setattr(nominal, "identify", identify)
    monkeypatch.setattr("palpate.commands.train.train", train)
    monkeypatch.setattr(rope_stabilization, "_energy_left_when_still", lambda *_: figure())
    monkeypatch.setattr(stabilization, "TRIAL_PERIODS", 0.05)
    return made


def figure():
    return rope_stabilization.Figure("least_energy_after_3_periods.held_still", 0.5, "")


def untrained(features: int, seed: int) -> CommandPolicy:
    seen = jnp.ones((2, features))
    key = jax.random.key(seed)
    return CommandPolicy.create(key, seen, VELOCITY, period=0.01, width=4)


def test_stages_hand_on_what_they_made(calls, tmp_path):
    result = rope_stabilization.reproduce(tmp_path, quick=True, seed=3)
    (_, start, aligned), (_, model, training) = calls
    assert aligned.observation.shape == (2, 21, 6, 3)  # every second of 11 markers
    assert aligned.action.shape == (2, 20, 1, 3)
    assert (start.drive, start.nodes) == ("position", 6)
    assert isinstance(model, Rope)
    assert (model.drive, model.driven) == ("velocity", (0,))
    assert float(jnp.sum(model.node_mass)) == pytest.approx(0.1)
    assert training == TINY.training
    assert {"success_rate", "time_to_1pct_periods", "time_to_1pct_s"} <= {
        row.name for row in result.figures
    }
    assert {row.name: row.bar for row in result.figures if row.bar is not None} == {
        "success_rate": 0.99,
        "time_to_1pct_periods": 0.9,
    }
    write_json(tmp_path / "result.json", result.to_dict())
    read_result(tmp_path / "result.json")
    evidence = read_evidence(tmp_path / "evaluate")
    assert [motion.group for motion in evidence.motions] == list(START_POSES)
    assert "energy" in evidence.pieces
    assert set(evidence.pieces["energy"].values) == {"controlled", "held still", "swing damper"}


def test_finished_stages_are_not_done_again(calls, tmp_path, monkeypatch):
    first = rope_stabilization.reproduce(tmp_path, quick=True)
    assert len(calls) == 2
    monkeypatch.setattr(nominal, "record_rope", None)
    monkeypatch.setattr("palpate.trials.trial.run_trials", None)
    second = rope_stabilization.reproduce(tmp_path, quick=True)
    assert len(calls) == 2
    assert second.figures == first.figures
    assert second.wall_time_s == first.wall_time_s


def test_another_seed_does_not_go_on_with_this_one(calls, tmp_path):
    rope_stabilization.reproduce(tmp_path, quick=True)
    with pytest.raises(PalpateError, match="seed was 0, now 1"):
        rope_stabilization.reproduce(tmp_path, quick=True, seed=1)


def test_shipped_weights_are_only_evaluated(calls, tmp_path, monkeypatch):
    save_controller(
        tmp_path / "policy.safetensors", untrained(30, 0), {"task": "rope-stabilization"}
    )
    monkeypatch.setattr(nominal.resources, "files", lambda _: tmp_path)
    monkeypatch.setattr(nominal, "SHIPPED", "policy.safetensors")
    result = rope_stabilization.reproduce(tmp_path / "out", quick=True, weights="shipped")
    assert calls == []
    assert result.settings["weights"] == "shipped"
    assert "shipped" in result.split["trained"]


def test_missing_shipped_weights_are_named(monkeypatch):
    monkeypatch.setattr(nominal, "SHIPPED", "assets/nothing.safetensors")
    with pytest.raises(PalpateError, match=r"no assets/nothing\.safetensors.*without --weights"):
        shipped_policy()


def test_ablations_differ_in_one_switch_at_equal_budget(calls, tmp_path):
    result = rope_ablation.reproduce(tmp_path, quick=True)
    trainings = [call[2] for call in calls if call[0] == "train"]
    full = dataclasses.replace(TINY.training, iterations=2)
    assert trainings == [full] + [
        dataclasses.replace(full, **{switch: False})
        for switch in ("horizon_curriculum", "noise_curriculum", "randomisation", "augmentation")
    ]
    names = {row.name for row in result.figures}
    assert {"success_rate.full", "time_to_1pct_periods.no_randomisation"} <= names
    assert all(row.bar is None for row in result.figures)
    picture = (tmp_path / "evaluate" / "ablation.png").read_bytes()
    assert picture.startswith(b"\x89PNG")


def test_rope_held_still_is_looked_at_after_three_periods():
    trials = stabilization.evaluation_trials(RopeConfiguration(**SMALL), 1, 0)
    after = int(np.floor(3 * trials[0].period / 0.01))
    energy = np.full((4, after + 5), 0.25)
    energy[:, 0] = 0.5
    energy[2, after] = 0.05
    energy[3, after + 1] = 0.01
    episodes = stabilization.Episodes(energy, energy, np.zeros((4, 1, 11, 3)), {})
    assert rope_stabilization._energy_left_when_still(trials, episodes).value == pytest.approx(0.1)
