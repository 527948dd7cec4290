"""A rope held by a gripper: a MuJoCo cable that no model in palpate shares its physics with.

The cable is a chain of capsules on ball joints, inextensible, with bending and twisting
stiffness (the plugin `mujoco.elasticity.cable`), joint damping and air drag. Its first end
hangs in the gripper, a body on three slides. Nothing collides: neither with the floor, which is
only drawn, nor the rope with itself.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from palpate.errors import PalpateError
from palpate.worlds.rope.configuration import Disturbance, RopeConfiguration, sample_configurations
from palpate.worlds.rope.starts import (
    DOWNWARDS,
    HANGING,
    START_POSES,
    joint_rotations,
    shake_commands,
    start_tangents,
)
from palpate.worlds.world import DivergedError, Drive, OffscreenCamera, World

__all__ = [
    "START_POSES", "Disturbance", "RopeConfiguration", "RopeObservation", "RopeTruth", "RopeWorld",
    "sample_configurations",
]  # fmt: skip

GRIPPER_START = (0.0, 0.0, 1.5)  # m, where every episode begins, at rest
GRIPPER_MASS = 0.5  # kg
# The gripper is a critically damped position servo: it follows its target with a lag of
# 2 / SERVO_FREQUENCY = 10 ms and no overshoot, so that a target within the limits of speed and
# acceleration keeps the gripper within them too.
SERVO_FREQUENCY = 200.0  # rad/s
SERVO_STIFFNESS = GRIPPER_MASS * SERVO_FREQUENCY**2  # N/m
SERVO_DAMPING = 2 * GRIPPER_MASS * SERVO_FREQUENCY  # N s/m
FORCE_NOISE = 0.005  # N, standard deviation


@dataclass(frozen=True)
class RopeObservation:
    """What a camera, the gripper's encoder and its force sensor show, in the world frame."""

    time: float  # s since reset at which this was measured
    markers: np.ndarray  # (markers, 3) m, from gripper to tip, with noise
    gripper_position: np.ndarray  # (3,) m
    gripper_velocity: np.ndarray  # (3,) m/s
    # (3,) N, on the gripper: what the rope pulls with, mean over the last control period, by a
    # sensor in the wrist, with noise; NaN where there is none.
    grip_force: np.ndarray


@dataclass(frozen=True)
class RopeTruth:
    """The hidden state of the rope, for experiments and tests alone.

    `energy` is that of the rope without the gripper: kinetic, gravitational and elastic, above
    the same rope hanging at rest under the gripper's present position; so lowering the gripper
    earns nothing.
    """

    time: float  # s since reset
    positions: np.ndarray  # (bodies + 1, 3) m, nodes from gripper to tip
    velocities: np.ndarray  # (bodies + 1, 3) m/s
    energy: float  # J
    gripper_position: np.ndarray  # (3,) m
    gripper_velocity: np.ndarray  # (3,) m/s
    configuration: RopeConfiguration


class RopeWorld(World):
    """A rope that hangs in a gripper; the action is the gripper's velocity.

    The commanded velocity (3,) in m/s is followed by a profile whose speed and acceleration
    stay within the configuration's limits (Euclidean norms); the profile's position is the
    target of a servo that lags 10 ms behind it. So the gripper's true motion is not quite the
    command, as with a real arm. With a `drive` the servo's force is what that makes of it.

    Raises `PalpateError` for an unknown start or a malformed action, and `DivergedError`.
    """

    def __init__(self, configuration: RopeConfiguration | None = None, drive: Drive | None = None):
        self.drive = drive
        self._configuration = configuration = configuration or RopeConfiguration()
        self._model = _compile(configuration)
        self._data = mujoco.MjData(self._model)
        self._first = self._model.body("B_first").id
        self._rope = slice(self._first, self._first + configuration.bodies)
        self._tip_site = self._model.site("S_last").id
        self._before, self._share = _marker_places(configuration)
        self._steps_per_period = round(configuration.control_period / configuration.time_step)
        self._delay = round(configuration.observation_delay / configuration.control_period)
        self._every = 1
        if configuration.observation_rate is not None:
            self._every = round(1 / (configuration.observation_rate * self.control_period))
        self._camera: OffscreenCamera | None = None
        self._history: list[RopeObservation] = []  # oldest first, as many as the delay holds back
        self._random = np.random.default_rng(0)  # reset brings its own

    @property
    def control_period(self) -> float:
        return self._configuration.control_period

    @property
    def speed_limit(self) -> float:
        """Greatest speed of the gripper in m/s."""
        return self._configuration.speed_limit

    @property
    def acceleration_limit(self) -> float:
        """Greatest acceleration of the gripper in m/s^2."""
        return self._configuration.acceleration_limit

    def reset(
        self, seed: int, start: str | np.ndarray = "hanging", azimuth: float | None = None
    ) -> RopeObservation:
        """Put the gripper at (0, 0, 1.5) m at rest and the rope into `start`.

        Args:
            seed: draws the azimuth and the observation noise.
            start: "hanging", or one of `START_POSES`: "straight", "half_circle", "helix" (see
                `starts`), all at rest; "shaken": released in motion, when a three-dimensional
                shaking of the gripper at 1.2 Hz from hanging has just stopped; or a polyline (n, 3)
                from gripper to tip, scaled to the rope's length and moved to the gripper, at rest.
            azimuth: angle in radians by which the start is turned about the vertical; drawn
                uniformly from the circle if None.
        """
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise PalpateError(f"a seed is a whole number, 0 or greater, not {seed!r}")
        self._history = []  # not to be stepped on if this start fails
        self._random = np.random.default_rng(seed)
        self._force_random = np.random.default_rng([seed, 1])  # so that it spoils no other draw
        drawn = self._random.uniform(0, 2 * np.pi)
        azimuth = drawn if azimuth is None else float(azimuth)
        if not math.isfinite(azimuth):
            raise PalpateError(f"an azimuth is a finite angle in radians, not {azimuth}")
        cosine, sine = math.cos(azimuth), math.sin(azimuth)
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        shaken = isinstance(start, str) and start == "shaken"
        tangents = start_tangents("hanging" if shaken else start, self._configuration.bodies)
        self._place(tangents @ turn.T)
        if shaken:
            self._shake(turn)
        self._data.time = 0.0
        self._step_count = 0
        if self.drive is not None:
            self.drive.begin()
        mujoco.mj_forward(self._model, self._data)
        self._pull = GRIPPER_MASS * self._data.qacc[:3] - self._given_force()
        self._history = [self._measure()] * (self._delay + 1)
        return self._history[0]

    def step(self, action: np.ndarray) -> RopeObservation:
        """Command the gripper velocity `action` (3,) in m/s for one control period."""
        if not self._history:
            raise PalpateError("a rope world is stepped after reset(seed), not before")
        command = np.asarray(action, float)
        if command.shape != (3,) or not np.isfinite(command).all():
            raise PalpateError(
                "a rope's action is a finite gripper velocity of shape (3,) in m/s, "
                f"not {command.tolist() if command.size < 10 else command.shape}"
            )
        self._advance(command)
        self._step_count += 1
        newest = self._measure() if self._step_count % self._every == 0 else self._history[-1]
        self._history = [*self._history[1:], newest]
        return self._history[0]

    def truth(self) -> RopeTruth:
        model, data, configuration = self._model, self._data, self._configuration
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        # cvel is the (angular, linear) velocity of the point of each body that coincides with
        # the centre of mass of the whole tree.
        angular, linear = data.cvel[self._rope, :3], data.cvel[self._rope, 3:]
        centre = data.subtree_com[model.body_rootid[self._first]]
        positions = self._nodes()
        carrier = [*range(configuration.bodies), configuration.bodies - 1]
        velocities = linear[carrier] + np.cross(angular[carrier], positions - centre)
        return RopeTruth(
            time=data.time,
            positions=positions,
            velocities=velocities,
            energy=self._energy(angular, linear, centre),
            gripper_position=np.array(GRIPPER_START) + data.qpos[:3],
            gripper_velocity=data.qvel[:3].copy(),
            configuration=configuration,
        )

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        if self._camera is None or (self._camera.width, self._camera.height) != (width, height):
            self._camera = OffscreenCamera(self._model, width, height)
        mujoco.mj_forward(self._model, self._data)
        view = mujoco.MjvCamera()
        view.lookat = np.array(GRIPPER_START) - [0, 0, 0.4 * self._configuration.length]
        view.distance = 2.6 * self._configuration.length
        view.azimuth, view.elevation = 90, -10
        return self._camera.picture(self._data, view)

    def _place(self, tangents: np.ndarray) -> None:
        """Set the rope at rest along unit `tangents` (bodies, 3) and the gripper to its start."""
        clamped = self._configuration.grip == "clamped"
        if clamped:
            tangents = np.concatenate([HANGING[None], tangents[1:]])
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[3:] = joint_rotations(tangents)[1 if clamped else 0 :].ravel()
        self._profile_velocity = np.zeros(3)

    def _shake(self, turn: np.ndarray) -> None:
        """Shake the gripper from hanging and bring it to rest where it was."""
        for command in shake_commands(self.control_period) @ turn.T:
            self._advance(command, disturbed=False)
        # What is left of the servo's lag: a fraction of a millimetre.
        self._data.qpos[:3] = self._data.qvel[:3] = self._data.ctrl[:] = 0
        self._profile_velocity = np.zeros(3)

    def _advance(self, command: np.ndarray, disturbed: bool = True) -> None:
        configuration, data = self._configuration, self._data
        command = _limit(command, configuration.speed_limit)
        greatest_change = configuration.acceleration_limit * configuration.time_step
        before, given = data.qvel[:3].copy(), np.zeros(3)
        for _ in range(self._steps_per_period):
            change = _limit(command - self._profile_velocity, greatest_change)
            self._profile_velocity = self._profile_velocity + change
            data.ctrl += self._profile_velocity * configuration.time_step
            if disturbed and configuration.disturbances:
                self._disturb()
            if disturbed and self.drive is not None:
                self._pass(self.drive)
            mujoco.mj_step(self._model, data)
            given += self._given_force()
        # What the servo has not given to the gripper's momentum, which keeps its own weight.
        gained = GRIPPER_MASS * (data.qvel[:3] - before) / self.control_period
        self._pull = gained - given / self._steps_per_period
        if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            raise DivergedError(
                f"the rope's simulation diverged at {data.time:.3f} s; a smaller time_step than "
                f"{configuration.time_step:g} s or a softer rope would work"
            )

    def _pass(self, drive: Drive) -> None:
        """Give what the drive makes of the servo's force, beside the servo."""
        data = self._data
        position, velocity = data.qpos[:3].copy(), data.qvel[:3].copy()
        servo = SERVO_STIFFNESS * (data.ctrl - position) - SERVO_DAMPING * velocity
        data.qfrc_applied[:3] = drive(servo, position, velocity) - servo

    def _given_force(self) -> np.ndarray:
        """What servo and drive have given to the gripper in the last time step, N."""
        return self._data.qfrc_actuator[:3] + self._data.qfrc_applied[:3]

    def _disturb(self) -> None:
        data, configuration = self._data, self._configuration
        data.xfrc_applied[:] = 0
        for push in configuration.disturbances:
            if push.time <= data.time + 0.5 * configuration.time_step < push.time + push.duration:
                node = round(push.node_fraction * configuration.bodies)
                body = self._first + min(node, configuration.bodies - 1)
                lever = self._nodes()[node] - data.xipos[body]
                data.xfrc_applied[body, :3] += push.force
                data.xfrc_applied[body, 3:] += np.cross(lever, push.force)

    def _measure(self) -> RopeObservation:
        configuration, data = self._configuration, self._data
        mujoco.mj_kinematics(self._model, data)
        nodes = self._nodes()
        after = nodes[np.minimum(self._before + 1, configuration.bodies)]
        markers = nodes[self._before] + self._share * (after - nodes[self._before])
        noise = configuration.observation_noise * self._random.standard_normal(markers.shape)
        return RopeObservation(
            time=self._step_count * configuration.control_period,
            markers=markers + noise,
            gripper_position=np.array(GRIPPER_START) + data.qpos[:3],
            gripper_velocity=data.qvel[:3].copy(),
            grip_force=self._pull + FORCE_NOISE * self._force_random.standard_normal(3),
        )

    def _nodes(self) -> np.ndarray:
        tip = self._data.site_xpos[self._tip_site]
        return np.concatenate([self._data.xpos[self._rope], tip[None]])

    def _energy(self, angular: np.ndarray, linear: np.ndarray, centre: np.ndarray) -> float:
        model, data, configuration = self._model, self._data, self._configuration
        rope, spacing = self._rope, configuration.length / configuration.bodies
        mass, centres = model.body_mass[rope], data.xipos[rope]

        velocity = linear + np.cross(angular, centres - centre)
        axes = data.ximat[rope].reshape(-1, 3, 3)
        spin = np.einsum("bij,bi->bj", axes, angular)
        kinetic = 0.5 * (mass @ (velocity**2).sum(-1) + (model.body_inertia[rope] * spin**2).sum())

        depth = np.arange(configuration.bodies) * spacing + model.body_ipos[rope, 0]
        gripper_height = GRIPPER_START[2] + data.qpos[2]
        potential = configuration.gravity * mass @ (centres[:, 2] - gripper_height + depth)

        # The plugin's moments at a joint are EI and GJ over the spacing times the rotation
        # vector of the joint, whose first component is the twist.
        quaternion = data.qpos[3:].reshape(-1, 4)[-(configuration.bodies - 1) :]
        twist_and_bends = (_rotation_vector(quaternion) ** 2).sum(0)
        stiffness = configuration.twisting_stiffness, *2 * (configuration.bending_stiffness,)
        elastic = 0.5 / spacing * twist_and_bends @ stiffness
        return float(kinetic + potential + elastic)


def _compile(configuration: RopeConfiguration) -> mujoco.MjModel:
    second_moment = math.pi * configuration.radius**4 / 4  # of the section's area
    slides = "".join(
        f'<joint name="{name}" type="slide" axis="{axis}"/>'
        for name, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
    )
    servos = "".join(
        f'<position joint="{name}" kp="{SERVO_STIFFNESS}" kv="{SERVO_DAMPING}"/>' for name in "xyz"
    )
    spec = mujoco.MjSpec.from_string(f"""
    <mujoco model="rope">
      <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
      <option timestep="{configuration.time_step}" integrator="Euler"
              gravity="0 0 {-configuration.gravity}"
              density="{configuration.air_density}" viscosity="{configuration.air_viscosity}">
        <flag contact="disable" autoreset="disable"/>
      </option>
      <asset>
        <texture name="sky" type="skybox" builtin="gradient" width="256" height="256"
                 rgb1="1 1 1" rgb2="0.8 0.85 0.9"/>
        <texture name="floor" type="2d" builtin="checker" width="256" height="256"
                 rgb1="0.85 0.85 0.85" rgb2="0.75 0.75 0.75"/>
        <material name="floor" texture="floor" texrepeat="10 10"/>
      </asset>
      <worldbody>
        <light pos="0 -2 4" dir="0 0.5 -1"/>
        <geom type="plane" size="5 5 0.1" material="floor"/>
        <body name="gripper" pos="{" ".join(map(str, GRIPPER_START))}" gravcomp="1">
          {slides}
          <geom type="sphere" size="0.02" mass="{GRIPPER_MASS}" rgba="0.3 0.3 0.35 1"/>
          <composite prefix="" type="cable" curve="s" count="{configuration.bodies + 1} 1 1"
                     size="{configuration.length}"
                     initial="{"ball" if configuration.grip == "pivot" else "none"}">
            <plugin plugin="mujoco.elasticity.cable">
              <config key="bend" value="{configuration.bending_stiffness / second_moment}"/>
              <config key="twist" value="{configuration.twisting_stiffness / (2 * second_moment)}"/>
            </plugin>
            <joint kind="main" damping="{configuration.joint_damping}"/>
            <geom type="capsule" size="{configuration.radius}" rgba="0.85 0.45 0.15 1"/>
          </composite>
        </body>
      </worldbody>
      <actuator>{servos}</actuator>
    </mujoco>""")
    body = spec.body("B_first")
    body.quat = DOWNWARDS  # the cable's own axis is x
    if configuration.grip_damping is not None:
        for joint in body.joints:
            joint.damping[0] = configuration.grip_damping
    for mass in configuration.body_masses():
        body.geoms[0].mass = mass
        body = body.bodies[0] if body.bodies else body
    if configuration.tip_mass:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(2 * configuration.radius, 0, 0),
            pos=(configuration.length / configuration.bodies, 0, 0), mass=configuration.tip_mass,
            rgba=(0.3, 0.3, 0.35, 1),
        )  # fmt: skip
    return spec.compile()


def _marker_places(configuration: RopeConfiguration) -> tuple[np.ndarray, np.ndarray]:
    """The node before each marker, (markers,), and how far it is to the next, (markers, 1)."""
    bodies, places = configuration.bodies, configuration.marker_places
    if places is None:
        place = np.arange(configuration.markers) * bodies / (configuration.markers - 1)
    else:
        place = np.array(places) * bodies
    place = np.where(abs(place - place.round()) < 1e-9, place.round(), place)
    before = np.floor(place).astype(int)
    return before, (place - before)[:, None]


def _limit(vector: np.ndarray, greatest: float) -> np.ndarray:
    norm = math.sqrt(vector @ vector)
    return vector if norm <= greatest else vector * (greatest / norm)


def _rotation_vector(quaternion: np.ndarray) -> np.ndarray:
    """(n, 4) unit quaternions to (n, 3) rotation vectors of at most pi radians."""
    quaternion = np.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(quaternion[:, 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternion[:, :1])
    return quaternion[:, 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
