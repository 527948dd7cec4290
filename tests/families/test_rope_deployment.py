"""A rope's policy is fed on a robot as it was in its trials."""

import numpy as np
import pytest

from deployed import PERIOD, impedance_policy, manifest, rope_policy
from palpate.deployment.deployment import deployment_of
from palpate.errors import PalpateError
from palpate.families.rope.counterpart import SEEN_MARKERS
from palpate.families.rope.deployment import RopeDecision
from palpate.tasks.rope import RopeStabilization
from palpate.trials.rope.learned import LearnedController
from palpate.trials.trial import stack_observations
from palpate.worlds.rope.rope import RopeConfiguration, RopeWorld
from small_rope import SMALL


@pytest.mark.parametrize("nodes", [6, 8, 11])
def test_a_rope_world_gets_the_commands_of_the_trials(nodes):
    """The same features as `LearnedController`: nodes, encoder, velocities, closed loop."""
    policy = rope_policy(nodes)
    world = RopeWorld(RopeConfiguration(**SMALL))
    theirs = LearnedController(policy, RopeStabilization())
    ours = RopeDecision(policy, markers=11)
    ours.see({"gripper": np.ones(3), "markers": np.ones((11, 3))})
    ours.forget()  # what was seen before a fault is not part of a velocity
    seen, command = world.reset(0, start="straight"), np.zeros(3, np.float32)
    carry = theirs.initial_carry(np.zeros((1, 3), np.float32))
    for _ in range(100):
        ours.see({"gripper": seen.gripper_position, "markers": seen.markers})
        command = ours.decide(command)
        carry, (expected,) = theirs(carry, stack_observations([seen]), None, None)
        np.testing.assert_allclose(command, expected, atol=1e-5)
        seen = world.step(command)
    assert np.linalg.norm(command) > 0.1


def test_fewer_markers_than_nodes_are_refused():
    with pytest.raises(PalpateError, match="6 nodes need at least as many markers, not 5"):
        RopeDecision(rope_policy(), markers=5)


def test_segments_are_those_of_the_model_shared_out_among_markers():
    deployment = deployment_of(rope_policy(), manifest(), {"markers": 11})
    np.testing.assert_allclose(deployment.segment_lengths(), np.full(10, 0.05))
    uneven = {"name": "rest_length", "value": [0.1, 0.3]}
    deployment = deployment_of(rope_policy(), {**manifest(), "model": [uneven]}, {"markers": 6})
    np.testing.assert_allclose(deployment.segment_lengths(), [0.04, 0.04, 0.08, 0.12, 0.12])


def test_states_have_the_markers_that_were_recorded():
    recorded = {**manifest(), "recordings": {SEEN_MARKERS: 8}}
    assert deployment_of(rope_policy(), manifest()).markers == 6
    assert deployment_of(rope_policy(), recorded).markers == 8
    assert deployment_of(rope_policy(), recorded, {"markers": 11}).markers == 11
    silent = deployment_of(rope_policy(), {**manifest(), "model": []})
    with pytest.raises(PalpateError, match="does not say how long its rope's segments are"):
        silent.check()
    with pytest.raises(PalpateError, match="'marker'; did you mean 'markers'"):
        deployment_of(rope_policy(), manifest(), {"marker": 11})


def test_a_policy_of_something_else_is_refused():
    with pytest.raises(PalpateError, match="expected positions and velocities of a rope's nodes"):
        deployment_of(impedance_policy(), manifest())


def test_the_rate_of_the_small_rope():
    assert RopeConfiguration(**SMALL).control_period == PERIOD
