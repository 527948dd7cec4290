"""The exported policy gives the commands of the JAX one: open loop, closed loop, every limit."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from deployed import impedance_policy, rope_policy, scaled
from palpate.deployment.onnx_export import difference, write_onnx
from palpate.errors import PalpateError
from palpate.networks import Channel, CommandPolicy

onnx = pytest.importorskip("onnx")
runtime = pytest.importorskip("onnxruntime")


def wide(rate_limit):
    """Two grippers, and features whose scale is anything between 1e-3 and 1e3."""
    seen = jax.random.normal(jax.random.key(2), (64, 7)) * jnp.logspace(-3, 3, 7) + 5
    return CommandPolicy.create(
        jax.random.key(3), seen, Channel("v", (2, 3), "m/s", 0.4, rate_limit), period=0.02, width=64
    )


POLICIES = {
    "rope": rope_policy,
    "no rate limit": lambda: rope_policy(rate_limit=None),
    "two grippers": lambda: wide(3.0),
    "two grippers, no rate limit": lambda: wide(None),
    "impedance": impedance_policy,
    "one layer": lambda: rope_policy(depth=1),
}


@pytest.mark.parametrize("name", POLICIES)
def test_parity_over_random_features(name, tmp_path):
    policy, path = POLICIES[name](), tmp_path / "policy.onnx"
    write_onnx(path, policy)
    assert difference(path, policy, steps=40, seed=0) < 5e-6


def test_a_difference_is_seen(tmp_path):
    policy, path = rope_policy(), tmp_path / "policy.onnx"
    write_onnx(path, policy)
    other = dataclasses.replace(policy, network=scaled(policy.network, 1.01))
    assert difference(path, other, steps=5, seed=0) > 1e-4


def test_parity_in_closed_loop(tmp_path):
    """Two copies of a lightly damped system, each moved by one of the two, stay together."""
    policy, random = rope_policy(), np.random.default_rng(0)
    write_onnx(tmp_path / "policy.onnx", policy)
    session = runtime.InferenceSession(tmp_path / "policy.onnx")
    turn, _ = np.linalg.qr(random.normal(size=(30, 30)))
    push = 0.3 * random.normal(size=(3, 30))
    ours = theirs = random.normal(size=(8, 30)).astype(np.float32)
    carry = other = np.zeros((8, 1, 3), np.float32)
    worst = 0.0
    for _ in range(200):
        carry = np.asarray(policy(jnp.asarray(carry), jnp.asarray(ours))[0])
        command, other = session.run(["command", "carry_out"], {"features": theirs, "carry": other})
        worst = max(worst, float(np.abs(command - carry).max()))
        ours, theirs = (
            (0.98 * state @ turn + action[:, 0] @ push).astype(np.float32)
            for state, action in ((ours, carry), (theirs, command))
        )
    assert np.linalg.norm(command[:, 0], axis=-1).max() > 0.5
    assert worst < 1e-5


def test_names_shapes_and_the_same_bytes_again(tmp_path):
    write_onnx(tmp_path / "a.onnx", wide(3.0))
    write_onnx(tmp_path / "b.onnx", wide(3.0))
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()
    session = runtime.InferenceSession(tmp_path / "a.onnx")
    found = {
        put.name: (put.shape, put.type) for put in (*session.get_inputs(), *session.get_outputs())
    }
    assert found == {
        "features": (["batch", 7], "tensor(float)"),
        "carry": (["batch", 2, 3], "tensor(float)"),
        "command": (["batch", 2, 3], "tensor(float)"),
        "carry_out": (["batch", 2, 3], "tensor(float)"),
    }


@pytest.mark.parametrize("missing", ["onnx", "onnxruntime"])
def test_without_the_extra_it_says_which_one(missing, tmp_path, monkeypatch):
    policy, path = rope_policy(), tmp_path / "policy.onnx"
    write_onnx(path, policy)
    monkeypatch.setitem(sys.modules, missing, None)
    needs = {
        "onnx": lambda: write_onnx(path, policy),
        "onnxruntime": lambda: difference(path, policy, 1, 0),
    }
    with pytest.raises(PalpateError) as refused:
        needs[missing]()
    assert str(refused.value) == (
        f"this needs {missing}, which is not installed: `pip install 'palpate[deploy]'` brings it"
    )
