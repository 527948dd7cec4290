"""Where open-loop predictions begin: what is at rest begins in the model's own balance."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.experiments.rope.posterior import hanging, nominal
from palpate.identification.data.prediction import initial_states
from palpate.identification.data.segments import cut, known_start
from palpate.parameters import with_values
from palpate.recordings import Aligned

NOISE = 2.4e-4  # m, of the mean of seventeen frames


@pytest.fixture(scope="module")
def rope():
    """Nearly as stiff as its time step allows, and hardly damped."""
    stiffness, damping = jnp.full(4, 3880.0), jnp.full(4, 0.053)
    return with_values(
        nominal(), {"stretch_stiffness": stiffness, "stretch_damping": damping}
    ).constrain()


def pieces(pose, relaxation=8):
    """Pieces of a gripper that stands still, from these poses at rest."""
    pose = jnp.asarray(pose, jnp.float32)
    still, none = jnp.zeros((len(pose), 4, 1, 3)), jnp.zeros((len(pose), 4, *pose.shape[1:]))
    segments = known_start(pose, jnp.zeros_like(pose), still, none)
    return dataclasses.replace(segments, relaxation=relaxation)


def test_a_pose_that_is_off_by_noise_comes_to_its_balance_where_the_rope_is_stiff(rope):
    balance = hanging(rope)
    noise = NOISE * np.random.default_rng(0).standard_normal((20, *balance.shape))
    state = initial_states(rope, pieces(balance + noise))
    along = np.asarray(state.position - balance)[..., 2]
    assert np.std(along) < 0.2 * NOISE
    assert not np.any(state.velocity)
    untouched = initial_states(rope, pieces(balance + noise, relaxation=0))
    np.testing.assert_array_equal(untouched.position, pieces(balance + noise).pose)


def test_what_hangs_in_balance_stays(rope):
    balance = hanging(rope)
    state = initial_states(rope, pieces(balance[None]))
    np.testing.assert_allclose(state.position[0], balance, atol=1e-6)


def test_no_error_of_a_pose_grows(rope):
    """It does where the rope is stopped at the end of each period: twentyfold in eight."""
    balance = jnp.asarray(hanging(rope), jnp.float32)

    def relaxed(pose):
        return initial_states(rope, pieces(pose.reshape(1, *balance.shape))).position.ravel()

    gains = np.linalg.svd(np.asarray(jax.jacfwd(relaxed)(balance.ravel())))[1]
    assert gains.max() < 1.0
    assert np.median(gains) < 0.1


def test_what_is_in_motion_begins_as_it_was_seen(rope):
    balance = hanging(rope)
    both = pieces(np.stack([balance + NOISE] * 2))
    moving = jnp.zeros_like(both.pose).at[1].set(0.1)
    both = dataclasses.replace(both, rate_deviation=moving)
    position = initial_states(rope, both).position
    np.testing.assert_array_equal(position[1], both.pose[1])
    assert np.abs(np.asarray(position[0] - both.pose[0])).max() > 0.1 * NOISE


def test_models_are_relaxed_where_starts_ring_and_trials_begin_at_rest(rope):
    still = np.broadcast_to(hanging(rope), (1, 80, 5, 3))
    seen = still + 1e-3 * np.random.default_rng(1).standard_normal(still.shape)
    aligned = Aligned(0.02, seen, np.zeros((1, 79, 1, 3)), np.array([80]))
    assert cut(aligned, rope, 1.0, at_rest=True, ringing=True).relaxation == 8
    assert cut(aligned, rope, 1.0, at_rest=True).relaxation == 0
    assert cut(aligned, rope, 1.0, ringing=True).relaxation == 0
