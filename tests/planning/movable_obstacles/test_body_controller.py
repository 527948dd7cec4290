"""The body controller's kinematics against closed forms, and what it promises."""

import math

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.motion.body_controller import (
    BodyController,
    arm_jacobian,
    gripper_pose,
    velocity_at,
)

LINKS = (0.4, 0.3, 0.2)
PERIOD = 0.02


@pytest.mark.parametrize(
    ("angles", "pose"),
    [
        ((0, 0, 0), (0.9, 0, 0)),
        ((math.pi / 2, 0, 0), (0, 0.9, math.pi / 2)),
        ((0, math.pi / 2, 0), (0.4, 0.5, math.pi / 2)),
        ((math.pi / 2, -math.pi / 2, -math.pi / 2), (0.3, 0.2, -math.pi / 2)),
        ((0, math.pi, 0), (-0.1, 0, math.pi)),
    ],
)
def test_the_gripper_is_where_geometry_puts_it(angles, pose):
    assert gripper_pose(np.array(angles, float), LINKS) == pytest.approx(pose, abs=1e-12)


def test_the_jacobian_is_the_derivative():
    random = np.random.default_rng(0)
    for angles in random.uniform(-3, 3, (20, 3)):
        step = 1e-6 * np.eye(3)
        numeric = [
            (gripper_pose(angles + s, LINKS) - gripper_pose(angles - s, LINKS)) / 2e-6 for s in step
        ]
        assert arm_jacobian(angles, LINKS) == pytest.approx(np.stack(numeric, -1), abs=1e-8)
    # Its determinant is that of the elbow: l1 l2 sin(q2).
    determinant = np.linalg.det(arm_jacobian(angles, LINKS))
    assert determinant == pytest.approx(0.4 * 0.3 * math.sin(angles[1]))


def test_a_point_moves_with_its_body():
    velocity = velocity_at(
        np.array([0.1, 0.2, 0.5]), np.array([1.0, 1.0, 2.0]), np.array([1.0, 3.0])
    )
    assert velocity == pytest.approx([0.1 - 0.5 * 2, 0.2, 0.5])


def run(controller, wanted, base=(0.3, -0.2, 0.8), angles=None, steps=400):
    """Integrate perfect servos; the history of base poses, angles, gripper poses, velocities."""
    base, velocity = np.array(base), np.zeros(3)
    angles = np.array(controller.nominal if angles is None else angles)
    history = []
    for step in range(steps):
        velocity, joints = controller.split(base, velocity, angles, wanted(step * PERIOD), PERIOD)
        base, angles = base + PERIOD * velocity, angles + PERIOD * joints
        cosine, sine = math.cos(base[2]), math.sin(base[2])
        x, y, turn = gripper_pose(angles, controller.links)
        gripper = base + np.array([cosine * x - sine * y, sine * x + cosine * y, turn])
        history.append((base, angles, gripper, velocity, joints))
    return [np.array(column) for column in zip(*history, strict=True)]


def test_the_gripper_follows_while_the_arm_returns_to_its_posture():
    controller = BodyController()
    wanted = np.array([0.15, -0.1, 0.1])
    bases, angles, grippers, velocities, _ = run(
        controller, lambda _: wanted, angles=(1.4, -2.0, 0.9), steps=500
    )
    # A second for the base to get going, then to the integrator's accuracy.
    moved = (grippers[-1] - grippers[100]) / (399 * PERIOD)
    assert moved == pytest.approx(wanted, abs=2e-3)
    assert angles[-1] == pytest.approx(controller.nominal, abs=2e-3)
    # In the end base and gripper are one rigid body, turning at the wanted rate.
    assert velocities[-1, 2] == pytest.approx(0.1, abs=2e-3)
    distance = np.linalg.norm(grippers[-1, :2] - bases[-1, :2])
    assert distance == pytest.approx(0.7 * math.cos(0.9) + 0.15, abs=2e-3)


def test_the_split_is_exact_when_the_base_is_free_to_follow():
    controller = BodyController(base_acceleration=1e6, turn_acceleration=1e6)
    random = np.random.default_rng(1)
    for _ in range(20):
        base = random.uniform(-2, 2, 3)
        angles = np.array(controller.nominal) + random.uniform(-0.3, 0.3, 3)
        wanted = random.uniform(-0.1, 0.1, 3)
        velocity, joints = controller.split(base, np.zeros(3), angles, wanted, PERIOD)
        cosine, sine = math.cos(base[2]), math.sin(base[2])
        rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        lever = rotation @ gripper_pose(angles, controller.links)
        got = (
            velocity_at(velocity, np.zeros(3), lever)
            + rotation @ arm_jacobian(angles, controller.links) @ joints
        )
        assert got == pytest.approx(wanted, abs=1e-9)
        assert joints == pytest.approx(np.array(controller.nominal) - angles)


def test_the_arm_takes_what_is_fast_and_small():
    controller = BodyController()

    def shaking(time):
        return np.array([0.1 * math.sin(2 * math.pi * 2 * time), 0, 0])

    bases, _, grippers, _, _ = run(controller, shaking, base=(0.0, 0.0, 0.0), steps=200)
    amplitude = 0.1 / (2 * math.pi * 2)
    gripper, base = np.ptp(grippers[100:, 0]) / 2, np.ptp(bases[100:, 0]) / 2
    assert gripper == pytest.approx(amplitude, rel=0.15)
    slow = run(BodyController(base_acceleration=0.3), shaking, base=(0.0, 0.0, 0.0), steps=200)
    assert np.ptp(slow[0][100:, 0]) / 2 < 0.5 * base  # a slower base leaves more to the arm
    assert np.ptp(slow[2][100:, 0]) / 2 == pytest.approx(amplitude, rel=0.15)


@pytest.mark.parametrize("wanted", [(2.0, 0, 0), (0, -1.0, 3.0), (0, 0, -5.0)])
def test_limits_are_kept(wanted):
    controller = BodyController()
    _, _, _, velocities, joints = run(controller, lambda _: np.array(wanted), steps=100)
    assert np.linalg.norm(velocities[:, :2], axis=1).max() <= controller.base_speed + 1e-9
    assert np.abs(velocities[:, 2]).max() <= controller.turn_speed + 1e-9
    assert np.abs(joints).max() <= controller.joint_speed + 1e-9


def test_a_stretched_arm_stays_tame():
    controller = BodyController()
    velocity, joints = controller.split(
        np.zeros(3), np.zeros(3), np.zeros(3), np.array([0.3, 0.0, 0.0]), PERIOD
    )
    assert np.isfinite([*velocity, *joints]).all()
    assert np.abs(joints).max() <= controller.joint_speed


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"base_speed": 0.0}, "base_speed is above 0"),
        ({"damping": math.nan}, "damping is above 0"),
        ({"links": (0.3, -0.1, 0.2)}, "links is above 0"),
        ({"links": (0.3, 0.1)}, "as many links as joints"),
    ],
)
def test_what_makes_no_sense_is_refused(changes, message):
    with pytest.raises(PalpateError, match=message):
        BodyController(**changes)
