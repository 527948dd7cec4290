"""A contract says everything that a stranger has to know."""

import importlib.resources
import json

import numpy as np
import pytest

from deployed import PERIOD, impedance_policy, manifest, rope_policy
from palpate.deployment.contract import check_contract, write_contract
from palpate.deployment.deployment import deployment_of
from palpate.errors import PalpateError
from palpate.networks import load_policy
from palpate.perception.rope.nodes import SMOOTHED
from palpate.perception.velocity import VelocityEstimator


def test_it_says_what_a_stranger_has_to_know(tmp_path):
    policy = rope_policy()
    write_contract(tmp_path / "policy.json", deployment_of(policy, manifest()), "policy.onnx")
    content = json.loads((tmp_path / "policy.json").read_text())
    assert content["file"] == "policy.onnx"
    assert content["rate_hz"] == pytest.approx(100)
    first, second = content["inputs"]["features"]["order"]
    assert (first["name"], first["shape"], first["unit"], first["first"]) == (
        "node position relative to the gripper", [5, 3], "m", 0,
    )  # fmt: skip
    assert (second["unit"], second["first"]) == ("m/s", 15)
    normalisation = content["inputs"]["features"]["normalisation"]
    np.testing.assert_allclose(normalisation["mean"], policy.mean)
    np.testing.assert_allclose(normalisation["scale"], policy.scale)
    assert content["inputs"]["carry"]["shape"] == ["batch", 1, 3]
    assert content["outputs"]["command"]["order"] == [
        {
            "name": "gripper velocity", "shape": [1, 3], "unit": "m/s", "first": 0,
            "limit": 1.5, "rate_limit": 10.0,
        }
    ]  # fmt: skip
    weights = content["velocities"]["weights_per_s"]
    np.testing.assert_allclose(weights, VelocityEstimator(PERIOD).weights)
    assert content["segments"]["smoothed_over_s"] == SMOOTHED
    assert content["trained"]["command"] == "palpate train rope-stabilization"
    assert content["trained"]["model"] == manifest()["model"]


def test_each_channel_has_its_place_unit_and_limits(tmp_path):
    write_contract(tmp_path / "policy.json", deployment_of(impedance_policy(), {}), "policy.onnx")
    content = json.loads((tmp_path / "policy.json").read_text())
    command = content["outputs"]["command"]
    assert command["shape"] == ["batch", 7]
    assert "segments" not in content
    rows = [(row["name"], row["first"], row["limit"]) for row in command["order"]]
    assert rows == [
        ("displacement", 0, 0.05), ("stiffness", 3, 800.0), ("damping ratio", 6, 2.0)
    ]  # fmt: skip


def test_the_policy_that_ships_has_one(tmp_path):
    file = importlib.resources.files("palpate") / "assets" / "rope-stabilization.safetensors"
    deployment = deployment_of(*load_policy(str(file)))
    write_contract(tmp_path / "policy.json", deployment, "policy.onnx")
    content = json.loads((tmp_path / "policy.json").read_text())
    assert content["inputs"]["features"]["shape"] == ["batch", 60]
    assert {row["name"] for row in content["trained"]["model"]} >= {"rest_length", "node_mass"}


def test_other_files_are_told_apart(tmp_path):
    path = tmp_path / "policy.json"
    write_contract(path, deployment_of(rope_policy(), manifest()), "policy.onnx")
    check_contract(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": 1}))
    check_contract(path)  # what an earlier palpate exported may be replaced
    for text in ('{"format": "palpate.model"}', "[1]"):
        path.write_text(text)
        with pytest.raises(PalpateError, match="is no contract: expected the JSON that `palpate"):
            check_contract(path)
