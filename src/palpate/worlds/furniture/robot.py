"""A mobile manipulator among furniture: a base that drives any way and a planar arm with a gripper.

The base is a cylinder on two slides and a yaw hinge (it never tips, and its own wheels are left
out), the arm has three hinges. Servos of both follow the integral of the commanded velocities, and
give way at their force limits; those of the base may stand behind a drive, such as a filter. Base
and gripper collide; the links, above the furniture, do not. A grasp is a weld, made where the
gripper touches an outline. What is sensed: encoders, motor efforts and a force-torque sensor in the
wrist.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import shapely

from palpate.errors import PalpateError
from palpate.numerics.polygons import place_points
from palpate.worlds.furniture.bodies import Bodies
from palpate.worlds.furniture.pieces import BAND, HANDLE_HEIGHT
from palpate.worlds.furniture.scene import BODY_BIT, DRAWN, SOLID
from palpate.worlds.world import Drive

BASE_MASS = 30.0  # kg
LINK_MASS = 1.0  # kg, of each
GRIPPER_MASS = 0.3  # kg
ARM_HEIGHT = 0.55  # m
# Servos of the base's x, y and yaw and of the three joints of the arm: N and m, or N m and rad.
STIFFNESS = (2e4, 2e4, 4e3, 2e3, 2e3, 2e3)
DAMPING = (3e3, 3e3, 5e2, 3e2, 3e2, 3e2)
GREATEST_FORCE = (200.0, 200.0, 100.0, 120.0, 80.0, 40.0)
GREATEST_ACCELERATION = (2.0, 2.0, 4.0, 10.0, 10.0, 10.0)  # by which velocities are reached
LEAD = (0.02, 0.02, 0.05, 0.1, 0.1, 0.1)  # by which a servo's target may run ahead
BASE_SPEED, TURN_SPEED, JOINT_SPEED = 0.6, 1.5, 1.5  # m/s, rad/s, rad/s, greatest commanded
JOINT_LIMIT = 3.05  # rad
SAMPLES = 10  # of the force sensors and the servos in a control period: each time step
GRIPPER_RADIUS = 0.04  # m
GRASP_DISTANCE = 0.03  # m between gripper and outline within which it can grasp
WELD_SOLREF = (0.01, 1.0)

# Standard deviations of the robot's sensors.
BASE_POSITION_NOISE, BASE_ANGLE_NOISE = 1e-3, 1e-3  # m, rad
BASE_VELOCITY_NOISE = 1e-3  # m/s, rad/s
JOINT_NOISE = 1e-4  # rad


@dataclass(frozen=True)
class Robot:
    """Where a robot starts, and its size. Its gripper starts open, its arm in `nominal`."""

    pose: Sequence[float | int] | np.ndarray = (0.0, 0.0, 0.0)  # m, m, rad
    radius: float = 0.25  # m, of the base
    links: tuple[float, float, float] = (0.35, 0.35, 0.15)  # m, from the base's middle
    nominal: tuple[float, float, float] = (0.9, -1.8, 0.9)  # rad: the gripper 0.59 m ahead
    folded: tuple[float, float, float] = (1.57, -3.0, 1.43)  # rad: the gripper within the base

    def __post_init__(self) -> None:
        if np.shape(self.pose) != (3,) or not np.isfinite(self.pose).all():
            raise PalpateError(f"a robot's pose is three finite numbers x, y, yaw, not {self.pose}")
        if not (self.radius > 0 and min(self.links) > 0):
            raise PalpateError(
                f"a robot's radius and links are above 0, not {self.radius} and {self.links}"
            )


@dataclass(frozen=True)
class RobotAction:
    """Velocities for one control period, limited by the world, and which body to hold.

    `grip` is the number of a body, which is grasped as soon as the gripper is within 3 cm of its
    outline and held until another `grip`; None opens the gripper.
    """

    base_velocity: np.ndarray  # (3,) m/s, m/s, rad/s, world axes
    joint_velocity: np.ndarray  # (3,) rad/s
    grip: int | None = None


@dataclass(frozen=True)
class RobotObservation:
    """What the robot's own sensors show, with their noise."""

    base_pose: np.ndarray  # (3,) m, m, rad
    base_velocity: np.ndarray  # (3,) m/s, m/s, rad/s, world axes
    joint_angles: np.ndarray  # (3,) rad
    gripper_pose: np.ndarray  # (3,) m, m, rad, world, from base_pose and joint_angles
    # (3,) N, N, N m, world axes, about the gripper: what it exerts on what it holds or touches,
    # mean over the last period, with the inertia of the gripper (0.3 kg) in it.
    wrist_wrench: np.ndarray
    # (2,) N, world axes: what the base exerts on what it bumps into: motor effort less the
    # robot's inertia and the wrist's force. A few newtons of noise.
    base_force: np.ndarray
    holding: int | None  # number of the body in the gripper


@dataclass(frozen=True)
class RobotTruth:
    """The robot's true state, for experiments and tests alone."""

    base_pose: np.ndarray  # (3,) m, m, rad
    base_velocity: np.ndarray  # (3,) m/s, m/s, rad/s
    joint_angles: np.ndarray  # (3,) rad
    joint_velocities: np.ndarray  # (3,) rad/s
    gripper_pose: np.ndarray  # (3,) m, m, rad
    holding: int | None


def base_inertia(robot: Robot) -> np.ndarray:
    """(3, 3) kg, kg, kg m^2: what the base's servos move, its arm as in `nominal`.

    How the arm couples turning with driving is left out: that depends on the heading.
    """
    joints = forward_kinematics(np.zeros(3), np.asarray(robot.nominal), robot.links)
    middles = (joints[1:] + joints[:-1]) / 2
    arm = LINK_MASS * (middles**2).sum() + GRIPPER_MASS * (joints[-1] ** 2).sum()
    rods = LINK_MASS * (np.square(robot.links) / 12).sum()
    mass = BASE_MASS + 3 * LINK_MASS + GRIPPER_MASS
    return np.diag([mass, mass, BASE_MASS * robot.radius**2 / 2 + arm + rods])


def forward_kinematics(
    base_pose: np.ndarray, joint_angles: np.ndarray, links: Sequence[float]
) -> np.ndarray:
    """Joints and gripper (4, 2) in the world, m, from the shoulder in the base's middle on."""
    headings = base_pose[2] + np.cumsum(joint_angles)
    steps = np.asarray(links)[:, None] * np.stack([np.cos(headings), np.sin(headings)], -1)
    return base_pose[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])


def add_robot(spec: mujoco.MjSpec, robot: Robot, names: Sequence[str]) -> None:
    """Add the robot to a scene of bodies called `names`, with a weld to each for grasping."""
    x, y, _ = map(float, robot.pose)
    hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    base = spec.worldbody.add_body(name="base", pos=(x, y, 0))
    base.add_joint(name="base 0", type=slide, axis=(1, 0, 0))
    base.add_joint(name="base 1", type=slide, axis=(0, 1, 0))
    base.add_joint(name="base 2", type=hinge, axis=(0, 0, 1))
    grey, dark = (0.75, 0.77, 0.8, 1), (0.25, 0.27, 0.3, 1)
    low, high = BAND
    base.add_geom(
        name="base", type=mujoco.mjtGeom.mjGEOM_CYLINDER, mass=BASE_MASS,
        pos=(0, 0, (low + high) / 2), size=(robot.radius, (high - low) / 2, 0), rgba=grey,
        **SOLID,
    )  # fmt: skip
    base.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER, mass=0, rgba=dark, pos=(0, 0, 0.08),
        size=(0.9 * robot.radius, 0.07, 0), **DRAWN,
    )  # fmt: skip
    link, start = base, (0.0, 0.0, ARM_HEIGHT)
    for number, length in enumerate(robot.links):
        link = link.add_body(name=f"link {number}", pos=start)
        link.add_joint(
            name=f"arm {number}", type=hinge, axis=(0, 0, 1), armature=0.05, limited=1,
            range=(-JOINT_LIMIT, JOINT_LIMIT),
        )  # fmt: skip
        link.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=(0, 0, 0, length, 0, 0), mass=LINK_MASS,
            size=(0.025, 0, 0), rgba=dark, **DRAWN,
        )  # fmt: skip
        start = (length, 0.0, 0.0)
    gripper = link.add_body(name="gripper", pos=(*start[:2], HANDLE_HEIGHT - ARM_HEIGHT))
    gripper.add_geom(
        name="gripper", type=mujoco.mjtGeom.mjGEOM_CYLINDER, mass=GRIPPER_MASS, rgba=grey,
        size=(GRIPPER_RADIUS, (high - low) / 2 - 0.01, 0), **SOLID,
    )  # fmt: skip
    gripper.add_site(name="wrist")
    spec.add_exclude(bodyname1="base", bodyname2="gripper")
    for kind in (mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TORQUE):
        spec.add_sensor(
            name=f"wrist {kind.name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="wrist"
        )
    servos = zip(STIFFNESS, DAMPING, GREATEST_FORCE, strict=True)
    for number, (stiffness, damping, force) in enumerate(servos):
        joint = f"{'base' if number < 3 else 'arm'} {number % 3}"
        servo = spec.add_actuator(
            name=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint, forcelimited=1,
            forcerange=(-force, force),
        )  # fmt: skip
        servo.set_to_position(kp=stiffness, kv=damping)
    for name in names:
        spec.add_equality(
            name=f"grasp {name}", type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1="gripper", name2=name, active=False, solref=WELD_SOLREF,
        )  # fmt: skip


class RobotInScene:
    """The robot in a compiled scene: drives it, and reads its sensors."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        robot: Robot,
        bodies: Bodies,
        outlines: Sequence[np.ndarray],
        drive: Drive | None = None,
    ):
        self._model, self._data, self._robot, self._drive = model, data, robot, drive
        self._bodies, self._outlines = bodies, outlines
        # Three joints of the base and three of the arm, one after the other; views of the state.
        first, motor = model.joint("base 0"), model.actuator("base 0").id
        self._position = data.qpos[first.qposadr[0] :][:6]
        self._velocity = data.qvel[first.dofadr[0] :][:6]
        self._command = data.ctrl[motor:][:6]
        self._effort = data.actuator_force[motor:][:6]
        self._given = data.qfrc_applied[first.dofadr[0] :][:3]
        self._welds = [model.equality(f"grasp {name}").id for name in bodies.names]
        self._gripper, self._claw = model.body("gripper").id, model.geom("gripper").id
        self._site = model.site("wrist").id
        self._mass = model.body_subtreemass[model.body("base").id] - GRIPPER_MASS
        self.holding: int | None = None
        self._position[2:] = [robot.pose[2], *robot.nominal]
        self._command[:] = self._position
        self._target, self._profile = self._position.copy(), np.zeros(6)
        if drive is not None:  # which gives the forces of the base's servos in their place
            model.actuator_gainprm[motor : motor + 3] = 0.0
            model.actuator_biasprm[motor : motor + 3] = 0.0
            drive.begin()
        mujoco.mj_forward(model, data)

    def advance(self, action: RobotAction, period: float) -> tuple[np.ndarray, np.ndarray]:
        """Run `period` seconds; returns the mean wrist wrench (3,) and base force (2,)."""
        model, data = self._model, self._data
        base = _check(action.base_velocity, "base_velocity")
        joints = _check(action.joint_velocity, "joint_velocity")
        base[:2] *= min(1.0, BASE_SPEED / max(float(np.hypot(*base[:2])), 1e-9))
        base[2] = np.clip(base[2], -TURN_SPEED, TURN_SPEED)
        wanted = np.array([*base, *np.clip(joints, -JOINT_SPEED, JOINT_SPEED)])
        self._grip(action.grip)
        time = period / SAMPLES
        change = np.array(GREATEST_ACCELERATION) * time
        feed_forward = np.array(DAMPING) / STIFFNESS  # so that servos damp the velocity's error
        wrist, effort = np.zeros(3), np.zeros(2)
        before = self._velocity[:2].copy()
        for _ in range(SAMPLES):
            self._profile += np.clip(wanted - self._profile, -change, change)
            self._target += self._profile * time
            self._target = np.clip(self._target, self._position - LEAD, self._position + LEAD)
            self._target[3:] = np.clip(self._target[3:], -JOINT_LIMIT, JOINT_LIMIT)
            self._command[:] = self._target + self._profile * feed_forward
            for _ in range(round(time / model.opt.timestep)):
                if self._drive is not None:
                    self._given[:] = self._drive(
                        self._servo_force(), self._position[:3], self._velocity[:3].copy()
                    )
                mujoco.mj_step(model, data)
            # In the site's axes, of which z is vertical.
            axes = data.site_xmat[self._site].reshape(3, 3)
            wrist[:2] += axes[:2] @ data.sensordata[:3]
            wrist[2] += data.sensordata[5]
            effort += self._effort[:2] + self._given[:2]
        acceleration = (self._velocity[:2] - before) / period
        wrist, effort = wrist / SAMPLES, effort / SAMPLES
        inertia = self._mass
        if self._drive is None:
            # The servo's damping acts at the end of an implicit step; `effort` is of its beginning.
            inertia = inertia + DAMPING[0] * model.opt.timestep
        return wrist, effort - inertia * acceleration - wrist[:2]

    def _servo_force(self) -> np.ndarray:
        """What the base's servos would give now, N, N, N m."""
        stiffness, damping, most = (
            np.array(each[:3]) for each in (STIFFNESS, DAMPING, GREATEST_FORCE)
        )
        force = stiffness * (self._command - self._position)[:3] - damping * self._velocity[:3]
        return np.clip(force, -most, most)

    def truth(self) -> RobotTruth:
        """Where the robot is and how it moves, without noise."""
        position, velocity = self._position.copy(), self._velocity.copy()
        base = position[:3] + np.array([*self._robot.pose[:2], 0.0])
        return RobotTruth(
            base_pose=base,
            base_velocity=velocity[:3],
            joint_angles=position[3:],
            joint_velocities=velocity[3:],
            gripper_pose=self._gripper_pose(base, position[3:]),
            holding=self.holding,
        )

    def observe(
        self, wrist: np.ndarray, base_force: np.ndarray, random: np.random.Generator, period: float
    ) -> RobotObservation:
        """The state with noise, beside what was measured with noise already."""
        truth = self.truth()
        noise = random.standard_normal((3, 3))
        spread = (BASE_POSITION_NOISE, BASE_POSITION_NOISE, BASE_ANGLE_NOISE)
        base = truth.base_pose + spread * noise[0]
        joints = truth.joint_angles + JOINT_NOISE * noise[1]
        # The inertia is judged by two noisy velocities.
        force_noise = self._mass * math.sqrt(2) * BASE_VELOCITY_NOISE / period
        return RobotObservation(
            base_pose=base,
            base_velocity=truth.base_velocity + BASE_VELOCITY_NOISE * noise[2],
            joint_angles=joints,
            gripper_pose=self._gripper_pose(base, joints),
            wrist_wrench=wrist,
            base_force=base_force + force_noise * random.standard_normal(2),
            holding=self.holding,
        )

    def _gripper_pose(self, base: np.ndarray, joints: np.ndarray) -> np.ndarray:
        points = forward_kinematics(base, joints, self._robot.links)
        return np.array([*points[-1], base[2] + joints.sum()])

    def _grip(self, wanted: int | None) -> None:
        if wanted is not None and not 0 <= wanted < len(self._welds):
            raise PalpateError(
                f"a robot grips body 0 to {len(self._welds) - 1}, or None, not {wanted}"
            )
        if wanted == self.holding:
            return
        data = self._data
        if self.holding is not None:
            data.eq_active[self._welds[self.holding]] = 0
            self.holding = None
        if wanted is not None and self._distance(wanted) <= GRASP_DISTANCE:
            self._weld(wanted)
            self.holding = wanted
        # While it holds something, the gripper is part of that and touches nothing else.
        bit = BODY_BIT if self.holding is None else 0
        self._model.geom_contype[self._claw] = self._model.geom_conaffinity[self._claw] = bit

    def _distance(self, body: int) -> float:
        """From the gripper's surface to the outline of a body, m."""
        outline = shapely.Polygon(place_points(self._outlines[body], self._bodies.poses()[body]))
        gripper = shapely.Point(self.truth().gripper_pose[:2])
        return outline.distance(gripper) - GRIPPER_RADIUS

    def _weld(self, body: int) -> None:
        """Hold the body as it stands, at the gripper's middle."""
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        piece = self._bodies.ids[body]
        anchor, turn, inverse = np.empty(3), np.empty(4), np.empty(4)
        rotation = data.xmat[piece].reshape(3, 3)
        anchor[:] = rotation.T @ (data.xpos[self._gripper] - data.xpos[piece])
        mujoco.mju_negQuat(inverse, data.xquat[self._gripper])
        mujoco.mju_mulQuat(turn, inverse, data.xquat[piece])
        weld = self._welds[body]
        # The anchor in the piece's frame, then where it is held in the gripper's, then the turn.
        model.eq_data[weld, :10] = [*anchor, 0, 0, 0, *turn]
        data.eq_active[weld] = 1


def _check(velocity: np.ndarray, name: str) -> np.ndarray:
    velocity = np.array(velocity, float)
    if velocity.shape != (3,) or not np.isfinite(velocity).all():
        raise PalpateError(
            f"a robot's {name} is three finite numbers, not {velocity.tolist()!s:.80}"
        )
    return velocity
