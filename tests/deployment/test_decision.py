"""The policy in NumPy gives what JAX gives, fed as it was in its trials."""

import numpy as np
import pytest
from jax import numpy as jnp

from deployed import impedance_policy, rope_policy
from palpate.deployment.decision import ChannelDecision, NetworkDecision

POLICIES = {
    "rope": rope_policy,
    "no rate limit": lambda: rope_policy(rate_limit=None),
    "impedance": impedance_policy,
}


@pytest.mark.parametrize("name", POLICIES)
def test_network_in_closed_loop(name):
    policy = POLICIES[name]()
    decide, random = NetworkDecision(policy), np.random.default_rng(0)
    limits = np.repeat([c.bound for c in policy.actions], [c.count for c in policy.actions])
    ours, theirs = np.zeros(len(limits), np.float32), np.zeros(policy.action_shape, np.float32)
    for _ in range(200):
        features = (0.3 * random.normal(size=len(policy.mean)) + 0.1).astype(np.float32)
        ours = decide(features, ours)
        theirs = np.asarray(policy(jnp.asarray(theirs), jnp.asarray(features))[0])
        np.testing.assert_allclose(ours / limits, theirs.reshape(-1) / limits, atol=6e-6)
    assert ours.dtype == np.float32
    assert np.linalg.norm(ours) > 0.1


def test_a_command_is_not_overwritten_by_the_next():
    decide = NetworkDecision(rope_policy(rate_limit=None))
    first = decide(np.ones(30, np.float32), np.zeros(3, np.float32))
    kept = first.copy()
    decide(-np.ones(30, np.float32), first)
    np.testing.assert_array_equal(first, kept)


def test_channels_are_shown_in_their_order():
    policy = rope_policy()
    random = np.random.default_rng(0)
    position, velocity = random.normal(size=(2, 5, 3)).astype(np.float32)
    decision = ChannelDecision(policy)
    names = [channel.name for channel in policy.observations]
    decision.see({"another": np.ones(1), names[1]: velocity, names[0]: position})
    command = np.full(3, 0.1, np.float32)
    features = np.concatenate([position, velocity]).reshape(-1)
    _, expected = policy(jnp.asarray(command[None]), jnp.asarray(features))
    np.testing.assert_allclose(decision.decide(command), expected[0], atol=1e-5)
