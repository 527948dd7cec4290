"""A contract says everything, is read back as it was, and refuses what it is not."""

import dataclasses
import importlib.resources
import json

import numpy as np
import pytest

from deployed import PERIOD, manifest, rope_policy
from palpate.deployment.contract import contract_of, read_contract, write_contract
from palpate.errors import PalpateError
from palpate.networks import load_policy
from palpate.perception.velocity import VelocityEstimator


@pytest.mark.parametrize("changes", [{}, {"rate_limit": None}], ids=["limited", "unlimited"])
def test_round_trip(tmp_path, changes):
    contract = contract_of(rope_policy(**changes), manifest())
    write_contract(tmp_path / "policy.json", contract, "policy.onnx")
    assert read_contract(tmp_path / "policy.json") == contract


def test_it_says_what_a_stranger_has_to_know(tmp_path):
    policy = rope_policy()
    write_contract(tmp_path / "policy.json", contract_of(policy, manifest()), "policy.onnx")
    told = json.loads((tmp_path / "policy.json").read_text())
    assert told["file"] == "policy.onnx"
    assert told["rate_hz"] == pytest.approx(100)
    first, second = told["inputs"]["features"]["order"]
    assert first == {
        "name": "node position relative to the gripper",
        "shape": [5, 3],
        "unit": "m",
        "first": 0,
    }
    assert (second["unit"], second["first"]) == ("m/s", 15)
    normalisation = told["inputs"]["features"]["normalisation"]
    np.testing.assert_allclose(normalisation["mean"], policy.mean)
    np.testing.assert_allclose(normalisation["scale"], policy.scale)
    assert told["inputs"]["carry"]["shape"] == ["batch", 1, 3]
    assert told["outputs"]["command"]["name"] == "gripper velocity"
    assert told["outputs"]["command"]["unit"] == "m/s"
    assert told["limits"]["command"] == 1.5
    assert told["limits"]["command_per_s"] == 10.0
    weights = told["velocities"]["weights_per_s"]
    np.testing.assert_allclose(weights, VelocityEstimator(PERIOD).weights)
    assert told["trained"]["command"] == "palpate train rope-stabilization"
    assert told["trained"]["model"] == manifest()["model"]


def test_the_policy_that_ships_has_one(tmp_path):
    file = importlib.resources.files("palpate") / "assets" / "rope-stabilization.safetensors"
    contract = contract_of(*load_policy(str(file)))
    assert sum(block.count for block in contract.features) == 60
    assert {row["name"] for row in contract.trained["model"]} >= {"rest_length", "node_mass"}
    write_contract(tmp_path / "policy.json", contract, "policy.onnx")
    assert read_contract(tmp_path / "policy.json") == contract


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "policy.json"
    contract = contract_of(rope_policy(), manifest())
    write_contract(path, contract, "policy.onnx")
    told = json.loads(path.read_text())
    for changed, sentence in (
        ({"format": "palpate.model"}, "is no contract: expected the JSON that `palpate export`"),
        ({"version": 2}, "has version 2; this palpate reads version 1"),
        ({"limits": {}}, "is damaged: KeyError('command')"),
        ({"inputs": []}, "is damaged"),
    ):
        path.write_text(json.dumps(told | changed))
        with pytest.raises(PalpateError, match=r"policy.json") as refused:
            read_contract(path)
        assert sentence in str(refused.value)
    path.write_text("[1]")
    with pytest.raises(PalpateError, match="is no contract"):
        read_contract(path)


def test_the_rate_is_that_of_the_policy():
    slow = contract_of(dataclasses.replace(rope_policy(), period=0.05), manifest())
    assert slow.rate == pytest.approx(20)
