"""The arm under joint torques against what its own inertia says, and what it refuses."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.arm import joints
from palpate.worlds.arm.joints import JointArm
from palpate.worlds.arm.panda import DAMPING, TORQUE_LIMITS
from palpate.worlds.world import DivergedError


def test_a_torque_accelerates_by_the_inertia_that_is_observed():
    """From rest over a millisecond: no Coriolis force yet, and hardly any damping."""
    arm = JointArm()
    seen = arm.reset(5)
    torque = np.array([3.0, -8.0, 2.0, 5.0, 0.5, -0.4, 0.2])
    after = arm.step(torque)
    expected = np.linalg.solve(seen.mass + 1e-3 * DAMPING * np.eye(7), torque)
    np.testing.assert_allclose(after.velocity / 1e-3, expected, rtol=1e-6)
    np.testing.assert_allclose(after.displacement, after.position - seen.position, atol=1e-15)


def test_the_meter_is_the_kinetic_energy_of_what_is_observed():
    arm = JointArm(1e-2)
    arm.reset(5)
    random = np.random.default_rng(0)
    for _ in range(20):
        seen = arm.step(TORQUE_LIMITS * random.uniform(-0.1, 0.1, 7))
        kinetic = 0.5 * seen.velocity @ seen.mass @ seen.velocity
        assert arm.meter().stored == pytest.approx(kinetic, rel=1e-9)
        assert arm.meter().work == 0.0


def test_episodes_begin_free_of_contact_and_the_peg_can_press_on_the_table():
    arm = JointArm()
    for seed in range(30):
        arm.reset(seed)
        assert not arm.truth().touching
    down = np.array([0.0, 20.0, 0.0, 0.0, 0.0, 0.0, 0.0])  # the shoulder bends forwards
    touched = False
    for _ in range(1500):
        arm.step(down)
        touched = touched or arm.truth().touching
    assert touched


def test_torques_are_cut_off_at_what_joints_give_and_nan_is_none(monkeypatch):
    arm, other = JointArm(), JointArm()
    arm.reset(1)
    other.reset(1)
    np.testing.assert_allclose(arm.step(10 * TORQUE_LIMITS).velocity,
                               other.step(TORQUE_LIMITS).velocity)  # fmt: skip
    arm.reset(1)
    np.testing.assert_allclose(arm.step(np.full(7, np.nan)).velocity, 0.0, atol=1e-12)
    with pytest.raises(PalpateError, match="7 torques"):
        arm.step(np.zeros(3))
    with pytest.raises(PalpateError, match="whole number of milliseconds"):
        JointArm(1.5e-3)
    with pytest.raises(PalpateError, match="after reset"):
        JointArm().step(np.zeros(7))
    monkeypatch.setattr(joints, "FASTEST", 1e-3)
    with pytest.raises(DivergedError, match="a joint is faster"):
        arm.step(TORQUE_LIMITS)
