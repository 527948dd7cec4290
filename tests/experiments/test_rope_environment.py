"""Bringing a rope to rest, episodes side by side, and what an actor of them does."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.experiments.rivals.rope_environment import Episodes
from palpate.learning import Training
from palpate.models.rope import Rope
from palpate.parameters import parameters_of
from palpate.tasks.rope import RopeStabilization
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.stabilization import StabilizationTrial
from palpate.trials.trial import run_trials
from palpate.worlds.rope.rope import RopeConfiguration

TASK = RopeStabilization(duration=0.2)
NOISE = 5e-4  # m


@pytest.fixture(scope="module")
def episodes() -> Episodes:
    model = Rope.uniform(1.0, 0.1, 4, drive="velocity", substeps=4, bend_stiffness=1e-4)
    training = Training(starts=64, observation_noise=NOISE, width=8)
    return Episodes.of(TASK, model, training, jax.random.key(1))


def test_rewards_are_minus_the_loss_along_a_known_path(episodes) -> None:
    """That of each instant; and their mean and the last instant make the loss of the episode."""
    situation, _ = episodes.begin(jax.random.key(0), 4)
    start, models = situation.start, situation.models
    actions = jax.random.uniform(jax.random.key(2), (20, 4, 3), minval=-0.5, maxval=0.5)
    rewards, path = [], []
    for action in actions:
        situation, _, reward = episodes.step(situation, action)
        rewards.append(reward)
        path.append(situation.state)
    rewards = jnp.stack(rewards, axis=1)
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1), *path)
    # |action| < 1 and |command| < limit here: the command is what the actions add up to.
    commands = start.command[:, None] + 0.1 * jnp.cumsum(actions, axis=0).swapaxes(0, 1)[:, :, None]
    np.testing.assert_allclose(states.velocity[:, :, 0], commands[:, :, 0], atol=1e-5)
    share, whole = eqx.filter_jit(_share_and_loss)(models, start, states, commands)
    speed = jnp.linalg.norm(commands[:, :, 0], axis=-1)
    expected = -(share + jnp.log1p(share / 0.01) + speed)
    np.testing.assert_allclose(rewards, expected, rtol=1e-3, atol=1e-3)
    settling = -jnp.mean(rewards + share + speed, axis=1)
    np.testing.assert_allclose(whole, settling + share[:, -1] + speed[:, -1], rtol=1e-3)


def _share_and_loss(models, start, states, commands):
    loss = TASK.loss(models, start, states, commands)
    return TASK.energy_share(models, start, states), loss


def test_ropes_are_drawn_within_their_spreads_and_seen_through_noise(episodes) -> None:
    situation, seen = episodes.begin(jax.random.key(0), 4)
    model, drawn = episodes.model, situation.models
    for name, declaration in parameters_of(model).items():
        if declaration.spread:
            ratio = getattr(drawn, name) / jnp.where(getattr(model, name), getattr(model, name), 1)
            assert np.all(ratio < 1 + declaration.spread + 1e-5)
    assert len(np.unique(drawn.node_mass[:, 1])) == 4
    inputs = episodes.actor.inputs(situation.command, TASK.features(situation.state, None))
    positions = slice(0, 9)  # of three nodes; their velocities are estimated, the command is known
    away = (seen - inputs)[:, positions] * episodes.actor.scale[positions]
    assert 0.5 * NOISE < np.std(away) < 2.5 * NOISE  # the gripper's noise is in all of them
    np.testing.assert_allclose(seen[:, 18:], inputs[:, 18:], atol=1e-6)


def test_an_actor_does_as_a_controller_what_it_does_in_the_environment(
    episodes,
) -> None:
    """And stays within the limits, whatever its network says."""
    actor = episodes.actor
    wild = eqx.tree_at(lambda a: a.network.layers[-1].bias, actor, jnp.array([9.0, -9.0, 9.0]))
    features = jax.random.normal(jax.random.key(0), (5, 18))
    command = wild.initial_carry(jnp.zeros((5, 1, 3)))
    for step in range(1, 30):
        action = jax.vmap(wild.network)(wild.inputs(command, features))
        following, given = wild(command, features)
        np.testing.assert_allclose(given, wild.moved(command, action), atol=1e-6)
        change = np.linalg.norm(given - command, axis=-1)
        speed = np.linalg.norm(given, axis=-1)
        assert np.all(change < 0.1 + 1e-5)
        np.testing.assert_allclose(speed, min(0.1 * step, 1.5), rtol=1e-4)
        command = following
    single, _ = wild(command[0], features[0])
    np.testing.assert_allclose(single, wild(command, features)[0][0], atol=1e-6)
    trials = [StabilizationTrial(RopeConfiguration(bodies=9, markers=10), "straight", 0)]
    done = run_trials(trials, LearnedController(wild, TASK), 10)
    assert done.gripper_speed[0, -1] == pytest.approx(1.0, abs=0.2)
