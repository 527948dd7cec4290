"""Features of bodies in the plane: their symmetries, and contacts on the right side."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.identification.regression.model import fit_regression
from palpate.models.planar import PlanarState, furniture
from palpate.models.planar.shapes import rectangle
from palpate.trials.furniture.planar_features import body_features, raw_features

BOX = rectangle(1.0, 0.6)
WALL = np.array([[2.0, -3.0], [2.2, -3.0], [2.2, 3.0], [2.0, 3.0]])


def draws(count: int, bodies: int, seed: int = 0) -> tuple[PlanarState, jax.Array]:
    keys = jax.random.split(jax.random.key(seed), 3)
    shape = count, bodies, 3
    state = PlanarState(*(jax.random.normal(key, shape) for key in keys[:2]))
    return state, jax.random.normal(keys[2], shape) * jnp.array([20.0, 20.0, 5.0])


@pytest.mark.parametrize("features", [raw_features(), body_features()])
def test_a_change_that_is_applied_leads_to_what_followed(features):
    (before, _), (after, _) = draws(20, 3), draws(20, 3, seed=1)
    reached = features.apply(before, features.change(before, after))
    np.testing.assert_allclose(reached.pose, after.pose, atol=1e-5)
    np.testing.assert_allclose(reached.velocity, after.velocity, atol=1e-5)


def moved(state: PlanarState, wrench: jax.Array, x: float, y: float, angle: float):
    """The whole scene elsewhere and turned."""
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = jnp.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], jnp.float32)
    pose = state.pose @ turn.T + jnp.array([x, y, angle], jnp.float32)
    return PlanarState(pose, state.velocity @ turn.T), wrench @ turn.T


def test_body_features_do_not_depend_on_the_place_and_raw_ones_do():
    model = furniture([BOX], floor_friction=0.1)
    state, wrench = draws(30, 1)
    there, pushed = moved(state, wrench, 3.0, -2.0, 0.7)
    features, step = body_features(), eqx.filter_jit(model.step)
    np.testing.assert_allclose(
        features.inputs(state, wrench), features.inputs(there, pushed), atol=1e-4
    )
    here = features.change(state, step(state, wrench))
    same = features.change(there, step(there, pushed))
    np.testing.assert_allclose(here, same, atol=1e-4)
    raw = raw_features()
    assert raw.inputs(state, wrench).shape == (30, 1, 9)
    assert np.abs(raw.inputs(state, wrench) - raw.inputs(there, pushed)).max() > 1.0


def test_a_regression_of_body_features_predicts_another_place():
    model = furniture([BOX], control_period=0.2, wheel_along=0.5, wheel_across=0.5)
    data = draws(200, 1)
    asked = moved(*draws(50, 1, seed=5), 4.0, 4.0, 2.0)
    error, step = {}, eqx.filter_jit(model.step)
    for name, features in (("raw", raw_features()), ("body", body_features())):
        fitted = fit_regression(model, features, "lwr", *data, step(*data))
        off = eqx.filter_jit(fitted.step)(*asked).pose - step(*asked).pose
        error[name] = float(jnp.abs(off).mean())
    assert error["body"] < 0.02
    assert error["raw"] > 2 * error["body"]


def bits(condition, pose) -> np.ndarray:
    pose = jnp.asarray(pose, jnp.float32)
    found = condition(PlanarState(pose, jnp.zeros_like(pose)))
    return np.asarray(found).reshape(2, 3, 4)  # of two bodies: with each, with walls; sectors


def test_contacts_are_told_with_whom_and_on_which_side():
    """Four sectors of a quarter turn each, from the body's x axis on."""
    condition = body_features([BOX, BOX], [WALL], sectors=4).condition
    assert condition is not None
    assert not bits(condition, [[0, 0, 0], [0, 2, 0]]).any()
    above = bits(condition, [[0, 0, 0], [0, 0.61, 0]])  # the second on the first one's y side
    assert above[0, 1].tolist() == [True, True, False, False]
    assert above[1, 0].tolist() == [False, False, True, True]
    assert not above[:, 2].any()
    assert not above[0, 0].any()
    turned = bits(condition, [[0, 0, np.pi], [0, 0.61, 0]])
    assert turned[0, 1].tolist() == [False, False, True, True]
    at_wall = bits(condition, [[1.49, 0, 0], [-3, 0, 0]])
    assert at_wall[0, 2].tolist() == [True, False, False, True]
    assert not at_wall[1].any()
    corner = bits(condition, [[1.69, 0, np.pi / 2], [-3, 0, 0]])
    assert corner[0, 2].tolist() == [False, False, True, True]


def test_a_corner_is_felt_by_both_bodies():
    """Wherever along a side it points, also between the points that are tried there."""
    long = rectangle(4.0, 0.2)
    condition = body_features([long, BOX], sectors=4).condition
    assert condition is not None
    reach = float(np.hypot(0.5, 0.3))
    angle = float(np.arctan2(0.3, 0.5))
    for along in np.linspace(0.0, 0.05, 6):
        pose = jnp.array([[0, 0, 0], [along, 0.1 + reach, -np.pi / 2 - angle]], jnp.float32)
        found = np.asarray(condition(PlanarState(pose, jnp.zeros_like(pose)))).reshape(2, 3, 4)
        assert found[0, 1].any()
        assert found[1, 0].any()
