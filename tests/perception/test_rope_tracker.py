"""The filter's parts against closed forms, and the whole against ropes that MuJoCo knows."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.models.rope import Rope
from palpate.perception import rope_tracking
from palpate.perception.image_folder import read_image_folder, write_image_folder
from palpate.perception.rope_segmentation import Appearance
from palpate.perception.rope_tracking import (
    Belief,
    RopeTracker,
    Sighting,
    View,
    advance,
    correct,
)
from palpate.worlds.filmed_rope import ROPE_COLOUR, TRIPOD, FilmedRope
from palpate.worlds.pinhole import Frame
from palpate.worlds.rope import RopeConfiguration

ROPE = Appearance(ROPE_COLOUR, 5e-3)
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


def belief(deviation: float = 0.03) -> Belief:
    """A rope that hangs 30 degrees to the side, at rest; as uncertain as said."""
    direction = np.array([np.sin(np.pi / 6), 0.0, -np.cos(np.pi / 6)])
    nodes = GRIPPER + np.arange(1, 11)[:, None] * 0.1 * direction
    mean = np.concatenate([nodes.ravel(), np.zeros(31)]).astype(np.float32)
    deviations = jnp.full(10, deviation)
    covariance = rope_tracking._block(deviations, deviations, 0.02)
    return Belief(jnp.asarray(mean), covariance, jnp.asarray(GRIPPER), jnp.zeros(3))


def sighting(nodes: np.ndarray, age: float = 0.0) -> Sighting:
    """100 points on the polyline of nodes (11, 3), as a perfect camera sees them."""
    places = np.linspace(0, 10, 100)
    points = np.stack([np.interp(places, np.arange(11), axis) for axis in nodes.T], axis=-1)
    pixels, depth = TRIPOD.project(points)
    count = rope_tracking.MOST_POINTS
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
    pixels, depth = View.of(TRIPOD).project(jnp.asarray(points, jnp.float32))
    expected = TRIPOD.project(points)
    assert np.allclose(pixels, expected[0], atol=1e-3)
    assert np.allclose(depth, expected[1], atol=1e-5)


def test_the_curve_passes_the_nodes_and_keeps_straight_lines_straight():
    weights = rope_tracking._curve(11)
    each = rope_tracking.PER_SEGMENT
    assert np.allclose(weights[: 10 * each + 1 : each], np.eye(11), atol=1e-6)
    places = weights @ np.arange(11.0)
    assert np.allclose(places, np.arange(len(places)) / each, atol=1e-5)
    slopes = rope_tracking._curve(11, slope=True)
    assert np.allclose(slopes @ np.arange(11.0), 1.0, atol=1e-5)


def test_chords_of_a_circle_are_as_long_as_geometry_says():
    radius, angle = 0.2, np.arange(11) * 0.5
    nodes = radius * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    arc = dataclasses.replace(MODEL, rest_length=np.full(10, radius * 0.5))
    bent = rope_tracking._as_bent(arc, jnp.asarray(nodes, jnp.float32), jnp.asarray(0.0))
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
    after, used = jitted[1](MODEL, View.of(TRIPOD), prior, sighting(moved))
    error = np.linalg.norm(np.asarray(after.state().position) - moved, axis=-1)
    assert int(used.sum()) > 90
    assert error.max() < 0.012
    assert np.linalg.norm(moved - nodes, axis=-1).max() > 0.06
    assert np.trace(after.covariance[:30, :30]) < 0.1 * np.trace(prior.covariance[:30, :30])


def test_a_frame_of_earlier_is_seen_where_the_rope_was():
    prior = belief()
    speed = np.tile([0.0, 1.0, 0.0], (10, 1)) * np.arange(1, 11)[:, None] / 10
    mean = np.asarray(prior.mean).copy()
    mean[30:60] = speed.ravel()
    prior = Belief(jnp.asarray(mean), 1e-2 * prior.covariance, prior.gripper, jnp.zeros(3))
    earlier = np.asarray(prior.state().position).copy()
    earlier[1:] -= 0.005 * speed
    after, _ = jitted[1](MODEL, View.of(TRIPOD), prior, sighting(earlier, age=0.005))
    assert np.allclose(after.mean[:30], prior.mean[:30], atol=1e-3)


def test_points_far_from_the_rope_are_not_believed():
    prior = belief(0.005)
    nodes = np.asarray(prior.state().position)
    _, used = jitted[1](MODEL, View.of(TRIPOD), prior, sighting(nodes + np.array([0.0, 0.4, 0.0])))
    assert int(used.sum()) < 0.1 * 100


def follow(background: str, steps: int, model: Rope = MODEL, **world) -> tuple[np.ndarray, ...]:
    """Root mean square node error (steps,) in m, the tracker, and what was seen."""
    scene = FilmedRope(RopeConfiguration(**world), background=background)
    view = scene.reset(1, start="half_circle")
    tracker = RopeTracker(model, scene.pinhole, ROPE)
    tracker.start(view.frame, view.gripper_position)
    errors, frames, places = [], [view.frame], [view.gripper_position]
    for _ in range(steps):
        view = scene.step(np.zeros(3))
        state = tracker.step(view.gripper_position, view.frame)
        if view.frame is not None:
            frames.append(view.frame)
            places.append(view.gripper_position)
        miss = np.asarray(state.position) - scene.truth().positions[::4]
        errors.append(np.sqrt((miss[1:] ** 2).sum(-1).mean()))
    return np.array(errors), tracker, frames, places


def test_a_falling_rope_is_followed_before_clutter_and_behind_a_bar():
    clear, *_ = follow("clutter", 25)
    hidden, *_ = follow("occluder", 25)
    assert np.sqrt((clear**2).mean()) < 0.012
    assert np.sqrt((hidden**2).mean()) < 0.03


def test_a_longer_rope_is_found_to_be_longer():
    _, tracker, *_ = follow("plain", 30, length=1.08)
    assert tracker.length == pytest.approx(1.08, abs=0.03)


def test_a_lost_rope_is_found_again():
    scene = FilmedRope(background="plain")
    view = scene.reset(1)
    tracker = RopeTracker(MODEL, scene.pinhole, ROPE)
    tracker.start(view.frame, view.gripper_position)
    away = np.tile([0.0, 0.3, 0.2], 10).astype(np.float32)
    mean = tracker.belief.mean.at[:30].add(jnp.asarray(away))
    tracker.belief = dataclasses.replace(
        tracker.belief, mean=mean, covariance=1e-4 * tracker.belief.covariance
    )
    for _ in range(30):
        view = scene.step(np.zeros(3))
        state = tracker.step(view.gripper_position, view.frame)
    miss = np.linalg.norm(np.asarray(state.position) - scene.truth().positions[::4], axis=-1)
    assert miss.max() < 0.03


def test_a_folder_of_pictures_is_followed_as_the_scene_was(tmp_path):
    _, tracker, frames, places = follow("plain", 20)
    write_image_folder(tmp_path, TRIPOD, frames, np.array(places))
    camera, read, grippers = read_image_folder(tmp_path)
    again = RopeTracker(MODEL, camera, ROPE)
    again.start(read[0], grippers[0])
    begin, passed = read[0].time, 0
    for frame, place in zip(read[1:], grippers[1:], strict=True):
        while begin + passed * MODEL.control_period < frame.time - 1e-9:
            passed += 1
            due = begin + passed * MODEL.control_period >= frame.time - 1e-9
            state = again.step(place, frame if due else None)
    assert np.isfinite(np.asarray(state.position)).all()
    assert again.length == pytest.approx(tracker.length, abs=0.01)


def test_what_cannot_be_followed_is_refused():
    both = Rope.uniform(nodes=11, driven=(0, 10), substeps=4)
    with pytest.raises(PalpateError, match=r"this one is held at \(0, 10\)"):
        RopeTracker(both, TRIPOD, ROPE)
    tracker = RopeTracker(MODEL, TRIPOD, ROPE)
    dark = Frame(0.0, np.zeros((240, 320, 3), np.uint8), None)
    with pytest.raises(PalpateError, match="0 are seen"):
        tracker.start(dark, GRIPPER)
    view = FilmedRope(background="plain").reset(0)
    tracker.start(view.frame, view.gripper_position)
    with pytest.raises(PalpateError, match=r"a frame lies between"):
        tracker.step(GRIPPER, dataclasses.replace(view.frame, time=0.5))
