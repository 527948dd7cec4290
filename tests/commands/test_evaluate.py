"""What a policy is tried in, and what cannot be evaluated: refused before anything is tried."""

import jax
import jax.numpy as jnp
import pytest

from deployed import rope_policy
from palpate.cli import main
from palpate.commands import train
from palpate.families.rope import control_options as rope_options
from palpate.families.rope.control_options import EvaluateRopeStabilization
from palpate.models.files import save_model
from palpate.models.rope import Rope
from palpate.networks import Channel, CommandPolicy, save_controller
from palpate.parameters import describe
from palpate.runs.result import read_result
from palpate.trials.rope import stabilization

pytestmark = pytest.mark.unchecked  # control loops, period by period


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Evaluate a policy for six nodes at some period with the model of a rope; what is said."""
    monkeypatch.chdir(tmp_path)

    def evaluate(*arguments):
        raise AssertionError("evaluated")

    monkeypatch.setattr(EvaluateRopeStabilization, "evaluate", evaluate)

    def refused(period=0.01, action_shape=(1, 3), options="", **rope):
        seen, key = jnp.ones((2, 30)), jax.random.key(0)
        policy = CommandPolicy.create(
            key, seen, Channel("velocity", action_shape, "m/s", 1.5), period=period, width=4
        )
        save_controller("policy.safetensors", policy, {"task": "rope-stabilization"})
        save_model("model.json", Rope.uniform(**rope), {})
        words = "evaluate rope-stabilization --policy policy.safetensors --model model.json "
        assert main((words + options).split()) == 2
        assert not (tmp_path / "runs").exists()  # nothing was begun
        return capsys.readouterr().err.removeprefix("palpate: ").rstrip()

    return refused


@pytest.mark.parametrize(
    ("policy", "model", "has"),
    [
        ({}, {"nodes": 11}, "60 and (1, 3) every 0.01 s"),
        ({}, {"nodes": 6, "control_period": 0.02}, "30 and (1, 3) every 0.02 s"),
        ({"action_shape": (2, 3)}, {"nodes": 6}, "30 and (1, 3) every 0.01 s"),
    ],
)
def test_a_model_that_the_policy_was_not_trained_through(refused, policy, model, has):
    gives = policy.get("action_shape", (1, 3))
    assert refused(**policy, **model) == (
        f"the policy wants 30 features and gives an action of shape {gives} every 0.01 s, the "
        f"model in model.json has {has}: expected the model that the policy was trained through, "
        "or one of its size and rate"
    )


def test_a_model_that_the_task_cannot_have(refused):
    assert "needs a rope driven by velocity at node 0" in refused(nodes=6, driven=(0, 5))


def test_no_rope_to_evaluate(refused):
    assert refused(options="--ropes 0", nodes=6) == "an evaluation has at least one rope, not 0"


@pytest.fixture
def tried(tmp_path, monkeypatch, capsys, short_tuning):
    """Evaluate an untrained policy of 12 markers at 60 Hz, for a moment; (lines, settings)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(stabilization, "TRIAL_PERIODS", 0.2)
    monkeypatch.setattr(rope_options, "RENDERED", 0.1)
    monkeypatch.setattr(train, "EPISODES", 8)
    own = Rope.uniform(length=0.73, mass=0.055, nodes=12, control_period=1 / 60)
    manifest = {
        "task": "rope-stabilization",
        "model": describe(own),
        "recordings": {"file": "own.npz"},
        "training": {"observation_noise": 2e-3},
    }
    save_controller("policy.safetensors", rope_policy(12, period=1 / 60), manifest)
    save_model("model.json", Rope.uniform(length=0.9, nodes=12, control_period=1 / 60), {})

    def tried(options=""):
        words = "evaluate rope-stabilization --policy policy.safetensors --ropes 1 --fresh"
        assert main([*words.split(), "--out", "tried", *options.split()]) == 0
        return capsys.readouterr().out.splitlines(), read_result("tried/result.json").settings

    return tried


def test_ones_own_rope_is_tried_to_the_end(tried):
    lines, settings = tried()
    assert lines[0] == (
        "tried in MuJoCo ropes drawn around that of the model it was trained on: 0.733 m, 55 g, "
        "bending stiffness 0.00066 N m^2, 12 markers at 60 Hz"
    )
    assert lines[1].startswith("controlled")
    assert settings["world.control_period"] == pytest.approx(1 / 60)
    assert settings["world.observation_noise"] == 2e-3


def test_ropes_are_drawn_around_the_model_that_is_named_and_its_figures_are_said(tried):
    lines, settings = tried("--model model.json --mass 0.2")
    assert "around that of the model: 0.905 m, 200 g" in lines[0]
    assert any(line.startswith("success, in the model: ") for line in lines)
    assert settings["world.length"] == pytest.approx(0.9, rel=0.02)
