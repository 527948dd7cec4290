"""The filter's parts against closed forms."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from palpate.models.rope import Rope
from palpate.perception.rope import filter as rope_filter
from palpate.perception.rope.filter import RopeBelief, Sighting, advance, correct, project
from palpate.worlds.rope.filmed import TRIPOD

GRIPPER = np.array([0.0, 0.0, 1.5], np.float32)
MODEL = Rope.uniform(
    nodes=11,
    substeps=4,
    drive="position",
    bend_stiffness=2e-3,
    bend_damping=5e-4,
    grip_damping=1e-3,
    air_drag=1e-3,
)
jitted = eqx.filter_jit(advance), eqx.filter_jit(correct)  # compiled once for all tests


def belief(deviation: float = 0.03) -> RopeBelief:
    """A rope that hangs 30 degrees to the side, at rest; as uncertain as said."""
    direction = np.array([np.sin(np.pi / 6), 0.0, -np.cos(np.pi / 6)])
    nodes = GRIPPER + np.arange(1, 11)[:, None] * 0.1 * direction
    mean = np.concatenate([nodes.ravel(), np.zeros(31)]).astype(np.float32)
    deviations = jnp.full(10, deviation)
    covariance = rope_filter._block(deviations, deviations, 0.02)
    return RopeBelief(jnp.asarray(mean), covariance, jnp.asarray(GRIPPER), jnp.zeros(3))


def sighting(nodes: np.ndarray, age: float = 0.0) -> Sighting:
    """100 points on the polyline of nodes (11, 3), as a perfect camera sees them."""
    places = np.linspace(0, 10, 100)
    points = np.stack([np.interp(places, np.arange(11), axis) for axis in nodes.T], axis=-1)
    pixels, depth = TRIPOD.project(points)
    count = rope_filter.MOST_POINTS
    padded = np.zeros((count, 2)), np.full(count, np.nan)
    padded[0][:100], padded[1][:100] = pixels, depth
    valid = jnp.arange(count) < 100
    return Sighting(
        jnp.asarray(padded[0], jnp.float32),
        jnp.asarray(padded[1], jnp.float32),
        valid,
        valid,
        jnp.asarray(age, jnp.float32),
    )


def test_the_view_is_the_pinhole_s():
    points = np.random.default_rng(0).uniform((-0.5, -0.5, 0.5), (0.5, 0.5, 1.5), (20, 3))
    pixels, depth = project(TRIPOD, jnp.asarray(points, jnp.float32))
    expected = TRIPOD.project(points)
    assert np.allclose(pixels, expected[0], atol=1e-3)
    assert np.allclose(depth, expected[1], atol=1e-5)


def test_the_curve_passes_the_nodes_and_keeps_straight_lines_straight():
    weights = rope_filter.curve_weights(11)
    each = rope_filter.PER_SEGMENT
    assert np.allclose(weights[: 10 * each + 1 : each], np.eye(11), atol=1e-6)
    places = weights @ np.arange(11.0)
    assert np.allclose(places, np.arange(len(places)) / each, atol=1e-5)
    slopes = rope_filter.curve_weights(11, slope=True)
    assert np.allclose(slopes @ np.arange(11.0), 1.0, atol=1e-5)


def test_chords_of_a_circle_are_as_long_as_geometry_says():
    radius, angle = 0.2, np.arange(11) * 0.5
    nodes = radius * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    arc = dataclasses.replace(MODEL, rest_length=np.full(10, radius * 0.5))
    bent = rope_filter.bent(arc, jnp.asarray(nodes, jnp.float32), jnp.asarray(0.0))
    chord = 2 * radius * np.sin(0.25)
    assert np.allclose(bent.rest_length, chord, rtol=1e-3)
    assert abs(chord / (radius * 0.5) - 1) > 0.01


def test_prediction_is_the_model_s_and_grows_less_certain():
    before = belief()
    after = jitted[0](MODEL, before, jnp.asarray(GRIPPER))
    stepped = MODEL.step(before.state(), jnp.asarray(GRIPPER)[None])
    assert np.allclose(after.state().position, stepped.position, atol=1e-5)
    assert np.allclose(after.state().velocity, stepped.velocity, atol=1e-3)
    covariance = np.asarray(after.covariance)
    assert np.allclose(covariance, covariance.T, atol=1e-7)
    assert np.linalg.eigvalsh(covariance).min() > -1e-6
    assert covariance[-1, -1] > before.covariance[-1, -1]


def test_a_sighting_corrects_towards_what_is_seen_and_makes_certain():
    prior = belief()
    nodes = np.asarray(prior.state().position)
    moved = nodes + np.linspace(0, 0.06, 11)[:, None] * [np.cos(np.pi / 6), 0.5, 0.5]
    after, fit = jitted[1](MODEL, TRIPOD, prior, sighting(moved))
    error = np.linalg.norm(np.asarray(after.state().position) - moved, axis=-1)
    assert int(fit.explained.sum()) > 90
    assert error.max() < 0.012
    assert np.linalg.norm(moved - nodes, axis=-1).max() > 0.06
    assert np.trace(after.covariance[:30, :30]) < 0.1 * np.trace(prior.covariance[:30, :30])


def test_a_frame_of_earlier_is_seen_where_the_rope_was():
    prior = belief()
    speed = np.tile([0.0, 1.0, 0.0], (10, 1)) * np.arange(1, 11)[:, None] / 10
    mean = np.asarray(prior.mean).copy()
    mean[30:60] = speed.ravel()
    prior = RopeBelief(jnp.asarray(mean), 1e-2 * prior.covariance, prior.gripper, jnp.zeros(3))
    earlier = np.asarray(prior.state().position).copy()
    earlier[1:] -= 0.005 * speed
    after, _ = jitted[1](MODEL, TRIPOD, prior, sighting(earlier, age=0.005))
    assert np.allclose(after.mean[:30], prior.mean[:30], atol=1e-3)


def test_points_far_from_the_rope_are_not_believed():
    prior = belief(0.005)
    nodes = np.asarray(prior.state().position)
    _, fit = jitted[1](MODEL, TRIPOD, prior, sighting(nodes + np.array([0.0, 0.4, 0.0])))
    assert int(fit.explained.sum()) < 0.1 * 100
