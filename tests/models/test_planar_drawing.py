"""What a planar model shows from above: outlines, and where its wheels are and roll."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from palpate.models.planar import furniture
from palpate.models.planar.drawing import PIVOT, WHEEL
from palpate.models.planar.shapes import rectangle
from palpate.models.planar.wheels import wheel_at_angle
from palpate.report.motion import in_space

POSE = jnp.array([[2.0, 1.0, np.pi / 2]])


def table(position, **wheel):
    wheel = {name: jnp.full((1, 1), value) for name, value in wheel.items()}
    place = jnp.array([[position]])
    return furniture([rectangle(2.0, 1.0)], wheel_position=place, **wheel)


def test_outlines_are_closed_and_turned():
    drawn = table([0.0, 0.0]).drawing(POSE)
    outline = drawn[""]
    assert outline.shape == (6, 3)
    assert np.isnan(outline[-1]).all()
    np.testing.assert_allclose(outline[0], outline[4], atol=1e-6)
    np.testing.assert_allclose(np.ptp(outline[:4], axis=0), [1.0, 2.0, 0.0], atol=1e-6)
    assert drawn[PIVOT].shape == (0, 3)


def test_a_wheel_is_a_stroke_along_which_it_rolls():
    model = table([1.0, -1.0], **wheel_at_angle(np.pi / 6, 4.0, 16.0))
    stroke, across = np.asarray(model.drawing(POSE)[WHEEL]).reshape(2, 3, 3)[:, :2]
    np.testing.assert_allclose(stroke.mean(axis=0), [2.5, 2.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(across.mean(axis=0), [2.5, 2.0, 0.0], atol=1e-5)
    along = stroke[1] - stroke[0]
    np.testing.assert_allclose(np.arctan2(along[1], along[0]), np.pi / 2 + np.pi / 6, rtol=1e-4)
    lengths = [np.linalg.norm(of[1] - of[0]) for of in (stroke, across)]
    np.testing.assert_allclose(lengths[1] / lengths[0], 4.0 / 16.0, rtol=1e-4)


def test_draws_lie_side_by_side_and_nobody_draws_a_wheel_that_is_not_believed():
    places = jnp.array([[0.5, 0.5], [-0.5, 0.5]])
    one = table([0.0, 0.0])
    several = dataclasses.replace(one, wheel_position=places[:, None, None, :])
    poses = np.broadcast_to(POSE, (5, 1, 3))
    draws = np.broadcast_to(POSE, (2, 5, 1, 3)) + np.array([0.0, 1.0]).reshape(2, 1, 1, 1)
    found = in_space(one, poses, {"draws": (several, draws)}, group="typical")
    assert set(found) == {f"motion/typical.{name}" for name in ("time", "observed", "draws", WHEEL)}
    assert found["motion/typical.observed"].shape == (5, 6, 3)
    fan, wheels = found["motion/typical.draws"], found[f"motion/typical.{WHEEL}"]
    assert fan.shape == (5, 14, 3)  # two outlines with a gap after each, and one more between
    own = several.drawing(jnp.asarray(draws[:, 0]))[WHEEL]
    np.testing.assert_allclose(wheels[3].reshape(2, 7, 3)[:, :6], own, rtol=1e-6)
    assert np.abs(own[0, 0] - own[1, 0]).max() > 0.3
