"""`palpate serve`: what is refused, and a short service with nobody there."""

import json
import sys

import pytest

from deployed import manifest, rope_policy
from palpate.cli import main
from palpate.commands.serve import free_endpoint
from palpate.networks import save_controller
from palpate.runs.result import read_result


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def refused(capsys):
    def refused(words, told=None, **changes):
        save_controller("policy.safetensors", rope_policy(**changes), manifest() | (told or {}))
        assert main(["serve", "policy.safetensors", *words.split()]) == 2
        return capsys.readouterr().err.removeprefix("palpate: ").rstrip()

    return refused


def test_sentences(refused, tmp_path, monkeypatch):
    assert refused("--speed-limit 2") == (
        "--speed-limit 2 is above the 1.5 that the policy was trained with: give that, or less"
    )
    assert "--acceleration-limit 11 is above the 10" in refused("--acceleration-limit 11")
    assert refused("", rate_limit=None) == (
        "the policy has no limit of acceleration, and without one nothing can brake: give "
        "--acceleration-limit"
    )
    assert refused("--speed-limit 0") == "a limit of speed is greater than 0, not 0.0"
    assert refused("--markers 8") == (
        "a policy for 6 nodes needs a multiple of 5 markers and one more, not 8"
    )
    assert refused("", {"task": "cart-to-origin"}) == (
        "the policy is for 'cart-to-origin' and `palpate serve` knows the features of "
        "rope-stabilization alone; `palpate export` writes any policy for a loop of your own"
    )
    assert "does not say how long its rope's segments are" in refused("", {"model": []})
    assert "servo every 0.002 s: expected a whole number" in refused("--simulate", period=0.015)
    assert not (tmp_path / "runs").exists()
    monkeypatch.setitem(sys.modules, "zenoh", None)
    assert "pip install 'palpate[zenoh]'" in refused("")


def test_with_nobody_there_it_waits_and_says_how_it_went(tmp_path, capsys):
    pytest.importorskip("zenoh")
    save_controller("policy.safetensors", rope_policy(), manifest())
    words = ["serve", "policy.safetensors", "--seconds", "0.3", "--listen", free_endpoint()]
    assert main([*words, "--out", "served"]) == 0
    said = capsys.readouterr().out
    assert "waiting: no state has come yet\n" in said
    assert "stopped: asked to stop\n" in said
    result = read_result(tmp_path / "served/result.json")
    assert {figure.name for figure in result.figures} == {
        "late_over_1ms", "decision_p99_ms", "turnaround_p99_ms", "brakes",
    }  # fmt: skip
    kept = json.loads((tmp_path / "served/latency.json").read_text())
    assert kept["lateness"]["count"] > 1
    assert kept["decisions"] == {"count": 0, "bins_ms": []}  # the policy never ran
    assert sum(count for _, count in kept["lateness"]["bins_ms"]) == kept["lateness"]["count"]
    assert main([*words, "--out", "served"]) == 2
    assert "served holds the record of an earlier `palpate serve`" in capsys.readouterr().err
    assert main([*words, "--out", "served", "--fresh"]) == 0
