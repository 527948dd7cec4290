"""How a batch is divided among the processors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.devices import over_devices


@pytest.fixture
def two(monkeypatch):
    """Two devices, however many there are: at least two, says `conftest`."""
    devices = jax.devices()[:2]
    assert len(devices) == 2
    monkeypatch.setattr(jax, "devices", lambda: devices)
    return devices


@pytest.mark.parametrize(("count", "used"), [(4, 2), (3, 1)])
def test_a_batch_gives_the_same_on_as_many_devices_as_divide_it(two, count, used):
    def raised(shared, each):
        scale, power, name = shared
        assert name == "no array"
        return {"raised": jax.vmap(lambda x: scale * x**power)(each["x"]), "key": each["key"]}

    each = {
        "x": jnp.arange(2.0 * count).reshape(count, 2),
        "key": jax.random.split(jax.random.key(0), count),
    }
    shared = jnp.asarray(3.0), 2, "no array"
    found, expected = over_devices(raised)(shared, each), raised(shared, each)
    np.testing.assert_array_equal(found["raised"], expected["raised"])
    np.testing.assert_array_equal(*(jax.random.key_data(of["key"]) for of in (found, expected)))
    assert found["raised"].sharding.device_set == set(two[:used])
