"""What cannot be evaluated is refused before anything is tried, in a sentence."""

import jax
import jax.numpy as jnp
import pytest

from palpate.cli import main
from palpate.families.rope.options import EvaluateRopeStabilization
from palpate.models.files import save_model
from palpate.models.rope import Rope
from palpate.networks import Channel, CommandPolicy, save_controller


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


def test_a_policy_of_another_rate_than_the_world(refused):
    assert refused(period=0.02, nodes=6, control_period=0.02) == (
        "a controller that decides every 0.02 s does not fit a world with a control period of "
        "0.01 s: expected one that was trained through a model identified at 100 Hz"
    )


def test_no_rope_to_evaluate(refused):
    assert refused(options="--ropes 0", nodes=6) == "an evaluation has at least one rope, not 0"
