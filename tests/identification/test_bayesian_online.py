"""A belief that follows the data as they arrive, and does not die of what it cannot explain."""

import equinox as eqx
import jax
import numpy as np
import pytest

from bayesian_toys import NOISE, Sled, pushes
from palpate.errors import PalpateError
from palpate.identification.data.segments import cut
from palpate.identification.online import absorb, begin, models_of, places
from palpate.identification.posterior.likelihood import inferred_scales, motion_posterior
from palpate.identification.samplers.tempered import effective_share, temper

TRUE = Sled(mass=14.0, friction=[6.0, 40.0])
MODEL = Sled(mass=10.0, friction=[15.0, 15.0])
SCALES = inferred_scales(MODEL, NOISE)


def pieces(sled, seed, trials=4):
    return cut(pushes(sled, seed, trials=trials, frames=51), MODEL, 1.0, at_rest=True)


def followed(data, count=None):
    belief = begin(places(MODEL, SCALES, 4, 50), jax.random.key(0))
    notes = []
    for index in range(data.count if count is None else count):
        belief, note = absorb(belief, data.take([index]), jax.random.key(index + 1))
        notes.append(note)
    return belief, notes


def test_particles_end_where_all_the_data_at_once_lead():
    data = pieces(TRUE, 1)
    belief, notes = followed(data)
    assert notes == [None] * 4
    models = models_of(belief, 500, jax.random.key(9))
    once = motion_posterior(MODEL, data, SCALES)
    found = temper(once, jax.random.key(5), particles=500, moves=20)
    masses = np.asarray(jax.vmap(once.model)(found.position).mass)
    assert np.mean(models.mass) == pytest.approx(14.0, rel=0.02)
    assert abs(np.mean(models.mass) - masses.mean()) < 1.0 * masses.std()
    assert 0.5 < np.std(models.mass) / masses.std() < 2.0


def test_a_belief_that_begins_with_data_goes_on_where_a_piece_has_gaps():
    """All that it begins with was seen and has one rotation; what comes has its own."""
    data = pieces(TRUE, 1)
    once = motion_posterior(MODEL, data, SCALES)
    found = once.with_one_rotation()
    assert found.rotation.shape[:2] == (1, 1)
    belief = begin(found, jax.random.key(0), 64)
    seen = np.array(data.seen[:1])
    seen[:, 10:20] = False
    gaps = eqx.tree_at(lambda piece: piece.seen, data.take([0]), seen)
    belief, _ = absorb(belief, gaps, jax.random.key(1))
    alone = motion_posterior(MODEL, gaps, SCALES)
    np.testing.assert_array_equal(belief.target.rotation[0], alone.rotation[0])
    np.testing.assert_array_equal(belief.target.rotation[1:], once.rotation[1:])


def test_a_belief_narrows_with_each_piece():
    data = pieces(TRUE, 2)
    spreads = [np.std(models_of(followed(data, n)[0], 256, jax.random.key(0)).mass) for n in (1, 4)]
    assert spreads[1] < spreads[0] < 1.0


def test_another_sled_after_the_first_is_believed_in_the_end():
    """With four places the first sled's pieces are forgotten when the second's have filled them."""
    belief, _ = followed(pieces(TRUE, 1))
    other = pieces(Sled(mass=40.0, friction=[60.0, 3.0]), 4)
    for index in range(4):
        belief, _ = absorb(belief, other.take([index]), jax.random.key(100 + index))
    assert effective_share(belief.log_weight) > 0.4
    assert np.mean(models_of(belief, 256, jax.random.key(0)).mass) == pytest.approx(40.0, rel=0.1)


def test_particles_that_all_fail_begin_anew():
    data = pieces(TRUE, 1)
    belief, _ = followed(data, 2)
    dead = type(belief)(
        belief.target, belief.position * np.nan, belief.log_weight, belief.scale, belief.filled
    )
    belief, note = absorb(dead, data.take([2]), jax.random.key(3))
    assert "began anew from the prior" in note
    assert np.mean(models_of(belief, 256, jax.random.key(0)).mass) == pytest.approx(14.0, rel=0.05)


def test_a_piece_that_no_model_explains_is_left_out():
    data = pieces(TRUE, 1)
    before, _ = followed(data, 2)
    piece = data.take([2])
    broken = eqx.tree_at(lambda piece: piece.action, piece, piece.action * np.inf)
    belief, note = absorb(before, broken, jax.random.key(3))
    assert "no particle explained" in note
    assert "the piece was left out" in note
    np.testing.assert_array_equal(belief.position, before.position)
    np.testing.assert_array_equal(belief.log_weight, before.log_weight)
    belief, note = absorb(belief, piece, jax.random.key(4))
    assert note is None
    assert np.mean(models_of(belief, 256, jax.random.key(0)).mass) == pytest.approx(14.0, rel=0.02)


def test_pieces_of_another_length_are_refused():
    belief = begin(places(MODEL, SCALES, 4, 50), jax.random.key(0), 64)
    with pytest.raises(PalpateError, match="expected one piece of 50 control periods"):
        absorb(belief, pieces(TRUE, 1), jax.random.key(0))
