"""Bayesian identification from end to end, on a sled seen by a noisy camera."""

import jax
import numpy as np
import pytest

from bayesian_toys import NOISE, Sled, pushes
from palpate.errors import PalpateError
from palpate.identification.bayesian import identify
from palpate.identification.segments import cut

TRUE = Sled(mass=14.0, friction=[6.0, 40.0])
MODEL = Sled(mass=10.0, friction=[15.0, 15.0])


@pytest.fixture(scope="module")
def posterior():
    # Headed backwards: the camera's angle jumps by a turn within the pieces.
    return identify(MODEL, pushes(TRUE, 1, heading=3.1), at_rest=True, draws=400)


def test_the_truth_lies_within_the_intervals(posterior):
    rows = {row.name: row for row in posterior.table}
    for name, true in (("mass", 14.0), ("friction[0]", 6.0), ("friction[1]", 40.0)):
        row = rows[name]
        width = row.upper - row.lower
        assert row.lower - width < true < row.upper + width
        assert width < 0.1 * true
        assert not row.undecided
    assert rows["noise (m)"].median == pytest.approx(NOISE[0], rel=0.15)
    assert rows["noise (rad)"].median == pytest.approx(NOISE[2], rel=0.15)


def test_chains_agree(posterior):
    assert posterior.rhat_of_predictions < 1.01
    assert posterior.size_of_predictions > 400
    assert posterior.draws.divergences <= 8


def test_intervals_cover_pushes_it_has_not_seen(posterior):
    held_out = cut(pushes(TRUE, 2, trials=20, heading=-3.0), MODEL, 2.0, at_rest=True)
    score = posterior.score(held_out)
    assert 0.85 < score.coverage[0.9] < 0.96
    assert 0.42 < score.coverage[0.5] < 0.62
    assert np.all(score.error < 3.0 * NOISE)


def test_models_are_a_batch(posterior):
    models = posterior.models(50)
    assert models.mass.shape == (50,)
    assert models.friction.shape == (50, 2)
    assert np.all(np.asarray(models.friction) > 0.0)


def test_the_same_seed_gives_the_same_draws(posterior):
    again = identify(MODEL, pushes(TRUE, 1, heading=3.1), at_rest=True, draws=400)
    np.testing.assert_array_equal(again.draws.position, posterior.draws.position)


def test_another_recording_of_the_same_shape_compiles_nothing(posterior):
    with jax.log_compiles(), pytest.MonkeyPatch.context():
        import logging

        records = []
        handler = logging.Handler()
        handler.emit = records.append
        logging.getLogger("jax").addHandler(handler)
        try:
            identify(MODEL, pushes(TRUE, 5, heading=3.1), at_rest=True, draws=400)
        finally:
            logging.getLogger("jax").removeHandler(handler)
    assert not [r for r in records if "_block" in r.getMessage() or "_climb" in r.getMessage()]


def test_an_unmoved_sled_is_said_to_tell_nothing():
    recording = pushes(TRUE, 3, trials=1, frames=61)
    still = type(recording)(
        recording.period,
        0.0 * recording.observation
        + np.float32(NOISE)
        * np.random.default_rng(0).normal(size=recording.observation.shape).astype(np.float32),
        0.0 * recording.action,
        recording.length,
    )
    found = identify(MODEL, still, at_rest=True, draws=400)
    assert {"mass", "friction[0]", "friction[1]"} <= set(found.undecided)
    assert any("next to nothing of" in sentence for sentence in found.warnings)


def test_a_model_that_fails_says_so():
    recording = pushes(TRUE, 3, trials=1, frames=61)
    broken = type(recording)(
        recording.period, recording.observation, recording.action * np.inf, recording.length
    )
    with pytest.raises(PalpateError, match="not finite anywhere"):
        identify(MODEL, broken, at_rest=True, draws=50)
