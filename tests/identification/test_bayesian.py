"""Bayesian identification from end to end, on a sled seen by a noisy camera."""

import contextlib
import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayesian_toys import NOISE, Sled, pushes
from palpate.errors import PalpateError
from palpate.identification.data.segments import cut
from palpate.identification.posterior.comparison import posterior_of
from palpate.identification.posterior.laplace import Modes
from palpate.identification.posterior.likelihood import known_scales, motion_posterior
from palpate.identification.posterior.posterior import SAMPLERS, Sampler, prepare_sampler, sample
from palpate.identification.posterior.settled import Part, Settled, settle_each

pytestmark = pytest.mark.optimised

TRUE = Sled(mass=14.0, friction=[6.0, 40.0])
MODEL = Sled(mass=10.0, friction=[15.0, 15.0])


COMPILED = {"_look", "_sensitivity", "_walk_chains"}


@contextlib.contextmanager
def compiled(among=COMPILED):
    """Those functions that are compiled meanwhile, in a set that fills."""
    names, handler = set(), logging.Handler()

    def emit(record):
        message = record.getMessage()
        if message.startswith("Compiling"):
            names.update(name for name in among if f"jit({name})" in message)

    handler.emit = emit
    logging.getLogger("jax").addHandler(handler)
    jax.config.update("jax_log_compiles", True)  # in all threads, as `jax.log_compiles` does not
    try:
        yield names
    finally:
        jax.config.update("jax_log_compiles", False)
        logging.getLogger("jax").removeHandler(handler)


@pytest.fixture(scope="module")
def first():
    """A posterior, and what was compiled for it."""
    with compiled() as names:
        # Headed backwards: the camera's angle jumps by a turn within the pieces.
        found = sample(posterior_of(MODEL, pushes(TRUE, 1, heading=3.1), seconds=1.0), draws=200)
    return found, names


@pytest.fixture(scope="module")
def posterior(first):
    return first[0]


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
    again = sample(posterior_of(MODEL, pushes(TRUE, 1, heading=3.1), seconds=1.0), draws=200)
    np.testing.assert_array_equal(again.draws.position, posterior.draws.position)


def test_another_recording_of_the_same_shape_compiles_nothing(first):
    assert first[1] == COMPILED
    with compiled() as names:
        sample(posterior_of(MODEL, pushes(TRUE, 5, heading=3.1), seconds=1.0), draws=50)
    assert not names


def test_a_sampler_that_was_compiled_during_the_search_is_not_compiled_again():
    scales = known_scales(MODEL, NOISE)  # another shape than all others here
    target = motion_posterior(MODEL, cut(pushes(TRUE, 3), MODEL, 1.0, at_rest=True), scales)
    with compiled() as names, prepare_sampler(target, 6):
        settled = settle_each(target, jax.random.key(0))
    assert "_walk_chains" in names
    with compiled() as names:
        sample(settled, chains=6, draws=4)
    assert not names


def test_one_chain_is_sampled_and_judged_by_its_halves():
    target = motion_posterior(
        MODEL, cut(pushes(TRUE, 3), MODEL, 1.0, at_rest=True), known_scales(MODEL, NOISE)
    )
    found = sample(target, chains=1, draws=200)
    assert found.draws.position.shape == (1, 200, target.dimension)
    mass = next(row for row in found.table if row.name == "mass")
    assert mass.lower < 14.0 < mass.upper


def test_fewer_draws_than_can_be_judged_are_refused_at_once(monkeypatch):
    def searched(*_):
        raise AssertionError("expected to be refused before the search for modes")

    monkeypatch.setattr("palpate.identification.posterior.posterior.settle_each", searched)
    monkeypatch.setitem(SAMPLERS, "local-global", Sampler(searched, 32, 100))
    recording = pushes(TRUE, 3, trials=1, frames=61)
    target = motion_posterior(
        MODEL, cut(recording, MODEL, 1.0, at_rest=True), known_scales(MODEL, NOISE)
    )
    some = jnp.zeros((1, target.dimension))
    modes = Modes(some, some[0, :1], some, np.eye(target.dimension)[None], some[0, :1])
    part = Part(target, modes, np.arange(target.dimension))
    for few in ({"draws": 3}, {"draws": -1}, {"chains": 0}, {"chains": -2}):
        with pytest.raises(PalpateError, match="expected at least 1 chain of 4 draws"):
            sample(target, **few)
        with pytest.raises(PalpateError, match="expected at least 1 chain of 4 draws"):
            sample(Settled(target, (part,)), **few)


def test_a_posterior_of_too_many_coordinates_is_for_the_no_u_turn_sampler(posterior, monkeypatch):
    monkeypatch.setattr(
        "palpate.identification.posterior.posterior.WIDEST", posterior.target.dimension - 1
    )
    with compiled({"_block", "_walk_chains"}) as names:
        found = sample(posterior.settled, chains=4, draws=150)
    assert names == {"_block"}
    assert found.draws.position.shape == (4, 150, posterior.target.dimension)
    np.testing.assert_allclose(
        found.flat.mean(axis=0), posterior.flat.mean(axis=0), atol=0.25 * posterior.flat.std()
    )


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
    found = sample(posterior_of(MODEL, still, seconds=1.0))
    assert {"mass", "friction[0]", "friction[1]"} <= set(found.undecided)
    assert any("next to nothing of" in sentence for sentence in found.warnings)


def test_a_model_that_fails_says_so():
    recording = pushes(TRUE, 3, trials=1, frames=61)
    broken = type(recording)(
        recording.period, recording.observation, recording.action * np.inf, recording.length
    )
    with pytest.raises(PalpateError, match="not finite anywhere"):
        sample(posterior_of(MODEL, broken, seconds=1.0), draws=50)
