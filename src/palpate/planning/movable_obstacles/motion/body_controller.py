"""Splits the velocity a gripper should have between a mobile base and its planar arm.

The body controller of Scholz (2015), "Physics-Based Reinforcement Learning for Mobile
Manipulation", turns a desired object velocity v_o into velocities of the manipulator v_m and of
the base v_b. Here the arm returns to its nominal posture while the base follows, and does what the
base's limited acceleration does not allow at once. Pure kinematics, no state.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpate.errors import PalpateError


def gripper_pose(joint_angles: np.ndarray, links: Sequence[float]) -> np.ndarray:
    """Pose (3,) in m, m, rad of the end of a planar arm in the frame of its shoulder.

    `joint_angles` (joints,) rad are relative to the link before, `links` lengths (joints,) m.
    """
    headings = np.cumsum(joint_angles)
    lengths = np.asarray(links)
    return np.array([lengths @ np.cos(headings), lengths @ np.sin(headings), headings[-1]])


def arm_jacobian(joint_angles: np.ndarray, links: Sequence[float]) -> np.ndarray:
    """(3, joints): the gripper's velocity in its shoulder's frame per joint velocity.

    A joint turns the gripper about itself: the column is (-y, x, 1) of the lever from it.
    """
    headings = np.cumsum(joint_angles)
    steps = np.asarray(links)[:, None] * np.stack([np.cos(headings), np.sin(headings)], -1)
    levers = np.cumsum(steps[::-1], 0)[::-1]  # from each joint to the end
    return np.stack([-levers[:, 1], levers[:, 0], np.ones(len(levers))])


def velocity_at(velocity: np.ndarray, pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Velocity (3,) of what is fixed at `point` (2,) of a body that moves with `velocity` (3,).

    All in world axes, m/s and rad/s; `pose` (3,) is of the body frame that `velocity` is of.
    """
    lever = np.asarray(point)[:2] - np.asarray(pose)[:2]
    turn = velocity[2]
    return np.array([velocity[0] - turn * lever[1], velocity[1] + turn * lever[0], turn])


@dataclass(frozen=True)
class BodyController:
    """The limits and the posture that a gripper velocity is split by; one shoulder amid the base.

    Raises `PalpateError` unless limits, lengths and rates are positive.
    """

    links: tuple[float, ...] = (0.35, 0.35, 0.15)  # m
    nominal: tuple[float, ...] = (0.9, -1.8, 0.9)  # rad, the posture to return to
    base_speed: float = 0.5  # m/s
    turn_speed: float = 1.0  # rad/s
    base_acceleration: float = 1.0  # m/s^2
    turn_acceleration: float = 2.0  # rad/s^2
    joint_speed: float = 1.2  # rad/s
    return_rate: float = 1.0  # 1/s at which the arm returns to its posture
    damping: float = 0.05  # m, of the least squares: below it the arm counts as singular

    def __post_init__(self) -> None:
        if len(self.links) != len(self.nominal) or not self.links:
            raise PalpateError(
                f"an arm has as many links as joints, not {len(self.links)} and {len(self.nominal)}"
            )
        for name, value in vars(self).items():
            if name != "nominal" and not 0 < np.min(value) <= np.max(value) < math.inf:
                raise PalpateError(f"a body controller's {name} is above 0, not {value}")

    def split(
        self,
        base_pose: np.ndarray,
        base_velocity: np.ndarray,
        joint_angles: np.ndarray,
        gripper_velocity: np.ndarray,
        period: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Velocities of base (3,) and joints (joints,) that move the gripper as wanted.

        The base moves, as its acceleration allows, so that the arm returns to its posture at
        `return_rate`; the arm makes up for the rest by damped least squares around that return.
        What is too fast slows both down alike, so that the gripper keeps its direction.

        Poses (3,) in m, m, rad; velocities (3,) in m/s, m/s, rad/s along world axes, of the base
        now and of the gripper as wanted; joints (joints,) in rad; `period`: s until the next call.
        """
        cosine, sine = math.cos(base_pose[2]), math.sin(base_pose[2])
        rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        arm = rotation @ arm_jacobian(joint_angles, self.links)
        lever = rotation @ gripper_pose(joint_angles, self.links)
        carried = np.array([[1, 0, -lever[1]], [0, 1, lever[0]], [0, 0, 1]])  # by the base
        homewards = self.return_rate * (np.asarray(self.nominal) - joint_angles)
        homewards = np.clip(homewards, -0.5 * self.joint_speed, 0.5 * self.joint_speed)

        base = np.linalg.solve(carried, gripper_velocity - arm @ homewards)
        linear = self.base_speed / max(math.hypot(*base[:2]), 1e-12)
        base *= min(1.0, linear, self.turn_speed / max(abs(base[2]), 1e-12))
        change = base - base_velocity
        planar = self.base_acceleration * period
        change[:2] *= min(1.0, planar / max(math.hypot(*change[:2]), 1e-12))
        greatest = self.turn_acceleration * period
        change[2] = min(max(change[2], -greatest), greatest)
        base = base_velocity + change

        missing = gripper_velocity - carried @ base - arm @ homewards
        gram = arm @ arm.T + self.damping**2 * np.eye(3)
        joints = homewards + arm.T @ np.linalg.solve(gram, missing)
        slower = min(1.0, self.joint_speed / max(np.abs(joints).max(), 1e-12))
        return slower * base, slower * joints
