"""Velocity estimation: exact on what the polynomial can follow, quiet as the theory says."""

import jax.numpy as jnp
import numpy as np
import pytest

from palpate.perception.velocity import VelocityEstimator

PERIOD = 0.01


def run(estimator: VelocityEstimator, positions: np.ndarray) -> np.ndarray:
    positions = jnp.asarray(positions)
    carry, velocities = estimator.init(positions[0]), []
    for position in positions:
        carry, velocity = estimator.update(carry, position)
        velocities.append(velocity)
    return np.array(velocities)


def test_exact_on_a_parabola_of_any_shape() -> None:
    estimator = VelocityEstimator(PERIOD)
    time = np.arange(30) * PERIOD
    slope = np.linspace(-1, 1, 6).reshape(2, 3)
    positions = 0.3 + time[:, None, None] * slope + 4.0 * time[:, None, None] ** 2
    expected = slope + 8.0 * time[:, None, None]
    got = run(estimator, positions.astype(np.float32))
    assert got.shape == (30, 2, 3)
    np.testing.assert_allclose(got[estimator.frames :], expected[estimator.frames :], atol=1e-3)


def test_object_at_rest_has_no_velocity_from_the_first_frame() -> None:
    got = run(VelocityEstimator(PERIOD), np.full((4, 3), 0.7, np.float32))
    np.testing.assert_allclose(got, 0.0, atol=1e-4)


def test_window_and_online_agree() -> None:
    estimator = VelocityEstimator(PERIOD)
    positions = np.random.default_rng(0).normal(size=(9, 4)).astype(np.float32)
    np.testing.assert_allclose(
        run(estimator, positions)[-1], estimator.velocity(jnp.asarray(positions[-7:])), rtol=1e-6
    )


@pytest.mark.parametrize(("frames", "order"), [(5, 1), (7, 2), (9, 3)])
def test_noise_gain_is_that_of_the_weights(frames: int, order: int) -> None:
    estimator = VelocityEstimator(PERIOD, frames, order)
    noise = np.random.default_rng(1).normal(scale=5e-4, size=(400, 50)).astype(np.float32)
    measured = run(estimator, noise)[frames:].std()
    assert measured == pytest.approx(5e-4 * np.sqrt((estimator.weights**2).sum()), rel=0.05)


def test_default_is_near_the_best_window_for_a_swinging_object() -> None:
    """0.5 mm noise at 100 Hz on a 2 Hz motion of 0.1 m: noise and lag nearly balance."""
    time = np.arange(600) * PERIOD
    path = 0.1 * np.sin(4 * np.pi * time)
    true = 0.4 * np.pi * np.cos(4 * np.pi * time)
    noisy = path[:, None] + np.random.default_rng(2).normal(scale=5e-4, size=(600, 20))

    def error(frames: int) -> float:
        got = run(VelocityEstimator(PERIOD, frames, 2), noisy.astype(np.float32))
        return float(np.sqrt(np.mean((got - true[:, None])[20:] ** 2)))

    errors = {frames: error(frames) for frames in (4, 7, 14)}
    assert errors[7] < 0.06
    assert errors[7] < min(errors[4], errors[14])
