"""Figures of posteriors are drawn, the same each time, and refuse what does not belong together."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.report.posterior_chart import marginal_figure, rank_figure


def test_ranks_are_drawn_the_same_each_time(tmp_path):
    counts = {"right": np.full((5, 8), 40), "wrong": np.full((5, 8), 40)}
    names = [f"parameter {index}" for index in range(5)]
    first, second = (rank_figure(tmp_path / f"{i}.png", names, counts) for i in range(2))
    assert first.read_bytes() == second.read_bytes()
    assert first.read_bytes().startswith(b"\x89PNG")


def test_marginals_are_drawn_of_wide_narrow_and_constant_draws(tmp_path):
    rng = np.random.default_rng(0)
    prior = {name: rng.normal(size=500) for name in ("wide (m)", "narrow (kg)")}
    posterior = {
        "wide (m)": rng.normal(size=(4, 200)),
        "narrow (kg)": 1e-3 * rng.normal(size=(4, 200)),
    }
    path = marginal_figure(tmp_path / "marginals.png", prior, posterior, {"narrow (kg)": 0.0})
    assert path.stat().st_size > 10_000


def test_other_parameters_are_refused(tmp_path):
    with pytest.raises(PalpateError, match="same parameters"):
        marginal_figure(tmp_path / "x.png", {"a": np.zeros(3)}, {"b": np.zeros((2, 3))})
