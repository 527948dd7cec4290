"""Exported actors and guards do what the JAX ones do, where a sensor drops out too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.deployment.onnx_actor import actor_difference, actor_model, guard_model, write_model
from palpate.networks import ActorPolicy, Channel, GuardedPolicy
from palpate.networks.actor import DeterministicActor, GaussianActor
from palpate.networks.guarded import untrained_guard

pytest.importorskip("onnx")
runtime = pytest.importorskip("onnxruntime")

KEYS = jax.random.split(jax.random.key(0), 3)
DECLARED = {
    "observations": (Channel("wrench", (6,), "N"), Channel("position", (3,), "m")),
    "actions": (Channel("displacement", (2, 1)), Channel("stiffness", (2, 1))),
    "period": 0.1,
}
GUARD = untrained_guard(KEYS[1], 6, 4, (32, 32), tuple(range(6)))
FEATURES = np.asarray(jax.random.normal(KEYS[2], (9, 9)), np.float32)


def guarded(threshold: float = 0.5) -> GuardedPolicy:
    network = GaussianActor.create(KEYS[0], 9, 4, 32, 2)
    return GuardedPolicy(actor=network, guard=GUARD, threshold=threshold, **DECLARED)


def run(model, path, outputs, **inputs):
    write_model(path, model)
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return session.run(outputs, inputs)


def test_parity_over_random_features(tmp_path):
    alone = ActorPolicy(actor=DeterministicActor.create(KEYS[0], 9, 4, 32, 1), **DECLARED)
    for number, policy in enumerate((alone, guarded())):
        path = tmp_path / f"{number}.onnx"
        write_model(path, actor_model(policy))
        assert actor_difference(path, policy, seed=0) < 5e-6
    assert actor_difference(tmp_path / "1.onnx", alone, seed=0) > 1e-3  # a difference is seen


def test_risk_and_the_guard_alone(tmp_path):
    policy, action = guarded(), np.full((9, 4), 0.3, np.float32)
    seen = jnp.asarray(FEATURES)
    (risk,) = run(actor_model(policy), tmp_path / "policy.onnx", ["risk"], features=FEATURES)
    np.testing.assert_allclose(risk[:, 0], policy.risk(seen, policy.propose(seen)), atol=1e-6)
    policy = guarded(float(np.median(policy.risk(seen, jnp.asarray(action)))) + 1e-4)
    inputs = {"features": FEATURES, "action": action}
    command, risk = run(guard_model(policy), tmp_path / "guard.onnx", ["command", "risk"], **inputs)
    risky = risk[:, 0] > policy.threshold
    assert risky.sum() == 4
    np.testing.assert_array_equal(command[~risky], action[~risky])
    np.testing.assert_allclose(command[risky], policy.guard.recover(seen)[risky], atol=1e-6)


def test_a_sensor_that_drops_out_ends_in_no_action(tmp_path):
    broken = FEATURES.copy()
    broken[0, 0] = np.nan
    outputs = ["command", "risk"]
    command, risk = run(actor_model(guarded()), tmp_path / "p.onnx", outputs, features=broken)
    assert risk[0] == 1.0
    assert (command[0] == 0.0).all()
    assert np.isfinite(command).all()
