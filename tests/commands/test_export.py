"""`palpate export`: a file, a contract beside it, and sentences when it cannot be."""

import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from deployed import actor_file, manifest, rope_policy
from palpate.cli import main
from palpate.commands import export
from palpate.networks import save_controller
from palpate.runs.result import read_result

runtime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")


@pytest.fixture(autouse=True)
def policy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    policy = rope_policy()
    save_controller("policy.safetensors", policy, manifest())
    return policy


def refused(words, capsys):
    assert main(["export", *words.split()]) == 2
    return capsys.readouterr().err.removeprefix("palpate: ").rstrip()


def test_export_and_again(policy, tmp_path, capsys):
    for _ in range(2):  # the second time over the first
        assert main(["export", "policy.safetensors", "--onnx", "out/rope.onnx"]) == 0
    assert "policy: out/rope.onnx (commands differ by at most" in capsys.readouterr().out
    (action,) = json.loads((tmp_path / "out/rope.json").read_text())["outputs"]["command"]["order"]
    assert (action["name"], action["limit"]) == ("gripper velocity", 1.5)
    session = runtime.InferenceSession("out/rope.onnx")
    carry = np.zeros((1, 1, 3), np.float32)
    features = np.ones((1, 30), np.float32)
    (command,) = session.run(["command"], {"features": features, "carry": carry})
    expected, _ = policy(jnp.asarray(carry[0]), jnp.asarray(features[0]))
    np.testing.assert_allclose(command[0], expected, atol=1e-5)
    result = read_result(tmp_path / "runs/export-001/result.json")
    assert result.figures[0].name == "onnx_difference"
    assert result.figures[0].met


@pytest.mark.parametrize(
    ("method", "stiffness"), [("bresa", (50.0, 1000.0)), ("k300", (300.0,) * 2)]
)
def test_an_actor_with_its_reflex_and_the_constants_of_its_training(method, stiffness, capsys):
    actor_file(method)
    assert main(["export", "actor.safetensors", "--onnx", "out/tip.onnx"]) == 0
    contract = json.loads(Path("out/tip.json").read_text())
    command = contract["outputs"]["command"]
    assert [row["name"] for row in command["order"]] == ["displacement", "stiffness"]
    assert (command["high"][0], command["rest"]) == (0.02, [0.0, 0.0, 50.0, 50.0])
    assert (command["low"][2], command["high"][3]) == stiffness
    assert contract["inputs"]["features"]["normalisation"]["scale"][0] == 20.0
    assert Path("out/tip.reflex.onnx").exists() == ("reflex" in contract) == (method == "bresa")
    if method == "bresa":
        assert contract["reflex"]["file"] == "tip.reflex.onnx"
        assert (contract["reflex"]["period_s"], contract["reflex"]["pace"]) == (0.001, 10)
        assert contract["guard"]["threshold"] == 0.5


def test_actors_that_cannot_be_connected(capsys):
    actor_file("self-tuning")
    assert "method self-tuning chooses no stiffness" in refused(
        "actor.safetensors --onnx a.onnx", capsys
    )
    actor_file("srl-vic", constants={})
    sentence = refused("actor.safetensors --onnx a.onnx", capsys)
    assert sentence.startswith("the policy does not say its constant task.force_limit")


def test_sentences(capsys, tmp_path, monkeypatch):
    words = "policy.safetensors --onnx"
    assert refused(f"{words} a.tflite", capsys) == "--onnx a.tflite has to end in .onnx"
    (tmp_path / "model.json").write_text('{"format": "palpate.model"}')
    assert refused(f"{words} model.onnx", capsys) == (
        "model.json, where the contract would go, holds something else: give another --onnx"
    )
    assert not (tmp_path / "runs").exists()
    assert "there is no file other.safetensors" in refused(
        "other.safetensors --onnx a.onnx", capsys
    )
    assert "--onnx FILE is missing" in refused("policy.safetensors", capsys)
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert "pip install 'palpate[deploy]'" in refused(f"{words} a.onnx", capsys)


def test_a_file_that_does_not_agree_is_not_handed_over(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "difference", lambda *given: 2e-5)
    sentence = refused("policy.safetensors --onnx a.onnx", capsys)
    assert "gives commands that differ from the policy's by 2e-05 of their limits" in sentence
    assert not (tmp_path / "a.onnx").exists()
    assert not (tmp_path / "a.json").exists()
