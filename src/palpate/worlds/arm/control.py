"""Motion of an arm's tool that is asked for as accelerations: control in operational space."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dposv

from palpate.worlds.arm.panda import DAMPING, JOINTS, RANGE, TORQUE_LIMITS

POSTURE_RATE = 5.0  # rad/s, at which joints return to their posture, critically damped


class OperationalSpace:
    """Torques that give a tool's site wanted accelerations (Khatib 1987, J. Robotics Automation 3).

    tau = M (qdd0 + J+ (a - Jdot qdot - J qdd0)) + h - J^T F, where J+ = M^-1 J^T (J M^-1 J^T)^-1, h
    is gravity, Coriolis and the joints' damping, F the contact wrench that is felt, and qdd0 pulls
    the joints to a posture where the task leaves them free. A task has five axes: the site's x, y,
    z, and its turning about x and y; how it is turned about z is left free.

    `model` and `data` are MuJoCo's, of which only what the robot knows of itself is read: joint
    angles and speeds, and the inertia and gravity that belong to them.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        site: str,
        posture: Float[np.ndarray, " 7"],
    ):
        self._model, self._data, self._posture = model, data, posture
        first = model.joint(JOINTS[0]).dofadr[0]
        self.dofs = slice(first, first + len(JOINTS))
        self._site, self._body = model.site(site).id, model.site(site).bodyid[0]
        count = model.nv
        self._jacobian, self._rate = np.zeros((6, count)), np.zeros((6, count))
        self._inertia = np.zeros((count, count))
        self.angle, self.speed = data.qpos[self.dofs], data.qvel[self.dofs]
        self._bias = data.qfrc_bias[self.dofs]
        self.place = data.site_xpos[self._site]
        self.axes = data.site_xmat[self._site].reshape(3, 3)

    def refresh(self) -> None:
        """Take the Jacobian of the present angles."""
        both = self._jacobian
        mujoco.mj_jacSite(self._model, self._data, both[:3], both[3:], self._site)
        self.jacobian = both[:5, self.dofs]
        self.motion = self.jacobian @ self.speed  # of the site, relative to the arm's mount

    def inertia(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """M (7, 7), M^-1 J^T (7, 5) and J M^-1 J^T (5, 5), in kg and m."""
        mujoco.mj_fullM(self._model, self._data, self._inertia)
        mass = self._inertia[self.dofs, self.dofs]
        response = dposv(mass, self.jacobian.T)[1]
        return mass, response, self.jacobian @ response

    def torque(
        self, acceleration: Float[np.ndarray, " 5"], felt: Float[np.ndarray, " 5"]
    ) -> Float[np.ndarray, " 7"]:
        """N m, within the joints' limits, for m/s^2 and rad/s^2, and a felt wrench in N and N m."""
        rate, jacobian = self._rate, self.jacobian
        mujoco.mj_jacDot(self._model, self._data, rate[:3], rate[3:], self.place, self._body)
        mass, response, mobility = self.inertia()
        free = POSTURE_RATE * (POSTURE_RATE * (self._posture - self.angle) - 2 * self.speed)
        missing = acceleration - rate[:5, self.dofs] @ self.speed - jacobian @ free
        joints = free + response @ dposv(mobility, missing)[1]
        torque = mass @ joints + self._bias + DAMPING * self.speed - jacobian.T @ felt
        return np.maximum(np.minimum(torque, TORQUE_LIMITS), -TORQUE_LIMITS)

    def restored(self, height_rate: float, tilt_rate: float) -> Float[np.ndarray, " 3"]:
        """Accelerations that bring height 0 and an upright tool back, critically damped.

        Rates in rad/s. In m/s^2 along z and rad/s^2 about x and y; upright is the site's z down.
        """
        height, axes, motion = self.place[2], self.axes, self.motion
        off = np.array([-height, -axes[1, 2], axes[0, 2]])  # the last two: z axis x (0, 0, -1)
        rate = np.array([height_rate, tilt_rate, tilt_rate])
        return rate * (rate * off - 2 * motion[2:])

    def reach(self, place: Float[np.ndarray, " 3"]) -> float:
        """Turn the joints so that the site is at `place` (world, m), upright.

        Newton's method from the posture. Returns by how much it misses in the end, m or rad, or by
        how much a joint is out of its range, rad.
        """
        self.angle[:] = self._posture
        for _ in range(100):
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_comPos(self._model, self._data)
            self.refresh()
            tilt = -self.axes[1, 2], self.axes[0, 2]
            off = np.concatenate([place - self.place, tilt])
            back = 0.2 * (self._posture - self.angle)
            jacobian = self.jacobian
            square = jacobian @ jacobian.T + 1e-9 * np.eye(5)
            step = back + jacobian.T @ np.linalg.solve(square, off - jacobian @ back)
            self.angle += np.clip(step, -0.2, 0.2)
        beyond = np.maximum(RANGE[0] - self.angle, self.angle - RANGE[1])
        return float(max(np.abs(off).max(), beyond.max()))
