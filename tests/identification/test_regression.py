"""Locally weighted regression: exact where the truth is linear, and local where it is not."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.identification.regression import locally_weighted as module
from palpate.identification.regression.locally_weighted import LocallyWeighted, locally_weighted


def data(count: int, inputs: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, inputs))


def predicted(fitted: LocallyWeighted, x: np.ndarray, bits: np.ndarray | None = None) -> np.ndarray:
    bits = np.zeros((len(x), 0), bool) if bits is None else bits
    return np.asarray(fitted(jnp.asarray(x, jnp.float32), jnp.asarray(bits)))


def test_a_linear_system_is_recovered_far_outside_the_data():
    x = data(60, 4) * [1.0, 100.0, 1e-3, 1.0] + [0.0, 50.0, 0.0, -3.0]
    slopes = data(4, 3, seed=1) / [[1.0], [100.0], [1e-3], [1.0]]
    fitted = locally_weighted(x, x @ slopes + 2.0)
    far = x[:10] * 5
    np.testing.assert_allclose(predicted(fitted, far), far @ slopes + 2.0, rtol=2e-3, atol=2e-2)
    assert float(fitted.bandwidth) == max(module.BANDWIDTHS)
    assert float(fitted.ridge) == pytest.approx(min(module.RIDGES))


def test_a_smooth_function_is_met_better_with_more_data():
    def truth(x: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(2 * x[:, 0]) * x[:, 1], np.cos(x[:, 1])], axis=1)

    asked = np.clip(data(200, 2, seed=9), -1.5, 1.5)
    error = []
    for count in (25, 100, 400, 1600):
        x = data(count, 2)
        error.append(
            np.sqrt(
                np.mean(
                    (predicted(locally_weighted(x, truth(x), capacity=1600), asked) - truth(asked))
                    ** 2
                )
            )
        )
    assert all(b < 0.75 * a for a, b in itertools.pairwise(error)), error
    assert error[-1] < 0.05


def test_the_prediction_is_the_formula():
    """The closed form, written out in double precision for one query."""
    x, y = data(30, 2), data(30, 1, seed=1)
    fitted = locally_weighted(x, y)
    wide = {"bandwidth": jnp.asarray(0.7), "ridge": jnp.asarray(2.0)}
    fitted = LocallyWeighted(**{**vars(fitted), **wide})
    query = np.array([0.9, -0.8])
    centre, scale = x.mean(0), x.std(0)
    z, q = (x - centre) / scale, (query - centre) / scale
    h, ridge = float(fitted.bandwidth), float(fitted.ridge)
    squares = ((z - q) ** 2).sum(1)
    w = np.exp(-(squares - squares.min()) / (2 * h**2))
    row = np.column_stack([np.ones(30), z])
    held = np.diag([0.0, ridge, ridge]) + module._ROUNDING * w.sum() * np.diag([0.0, 1, 1])
    slopes = np.linalg.solve(row.T @ (w[:, None] * row) + held, row.T @ (w * (y[:, 0] - y.mean())))
    expected = slopes @ [1, *q] + y.mean()
    assert predicted(fitted, query[None])[0, 0] == pytest.approx(expected, rel=1e-3, abs=1e-4)


def test_noise_asks_for_a_wider_neighbourhood():
    x = data(150, 1)
    smooth = locally_weighted(x, np.sin(3 * x))
    noisy = locally_weighted(x, np.sin(3 * x) + 1.5 * data(150, 1, seed=3))
    assert float(noisy.bandwidth) > float(smooth.bandwidth)


def test_every_condition_has_a_regression_of_its_own_and_a_new_one_asks_all():
    x = data(200, 2)
    bits = data(200, 3, seed=4) > 0
    bits[:, 2] = False
    y = np.where(bits[:, :1], x[:, :1], -3 * x[:, :1]) + bits[:, 1:2]
    fitted = locally_weighted(x, y, bits)
    np.testing.assert_allclose(predicted(fitted, x, bits), y, atol=0.03)
    plain = locally_weighted(x, y)
    new = np.ones((200, 3), bool)
    alike = LocallyWeighted(**{**vars(plain), "bandwidth": fitted.bandwidth, "ridge": fitted.ridge})
    np.testing.assert_allclose(predicted(fitted, x, new), predicted(alike, x), atol=1e-4)
    assert (
        np.abs(predicted(plain, x) - y).mean() > 10 * np.abs(predicted(fitted, x, bits) - y).mean()
    )


def test_room_for_more_data_changes_nothing_and_compiles_once():
    x, y = data(50, 3), data(50, 2, seed=1)
    tight, roomy = locally_weighted(x, y), locally_weighted(x, y, capacity=128)
    assert roomy.inputs.shape == (128, 3)
    asked = data(20, 3, seed=2) + 0.01  # nothing lies at the padding's zeros
    np.testing.assert_allclose(predicted(roomy, asked), predicted(tight, asked), atol=1e-4)
    at_padding = np.zeros((1, 3)) + x.mean(0)
    np.testing.assert_allclose(
        predicted(roomy, at_padding), predicted(tight, at_padding), atol=1e-4
    )
    traced = []

    @jax.jit
    def ask(fitted: LocallyWeighted, asked: jax.Array) -> jax.Array:
        traced.append(1)
        return fitted(asked, jnp.zeros((len(asked), 0), bool))

    for count in (10, 50):
        ask(locally_weighted(x[:count], y[:count], capacity=128), jnp.zeros((4, 3)))
    assert len(traced) == 1


def test_few_and_constant_data_still_give_a_finite_answer():
    one = locally_weighted(np.ones((1, 2)), np.array([[3.0]]))
    assert predicted(one, np.array([[9.0, -9.0]]))[0, 0] == pytest.approx(3.0)
    still = locally_weighted(np.ones((40, 2)), np.full((40, 1), 0.5), capacity=64)
    assert predicted(still, np.array([[4.0, 1.0]]))[0, 0] == pytest.approx(0.5)
    twice = np.repeat(data(40, 1), 3, axis=1)  # inputs that say the same thrice
    np.testing.assert_allclose(predicted(locally_weighted(twice, twice), twice), twice, atol=1e-2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.ones((3, 2)), np.ones((4, 1))), r"at least one datum, got \(3, 2\) and \(4, 1\)"),
        ((np.ones((0, 2)), np.ones((0, 1))), "at least one datum"),
        ((np.full((3, 2), np.nan), np.ones((3, 1))), "leave out data with gaps"),
        ((np.ones((3, 2)), np.ones((3, 1)), np.ones((3, 2))), r"booleans of shape \(3, bits\)"),
        ((np.ones((3, 2)), np.ones((3, 1)), None, 2), "more than the capacity of 2: enlarge it"),
    ],
)
def test_what_cannot_be_fitted_is_said(arguments, message):
    with pytest.raises(PalpateError, match=message):
        locally_weighted(*arguments)
