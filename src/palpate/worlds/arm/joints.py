"""A seven-axis arm whose joints are driven by torques, with a peg that can press on a table."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np

from palpate.errors import PalpateError
from palpate.worlds.arm.panda import GRIP_Z, JOINTS, TORQUE_LIMITS, add_panda
from palpate.worlds.world import DivergedError, Meter, OffscreenCamera, World

TIME_STEP = 1e-3  # s
POSTURE = np.array([0.0, -0.43, 0.0, -2.36, 0.0, 1.93, math.pi / 4])  # rad
SCATTER = 0.2  # rad, from the posture to where episodes begin, at most
TABLE = 0.02  # m below the peg's tip in that posture
PEG_LENGTH, PEG_RADIUS, PEG_MASS = 0.085, 0.01, 0.1  # m, m, kg
FASTEST = 50.0  # rad/s of a joint, in which physics is lost


class ArmObservation(NamedTuple):
    """What the arm knows of itself."""

    time: float  # s since reset
    position: np.ndarray  # (7,) rad
    velocity: np.ndarray  # (7,) rad/s
    displacement: np.ndarray  # (7,) rad since the observation before
    mass: np.ndarray  # (7, 7) kg m^2, of the present angles


class ArmTruth(NamedTuple):
    """For judges and tests alone."""

    time: float  # s since reset
    touching: bool  # whether the peg is in contact with the table, or a joint with its limit


class JointArm(World):
    """The arm of `palpate.worlds.arm.panda` under torques (7,) N m, each held for a period.

    Gravity is compensated by the arm itself: it is switched off. Torques are cut off at what joints
    give, and those that are not finite are none. The peg in its gripper can press on a table, and
    joints end at their limits; nothing else collides. `control_period` is a whole number of
    milliseconds, in s; episodes begin at rest about one posture.

    Raises `PalpateError` for another control period, and for a torque of another shape.
    """

    def __init__(self, control_period: float = TIME_STEP):
        substeps = control_period / TIME_STEP
        if not (0.5 < substeps < 1e4 and abs(substeps - round(substeps)) < 1e-6):
            raise PalpateError(
                f"the control period is a whole number of milliseconds, not {control_period} s"
            )
        self._substeps = round(substeps)
        self._model = _scene().compile()
        self._data = mujoco.MjData(self._model)
        joint = self._model.joint(JOINTS[0])
        self._dofs = slice(joint.dofadr[0], joint.dofadr[0] + len(JOINTS))
        self._inertia = np.zeros((self._model.nv, self._model.nv))
        self._camera: OffscreenCamera | None = None
        self._ready = False

    @property
    def control_period(self) -> float:
        return self._substeps * TIME_STEP

    def reset(self, seed: int) -> ArmObservation:
        """At rest above the table, up to `SCATTER` rad from the posture in every joint."""
        random, data = np.random.default_rng(seed), self._data
        mujoco.mj_resetData(self._model, data)
        free = False
        while not free:  # a peg in the table would be thrown out of it
            data.qpos[self._dofs] = POSTURE + random.uniform(-SCATTER, SCATTER, len(JOINTS))
            mujoco.mj_forward(self._model, data)
            free = data.ncon == 0
        self._ready, self._before = True, data.qpos[self._dofs].copy()
        return self._observe()

    def step(self, action: np.ndarray) -> ArmObservation:
        """Hold the torques `action` (7,) N m for one control period."""
        self._check_ready("runs")
        torque = np.asarray(action, float)
        if torque.shape != TORQUE_LIMITS.shape:
            raise PalpateError(f"an arm takes 7 torques in N m, not {action}")
        torque = np.where(np.isfinite(torque), torque, 0.0)
        model, data = self._model, self._data
        data.qfrc_applied[self._dofs] = np.clip(torque, -TORQUE_LIMITS, TORQUE_LIMITS)
        mujoco.mj_step(model, data, nstep=self._substeps)
        if not np.abs(data.qvel).max() < FASTEST:
            self._ready = False
            raise DivergedError(f"a joint is faster than {FASTEST:g} rad/s at {data.time:.3f} s")
        mujoco.mj_forward(model, data)
        return self._observe()

    def meter(self) -> Meter:
        """See `World.meter`; nothing acts from outside."""
        self._check_ready("has a meter")
        mujoco.mj_energyVel(self._model, self._data)
        return Meter(float(self._data.energy[1]), 0.0)

    def truth(self) -> ArmTruth:
        self._check_ready("has a truth")
        return ArmTruth(self._data.time, self._data.nefc > 0)

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        self._check_ready("is drawn")
        camera = self._camera
        if camera is None or (camera.width, camera.height) != (width, height):
            self._camera = camera = OffscreenCamera(self._model, width, height)
        view = mujoco.MjvCamera()
        view.lookat, view.distance, view.azimuth, view.elevation = (0.3, 0, 0.3), 1.8, 130, -25
        return camera.picture(self._data, view)

    def _observe(self) -> ArmObservation:
        data = self._data
        angle = data.qpos[self._dofs].copy()
        went, self._before = angle - self._before, angle
        mujoco.mj_fullM(self._model, data, self._inertia)
        mass = self._inertia[self._dofs, self._dofs].copy()
        return ArmObservation(data.time, angle, data.qvel[self._dofs].copy(), went, mass)

    def _check_ready(self, does: str) -> None:
        if not self._ready:
            raise PalpateError(f"an arm {does} after reset(seed), not before")


def _scene() -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep, spec.option.gravity = TIME_STEP, (0, 0, 0)
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    world = spec.worldbody
    world.add_light(pos=(0.5, -0.5, 2))
    hand = add_panda(spec, world, (0.0, 0.0, 0.0), 0.0, PEG_RADIUS)
    peg = hand.add_body(name="peg", pos=(0, 0, GRIP_Z), mass=PEG_MASS, inertia=(1e-4, 1e-4, 1e-5))
    peg.explicitinertial = True
    peg.add_geom(
        name="peg", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=(PEG_RADIUS, 0, 0),
        fromto=(0, 0, 0, 0, 0, PEG_LENGTH), contype=1, conaffinity=2,
    )  # fmt: skip
    table = world.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.4, 0.4, 0.05), contype=2,
        conaffinity=1, rgba=(0.8, 0.75, 0.65, 1),
    )  # fmt: skip
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = POSTURE
    mujoco.mj_kinematics(model, data)
    axes = data.body("peg").xmat.reshape(3, 3)
    tip = data.body("peg").xpos + axes[:, 2] * (PEG_LENGTH + PEG_RADIUS)
    table.pos = (tip[0], tip[1], tip[2] - TABLE - 0.05)
    return spec
