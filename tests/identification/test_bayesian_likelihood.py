"""The likelihood of pieces of motion against dense normal distributions, and how they are cut."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import hinge
from bayesian_toys import NOISE, Sled, pushes
from palpate.errors import PalpateError
from palpate.identification.data.prediction import residuals
from palpate.identification.data.segments import VAGUE, Segments, cut, known_start, noise_scale
from palpate.identification.posterior.discrepancy import (
    MEMORY,
    discrepancy_covariance,
    eigenvectors,
)
from palpate.identification.posterior.likelihood import (
    from_start,
    inferred_scales,
    initial_position,
    known_scales,
    motion_posterior,
)
from palpate.identification.posterior.predictive import Predicted, predict, score
from palpate.models.model import rollout
from palpate.parameters import sample_prior
from palpate.recordings import Aligned
from toys import Cart, CartState, Pendulum

SLED = Sled(mass=14.0, friction=[6.0, 40.0])


def aligned_with(recording, observation):
    return type(recording)(recording.period, observation, recording.action, recording.length)


@pytest.mark.usefixtures("float64")
def test_the_likelihood_is_that_of_the_dense_normal_distribution():
    """Noise, a discrepancy that grows, unseen frames, and a start that is not known."""
    recording = pushes(SLED, 1, trials=1, frames=31)
    observation = recording.observation.astype(float).copy()
    observation[0, 20, 1] = np.nan
    sled = Sled(mass=14.0, friction=[6.0, 40.0])
    segments = cut(aligned_with(recording, observation), sled, 0.4)
    target = motion_posterior(sled, segments, inferred_scales(sled, NOISE))
    position = initial_position(target) + 0.1
    target = target.linearised(position)
    found = np.asarray(eqx.filter_jit(target.by_segment)(position))
    kernel = discrepancy_covariance(0.02 * np.arange(1, 21))
    model = target.model(position)
    noise, growth = np.asarray(target.noise(position)), np.asarray(target.growth(position))

    def moved(error, piece):
        pose, rate = (VAGUE * part for part in jnp.split(error, 2))
        start = Segments(
            piece.pose + pose * piece.pose_deviation,
            piece.rate + rate * piece.rate_deviation,
            *(piece.pose_deviation, piece.rate_deviation),
            *(piece.action, piece.target, piece.seen),
        )
        return residuals(model, from_start(model, start), piece)[0].T.ravel()

    centre, spread = eqx.filter_jit(moved), eqx.filter_jit(jax.jacfwd(moved))
    for index in range(segments.count):
        piece = segments.take([index])
        mean = np.asarray(centre(jnp.zeros(6), piece))
        starts = np.asarray(spread(jnp.zeros(6), piece))
        covariance = starts @ starts.T
        for channel in range(3):
            rows = slice(20 * channel, 20 * channel + 20)
            covariance[rows, rows] += (
                noise[channel] ** 2 * np.eye(20) + growth[channel] ** 2 * kernel
            )
        seen = np.asarray(piece.seen)[0].T.ravel()
        expected = multivariate_normal.logpdf(
            mean[seen], np.zeros(seen.sum()), covariance[np.ix_(seen, seen)]
        )
        assert found[index] == pytest.approx(expected, rel=1e-8)


@pytest.mark.usefixtures("float64")
def test_curvature_is_that_of_the_expected_information():
    """At data without residuals, Fisher's information of the mean is minus the Hessian."""
    sled = Sled(mass=14.0, friction=[6.0, 40.0])
    actions = jnp.asarray(np.random.default_rng(0).normal(size=(2, 10, 3))) * 10.0
    pose = jnp.zeros((2, 3))
    blank = known_start(pose, pose, actions, jnp.zeros((2, 10, 3)))
    exact = known_start(pose, pose, actions, from_start(sled, blank))
    target = motion_posterior(sled, exact, known_scales(sled, NOISE))
    position = initial_position(target)
    value, slope, curvature = eqx.filter_jit(target.curvature)(position)
    assert value == pytest.approx(float(eqx.filter_jit(target.density)(position)))
    gradient, hessian = jax.jit(jax.grad(target.density)), jax.jit(jax.hessian(target.density))
    np.testing.assert_allclose(slope, gradient(position), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(curvature, -hessian(position), rtol=1e-6)


@pytest.mark.usefixtures("float64")
def test_several_positions_side_by_side_are_each_by_itself():
    sled = Sled(mass=14.0, friction=[6.0, 40.0])
    segments = cut(pushes(SLED, 1, trials=2, frames=31), sled, 0.2)
    target = motion_posterior(sled, segments, inferred_scales(sled, NOISE))
    positions = jnp.asarray(np.random.default_rng(0).normal(size=(3, target.dimension))) * 0.3
    densities, curvatures = jax.jit(lambda p: (target.densities(p), target.curvatures(p)))(
        positions
    )
    slopes = jax.jit(jax.grad(lambda p: jnp.sum(target.densities(p))))(positions)

    @jax.jit
    def alone(position):
        return jax.value_and_grad(target.density)(position), target.curvature(position)

    for index, position in enumerate(positions):
        (value, slope), curvature = alone(position)
        assert densities[index] == pytest.approx(float(value), rel=1e-12)
        np.testing.assert_allclose(slopes[index], slope, rtol=1e-9, atol=1e-9)
        for several, one in zip(curvatures, curvature, strict=True):
            np.testing.assert_allclose(several[index], one, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(curvatures[1][index], slope, rtol=1e-8, atol=1e-8)
    assert np.ptp(densities) > 1.0


@pytest.mark.usefixtures("float64")
def test_curvature_counts_what_an_unknown_start_explains_as_the_dense_covariance_does():
    sled = Sled(mass=14.0, friction=[6.0, 40.0])
    segments = cut(pushes(SLED, 1, trials=1, frames=31), sled, 0.4)
    target = motion_posterior(sled, segments, known_scales(sled, NOISE))
    position = initial_position(target) + 0.1
    target = target.linearised(position)

    def off(position, error, piece):
        pose, rate = (VAGUE * part for part in jnp.split(error, 2))
        start = Segments(
            piece.pose + pose * piece.pose_deviation,
            piece.rate + rate * piece.rate_deviation,
            *(piece.pose_deviation, piece.rate_deviation),
            *(piece.action, piece.target, piece.seen),
        )
        model = target.model(position)
        return residuals(model, from_start(model, start), piece)[0].ravel()

    slopes, expected = jax.jit(jax.jacfwd(off, argnums=(0, 1))), np.eye(3)
    for index in range(segments.count):
        piece = segments.take([index])
        slope, starts = slopes(position, jnp.zeros(6), piece)
        seen = np.asarray(piece.seen)[0].ravel()
        slope, starts = np.asarray(slope)[seen], np.asarray(starts)[seen]
        noise = np.tile(np.square(NOISE), 20)[seen]
        expected += slope.T @ np.linalg.solve(starts @ starts.T + np.diag(noise), slope)
    found = np.asarray(eqx.filter_jit(lambda t: t.curvature(position)[2])(target))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * expected.max())


@pytest.mark.usefixtures("float64")
def test_the_discrepancy_is_twice_integrated_from_an_acceleration_that_is_forgotten():
    rng = np.random.default_rng(0)
    step, count = 1e-3, 4000
    kept = np.exp(-step / MEMORY)
    acceleration = rng.normal(size=(count, 1000)) / np.sqrt(2.0 * MEMORY)
    for now in range(1, 1000):
        acceleration[:, now] *= np.sqrt(1.0 - kept**2)
        acceleration[:, now] += kept * acceleration[:, now - 1]
    path = np.cumsum(np.cumsum(acceleration, axis=1), axis=1) * step**2
    at = [49, 249, 499, 999]
    expected = discrepancy_covariance(step * (np.array(at) + 1.0))
    np.testing.assert_allclose(np.cov(path[:, at], rowvar=False), expected, rtol=0.1)


@pytest.mark.usefixtures("float64")
def test_the_discrepancy_of_a_force_comes_and_goes_and_that_of_a_place_grows():
    """A likelihood that takes a sensor's lasting noise for white counts it many times."""
    seen = np.ones((2, 15, 3), bool)
    vectors, values, _ = eigenvectors(seen, 0.02, np.array([False, True, True]))
    kernel = np.einsum("wcts,wcs,wcus->wctu", vectors, values, vectors)
    time = 0.02 * np.arange(1, 16)
    forgotten = np.exp(-np.abs(time[:, None] - time) / MEMORY)
    np.testing.assert_allclose(kernel[:, 1:], np.broadcast_to(forgotten, (2, 2, 15, 15)), atol=1e-9)
    np.testing.assert_allclose(kernel[0, 0], discrepancy_covariance(time), atol=1e-12)


def test_angles_are_wrapped():
    recording = pushes(SLED, 1)
    turned = recording.observation.copy()
    turned[..., 2] += np.float32(4.0 * np.pi)
    densities = [
        eqx.filter_jit(
            motion_posterior(
                SLED, cut(aligned, SLED, 1.0, at_rest=True), known_scales(SLED, NOISE)
            ).by_segment
        )(jnp.zeros(3))
        for aligned in (recording, aligned_with(recording, turned))
    ]
    np.testing.assert_allclose(*densities, rtol=1e-3)


def test_noise_is_found_under_any_smooth_motion():
    found = noise_scale(pushes(SLED, 1, trials=8), SLED)
    np.testing.assert_allclose(found, NOISE, rtol=0.1)


def test_smoothed_starts_are_as_good_as_they_say():
    errors, seen = [], []
    for seed in range(12):
        recording = pushes(SLED, seed)
        clean = rollout(
            SLED,
            SLED.initial_state(jnp.zeros((4, 1, 3))),
            jnp.asarray(recording.action),
        )
        pieces = cut(recording, SLED, 1.0)
        rows = np.arange(1, pieces.count, 2)  # the second piece of each trial begins in mid motion
        errors.append(np.asarray(pieces.rate[rows] - clean.rate[:, 49]))
        seen.append(np.asarray(pieces.rate_deviation[rows]))
    ratio = np.concatenate(errors) / np.concatenate(seen)
    assert 0.7 < np.sqrt(np.mean(np.square(ratio))) < 2.0  # wrenches jump within the polynomial


def test_pieces_at_rest_begin_at_rest_and_short_ones_are_padded():
    recording = pushes(SLED, 1, trials=2, frames=81)
    pieces = cut(recording, SLED, 1.0, at_rest=True, count=6)
    assert (pieces.count, pieces.horizon) == (6, 50)
    assert np.all(np.asarray(pieces.rate_deviation)[[0, 2]] == 0.0)
    assert np.all(np.asarray(pieces.rate_deviation)[[1, 3]] > 0.0)
    seen = np.asarray(pieces.seen).all(axis=2).sum(axis=1)
    np.testing.assert_array_equal(seen, [50, 30, 50, 30, 0, 0])
    with pytest.raises(PalpateError, match="do not fit into 3"):
        cut(recording, SLED, 1.0, count=3)


@pytest.mark.parametrize(("frames", "kept"), [(61, [50, 10]), (60, [50]), (9, [8])])
def test_what_remains_is_kept_unless_it_is_shorter_than_the_smoothing(frames, kept):
    pieces = cut(pushes(SLED, 1, trials=1, frames=frames), SLED, 1.0, at_rest=True)
    np.testing.assert_array_equal(np.asarray(pieces.seen).all(axis=2).sum(axis=1), kept)


def test_a_recording_in_which_nothing_is_seen_is_refused():
    recording = pushes(SLED, 1)
    with pytest.raises(PalpateError, match="no piece of 1 s can begin"):
        cut(aligned_with(recording, recording.observation * np.nan), SLED, 1.0)


def test_pieces_of_another_model_and_noise_without_size_are_refused():
    pieces = cut(pushes(SLED, 1), SLED, 1.0)
    with pytest.raises(PalpateError, match=r"Cart observes \(1,\)"):
        motion_posterior(Cart(mass=1.0, friction=1.0), pieces, known_scales(SLED, NOISE))
    with pytest.raises(PalpateError, match="positive noise"):
        known_scales(SLED, np.array([1e-3, 0.0, 1e-3]))


class LinearCart(Cart):
    """Of unit names, so that its scales have labels."""

    observation_units = ("m",)


def test_predictions_cover_as_they_claim():
    """Draws of the prior predict motions of other draws of the prior: 90 % lie within 90 %."""
    model = LinearCart(mass=1.0, friction=0.5)
    models = jax.vmap(lambda key: sample_prior(model, key))(jax.random.split(jax.random.key(0), 60))
    rng = np.random.default_rng(0)
    action = jnp.asarray(np.repeat(rng.normal(size=(60, 4, 1)), 10, axis=1), jnp.float32)
    states = jax.vmap(rollout)(models, CartState(jnp.zeros((60, 1)), jnp.zeros((60, 1))), action)
    noisy = np.asarray(states.position) + 0.01 * rng.normal(size=(60, 40, 1)).astype(np.float32)
    pieces = known_start(jnp.zeros((60, 1)), jnp.zeros((60, 1)), action, jnp.asarray(noisy))
    target = motion_posterior(model, pieces, known_scales(model, np.array([0.01])))
    draws = np.random.default_rng(1).normal(size=(400, 2)).astype(np.float32)
    predicted = predict(target, draws, pieces, seed=0)
    found = score(target, predicted, pieces)
    assert found.coverage[0.9] == pytest.approx(0.9, abs=0.06)
    assert found.coverage[0.5] == pytest.approx(0.5, abs=0.1)
    assert found.error == pytest.approx(found.spread, rel=0.4)
    lower, upper = predicted.interval(0.9)
    assert np.all(lower < upper)
    sharper = score(target, predict(target, draws * 0.0, pieces, seed=0), pieces)
    assert sharper.log_score < found.log_score


def test_the_error_of_what_is_never_seen_is_not_known():
    """Of y a quarter of the frames, of the angle none."""
    shape = 2, 8, 3
    nothing, seen = jnp.zeros((2, 3)), np.ones(shape, bool)
    seen[0, :, 1], seen[1, 4:, 1], seen[..., 2] = False, False, False
    pieces = known_start(nothing, nothing, jnp.zeros(shape), jnp.zeros(shape), jnp.asarray(seen))
    target = motion_posterior(SLED, pieces, known_scales(SLED, NOISE))
    noise = np.random.default_rng(0).normal(size=(100, *shape))
    motion = np.broadcast_to([3.0, 6.0, 1.0], noise.shape)
    found = score(target, Predicted(motion, motion + noise, np.ones(noise.shape)), pieces)
    np.testing.assert_array_equal(found.seen, [16, 4, 0])
    np.testing.assert_allclose(found.error, [3.0, 6.0, np.nan])
    assert np.isfinite(found.spread).tolist() == [True, True, False]
    for share in found.coverage_by_channel.values():
        assert np.isfinite(share).tolist() == [True, True, False]
    metres = np.array([True, True, False])
    assert found.pooled(metres) == pytest.approx(np.sqrt((16 * 3**2 + 4 * 6**2) / 20))
    assert np.isnan(found.pooled(~metres))


def test_unseen_pieces_cannot_be_scored():
    model = LinearCart(mass=1.0, friction=0.5)
    nothing = jnp.zeros((1, 1))
    pieces = known_start(nothing, nothing, jnp.zeros((1, 10, 1)), jnp.full((1, 10, 1), jnp.nan))
    target = motion_posterior(model, pieces, known_scales(model, np.array([0.01])))
    with pytest.raises(PalpateError, match="nothing to score"):
        score(target, predict(target, np.zeros((10, 2), np.float32), pieces, 0), pieces)


def test_a_draw_without_a_finite_motion_is_named():
    model = LinearCart(mass=1.0, friction=0.5)
    nothing = jnp.zeros((1, 1))
    pieces = known_start(nothing, nothing, jnp.ones((1, 10, 1)), jnp.zeros((1, 10, 1)))
    target = motion_posterior(model, pieces, known_scales(model, np.array([0.01])))
    draws = np.zeros((10, 2), np.float32)
    draws[3] = np.nan
    with pytest.raises(PalpateError, match="draw 3 of the posterior predicts no finite motion"):
        predict(target, draws, pieces, 0)


@pytest.mark.usefixtures("float64")
def test_the_most_probable_error_of_a_start_is_found_where_the_model_is_not_linear_in_it():
    """A start that is far off: rounds about it find it, and the likelihood is that of a good one.

    The hinge begins near the top, so that its motion is not linear in where it begins.
    """
    recording = hinge.recorded(0, trials=2, seconds=1.0)
    good = cut(recording, hinge.TRUE, 1.0)
    off = jnp.asarray([[[1.5], [-1.0]], [[-1.0], [1.5]]])  # pose and rate, in vague deviations
    wide = eqx.tree_at(
        lambda s: (s.pose_deviation, s.rate_deviation),
        good,
        (0.05 + 0.0 * good.pose, 0.3 + 0.0 * good.rate),
    )
    bad = wide.moved(off)
    scales = known_scales(hinge.TRUE, np.array([hinge.NOISE]))
    found = {}
    for name, pieces, rounds in (("good", wide, 3), ("bad", bad, 3), ("linear", bad, 0)):
        target = motion_posterior(hinge.TRUE, pieces, scales, ringing=True)
        position = initial_position(target)
        found[name] = target.linearised(position, rounds)
    start = found["good"].error - off.reshape(2, 2)
    assert np.allclose(found["bad"].error, start, atol=0.01)
    densities = {
        name: float(eqx.filter_jit(t.log_likelihood)(position)) for name, t in found.items()
    }
    # The two differ by the prior of the starts' errors, half a square each.
    prior = 0.5 * float(jnp.sum(jnp.square(start)) - jnp.sum(jnp.square(found["good"].error)))
    assert densities["bad"] == pytest.approx(densities["good"] - prior, abs=0.5)
    assert densities["linear"] < densities["good"] - 50.0


def test_half_a_rest_is_averaged_and_not_seen_again():
    """Forty frames at rest, then motion: one start from the mean of the first half of them."""
    rng = np.random.default_rng(0)
    still = np.zeros((1, 90, 1))
    still[0, 40:, 0] = 0.1 * np.arange(1, 51)
    noise = 1e-3 * rng.standard_normal(still.shape)
    aligned = Aligned(0.02, still + noise, np.zeros((1, 89, 1)), np.array([90]))
    (pieces, usual) = (
        cut(aligned, hinge.TRUE, 5.0, at_rest=True, ringing=ringing) for ringing in (True, False)
    )
    (deviation,) = np.asarray(VAGUE * pieces.pose_deviation)[0]
    assert np.asarray(pieces.rate_deviation) == 0.0
    assert deviation == pytest.approx(noise_scale(aligned, hinge.TRUE)[0] / np.sqrt(19))
    assert abs(float(pieces.pose[0, 0])) < 3.0 * deviation
    first = int(np.argmax(np.asarray(pieces.target)[0, :, 0] > 0.05))
    assert first == 40 - 19  # the frames of the rest are not there again
    assert int(np.argmax(np.asarray(usual.target)[0, :, 0] > 0.05)) == 39


def test_starts_that_ring_on_are_not_taken_for_damping():
    """A pendulum left alone, its angle known to a tenth of a radian: the density has the slope of
    one whose starts are propagated anew everywhere, and not of one that has them fixed.
    """
    model, still = Pendulum(1.0, 0.5), jnp.zeros((3, 100, 1))
    pieces = known_start(jnp.zeros((3, 1)), jnp.zeros((3, 1)), still, still)
    pieces = eqx.tree_at(lambda p: p.pose_deviation, pieces, jnp.full((3, 1), 0.1 / VAGUE))
    target = motion_posterior(model, pieces, known_scales(model, np.array([0.01])), ringing=True)
    here, (index,) = initial_position(target), (0,)
    assert target.names[index] == "damping"

    def slope(densities):
        return (float(densities[1]) - float(densities[0])) / 0.2

    sides = here.at[index].add(-0.1), here.at[index].add(0.1)
    anew = slope([eqx.filter_jit(target.linearised(side).density)(side) for side in sides])
    assert slope(list(map(eqx.filter_jit(target.density), sides))) == pytest.approx(anew, abs=0.05)
    fixed = eqx.tree_at(lambda t: t.volume_slope, target, jnp.zeros_like(target.volume_slope))
    assert slope(list(map(eqx.filter_jit(fixed.density), sides))) < anew - 0.2


def test_a_trial_that_rests_to_its_end_is_not_lost():
    noise = 1e-3 * np.random.default_rng(1).standard_normal((1, 60, 1))
    aligned = Aligned(0.02, noise, np.zeros((1, 59, 1)), np.array([60]))
    pieces = cut(aligned, hinge.TRUE, 5.0, at_rest=True, ringing=True)
    assert np.asarray(pieces.seen).sum() == 30
