"""A filter in the robot's program: its tank is sent, watched, logged, and its fault brakes."""

import dataclasses
import json

import numpy as np
import pytest

from deployed import PERIOD, actor_file, impedance_policy, manifest, rope_policy
from palpate.commands.serve import limits_of, supervisor_of
from palpate.deployment.contract import write_actor_contract, write_contract
from palpate.deployment.deployment import deployment_of, load_network
from palpate.deployment.messages import StateMessage, encode_state
from palpate.deployment.supervisor import GOOD, Mode
from palpate.deployment.tank import EVERY, RobotFilter, TankLog
from palpate.errors import PalpateError
from palpate.safety.filters import filter_of
from palpate.safety.passivity import PassivityFilter


def toy(name="passivity", tank=1.0):
    deployment = deployment_of(impedance_policy(period=PERIOD), {"task": "a toy"})
    if name:
        deployment.stand_behind(name, tank)
    return deployment


def orders(deployment, levels):
    """What is ordered in each period, where the tank's level is this."""
    supervisor, found = (
        supervisor_of(deployment, limits_of(deployment, [], ["damping ratio=3"])),
        [],
    )
    features = np.random.default_rng(0).normal(size=7).astype(np.float32)
    for step, level in enumerate(levels):
        values = {"features": features, "tank": np.array([level], np.float32)}
        data = encode_state(StateMessage(1, step + 1, PERIOD * step, values))
        found.append(supervisor.tick(PERIOD * step, [(PERIOD * step, data)]))
    return found


@pytest.mark.parametrize(
    ("level", "reason"),
    [(0.04, "the tank holds 0.04 J, below its reserve of 0.05 J"), (np.nan, "no level")],
)
def test_a_robot_whose_filter_does_not_hold_is_braked(level, reason):
    found = orders(toy(), [1.0] * (2 * GOOD) + [level])
    assert found[-2].mode is Mode.RUNNING
    assert found[-1].mode is Mode.BRAKING
    assert reason in found[-1].reason


def test_a_tank_that_only_counts_may_be_empty():
    assert orders(toy("none"), [1.0] * (2 * GOOD) + [-3.0])[-1].mode is Mode.RUNNING


def test_filters_that_cannot_be_are_refused():
    deployment = toy(name=None)
    for tank in (None, 1.0):
        with pytest.raises(PalpateError, match="did you mean 'passivity'"):
            deployment.stand_behind("passive", tank)
    with pytest.raises(PalpateError, match="--tank 1 is that of a filter: give --filter, too"):
        deployment.stand_behind(None, 1.0)
    deployment.stand_behind(None, None)
    assert deployment.filter is None
    with pytest.raises(PalpateError, match="give --tank JOULE"):
        deployment.stand_behind("passivity", None)
    with pytest.raises(PalpateError, match="the filter kinetic-barrier has no tank"):
        deployment.stand_behind("kinetic-barrier", 1.0)
    rope = deployment_of(rope_policy(), manifest())
    with pytest.raises(PalpateError, match="expected one of kinetic-barrier, none, passivity"):
        rope.stand_behind("textbook-valve", 1.0)
    sensors = deployment.sensors
    deployment.stand_behind("kinetic-barrier", None)
    assert deployment.sensors == sensors  # nothing to send
    assert deployment.filter.to_dict() == {"name": "kinetic-barrier", "numbers": {}}


def test_the_contract_has_the_filter(tmp_path):
    rope = deployment_of(rope_policy(), manifest())
    rope.stand_behind("passivity", 1.0)
    assert [channel.name for channel in rope.sensors] == ["gripper", "markers", "tank"]
    file = tmp_path / "policy.json"
    write_contract(file, rope, "policy.onnx")
    told = json.loads(file.read_text())["filter"]
    made = filter_of(told["name"], told["numbers"])
    assert isinstance(made, PassivityFilter)
    assert (made.tank.initial, made.tank.upper, made.fastest) == (1.0, 1.0, 1.5)
    assert "last channel, `tank`" in told["level"]
    write_contract(file, deployment_of(rope_policy(), manifest()), "policy.onnx")
    assert "filter" not in json.loads(file.read_text())


def test_a_policy_that_sees_the_tank_is_sent_it_and_has_the_tank_of_its_training(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    tank = {"initial": 0.6, "upper": 0.6, "flow": 1.5}
    actor_file("passive", energy=tank, options={"method": "passive", "mazes": ["home"]})
    deployment = deployment_of(*load_network("actor.safetensors"))
    assert deployment.filter == RobotFilter("none", {"tank": tank})
    names = [channel.name for channel in deployment.scaling.sensors]
    assert names == ["wrench", "position", "tank"]
    assert deployment.sensors == deployment.scaling.sensors
    deployment.policy = dataclasses.replace(deployment.policy, threshold=1.0)  # no recovery
    decision, actions = deployment.decision(), []
    for level in (0.6, 0.1):
        decision.see({"wrench": np.zeros(6), "position": np.zeros(3), "tank": np.array([level])})
        actions.append(decision.decide(np.zeros(4, np.float32)))
    assert not np.allclose(*actions)
    with pytest.raises(
        PalpateError, match="the policy sees a tank, and the filter kinetic-barrier"
    ):
        deployment.stand_behind("kinetic-barrier", None)
    deployment.stand_behind(None, 0.7)  # of what it has anyway
    assert deployment.filter == RobotFilter("none", {"tank": tank | {"initial": 0.7, "upper": 0.7}})
    deployment.stand_behind("passivity", 0.8)
    assert deployment.filter.tank.initial == 0.8
    assert deployment.filter.tank.flow == 1.5
    assert len(deployment.sensors) == 3
    write_actor_contract(tmp_path / "c.json", deployment.policy, deployment, "policy.onnx")
    content = json.loads((tmp_path / "c.json").read_text())
    assert content["inputs"]["features"]["order"][-1]["name"] == "tank"
    assert content["inputs"]["features"]["normalisation"]["scale"][-1] == 0.6
    assert content["filter"]["numbers"]["tank"]["upper"] == 0.8
    words = deployment.simulated_robot("tcp/127.0.0.1:1", 1.0, 0)
    assert json.loads(words[words.index("--filter") + 1]) == deployment.filter.to_dict()


def test_levels_are_logged_now_and_then_and_the_least_always():
    log = TankLog()
    for step in range(100):
        log(0.01 * step, {"tank": np.array([1.0 if step != 33 else 0.3])})
    assert log.least == 0.3
    assert 10 < len(log.times) <= round(1.0 / EVERY)
    assert log.to_dict()["level_J"] == log.levels
