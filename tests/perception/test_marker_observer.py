"""Markers, late and seldom, to a rope's state."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.models.rope import Rope, RopeState
from palpate.perception.rope.marker_observer import MODEL_ERROR, MarkerObserver, gains

PERIOD, NOISE, STEPS = 0.01, 5e-4, 150
ROPE = dataclasses.replace(Rope.uniform(1.0, 0.1, 11, driven=(0,), substeps=4), drive="velocity")
ROPE = ROPE.constrain()


def motion(rope: Rope, steps: int = STEPS) -> tuple[list[RopeState], np.ndarray]:
    """True states (steps + 1) of two ropes whose grippers circle, and the commands."""
    time = np.arange(steps) * PERIOD
    commands = 0.6 * np.stack([np.sin(7 * time), np.cos(5 * time), 0.3 * np.sin(4 * time)], axis=-1)
    commands = np.stack([commands, -0.5 * commands], axis=1)[:, :, None].astype(np.float32)
    down = np.linspace(0, 1, rope.nodes)[:, None] * [0.2, 0.0, -0.98]
    position = jnp.asarray(np.stack([down, down]), jnp.float32)
    states = [RopeState(position, jnp.zeros_like(position))]
    step = eqx.filter_jit(rope.step)
    for command in commands:
        states.append(step(states[-1], jnp.asarray(command)))
    return states, commands


def followed(
    rope: Rope, states: list[RopeState], commands: np.ndarray, every: int, delay: int, noise: float
) -> list[RopeState]:
    """What the observer makes of a measurement `every` so many periods, `delay` periods late."""
    random = np.random.default_rng(3)
    seen = [np.asarray(s.position) + noise * random.standard_normal((2, 11, 3)) for s in states]
    observer = MarkerObserver(rope, noise)
    found = [observer.begin(seen[0], 0.0)]
    for step, command in enumerate(commands, 1):
        newest = max(0, (step - delay) // every * every)
        found.append(observer.step(jnp.asarray(command), seen[newest], newest * PERIOD))
    return found


def velocity_error(states: list[RopeState], found: list[RopeState]) -> float:
    """Root mean square over the second half, m/s, of the free nodes."""
    half = len(states) // 2
    missed = [
        (f.velocity - s.velocity)[:, 1:] for s, f in zip(states[half:], found[half:], strict=True)
    ]
    return float(jnp.sqrt(jnp.mean(jnp.stack(missed) ** 2)))


@pytest.mark.parametrize(("interval", "noise"), [(0.01, 5e-4), (0.1, 5e-4), (0.01, 5e-3)])
def test_gains_are_those_of_the_stationary_kalman_filter(interval, noise):
    """Riccati's equation of a point accelerated at random, constant over each interval."""
    move = np.array([[1, interval], [0, 1]])
    push = np.array([[interval**2 / 2], [interval]]) * MODEL_ERROR
    covariance, gain = np.eye(2), np.zeros((2, 1))
    for _ in range(20_000):
        covariance = move @ covariance @ move.T + push @ push.T
        gain = covariance[:, :1] / (covariance[0, 0] + noise**2)
        covariance = covariance - gain @ covariance[:1]
    alpha, beta = gains(interval, noise)
    assert alpha == pytest.approx(gain[0, 0], rel=1e-4)
    assert beta / interval == pytest.approx(gain[1, 0], rel=1e-4)


@pytest.mark.parametrize(("every", "delay"), [(1, 0), (2, 2), (10, 5)])
def test_a_rope_that_moves_as_the_model_is_followed_exactly(every, delay):
    states, commands = motion(ROPE)
    found = followed(ROPE, states, commands, every, delay, 0.0)
    for state, one in zip(states, found, strict=True):
        np.testing.assert_allclose(one.position, state.position, atol=1e-4)
        np.testing.assert_allclose(one.velocity, state.velocity, atol=1e-2)


@pytest.mark.parametrize(("every", "delay"), [(1, 0), (10, 5)])
def test_a_rope_of_another_damping_is_followed_through_noise(every, delay):
    """Far nearer than the model alone, and than no estimate of the velocity at all."""
    other = eqx.tree_at(lambda r: r.air_drag, ROPE, 4 * ROPE.air_drag)
    states, commands = motion(other)
    found = followed(ROPE, states, commands, every, delay, NOISE)
    alone = followed(ROPE, states, commands, 10**6, 0, 0.0)
    error = velocity_error(states, found)
    assert error < 0.12
    assert error < 0.7 * velocity_error(states, alone)


def test_noise_is_no_stretch():
    states, commands = motion(ROPE, 60)
    found = followed(ROPE, states, commands, 1, 0, 5e-3)
    lengths = [jnp.linalg.norm(jnp.diff(one.position, axis=1), axis=-1) for one in found[1:]]
    true = [jnp.linalg.norm(jnp.diff(one.position, axis=1), axis=-1) for one in states[1:]]
    # But for the first measurement, which nothing was known before.
    assert float(jnp.abs(lengths[-1] - true[-1]).max()) < 5e-3
    stretching = jnp.abs(jnp.diff(jnp.stack(lengths[20:]), axis=0)).max()
    assert float(stretching) < 3e-3


def test_an_old_measurement_changes_nothing_and_a_future_one_is_refused():
    states, commands = motion(ROPE, 3)
    observer = MarkerObserver(ROPE, NOISE)
    observer.begin(states[0].position, 0.0)
    moved = observer.step(jnp.asarray(commands)[0], states[0].position + 1.0, 0.0)
    np.testing.assert_allclose(moved.position, states[1].position, atol=1e-5)
    with pytest.raises(PalpateError, match=r"this one is of 0\.050 s"):
        observer.step(jnp.asarray(commands)[1], states[2].position, 0.05)
