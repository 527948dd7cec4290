"""The exact Gaussian process against closed forms and finite differences."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from palpate.errors import PalpateError
from palpate.identification.regression.gaussian_process import (
    LARGEST,
    gaussian_process,
    log_marginal_likelihood,
)


def data(count: int, inputs: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, inputs))


def smooth(x: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(2 * x[:, 0]), x[:, 0] * x[:, 1]], axis=1)


def test_the_posterior_is_the_closed_form():
    x = data(25, 2) * [1.0, 10.0] + 3.0
    y = smooth(x / [1.0, 10.0]) + 0.1 * data(25, 2, seed=1)
    fitted = gaussian_process(x, y)
    asked = data(9, 2, seed=2) * [1.0, 10.0] + 3.0
    mean, variance = fitted(jnp.asarray(asked)), fitted.variance(jnp.asarray(asked))
    z, q = (x - x.mean(0)) / x.std(0), (asked - x.mean(0)) / x.std(0)
    for output in range(2):
        length = np.asarray(fitted.length[output], float)
        size, noise, slope = (
            float(values[output]) for values in (fitted.size, fitted.noise, fitted.slope)
        )

        def k(a, b, length=length, size=size, slope=slope):
            return size**2 * np.exp(-0.5 * (((a[:, None] - b) / length) ** 2).sum(-1)) + (
                slope**2 * a @ b.T
            )

        inverse = np.linalg.inv(k(z, z) + noise**2 * np.eye(25))
        centre, scale = y[:, output].mean(), y[:, output].std()
        expected = k(q, z) @ inverse @ ((y[:, output] - centre) / scale) * scale + centre
        known = np.einsum("qi,ij,qj->q", k(q, z), inverse, k(q, z))
        spread = np.diag(k(q, q)) + noise**2 - known
        np.testing.assert_allclose(mean[:, output], expected, rtol=1e-3, atol=3e-3)
        np.testing.assert_allclose(variance[:, output], spread * scale**2, rtol=1e-2, atol=1e-4)


def test_the_likelihood_is_the_density_and_its_gradient_the_slope():
    x, y = data(12, 3), data(12, 1, seed=1)[:, 0]
    squares = (x[:, None] - x) ** 2
    products = x @ x.T
    free = np.log([1.3, 0.2, 0.7, 0.5, 1.0, 4.0])
    value, slope = log_marginal_likelihood(free, squares, products, y)
    covariance = 0.7**2 * products + 1.3**2 * np.exp(
        -0.5 * squares @ (1 / np.array([0.5, 1.0, 4.0]) ** 2)
    )
    density = scipy.stats.multivariate_normal(np.zeros(12), covariance + 0.04 * np.eye(12))
    assert value == pytest.approx(density.logpdf(y))
    for index in range(6):
        step = np.eye(6)[index] * 1e-5
        ahead, behind = (
            log_marginal_likelihood(free + change, squares, products, y)[0]
            for change in (step, -step)
        )
        assert slope[index] == pytest.approx((ahead - behind) / 2e-5, rel=1e-4, abs=1e-6)


def test_more_data_and_intervals_that_hold():
    asked = np.clip(data(300, 2, seed=9), -1.5, 1.5)
    error = []
    for count in (10, 40, 160):
        x = data(count, 2)
        fitted = gaussian_process(x, smooth(x) + 0.05 * data(count, 2, seed=1))
        error.append(
            np.sqrt(np.mean((np.asarray(fitted(jnp.asarray(asked))) - smooth(asked)) ** 2))
        )
    assert error[2] < 0.5 * error[1] < 0.25 * error[0], error
    seen = smooth(asked) + 0.05 * data(300, 2, seed=3)
    z = (seen - fitted(jnp.asarray(asked))) / np.sqrt(fitted.variance(jnp.asarray(asked)))
    assert 0.85 < np.mean(np.abs(z) < 1.645) < 0.95


def test_an_input_that_says_nothing_is_told_by_its_length():
    x = data(80, 2)
    fitted = gaussian_process(x, np.sin(2 * x[:, :1]))
    assert float(fitted.length[0, 1]) > 20 * float(fitted.length[0, 0])


def test_batch_axes_lead():
    x = data(15, 2)
    fitted = gaussian_process(x, smooth(x))
    asked = jnp.asarray(data(12, 2, seed=1)).reshape(3, 4, 2)
    flat = fitted(asked.reshape(12, 2))
    np.testing.assert_allclose(fitted(asked).reshape(12, 2), flat, rtol=1e-5)
    assert fitted.variance(asked).shape == (3, 4, 2)


def test_too_many_data_are_refused_with_a_way_out():
    with pytest.raises(PalpateError, match="expected at most 2000, for instance every 2th"):
        gaussian_process(np.zeros((LARGEST + 1, 1)), np.zeros((LARGEST + 1, 1)))
