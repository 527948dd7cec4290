"""How a batch is divided among the processors."""

import os
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.numerics.devices import one_on_each, over_devices


@pytest.fixture
def two(monkeypatch):
    """Two devices, however many there are: at least two, says `conftest`."""
    devices = jax.devices("cpu")[:2]
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


def test_pieces_of_work_are_each_on_a_device_and_at_the_same_time(two):
    both = threading.Barrier(2, timeout=60)

    def doubled(piece):
        both.wait()  # for ever, were they one after another
        twice = over_devices(lambda shared, each: shared * each)(jnp.asarray(2.0), jnp.arange(4.0))
        return piece, twice, jnp.zeros(()).dtype

    with jax.enable_x64(True):
        found = one_on_each(doubled, range(6))
    assert [piece for piece, _, _ in found] == list(range(6))
    for _, twice, dtype in found:
        np.testing.assert_array_equal(twice, [0.0, 2.0, 4.0, 6.0])
        assert dtype == jnp.float64
    used = [twice.sharding.device_set for _, twice, _ in found]
    assert all(len(of) == 1 for of in used)
    assert set.union(*used) == set(two)


def test_what_a_piece_of_work_raises_is_raised_and_no_other_begins(two):
    begun = []

    def failing(piece):
        begun.append(piece)
        if piece:
            time.sleep(0.05)
        else:
            raise ValueError("piece 0")

    with pytest.raises(ValueError, match="piece 0"):
        one_on_each(failing, range(100))
    assert len(begun) < 100


IMPORTED = """
import jax.numpy as jnp
if {computed}: jnp.ones(3).sum()
import jax, palpate, os
print(jax.config.jax_default_matmul_precision, len(jax.devices("cpu")))
"""


@pytest.mark.parametrize(
    ("chosen", "computed", "expected"),
    [
        ({}, False, "highest 3"),
        ({}, True, "highest 1"),
        (
            {"JAX_DEFAULT_MATMUL_PRECISION": "bfloat16", "JAX_NUM_CPU_DEVICES": "5"},
            False,
            "bfloat16 5",
        ),
    ],
)
def test_back_ends_are_set_up_as_far_as_the_user_has_not(chosen, computed, expected):
    ours = ("JAX_DEFAULT_MATMUL_PRECISION", "JAX_NUM_CPU_DEVICES", "XLA_FLAGS")
    environment = {name: value for name, value in os.environ.items() if name not in ours} | chosen
    cores = "import os; os.sched_getaffinity = lambda process: range(3)\n"
    program = cores + IMPORTED.format(computed=computed)
    ran = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert ran.stdout.strip() == expected
