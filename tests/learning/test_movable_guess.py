"""A network that says which surfaces move by their looks."""

import numpy as np
import pytest
from safetensors.numpy import load_file

from palpate.errors import PalpateError
from palpate.experiments.appliance.movable_surfaces import area_under_curve, log_loss, logistic
from palpate.learning.movable_guess import FURTHEST, fit_guess, load_guess
from palpate.perception.surface_features import FEATURES

pytestmark = pytest.mark.optimised


@pytest.fixture(scope="module")
def ring():
    """Surfaces that move where two of their features are on a ring: no line tells them apart."""
    random = np.random.default_rng(0)
    features = random.standard_normal((8000, len(FEATURES)))
    moves = (np.abs(np.hypot(features[:, 0], features[:, 1]) - 1.2) < 0.4).astype(float)
    return features, moves


@pytest.fixture(scope="module")
def guess(ring):
    features, moves = ring
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("palpate.learning.movable_guess.STEPS", 3000)
        return fit_guess(features[:7000], moves[:7000], seed=0)


def test_it_learns_what_no_line_tells(ring, guess):
    features, moves = ring
    straight = logistic(features[:7000], moves[:7000])
    assert area_under_curve(straight(features[7000:]), moves[7000:]) < 0.6
    chance = guess(features[7000:])
    assert area_under_curve(chance, moves[7000:]) > 0.85
    assert ((chance > 0.0) & (chance < 1.0)).all()
    assert log_loss(chance, moves[7000:]) < log_loss(straight(features[7000:]), moves[7000:])


def test_what_was_never_seen_is_taken_to_be_at_the_edge_of_what_was(guess):
    edge = np.zeros((1, len(FEATURES)))
    edge[0, 3] = np.asarray(guess.mean)[3] + FURTHEST * np.asarray(guess.deviation)[3]
    far = edge.copy()
    far[0, 3] *= 100.0
    assert guess(far) == pytest.approx(guess(edge))


def test_the_same_seed_gives_the_same_network(ring, monkeypatch):
    features, moves = ring
    monkeypatch.setattr("palpate.learning.movable_guess.STEPS", 50)
    one, same = (fit_guess(features[:300], moves[:300], seed=3) for _ in range(2))
    assert np.array_equal(one(features), same(features))


def test_a_file_gives_it_back_and_other_features_are_refused(tmp_path, ring, guess, monkeypatch):
    features, _ = ring
    path = tmp_path / "guess.safetensors"
    guess.save(path, {"appliances": 1})
    assert load_guess(path)(features) == pytest.approx(guess(features), abs=1e-6)
    assert len(load_file(path)) > 0
    for names in (("height", *FEATURES[1:]), FEATURES[1:]):
        monkeypatch.setattr("palpate.learning.movable_guess.FEATURES", names)
        with pytest.raises(PalpateError, match="was trained on other features: train it anew"):
            load_guess(path)


def test_of_surfaces_that_all_move_nothing_is_learnt():
    with pytest.raises(PalpateError, match="expected some of both"):
        fit_guess(np.zeros((5, len(FEATURES))), np.ones(5), 0)


def test_the_one_that_comes_with_palpate_prefers_what_stands_free():
    names = list(FEATURES)
    mean = np.asarray(load_guess().mean)
    wall, door = mean.copy(), mean.copy()
    wall[names.index("free behind it")], door[names.index("free behind it")] = 0.0, 1.0
    wall[names.index("off the scene's axes")], door[names.index("off the scene's axes")] = 0.0, 0.6
    wall_chance, door_chance = load_guess()(np.stack([wall, door]))
    assert door_chance > wall_chance + 0.2


def test_ranks_are_those_of_pairs():
    chance, real = np.array([0.1, 0.4, 0.4, 0.8]), np.array([0.0, 1.0, 0.0, 1.0])
    assert area_under_curve(chance, real) == pytest.approx((1.0 + 0.5 + 1.0 + 1.0) / 4.0)
    assert area_under_curve(chance, np.ones(4)) is None
    assert log_loss(np.array([0.5]), np.array([1.0])) == pytest.approx(np.log(2.0))
