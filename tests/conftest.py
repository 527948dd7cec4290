"""What every test has: palpate first, so that JAX is set up as a user's is; float64 on request."""

import palpate  # noqa: F401  before JAX: it sets compiler flags

import jax  # noqa: I001
import pytest


@pytest.fixture
def float64():
    """Arrays made inside the test are float64: for finite differences and closed forms."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def strict():
    """Refuse implicit promotion of dtypes inside the test."""
    with jax.numpy_dtype_promotion("strict"):
        yield
