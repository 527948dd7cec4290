"""The blind maze, felt by a seven-axis arm through the peg that its gripper holds."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from palpate.errors import PalpateError
from palpate.worlds.arm.control import OperationalSpace
from palpate.worlds.arm.panda import GRIP_Z, HAND, MASS, add_panda, balance, wrist
from palpate.worlds.maze.layout import TIP_RADIUS, Layout
from palpate.worlds.maze.maze import BlindMaze
from palpate.worlds.maze.scene import (
    REFERENCE_HEIGHT,
    SLIP_DAMPING,
    SWAY_AXIS,
    TIME_STEP,
    TIP,
    TIP_MASS,
    add_peg,
    contact_solref,
    maze_scene,
)
from palpate.worlds.world import World

GRAVITY = 9.81  # m/s^2
# Where the arm stands on the base: beside the maze, which lies higher, as on a table. From there it
# reaches every place of the maze, far from its joints' limits and from stretching out.
MOUNT, MOUNT_YAW = (0.0, -0.42, -0.3), math.pi / 2  # m, rad
POSTURE = np.array([0.0, -0.43, 0.0, -2.36, 0.0, 1.93, math.pi / 4])  # rad, about the maze's middle
PEG_MASS, PEG_LENGTH = 0.1, 0.085  # kg; m from where the fingers hold it to its tip
PEG_INERTIA = (1e-4, 1e-4, 1e-5)  # kg m^2
# With the wrist's force fed back the peg answers every push as a tip of this mass would, which is
# about half of what it weighs there by itself (1.5 to 2 kg, its joints free).
APPARENT_MASS = TIP_MASS  # kg
# What is fed back is filtered at 100 Hz, as by the manufacturer's library: dry friction answers a
# command within one period, and the raw force would chatter. Only its part in the plane is.
SMOOTHING = 1 - math.exp(-2 * math.pi * 100 * TIME_STEP)
HEIGHT_RATE = TILT_RATE = 40.0  # rad/s: 40^2 times some 6 kg is the 1e4 N/m that a tip is held with


class ArmMaze(BlindMaze):
    """`BlindMaze` with a seven-axis arm on the swaying base, whose gripper holds the peg.

    It takes the same force on the tip, shows the same observations, and is judged by the same
    truth. At 1 kHz the arm makes torques of it (`OperationalSpace`): the peg accelerates by the
    force commanded and the force felt over `APPARENT_MASS` (inertia shaping: Hogan 1985, J. Dyn.
    Syst. Meas. Control 107), keeps its height, and stays upright. What is felt is what the wrist's
    sensor showed one period before, with its noise, filtered. Gravity, inertia and limits are real.

    The wrench is the wrist sensor's, without weight and inertia of hand and peg.

    Raises `PalpateError` as `BlindMaze`, and for a start out of the arm's reach.
    """

    _carried = MASS + PEG_MASS
    _rolls_out = False  # its torques follow from sensors in every period
    meter = World.meter  # nobody has told what gravity does
    _view = (0.0, -0.12, 0.12), 1.5, 140.0, -25.0

    def _compile(self, layout: Layout) -> mujoco.MjModel:
        model = maze_scene(layout, _add_arm).compile()
        inverse_mass = model.body_invweight0[model.body(TIP).id, 0]
        model.pair_solref[:] = contact_solref(inverse_mass)
        model.pair_solreffriction[:] = -SLIP_DAMPING * inverse_mass
        self._balance = balance(model, GRIP_Z + PEG_LENGTH - REFERENCE_HEIGHT)
        return model

    def _seat(self, x: float, y: float) -> None:
        model, data = self._model, self._data
        self._control = control = OperationalSpace(model, data, TIP, POSTURE)
        place = np.add((x, y), np.multiply(data.qpos[0], SWAY_AXIS))
        if control.reach(np.array([*place, 0.0])) > 1e-6:
            raise PalpateError(f"the arm does not reach ({x:.3f}, {y:.3f}) m")
        self._wrist = wrist(model, data)
        self._hand_axes = data.site_xmat[model.site(HAND).id].reshape(3, 3)
        self._shown, self._felt_force = np.zeros(6), np.zeros(5)
        mujoco.mj_forward(model, data)
        control.refresh()
        self._drive(np.zeros(3))

    def _drive(self, force: np.ndarray) -> None:
        """Set the torques for a force (3,) N on the tip."""
        control, felt = self._control, self._felt_force
        felt[:2] += SMOOTHING * (self._shown[:2] - felt[:2])
        wanted = np.zeros(5)
        wanted[:3] = (force + felt[:3]) / APPARENT_MASS
        wanted[2:] += control.restored(HEIGHT_RATE, TILT_RATE)
        self._applied[control.dofs] = control.torque(wanted, felt)

    def _advance(self, x: float, y: float, z: float) -> float:
        model, data, felt = self._model, self._data, self._felt
        force, peak = np.array([x, y, z]), 0.0
        for _ in range(self._substeps):
            self._applied[0] = self._swaying_force()
            self._drive(force)
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)  # the next state's angles, inertia and contacts
            self._control.refresh()
            peak = max(peak, felt.item(0) ** 2 + felt.item(1) ** 2)
        return peak

    def _motion(self) -> tuple[np.ndarray, np.ndarray]:
        position = self._control.place.copy()
        position[:2] -= np.multiply(self._position[0], SWAY_AXIS)
        return position, self._control.motion[:3].copy()

    def _force(self) -> np.ndarray:
        return -self._felt[:3]

    def _wrench(self) -> np.ndarray:
        self._shown = ((self._balance @ self._wrist).reshape(2, 3) @ self._hand_axes.T).ravel()
        return self._shown  # to which the sensor's noise is added in place


def _add_arm(spec: mujoco.MjSpec, base: mujoco.MjsBody) -> None:
    spec.option.gravity = (0, 0, -GRAVITY)
    # The joints' damping is compensated as it acts, not as an implicit step would have it.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    hand = add_panda(spec, base, MOUNT, MOUNT_YAW, TIP_RADIUS)
    tip = hand.add_body(
        name=TIP, pos=(0, 0, GRIP_Z + PEG_LENGTH), mass=PEG_MASS, ipos=(0, 0, -REFERENCE_HEIGHT),
        inertia=PEG_INERTIA,
    )  # fmt: skip
    tip.explicitinertial = True
    tip.add_site(name=TIP)
    add_peg(tip, up=-1.0)
