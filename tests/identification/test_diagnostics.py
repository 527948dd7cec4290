"""R-hat and effective sizes against chains whose correlation is known."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.identification.posterior.diagnostics import bulk_size, rhat, tail_size


def autoregressive(correlation, chains=4, draws=2000, repeats=40, seed=0):
    """Stationary chains x' = c x + sqrt(1 - c^2) noise, (chains, draws, repeats)."""
    rng = np.random.default_rng(seed)
    values = [rng.normal(size=(chains, repeats))]
    for _ in range(draws - 1):
        noise = rng.normal(size=(chains, repeats))
        values.append(correlation * values[-1] + np.sqrt(1.0 - correlation**2) * noise)
    return np.stack(values, axis=1)


@pytest.mark.parametrize("correlation", [-0.3, 0.0, 0.5, 0.9])
def test_bulk_size_is_that_of_the_known_correlation(correlation):
    draws = autoregressive(correlation)
    expected = 4 * 2000 * (1.0 - correlation) / (1.0 + correlation)
    assert np.mean(bulk_size(draws)) == pytest.approx(expected, rel=0.08)


def test_tail_size_of_independent_draws_is_about_their_number():
    assert np.mean(tail_size(autoregressive(0.0))) == pytest.approx(8000, rel=0.1)
    assert np.mean(tail_size(autoregressive(0.9))) < 2000


def test_rhat_of_chains_that_agree_is_one():
    assert np.max(rhat(autoregressive(0.3))) < 1.01


def test_rhat_sees_chains_that_differ_in_place_in_spread_or_over_time():
    draws = autoregressive(0.0, repeats=1)
    shifted = draws + np.array([0.0, 0.0, 0.0, 1.0])[:, None, None]
    wider = draws * np.array([1.0, 1.0, 1.0, 3.0])[:, None, None]
    drifting = draws + np.linspace(0.0, 2.0, draws.shape[1])[:, None]
    for broken in (shifted, wider, drifting):
        assert rhat(broken)[0] > 1.02


def test_rank_normalisation_gives_heavy_tails_a_size():
    rng = np.random.default_rng(1)
    cauchy = rng.standard_cauchy(size=(4, 1000, 20))
    assert np.mean(bulk_size(cauchy)) == pytest.approx(4000, rel=0.1)
    assert np.max(rhat(cauchy)) < 1.01


def test_what_never_changes_has_mixed():
    still = np.ones((4, 100, 2))
    assert np.all(rhat(still) == 1.0)
    assert np.all(bulk_size(still) == 400.0)
    assert np.all(tail_size(still) == 400.0)


def test_bad_draws_are_refused():
    with pytest.raises(PalpateError, match="at least 4 draws"):
        rhat(np.zeros((4, 3)))
    with pytest.raises(PalpateError, match="NaN"):
        bulk_size(np.full((4, 10), np.nan))


def test_values_agree_with_arviz():
    arviz = pytest.importorskip("arviz")
    draws = autoregressive(0.6, repeats=3, draws=501)
    for index in range(3):
        column = draws[..., index]
        assert rhat(column) == pytest.approx(float(arviz.rhat(column)), abs=1e-6)
        for ours, method in ((bulk_size, "bulk"), (tail_size, "tail")):
            assert ours(column) == pytest.approx(float(arviz.ess(column, method=method)), rel=1e-6)
