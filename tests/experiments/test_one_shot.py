"""The parts of `reproduce one-shot` that count: what is judged, and against what."""

import jax
import numpy as np
import pytest

from palpate.experiments.furniture import one_shot, one_shot_pieces, one_shot_regression
from palpate.experiments.furniture.one_shot_figure import shares_figure
from palpate.experiments.furniture.one_shot_pieces import PERIOD, error_share, judge, pushes_of
from palpate.experiments.furniture.one_shot_regression import (
    OURS,
    RIVALS,
    first_samples,
    transitions,
    truncate,
)
from palpate.experiments.furniture.one_shot_sampling import OURS as SAMPLER
from palpate.families.furniture.recording import POSE, WRENCH, one_body, starting_furniture
from palpate.families.furniture.structures import structures
from palpate.identification.posterior.comparison import posterior_of
from palpate.identification.posterior.laplace import settle
from palpate.identification.posterior.predictive import Predicted
from palpate.worlds.furniture.furniture import FurnitureWorld, Piece
from palpate.worlds.furniture.handling import Together, Wiggle, record, record_pushes

KINDS = "cart", "chair"


@pytest.fixture(scope="module")
def pushes():
    """Two pieces, each pushed once while the other stands."""
    pieces = [Piece(kind, (0.0, 4.0 * row, 0.0)) for row, kind in enumerate(KINDS)]
    return record_pushes(FurnitureWorld(pieces), seed=3, count=2)


def predicted_with(asked, off, spread, draws=200):
    """Draws about the truth, shifted by `off` in x, normal with the standard deviation `spread`."""
    target = np.asarray(asked.target, float)
    shift = np.zeros(3)
    shift[0] = off
    noise = np.random.default_rng(0).normal(size=(draws, *target.shape)) * spread
    motion = np.broadcast_to(target + shift, noise.shape)
    return Predicted(motion, motion + noise, np.full(noise.shape, spread))


def test_only_what_was_pushed_is_judged(pushes):
    model = starting_furniture(pushes, PERIOD)
    asked = pushes_of(pushes, model)
    found = judge(model, predicted_with(asked, 0.1, 0.05), asked)
    np.testing.assert_allclose(found.error_m, 0.1, rtol=1e-5)
    assert found.error_m.shape == found.displacement_m.shape == (2,)
    moved = np.asarray(asked.target[:, -1] - asked.pose)[[0, 1], [0, 1], :2]
    np.testing.assert_allclose(found.displacement_m, np.linalg.norm(moved, axis=1), rtol=1e-5)
    assert found.displacement_m.min() > 0.1
    # two standard deviations off in x of three channels: there the interval misses
    assert found.inside == pytest.approx(2 / 3, abs=0.01)
    assert judge(model, predicted_with(asked, 0.0, 0.05), asked).inside == 1.0
    assert found.drift_m == pytest.approx(np.linalg.norm(moved, axis=1).max(), abs=0.12)


def test_shares_are_pooled_over_pushes_and_not_averaged():
    stages = [
        {"error_m": [0.1], "displacement_m": [1.0]},
        {"error_m": [0.1], "displacement_m": [0.1]},
    ]
    assert one_shot.pooled_share(stages) == pytest.approx(0.02 / 1.01)
    assert error_share(np.array([0.3, 0.4]), np.array([0.0, 5.0])) == pytest.approx(0.01)


def stage(error, **more):
    return {"error_m": [error], "displacement_m": [1.0], "inside": 0.9, "drift_m": 0.0, **more}


def test_mujoco_sysid_is_held_against_ours_on_the_same_pieces():
    judged_by = {"rhat": 1.0, "ess": 1000.0}
    first = 920_000
    pieces = {
        "cart": [stage(0.1, **judged_by), stage(0.2, **judged_by)],
        "couch": [stage(0.3, **judged_by), stage(0.4, **judged_by)],
        "chair": [stage(0.5, **judged_by), stage(0.6, **judged_by)],
        "bolted": [stage(0.0, **judged_by)],
    }
    told = {
        "cart": stage(0.7, piece=first + 1),
        "couch": stage(0.8, piece=first),
        "chair": {"error_m": [], "displacement_m": []},
    }
    pace = {"rhat": 1.0, "size": 1.0, "seconds": 1.0, "evaluations": 1}
    raced = {"paces": dict.fromkeys((SAMPLER, "metropolis", "adapted"), pace), "posterior_s": 1.0}
    compared = {"cart": {"shares": {name: {"1": 0.1} for name in (OURS, *RIVALS)}}}

    def value_of(told):
        found = one_shot._figures(pieces, compared, told, raced, None, first)
        return {figure.name: figure.value for figure in found}

    found = value_of(told)
    assert found["error_share_of_sysid"] == pytest.approx((0.7**2 + 0.8**2) / 2)
    assert found["error_share_of_the_same_pieces"] == pytest.approx((0.2**2 + 0.3**2) / 2)
    assert found["error_share_of_sysid.chair"] is None
    none = value_of({"chair": told["chair"]})
    assert none["error_share_of_sysid"] is none["error_share_of_the_same_pieces"] is None


def test_a_cell_is_won_against_the_best_regression():
    shares = {OURS: {"1": 0.2, "2": 0.1}, **{of: {"1": 0.3, "2": 0.3} for of in RIVALS}}
    shares[RIVALS[1]] = {"1": 0.19, "2": None}
    assert one_shot.victories({"cart": {"shares": shares}}) == (1, 2)


def test_the_figure_shows_every_kind_and_bears_what_diverged(tmp_path):
    shares = {name: {"1": 0.5, "2": None, "5": 0.01} for name in (OURS, *RIVALS)}
    shares_figure(tmp_path / "shares.png", {of: {"shares": shares} for of in "abcd"})
    assert (tmp_path / "shares.png").read_bytes()[:4] == b"\x89PNG"


def test_a_scene_is_handled_all_at_once_and_can_be_taken_apart():
    pieces = [Piece(kind, (0.0, 4.0 * row, 0.0)) for row, kind in enumerate(KINDS)]
    hands = Together([Wiggle(3, 0, 1.0), Wiggle(3, 1, 1.5)])
    handled = record(FurnitureWorld(pieces), [hands], 3, ["all"])
    wrench = handled.trials[0][WRENCH].values
    assert len(wrench) == 75
    assert np.abs(wrench[10:50]).max(axis=(0, 2)).min() > 1.0
    assert np.abs(wrench[50:, 1]).max() > 1.0 > np.abs(wrench[51:, 0]).max()
    second = one_body(handled, 1)
    np.testing.assert_array_equal(
        second.trials[0][POSE].values[:, 0], handled.trials[0][POSE].values[:, 1]
    )
    model, whole = starting_furniture(second, PERIOD), starting_furniture(handled, PERIOD)
    np.testing.assert_array_equal(model.half_extent[0], whole.half_extent[1])


def test_samples_count_from_where_the_piece_is_seen_to_have_moved(pushes):
    model = starting_furniture(pushes, PERIOD)
    aligned = pushes.align(PERIOD, POSE, WRENCH)
    truth = np.asarray(aligned.observation[0])
    kept = first_samples(aligned, 1)
    assert kept.observation.shape[1] == kept.action.shape[1] + 1 == int(kept.length[0])
    moved = np.linalg.norm(kept.observation[0, :, 0, :2] - truth[0, 0, :2], axis=-1)
    assert moved[:-6].max() < 0.02 < moved[-6:].max()
    assert len(first_samples(aligned, 3).observation[0]) == len(kept.observation[0]) + 10
    assert len(first_samples(aligned, 1000).observation[0]) == len(truth)
    before, wrench, after = transitions(aligned, model, 5)
    count = len(wrench)
    assert count == (len(kept.observation[0]) - 1) // 5 + 4
    np.testing.assert_allclose(before.pose, truth[0 : 5 * count : 5], atol=0.01)
    np.testing.assert_allclose(after.pose, truth[5 : 5 * count + 5 : 5], atol=0.01)
    mean = np.asarray(aligned.action[0])[5:10].mean(axis=0)
    np.testing.assert_allclose(wrench[1], mean, rtol=1e-5)
    rate = (after.pose - before.pose) / 0.1
    np.testing.assert_allclose(0.5 * (before.velocity + after.velocity), rate, atol=0.05)


def test_the_posterior_is_given_the_frames_that_regressions_are_given(monkeypatch, pushes):
    first = one_body(pushes, 0)
    aligned = first.align(PERIOD, POSE, WRENCH)
    call, given = one_shot_regression.cut, []

    def noting(aligned, *arguments, **options):
        given.append(aligned.observation)
        return call(aligned, *arguments, **options)

    def stop(*_, **__):
        raise StopIteration

    monkeypatch.setattr(one_shot_regression, "cut", noting)
    monkeypatch.setattr(one_shot_regression, "compare", stop)
    seen = first_samples(aligned, 4)
    told = truncate(first, seen)
    np.testing.assert_array_equal(told.align(PERIOD, POSE, WRENCH).observation, seen.observation)
    with pytest.raises(StopIteration):
        one_shot_regression._ours(told, seen, first, 10, 0)
    transitions(aligned, starting_furniture(first, PERIOD), 3)
    np.testing.assert_array_equal(*given)
    assert len(given[0][0]) < len(aligned.observation[0])


@pytest.mark.slow
def test_a_hinge_is_found_where_climbs_with_free_scales_call_all_that_happens_noise():
    handled, _ = one_shot_pieces.recordings("hinged", 912_000, 1)
    target = posterior_of(structures(handled, PERIOD)["hinge"], handled.align(PERIOD, POSE, WRENCH))
    _, modes = settle(target, jax.random.key(0))
    assert float(modes.density[0]) > 7700.0  # 6680 is where the others end
