"""The policy in NumPy gives what JAX gives, fed as it was in its trials."""

import numpy as np
import pytest
from jax import numpy as jnp

from deployed import PERIOD, manifest, rope_policy
from palpate.deployment.contract import contract_of
from palpate.deployment.decision import NetworkDecision, RopeDecision, segment_lengths
from palpate.errors import PalpateError
from palpate.tasks.rope import RopeStabilization
from palpate.trials.rope.trials import LearnedController, Seen
from palpate.worlds.rope.rope import RopeConfiguration, RopeWorld
from small_rope import SMALL


@pytest.mark.parametrize("rate_limit", [10.0, None])
def test_network_in_closed_loop(rate_limit):
    policy = rope_policy(rate_limit=rate_limit)
    decide, random = NetworkDecision(policy), np.random.default_rng(0)
    ours = theirs = np.zeros((1, 3), np.float32)
    for _ in range(200):
        features = (0.3 * random.normal(size=30) + 0.1).astype(np.float32)
        ours = decide(features, ours)
        theirs = np.asarray(policy(jnp.asarray(theirs), jnp.asarray(features))[0])
        np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert ours.dtype == np.float32
    assert np.linalg.norm(ours) > 0.1


def test_a_command_is_not_overwritten_by_the_next():
    decide = NetworkDecision(rope_policy(rate_limit=None))
    first = decide(np.ones(30, np.float32), np.zeros((1, 3), np.float32))
    kept = first.copy()
    decide(-np.ones(30, np.float32), first)
    np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("nodes", [6, 11])
def test_a_rope_world_gets_the_commands_of_the_trials(nodes):
    """The same features as `LearnedController`: thinning, encoder, velocities, closed loop."""
    policy = rope_policy(nodes)
    world = RopeWorld(RopeConfiguration(**SMALL))
    theirs = LearnedController(policy, RopeStabilization())
    ours = RopeDecision(policy, contract_of(policy, manifest(nodes)), markers=11)
    ours.see(np.ones(3), np.ones((11, 3)))
    ours.forget()  # what was seen before a fault is not part of a velocity
    seen, command = world.reset(0, start="straight"), np.zeros(3, np.float32)
    theirs.begin(Seen(seen.markers[None], seen.gripper_position[None]))
    for _ in range(100):
        ours.see(seen.gripper_position, seen.markers)
        command = ours.decide(command)
        expected = theirs.command(Seen(seen.markers[None], seen.gripper_position[None]))[0]
        np.testing.assert_allclose(command, expected, atol=1e-5)
        seen = world.step(command)
    assert np.linalg.norm(command) > 0.1


def test_markers_that_no_nodes_fall_on_are_refused():
    policy = rope_policy()
    with pytest.raises(PalpateError) as refused:
        RopeDecision(policy, contract_of(policy, manifest()), markers=8)
    assert str(refused.value) == (
        "a policy for 6 nodes needs a multiple of 5 markers and one more, not 8"
    )


def test_segments_are_those_of_the_model_shared_out_among_markers():
    contract = contract_of(rope_policy(), manifest())
    np.testing.assert_allclose(segment_lengths(contract, 11), np.full(10, 0.05))
    silent = contract_of(rope_policy(), {**manifest(), "model": []})
    with pytest.raises(PalpateError, match="does not say how long its rope's segments are"):
        segment_lengths(silent, 11)


def test_the_rate_of_the_small_rope():
    assert RopeConfiguration(**SMALL).control_period == PERIOD
