"""What `movable-surfaces` learns from, and what it says of it."""

import numpy as np
import pytest

from palpate.experiments.appliance.movable_surfaces import figures, together
from palpate.perception.surface_features import FEATURES
from palpate.trials.appliance.surface_examples import examples_of
from palpate.worlds.appliance.categories import draw_design


def test_examples_are_of_fixed_and_moving_surfaces_and_of_parts_on_parts():
    features, moves = examples_of("microwave", 3)  # a door and a drawer, side by side
    on_part = features[:, FEATURES.index("on a part")] > 0.5
    assert features.shape == (len(moves), len(FEATURES))
    assert np.isfinite(features).all()
    assert 0.0 < moves[~on_part].mean() < 1.0
    assert on_part.any()
    assert moves[on_part].sum() == 0.0  # nothing hangs on either
    nested = [
        seed for seed in range(40)
        if any(part.parent >= 0 for part in draw_design("refrigerator", seed).parts)
    ][:3]  # fmt: skip
    found = [examples_of("refrigerator", seed) for seed in nested]
    on_doors = np.concatenate([m[f[:, FEATURES.index("on a part")] > 0.5] for f, m in found])
    assert 0.0 < on_doors.mean() < 0.5


def test_the_same_seed_gives_the_same_examples():
    one, same = examples_of("box", 1), examples_of("box", 1)
    assert np.array_equal(one[0], same[0])
    assert np.array_equal(one[1], same[1])


def test_figures_are_of_both_kinds_and_beside_their_rivals():
    features = np.zeros((8, len(FEATURES)))
    features[4:, FEATURES.index("on a part")] = 1.0
    real = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0])
    half = np.full(8, 0.5)
    values = {
        one.name: one.value for one in figures(0.8 * real + 0.1, {"constant": half}, features, real)
    }
    assert values["area_under_curve"] == 1.0
    assert values["on_part.area_under_curve"] == 1.0
    assert values["constant.area_under_curve"] == 0.5
    assert values["log_loss"] == pytest.approx(-np.log(0.9))
    assert values["on_part.surfaces"] == 4.0


def test_parts_are_put_together_in_their_order():
    parts = [{"features": [[1.0], [2.0]], "moves": [0.0, 1.0]}, {"features": [[3.0]], "moves": [1]}]
    features, moves = together(parts)
    assert features.tolist() == [[1.0], [2.0], [3.0]]
    assert moves.tolist() == [0.0, 1.0, 1.0]
