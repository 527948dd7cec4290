"""Cosines and sines that compilers turn into vectors, against the C library's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.numerics.trigonometry import cosine_and_sine

ANGLES = np.concatenate(
    [np.linspace(-12.0, 12.0, 4001), np.pi / 4 * np.arange(-40, 41), [0.0, 1e-30, -1e-8, 300.0]]
)


def check(dtype, roundings: float) -> None:
    angles = jnp.asarray(ANGLES, dtype)
    assert angles.dtype == dtype
    exact = np.asarray(angles, np.float64)
    allowed = roundings * np.finfo(dtype).eps * np.maximum(1.0, np.abs(exact))
    cosine, sine = cosine_and_sine(angles)
    assert np.all(np.abs(np.asarray(cosine, np.float64) - np.cos(exact)) <= allowed)
    assert np.all(np.abs(np.asarray(sine, np.float64) - np.sin(exact)) <= allowed)


def test_they_are_right_to_a_few_roundings():
    check(np.float32, 1.5)


def test_they_are_right_to_a_few_roundings_of_float64(float64):
    check(np.float64, 1.5)


def test_their_derivatives_are_each_other(float64):
    for angle in (-4.0, 0.0, 0.3, np.pi / 4, 2.5):
        slopes = jax.jacfwd(lambda a: jnp.stack(cosine_and_sine(a)))(jnp.asarray(angle))
        np.testing.assert_allclose(slopes, [-np.sin(angle), np.cos(angle)], atol=1e-14)


def test_what_is_no_angle_stays_none():
    for part in cosine_and_sine(jnp.asarray([np.nan, np.inf])):
        assert np.all(np.isnan(part))


@pytest.mark.parametrize("turns", [1, 7, 100])
def test_they_return_after_whole_turns(turns, float64):
    cosine, sine = cosine_and_sine(jnp.asarray(0.7 + 2.0 * np.pi * turns))
    assert cosine == pytest.approx(np.cos(0.7), abs=1e-13 * turns)
    assert sine == pytest.approx(np.sin(0.7), abs=1e-13 * turns)
