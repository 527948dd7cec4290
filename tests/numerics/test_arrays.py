"""NumPy's arrays become JAX's without compiling, and share no memory with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.numerics.arrays import as_array


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int64, bool])
def test_no_shape_is_compiled_for(kind):
    compiled = []

    def listen(name, seconds, **_):
        compiled.extend([name] if name.endswith("backend_compile_duration") else [])

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for count in (41, 43):
            values = np.ones((2, count), kind)
            made = as_array(values)
            assert made.dtype == jax.dtypes.canonicalize_dtype(kind)
            np.testing.assert_array_equal(made, values)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not compiled


def test_what_is_written_later_does_not_show():
    # aligned as JAX likes it: a page of memory of its own
    values = np.zeros(1 << 16, np.float32)
    made = as_array(values)
    values[:] = 7.0
    assert not np.any(made)


def test_the_kind_that_was_asked_for_and_never_a_weak_one():
    assert as_array([1, 2], np.float32).dtype == np.float32
    assert as_array(jnp.ones(2, int), np.float32).dtype == np.float32
    assert not as_array(1.5).weak_type
    with jax.enable_x64(True):
        assert as_array(np.ones(2)).dtype == np.float64
    doubled = jax.jit(lambda x: 2.0 * as_array(x) * as_array(np.ones(3)))
    np.testing.assert_array_equal(doubled(jnp.ones(3)), 2.0 * np.ones(3))
