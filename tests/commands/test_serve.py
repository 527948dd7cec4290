"""`palpate serve`: what is refused, and a short service with nobody there."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest

from deployed import PERIOD, actor_file, impedance_policy, manifest, rope_policy
from palpate.cli import main
from palpate.commands.serve import fault_of, free_endpoint, limits_of, supervisor_of
from palpate.deployment.decision import ReflexDecision
from palpate.deployment.deployment import deployment_of, load_network
from palpate.deployment.loop import Record
from palpate.deployment.messages import StateMessage, encode_state
from palpate.deployment.supervisor import GOOD, Mode
from palpate.families.rope.deployment import RopeDeployment
from palpate.models.rope import Rope
from palpate.networks import load_policy, save_controller
from palpate.parameters import describe
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
    assert refused("--limit 2") == (
        "--limit 2 is above the 1.5 that the policy was trained with: give that, or less"
    )
    assert "--rate-limit 11 is above the 10" in refused("--rate-limit 11")
    assert refused("", rate_limit=None) == (
        "the gripper velocity has no limit of its rate, and without one nothing can brake: give "
        "--rate-limit"
    )
    assert refused("--limit 0") == ("a limit of the gripper velocity is greater than 0, not 0.0")
    assert refused("--rows markers=5") == "6 nodes need at least as many markers, not 5"
    assert "did you mean 'gripper velocity'" in refused("--limit gripper-velocity=1")
    assert refused("--rows 8") == "--rows 8 is not NAME=NUMBER"
    assert "--rows markers=8.5 is not NAME=NUMBER" in refused("--rows markers=8.5")
    assert "'marker'; did you mean 'markers'" in refused("--rows marker=11")
    assert "expected no --rows" in refused("--rows markers=11", {"task": "cart-to-origin"})
    assert "no family brings a simulated robot for 'cart-to-origin'" in refused(
        "--simulate", {"task": "cart-to-origin"}
    )
    assert "does not say how long its rope's segments are" in refused("", {"model": []})
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
    assert "\ntimes it braked: 0\n" in said
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


def test_a_policy_of_no_family_is_served_by_its_declared_channels(tmp_path):
    """Stiffness in N/m and metres: from the file to orders within the limits of each channel."""
    save_controller("policy.safetensors", impedance_policy(period=PERIOD), {"task": "a toy"})
    policy, manifest = load_policy("policy.safetensors")
    deployment = deployment_of(policy, manifest)
    limits = limits_of(deployment, ["displacement=0.02"], ["damping ratio=3"])
    supervisor = supervisor_of(deployment, limits)
    assert [channel.name for channel in deployment.sensors] == ["features"]
    random, actions = np.random.default_rng(0), []
    for step in range(2 * GOOD):
        values = {"features": random.normal(size=7).astype(np.float32)}
        data = encode_state(StateMessage(1, step + 1, PERIOD * step, values))
        now = PERIOD * step
        order = supervisor.tick(now, [(now, data)])
        actions.append(order.action)
    assert order.mode is Mode.RUNNING
    actions = np.array(actions)
    assert 0 < np.linalg.norm(actions[:, :3], axis=1).max() <= 0.02 * (1 + 1e-6)
    assert 1 < np.abs(actions[:, 3:6]).max() <= 800.0
    assert np.abs(np.diff(actions[:, 6])).max() <= 3 * PERIOD * (1 + 1e-4)
    values["features"][3] = np.nan
    bad = encode_state(StateMessage(1, step + 2, now + PERIOD, values))
    order = supervisor.tick(now + PERIOD, [(now + PERIOD, bad)])
    assert order.mode is Mode.BRAKING
    assert order.reason == "the features has no value"
    wrong = encode_state(StateMessage(1, 1, 0.0, {"features": np.zeros(6, np.float32)}))
    order = supervisor_of(deployment, limits).tick(0.0, [(0.0, wrong)])
    assert order.reason == "6 features where 7 were agreed"


def test_an_actor_is_served_in_the_robots_units_and_rests_without_eyes():
    policy = actor_file()
    deployment = deployment_of(*load_network("actor.safetensors"))
    supervisor = supervisor_of(deployment, limits_of(deployment, ["stiffness=600"], []))
    random, actions = np.random.default_rng(0), []
    for step in range(30):
        features = random.normal(size=9).astype(np.float32)
        wrench, position = 20.0 * features[:6] * [1, 1, 1, 0.05, 0.05, 0.05], 0.01 * features[6:]
        values = {"wrench": wrench, "position": position}
        order = supervisor.tick(0.1 * step, [(0.1 * step, _state(step, values))])
        actions.append(order.action)
        if order.mode is Mode.WAITING:
            np.testing.assert_array_equal(order.action, [0, 0, 50, 50])
    assert order.mode is Mode.RUNNING
    seen = np.concatenate([features[:6], position / np.float32(0.3)])
    wanted = deployment.scaling.command(np.asarray(policy(None, jnp.asarray(seen))[1]))
    np.testing.assert_allclose(order.action[:2], wanted[:2], atol=1e-6)
    np.testing.assert_allclose(order.action[2:], np.minimum(wanted[2:], 650.0), rtol=1e-4)
    assert np.linalg.norm(np.array(actions)[:, :2], axis=1).max() <= 0.02 * (1 + 1e-6)
    values["wrench"] = np.full(6, np.nan)
    order = supervisor.tick(3.0, [(3.0, _state(30, values))])
    assert (order.mode, order.reason) == (Mode.STOPPED, "the wrench has no value")
    np.testing.assert_array_equal(order.action, [0, 0, 50, 50])


def test_a_reflex_is_served_as_often_as_it_may_interrupt():
    policy = actor_file("bresa")
    deployment = deployment_of(*load_network("actor.safetensors"))
    assert deployment.period == pytest.approx(0.01)
    assert isinstance(deployment.decision(), ReflexDecision)
    random, under_way = np.random.default_rng(0), np.zeros(4)
    some = jnp.asarray(random.normal(size=(99, 9)), jnp.float32)
    often = float(np.quantile(policy.risk(some, policy.propose(some)), 0.7))
    policy = dataclasses.replace(policy, threshold=often)
    decision, scale = ReflexDecision(policy, deployment.scaling, 10), deployment.scaling.scale
    held = interrupted = 0
    for step in range(200):
        features = random.normal(size=9).astype(np.float32)
        decision.see({"wrench": scale[:6] * features[:6], "position": scale[6:] * features[6:]})
        seen = jnp.asarray(features)
        if step % 10 == 0:
            under_way = np.asarray(policy.propose(seen))
        risky = float(policy.risk(seen, jnp.asarray(under_way))) > policy.threshold
        if risky:
            under_way = np.asarray(policy.guard.recover(seen))
        given = decision.decide(np.zeros(4, np.float32))
        expected = deployment.scaling.command(under_way)
        np.testing.assert_allclose(given, expected, rtol=1e-3, atol=1e-4)
        assert decision.holds == (step % 10 != 0 and not risky)
        held, interrupted = held + decision.holds, interrupted + (risky and step % 10 != 0)
    assert min(held, interrupted) > 10
    decision.see({"wrench": np.full(6, np.nan), "position": np.zeros(3)})
    assert not np.isfinite(decision.decide(np.zeros(4, np.float32))).any()


def _state(step, values):
    return encode_state(StateMessage(1, step + 1, 0.1 * step, values))


def own_policy():
    """Of 12 markers at 60 Hz, on a rope of 0.73 m; it acts at random."""
    own = Rope.uniform(length=0.73, mass=0.055, nodes=12, control_period=1 / 60)
    told = {"model": describe(own), "recordings": {"file": "own.npz"}}
    save_controller("policy.safetensors", rope_policy(12, period=1 / 60), manifest() | told)


def test_one_interrupt_ends_the_loop_and_the_simulated_robot(tmp_path):
    """Ones own rope is served; both processes are gone soon after a signal to the first."""
    pytest.importorskip("zenoh")
    own_policy()
    words = "-m palpate serve policy.safetensors --simulate --seconds 40 --out served"
    # Where the tests run in the background their shell has them ignore it, and all they start.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    loop = subprocess.Popen([sys.executable, *words.split()], stdout=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, before)
    try:
        assert loop.stdout is not None
        said = []
        while not said or not said[-1].startswith("running"):
            said.append(loop.stdout.readline())
            assert said[-1], said
        (robot,) = _children(loop.pid)
        began = time.monotonic()
        loop.send_signal(signal.SIGINT)
        rest = loop.communicate(timeout=30)[0]
        assert time.monotonic() - began < 4.0  # 2 s, and as much for a busy machine
        assert loop.returncode == 0
        assert "stopped: asked to stop" in rest
        assert not os.path.exists(f"/proc/{robot}")
    finally:
        loop.kill()


def _children(process: int) -> list[int]:
    with open(f"/proc/{process}/task/{process}/children", encoding="ascii") as file:
        return [int(word) for word in file.read().split()]


def test_a_rope_that_cannot_be_stops_the_policy_and_the_command_says_so(monkeypatch, capsys):
    pytest.importorskip("zenoh")
    own_policy()
    usual = RopeDeployment.simulated_robot

    def another(self, endpoint, seconds, seed):  # the same points on a rope of 1 m
        words = usual(self, endpoint, seconds, seed)
        place = words.index("--rope") + 1
        words[place] = json.dumps({**json.loads(words[place]), "length": 1.2})
        return words

    monkeypatch.setattr(RopeDeployment, "simulated_robot", another)
    began = time.monotonic()
    words = "serve policy.safetensors --simulate --seconds 1 --out served"
    assert main(words.split()) == 3
    assert time.monotonic() - began < 60
    said = capsys.readouterr().err
    assert said.startswith("palpate: the policy was stopped and did not go on: ")
    assert "m apart" in said
    assert (read_result("served/result.json")).figures  # all is written down


@pytest.mark.parametrize(
    ("events", "fault"),
    [
        ([], ""),
        ([(Mode.WAITING, "no state has come yet"), (Mode.STOPPED, "asked to stop")], ""),
        ([(Mode.RUNNING, ""), (Mode.BRAKING, "asked to stop")], ""),
        ([(Mode.RUNNING, ""), (Mode.STOPPED, "no state for 23 ms")], ""),
        ([(Mode.RUNNING, ""), (Mode.BRAKING, "marker 3 jumped")], "marker 3 jumped"),
        ([(Mode.WAITING, "marker 3 jumped"), (Mode.STOPPED, "asked to stop")], "marker 3 jumped"),
        ([(Mode.STOPPED, "marker 3 jumped"), (Mode.RUNNING, "")], ""),
    ],
)
def test_what_kept_a_policy_from_going_on(events, fault):
    assert fault_of(Record(events=[(0.0, *event) for event in events])) == fault
