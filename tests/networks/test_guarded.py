"""Actors as controllers: what is risky or not a number is not done, and files give them back."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.networks import Channel, load_controller, save_controller
from palpate.networks.actor import DeterministicActor, GaussianActor
from palpate.networks.guarded import ActorPolicy, GuardedPolicy, untrained_guard

SEEN = (Channel("wrench", (6,), "N"), Channel("position", (3,), "m"))
DONE = (Channel("displacement", (2, 1), "", 1.0), Channel("stiffness", (2, 1), "", 1.0))
KEYS = jax.random.split(jax.random.key(0), 3)
OBSERVATION = jax.random.normal(KEYS[2], (7, 9))


def actor() -> ActorPolicy:
    network = DeterministicActor.create(KEYS[0], 9, 4, 16, 2)
    return ActorPolicy(actor=network, observations=SEEN, actions=DONE, period=0.1)


def guarded(threshold: float = 0.5) -> GuardedPolicy:
    guard = untrained_guard(KEYS[1], 6, 4, (16, 16, 16), tuple(range(6)))
    network = GaussianActor.create(KEYS[0], 9, 4, 16, 2)
    return GuardedPolicy(
        actor=network,
        observations=SEEN,
        actions=DONE,
        period=0.1,
        guard=guard,
        threshold=threshold,
    )


def test_what_is_risky_is_recovered_and_nothing_else() -> None:
    policy = guarded()
    proposed = policy.propose(OBSERVATION)
    risk = np.asarray(policy.risk(OBSERVATION, proposed))
    policy = guarded(float(np.median(risk)))
    executed = policy(None, OBSERVATION)[1]
    risky = risk > np.median(risk)
    assert risky.sum() == 3
    np.testing.assert_array_equal(executed[~risky], proposed[~risky])
    np.testing.assert_array_equal(executed[risky], policy.guard.recover(OBSERVATION)[risky])
    position = OBSERVATION.at[:, 6:].set(9.0)  # the guard does not see it
    np.testing.assert_array_equal(policy.risk(position, proposed), risk)
    one = policy(None, OBSERVATION[0])[1]
    np.testing.assert_allclose(one, executed[0], atol=1e-6)


@pytest.mark.parametrize("place", [0, 7])
def test_a_sensor_that_drops_out_ends_in_no_action(place: int) -> None:
    broken = OBSERVATION.at[0, place].set(jnp.nan)
    policy = guarded()
    executed = policy(None, broken)[1]
    if place < 6:  # the recovery sees it too
        assert (executed[0] == 0.0).all()
    assert jnp.isfinite(executed).all()
    assert (actor()(None, broken)[1][0] == 0.0).all()


def test_an_action_that_is_not_a_number_is_as_risky_as_can_be() -> None:
    policy = guarded(0.999)
    last = lambda policy: policy.actor.network.biases[-1]  # noqa: E731
    spoilt = eqx.tree_at(last, policy, jnp.full(8, jnp.nan))
    assert (spoilt.risk(OBSERVATION, spoilt.propose(OBSERVATION)) == 1.0).all()
    recovered = policy.guard.recover(OBSERVATION)
    np.testing.assert_array_equal(spoilt(None, OBSERVATION)[1], recovered)
    unguarded = dataclasses.replace(spoilt, threshold=1.0)  # no risk is above it
    assert (unguarded(None, OBSERVATION)[1] == 0.0).all()


@pytest.mark.parametrize("policy", [actor(), guarded()], ids=["actor", "guarded"])
def test_policies_come_back_from_their_files(policy, tmp_path) -> None:
    path = tmp_path / "policy.safetensors"
    save_controller(path, policy, {"task": "a task"})
    loaded, manifest = load_controller(path)
    assert manifest["task"] == "a task"
    assert eqx.tree_equal(loaded, policy)
    np.testing.assert_array_equal(loaded(None, OBSERVATION)[1], policy(None, OBSERVATION)[1])
