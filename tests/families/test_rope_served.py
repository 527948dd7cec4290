"""A policy in trials as `palpate serve` runs it."""

import numpy as np
import pytest

from deployed import PERIOD, manifest, rope_policy
from palpate.deployment.onnx_export import write_onnx
from palpate.deployment.supervisor import AT, GOOD
from palpate.errors import PalpateError
from palpate.families.rope.deployment import RopeDeployment
from palpate.families.rope.served import ServedController
from palpate.worlds.rope.rope import RopeObservation

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


@pytest.fixture
def served(tmp_path):
    policy = rope_policy()
    write_onnx(tmp_path / "policy.onnx", policy)
    deployment = RopeDeployment(policy, manifest(), {})
    return ServedController(deployment, tmp_path / "policy.onnx"), deployment


def hanging(aside: float) -> RopeObservation:
    """Two worlds; in the second the rope hangs aside by so much at each marker."""
    markers = np.zeros((2, 6, 3))
    markers[:, :, 2] = -0.1 * np.arange(6)
    markers[1, :, 0] = aside * np.arange(6)
    return RopeObservation(0.0, markers, *np.zeros((3, 2, 3)))


def test_it_watches_first_and_then_begins_softly(served):
    controller, deployment = served
    carry = controller.initial_carry(np.zeros((2, 3)))
    actions = []
    for _ in range(80):
        carry, action = controller(carry, hanging(0.01), None, None)
        actions.append(action)
    speeds = np.linalg.norm(actions, axis=-1)
    waited = round(GOOD * AT / PERIOD)
    assert not speeds[: waited - 1].any()
    assert (speeds[-1] > 0).all()
    limit = deployment.policy.actions[0].rate_limit * PERIOD
    assert speeds[waited].max() < 0.2 * limit  # softly


def test_a_world_that_shows_the_impossible_is_braked_alone(served):
    controller, _ = served
    carry = controller.initial_carry(np.zeros((2, 3)))
    for _ in range(80):
        carry, action = controller(carry, hanging(0.01), None, None)
    for _ in range(40):
        torn = hanging(0.01)
        torn.markers[1, 3] += 1.0
        carry, action = controller(carry, torn, None, None)
    assert action[0].any()
    assert not action[1].any()


def test_a_file_of_another_policy_is_refused(served, tmp_path):
    _, deployment = served
    write_onnx(tmp_path / "other.onnx", rope_policy(11))
    other = ServedController(deployment, tmp_path / "other.onnx")
    with pytest.raises(PalpateError, match="expected what `palpate export` makes of it"):
        other(other.initial_carry(np.zeros((2, 3))), hanging(0.0), None, None)
    gone = ServedController(deployment, tmp_path / "none.onnx")
    with pytest.raises(PalpateError, match=r"none\.onnx cannot decide"):
        gone(gone.initial_carry(np.zeros((2, 3))), hanging(0.0), None, None)


def test_the_deployment_says_how_many_markers_there_are():
    own = RopeDeployment(rope_policy(), manifest(), {"markers": 11})
    assert [channel.shape for channel in own.sensors] == [(3,), (11, 3)]
