"""Simulation-based calibration passes where a posterior is right, and fails where it is not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayesian_toys import NOISE, Sled
from palpate.errors import PalpateError
from palpate.identification.posterior.calibration import histogram, p_values, problem, ranks_of

pytestmark = pytest.mark.optimised

SIMULATIONS, DRAWS, BINS = 40, 31, 8
LONG = 63  # draws where R-hat is asked for: of half as many some are above 1.1 by chance


def pushed(sigma_factor):
    rng = np.random.default_rng(0)
    action = jnp.asarray(np.repeat(rng.normal(size=(2, 2, 3)) * 10.0, 10, axis=1), jnp.float32)
    model = Sled(mass=10.0, friction=[15.0, 15.0])
    return problem(model, jnp.zeros((2, 3)), action, 0.2 * NOISE, sigma_factor)


def test_the_right_likelihood_passes_and_a_wrong_sigma_fails():
    right = ranks_of(pushed(1.0), jax.random.key(3), SIMULATIONS, LONG)
    wrong = ranks_of(pushed(3.0), jax.random.key(3), SIMULATIONS, DRAWS)
    assert right.rank.shape == (SIMULATIONS, 3)
    assert right.size.min() > 2 * LONG  # of all draws, of which these are the fifth part
    assert right.rhat.max() < 1.1
    assert p_values(right.rank, LONG, BINS).min() > 0.01 / 3
    assert p_values(wrong.rank, DRAWS, BINS).min() < 1e-3


@pytest.mark.slow
def test_a_sigma_that_is_half_as_large_again_fails_among_more_simulations():
    right, wrong = (
        ranks_of(pushed(factor), jax.random.key(3), 160, DRAWS) for factor in (1.0, 1.5)
    )
    assert p_values(right.rank, DRAWS, BINS).min() > 0.01 / 3
    assert p_values(wrong.rank, DRAWS, BINS).min() < 1e-3


def test_the_same_key_gives_the_same_ranks_whichever_device_comes_to_them():
    first, second = (ranks_of(pushed(1.0), jax.random.key(4), 3, DRAWS) for _ in range(2))
    np.testing.assert_array_equal(first.rank, second.rank)
    assert len({tuple(rank) for rank in first.rank}) == 3


def test_p_values_of_uniform_ranks_are_uniform():
    rng = np.random.default_rng(0)
    values = p_values(rng.integers(0, 64, size=(320, 2000)), 63)
    np.testing.assert_allclose(np.quantile(values, [0.05, 0.5, 0.95]), [0.05, 0.5, 0.95], atol=0.03)
    narrow = np.clip(rng.normal(32, 12, size=(320, 5)), 0, 63).astype(int)
    assert np.all(p_values(narrow, 63) < 1e-6)


def test_each_rank_has_its_bin():
    counts = histogram(np.array([[0], [3], [4], [63]]), 63)
    np.testing.assert_array_equal(np.flatnonzero(counts[0]), [0, 1, 15])
    assert counts[0, 0] == 2


def test_too_few_simulations_are_refused():
    with pytest.raises(PalpateError, match="at least 80 simulations"):
        p_values(np.zeros((79, 1), int), 63)
    with pytest.raises(PalpateError, match="multiple of the bins"):
        p_values(np.zeros((320, 1), int), 60)
