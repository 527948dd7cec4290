"""What is wrong with a recording of a rope is seen in it, and its cause is named."""

import numpy as np
import pytest

from numpy_rope import GRAVITY, PERIOD, chain
from palpate.families.rope.recording_check import gravity, misfit, problems
from palpate.recordings import Aligned


@pytest.fixture(scope="module")
def markers():
    seen = chain()[None]
    return seen + 1e-3 * np.random.default_rng(0).standard_normal(seen.shape)


def found(markers, period=PERIOD, mass=0.05, driven=(0,)):
    count = np.full(len(markers), markers.shape[1])
    aligned = Aligned(period, markers.astype(np.float32), markers[:, :-1, :1], count)
    return problems(aligned, driven, mass)


def test_a_good_recording_has_no_problem_and_shows_gravity(markers):
    assert found(markers) == []
    assert found(markers, mass=None) == []
    assert gravity(markers, PERIOD) == pytest.approx([0.0, 0.0, -GRAVITY], abs=0.15 * GRAVITY)


def test_gaps_are_no_problem(markers):
    gaps = markers.copy()
    gaps[0, 40:60, 2] = np.nan
    gaps[0, 80:82] = np.nan
    assert found(gaps) == []


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_rate_is_named(markers, factor):
    (problem,) = found(markers, period=factor * PERIOD)
    assert problem.startswith("rate: ")
    assert ("faster" in problem) == (factor < 1)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda m: m[:, :, [0, 2, 1, 3, 4, 5]], "order of the markers: neighbours in the file"),
        (lambda m: m[:, :, ::-1], "order of the markers: the rope hangs from its last marker"),
        (lambda m: m[..., [0, 2, 1]], "up axis: the rope hangs towards -y"),
        (lambda m: m * [1, 1, -1], "up axis: the rope hangs towards +z"),
        (lambda m: 100.0 * m, "unit of length: "),
        (lambda m: np.concatenate([m[:, :70], m[:, 95:]], axis=1), "discontinuity: in trial 0"),
    ],
)
def test_the_cause_is_named(markers, change, cause):
    (problem,) = found(change(markers))
    assert problem.startswith(cause)


@pytest.mark.parametrize(("mass", "unit"), [(50.0, "grams"), (5e-5, "tonnes")])
def test_a_mass_in_another_unit_is_named(markers, mass, unit):
    (problem,) = found(markers, mass=mass)
    assert problem.endswith(f"not in {unit}")


def test_the_order_that_would_be_right_is_said(markers):
    shuffled = markers[:, :, [3, 0, 5, 1, 4, 2]]
    (problem,) = found(shuffled)
    assert problem.endswith("1, 3, 5, 0, 4, 2") or problem.endswith("2, 4, 0, 5, 3, 1")


def test_a_fit_that_misses_is_said(markers):
    aligned = Aligned(PERIOD, markers, markers[:, :-1, :1], np.array([markers.shape[1]]))
    assert misfit(aligned, 0.005) == ""
    assert "10 cm, 20% of its length" in misfit(aligned, 0.1)
    assert "not finite" in misfit(aligned, float("nan"))
