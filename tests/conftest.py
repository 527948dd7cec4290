"""What every test may ask for: float64, and no implicit promotion of dtypes."""

import jax
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
