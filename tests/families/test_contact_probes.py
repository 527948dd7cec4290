"""What probes find, in worlds whose forces are known beforehand."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.families.contact import probes
from palpate.networks import Channel
from palpate.networks.actor import GaussianActor
from palpate.networks.guarded import GuardedPolicy, untrained_guard
from palpate.worlds.gymnasium import GymnasiumWorlds
from palpate.worlds.maze.maze import STIFFNESS_RANGE

COUNT = 12
ALONG, ACROSS = 0.5, -0.5


class Knowing(GuardedPolicy):
    """Its risk is the danger that it sees; it proposes to push and, guarded, stands still."""

    def propose(self, observation):
        return jnp.broadcast_to(jnp.array([1.0, 0.0, ALONG, ACROSS]), (*observation.shape[:-1], 4))

    def risk(self, observation, action):
        return observation[..., 2]

    def execute(self, observation):
        return self.propose(observation) * jnp.array([0.5, 1.0, 1.0, 1.0])


class Worlds(GymnasiumWorlds):
    """World i does i N once it is let, and its block goes a millimetre a decision."""

    num_envs = COUNT

    def __init__(self):
        blocks = [SimpleNamespace(truth=lambda: SimpleNamespace(obstacle=self.obstacle))] * COUNT
        self.lockstep, self.obstacle = SimpleNamespace(worlds=blocks), 0.0
        self.danger = np.random.default_rng(0).permutation(COUNT).astype(np.float32)
        self.unguarded = np.zeros(COUNT, int)

    def seen(self):
        observation = np.zeros((COUNT, 9), np.float32)
        observation[:, 0], observation[:, 2] = np.arange(COUNT), self.danger
        return observation

    def reset(self, *, seed=None, options=None):
        return self.seen(), {}

    def step(self, actions):
        self.obstacle += 1e-3
        free = actions[:, 0] == 1.0
        self.unguarded += free
        force = np.where(free, self.danger, 100.0)  # what is done under guard does not count
        nothing = np.zeros(COUNT, bool)
        return self.seen(), np.zeros(COUNT), nothing, nothing, {"force": force}


def policy():
    guard = untrained_guard(jax.random.key(0), 9, 4, (4,), None)
    actor = GaussianActor.create(jax.random.key(1), 9, 4, 4, 1)
    channels = (Channel("seen", (9,)),), (Channel("done", (4,)),)
    return Knowing(
        actor=actor, guard=guard, threshold=0.5, observations=channels[0], actions=channels[1],
        period=0.1,
    )  # fmt: skip


def test_risk_is_held_against_the_forces_that_follow_when_nothing_overrules(monkeypatch):
    monkeypatch.setattr(probes, "LATEST", 6)
    worlds = Worlds()
    found = probes.probe(policy(), worlds, seed=0)
    assert (worlds.unguarded == probes.AHEAD).all()
    np.testing.assert_array_equal(found.greatest, worlds.danger)
    np.testing.assert_array_equal(found.risk, worlds.danger)
    np.testing.assert_array_equal(found.force, np.arange(COUNT))
    told = {f.name: f.value for f in probes.figures(found, guarded=True, free=True)}
    assert told["risk_rank_correlation"] == pytest.approx(1.0)
    felt = np.corrcoef(worlds.danger, np.arange(COUNT))[0, 1]
    assert told["risk_gain_over_force"] == pytest.approx(1.0 - felt, abs=1e-6)
    low, high = STIFFNESS_RANGE
    stiff = [low + (high - low) * (1 + k) / 2 for k in (ALONG, ACROSS)]
    assert told["stiffness_contrast"] == pytest.approx(stiff[0] / stiff[1])


def test_what_never_varies_has_no_correlation():
    assert probes.rank_correlation(np.ones(4), np.arange(4.0)) is None
