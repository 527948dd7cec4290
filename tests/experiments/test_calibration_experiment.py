"""The calibration experiment from end to end at the smallest size, interrupted and resumed."""

import jax
import numpy as np
import pytest

from palpate.experiments.furniture import calibration
from palpate.identification.posterior.calibration import Ranks


def drawn(problem, key, simulations, draws):
    """Ranks as a calibrated posterior has them; too central where the likelihood is wrong."""
    right = np.allclose(problem.target.scales.noise[0], calibration.NOISE[0])
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    size = simulations, problem.target.dimension
    rank = rng.integers(0, draws + 1, size) if right else rng.integers(16, 48, size)
    return Ranks(rank=rank, size=np.full(size, 300.0), rhat=np.full(size, 1.01), draws=draws)


@pytest.fixture
def quickly(monkeypatch):
    monkeypatch.setattr(calibration, "ranks_of", drawn)


def test_figures_and_resumption(tmp_path, quickly, monkeypatch):
    whole = calibration.reproduce(tmp_path / "whole", quick=True)
    figures = {figure.name: figure for figure in whole.figures}
    assert set(figures) >= {"p_min", "p_min_wrong_sigma", "simulations"}
    assert figures["p_min"].met
    assert figures["p_min_wrong_sigma"].met
    assert figures["ess_min"].value == 300.0
    assert figures["rhat_max"].value == pytest.approx(1.01)
    assert (tmp_path / "whole" / calibration.FIGURE).exists()

    calls = []

    def failing(*arguments):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return drawn(*arguments)

    monkeypatch.setattr(calibration, "ranks_of", failing)
    with pytest.raises(KeyboardInterrupt):
        calibration.reproduce(tmp_path / "cut", quick=True)
    monkeypatch.setattr(calibration, "ranks_of", drawn)
    again = calibration.reproduce(tmp_path / "cut", quick=True)
    assert [f.value for f in again.figures] == [f.value for f in whole.figures]


def test_a_finished_run_is_only_read(tmp_path, quickly, monkeypatch):
    first = calibration.reproduce(tmp_path, quick=True)
    monkeypatch.setattr(calibration, "ranks_of", None)
    assert calibration.reproduce(tmp_path, quick=True).figures == first.figures


def test_the_body_has_fourteen_parameters():
    given = calibration.push_problem(0, 1.0)
    assert given.target.dimension == 14
    assert given.target.sensitivity is None  # every motion begins at rest, at a known pose
