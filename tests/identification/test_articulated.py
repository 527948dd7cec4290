"""The shared identification on a cabinet: a door's and a drawer's physics from how they moved."""

import jax.numpy as jnp
import numpy as np
import pytest

from palpate.identification.gradient.descent import Settings
from palpate.identification.identify import identify
from palpate.models import rollout
from palpate.models.articulated import ArticulatedState, Link, tree_of
from palpate.parameters import declare
from palpate.recordings import Aligned

NOISE = 1e-3  # rad, m
TRIALS, STEPS = 4, 100
DOOR = {"axis": (0.0, 0.0, 1.0), "centre_of_mass": (0.3, 0.0, 0.2)}
DRAWER = {"joint": "prismatic", "axis": (1.0, 0.0, 0.0)}
INERTIA = np.diag([0.02, 0.06, 0.06])


def cabinet(mass, damping, friction):
    """A door on an upright hinge and a drawer; what its angles cannot tell is fixed."""
    (heavy, light), (first, second), (rubs, grates) = mass, damping, friction
    own, other = INERTIA * heavy, INERTIA * light
    links = [
        Link(mass=heavy, inertia=own, damping=first, friction=rubs, **DOOR),
        Link(mass=light, inertia=other, damping=second, friction=grates, **DRAWER),
    ]
    model = tree_of(links, control_period=0.02, substeps=2)
    return declare(model, centre_of_mass={"fixed": True}, gyration={"fixed": True})


def recorded(model, seed):
    """Pushed by torques of three sinusoids each, seen with noise."""
    rng = np.random.default_rng(seed)
    time = model.control_period * np.arange(STEPS)
    shape = TRIALS, 3, 2, 1
    frequency, phase = rng.uniform(0.3, 1.5, shape), rng.uniform(0, 6.28, shape)
    waves = np.array([2.0, 10.0])[:, None] * np.sin(2 * np.pi * frequency * time + phase)
    force = np.sum(waves, axis=1)  # (trials, links, steps)
    actions = np.zeros((TRIALS, STEPS, 2, 7), np.float32)
    actions[..., 0] = np.swapaxes(force, 1, 2)
    start = ArticulatedState(jnp.zeros((TRIALS, 2)), jnp.zeros((TRIALS, 2)))
    states = rollout(model, start, jnp.asarray(actions))
    seen = np.concatenate([np.zeros((TRIALS, 1, 2)), np.asarray(states.position)], axis=1)
    seen = (seen + NOISE * rng.normal(size=seen.shape)).astype(np.float32)
    return Aligned(model.control_period, seen, actions, np.full(TRIALS, STEPS + 1))


def test_masses_damping_and_friction_come_out_with_intervals_that_hold():
    true = cabinet((3.0, 1.5), (0.3, 4.0), (0.4, 3.0))
    start = cabinet((2.0, 2.0), (0.1, 1.0), (0.1, 1.0))
    assert true.observation_units == ("rad", "m")
    settings = Settings(iterations=(3, 3, 12))
    found = identify(start, recorded(true, 0), "levenberg-marquardt", settings=settings)
    held = []
    for name in ("mass", "damping", "friction"):
        value = np.asarray(getattr(true, name))
        np.testing.assert_allclose(getattr(found.model, name), value, rtol=0.1)
        held += list((found.lower[name] <= value) & (value <= found.upper[name]))
    assert sum(held) >= 5, held


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say():
    true = cabinet((3.0, 1.5), (0.3, 4.0), (0.4, 3.0))
    start = cabinet((2.0, 2.0), (0.1, 1.0), (0.1, 1.0))
    settings, held = Settings(iterations=(3, 3, 12)), []
    for seed in range(20):
        found = identify(start, recorded(true, seed), "levenberg-marquardt", settings=settings)
        for name in ("mass", "damping", "friction"):
            value = np.asarray(getattr(true, name))
            held += list((found.lower[name] <= value) & (value <= found.upper[name]))
    assert 0.8 <= np.mean(held) <= 0.98
