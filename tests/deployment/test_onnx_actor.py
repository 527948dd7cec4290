"""Exported actors and guards do what the JAX ones do in a robot's units, and rest without eyes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.deployment.decision import ActorDecision
from palpate.deployment.onnx_actor import actor_difference, actor_model, guard_model, write_model
from palpate.deployment.scaling import Scaling
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
SCALING = Scaling(
    DECLARED["observations"],
    (Channel("displacement", (2,), "m", 0.03), Channel("stiffness", (2, 1), "N/m", 950.0)),
    np.array([26.0] * 6 + [0.3] * 3),
    np.array([-0.03, -0.03, 50.0, 50.0]),
    np.array([0.03, 0.03, 1000.0, 1000.0]),
    np.array([0.0, 0.0, 50.0, 50.0]),
)
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
        write_model(path, actor_model(policy, SCALING))
        assert actor_difference(path, policy, SCALING, seed=0) < 5e-6
    assert actor_difference(tmp_path / "1.onnx", alone, SCALING, seed=0) > 1e-3  # it is seen
    write_model(path, guard_model(guarded(), SCALING))
    assert actor_difference(path, guarded(), SCALING, seed=0) < 5e-6
    assert actor_difference(path, guarded(0.9), SCALING, seed=0) > 1e-3


def test_commands_are_in_the_robots_units_within_their_limits(tmp_path):
    policy = guarded()
    model, outputs = actor_model(policy, SCALING), ["command", "action"]
    measured = (FEATURES * SCALING.scale).astype(np.float32)
    command, action = run(model, tmp_path / "policy.onnx", outputs, features=measured)
    np.testing.assert_allclose(action, policy(None, jnp.asarray(FEATURES))[1], atol=1e-5)
    np.testing.assert_allclose(command[:, 2:], 525.0 + 475.0 * action[:, 2:], rtol=1e-5)
    lengths = np.linalg.norm(action[:, :2], axis=1)
    expected = 0.03 * action[:, :2] / np.maximum(lengths, 1.0)[:, None]
    np.testing.assert_allclose(command[:, :2], expected, atol=1e-8)
    decision = ActorDecision(policy, SCALING)
    for row, told in zip(measured, command, strict=True):
        decision.see({"wrench": row[:6], "position": row[6:]})
        np.testing.assert_allclose(decision.decide(SCALING.rest), told, rtol=1e-4, atol=1e-6)
    decision.see({"wrench": row[:6] * np.nan, "position": row[6:]})
    assert np.isnan(decision.decide(SCALING.rest)).all()
    corner = SCALING.command(np.array([1.0, -1.0, -1.0, 1.0]))
    np.testing.assert_allclose(corner, [0.03 * 0.5**0.5, -0.03 * 0.5**0.5, 50, 1000], rtol=1e-6)


def test_risk_and_the_guard_alone(tmp_path):
    policy, action = guarded(), np.full((9, 4), 0.3, np.float32)
    seen, none = jnp.asarray(FEATURES), Scaling.none(policy)
    model = actor_model(policy, none)
    (risk,) = run(model, tmp_path / "policy.onnx", ["risk"], features=FEATURES)
    np.testing.assert_allclose(risk[:, 0], policy.risk(seen, policy.propose(seen)), atol=1e-6)
    policy = guarded(float(np.median(policy.risk(seen, jnp.asarray(action)))) + 1e-4)
    inputs, outputs = {"features": FEATURES, "action": action}, ["action_out", "risk"]
    after, risk = run(guard_model(policy, none), tmp_path / "guard.onnx", outputs, **inputs)
    risky = risk[:, 0] > policy.threshold
    assert risky.sum() == 4
    np.testing.assert_array_equal(after[~risky], action[~risky])
    np.testing.assert_allclose(after[risky], policy.guard.recover(seen)[risky], atol=1e-6)


def test_a_sensor_that_drops_out_ends_in_rest(tmp_path):
    broken = FEATURES.copy()
    broken[0, 0] = broken[1, 8] = np.nan  # the second only the actor sees
    given = {"features": broken, "action": np.full((9, 4), 0.3, np.float32)}
    for model, name in ((actor_model(guarded(), SCALING), "action"),
                        (guard_model(guarded(), SCALING), "action_out")):  # fmt: skip
        inputs = given if name == "action_out" else {"features": broken}
        command, action, risk = run(model, tmp_path / "p.onnx", ["command", name, "risk"], **inputs)
        assert risk[0] == 1.0
        np.testing.assert_array_equal(command[:2], np.tile([0.0, 0.0, 50.0, 50.0], (2, 1)))
        assert (action[:2] == 0.0).all()
        assert (np.abs(action[2:]).max(axis=1) > 0).all()
        assert np.isfinite(command).all()
