"""Two plates on springs and a tip under impedance control, in MuJoCo.

What is not told: where the plates are, how they are turned, their springs, and how they yield and
rub. The force sensor sits at a wrist: it feels the tool beyond it resist every acceleration, is
tared badly, and its noise lasts (Ornstein-Uhlenbeck, as the maze's). The arm creeps before it
slides, plates come back more slowly than the tip leaves, and the controller holds its force for a
millisecond.
"""

import dataclasses
import math
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.worlds.world import DivergedError, OffscreenCamera, World

CONTROL_PERIOD = 1e-3  # s
# Of MuJoCo in it. Five, with contacts of 1 ms, made plates up to .6 % softer than their springs,
# and felt them .03 mm late: more than 20 s of touching leave open.
STEPS = 20
RADIUS = 0.01  # m, of the tip
NOMINAL = math.pi, -math.pi / 2  # rad, where the plates face: one behind larger x, one larger y
DISTANCE, SPREAD = 0.06, 0.01  # m from the start to where a plate meets the tip, and more or less
TURNED = 0.15  # rad, at most: nobody measured how they were mounted
STIFFNESS, FRICTION = (400.0, 4000.0), (0.15, 0.7)  # N/m; log-uniform both
MASS, DAMPING = (0.01, 0.03), (5.0, 40.0)  # kg and N s/m, of a plate
TIP_MASS, DAMPING_RATIO = (0.7, 1.6), (0.7, 1.0)
TOOL_MASS = 0.15, 0.5  # kg of it, beyond the force sensor
ARM_FRICTION, STICKS = 0.3, 1e-3  # N, dry, and the velocity (m/s) from which it is about all there
LOW_PASS = 3e-3  # s
FORCE_NOISE, POSITION_NOISE = 0.15, 1e-4  # N and m, standard deviations, white
BIAS, WANDERING, CORRELATION = 0.3, 0.3, 0.1  # N, N, and s in which it is forgotten
FASTEST = 20.0  # m/s, of a tip that is lost


@dataclasses.dataclass(frozen=True)
class Plates:
    """What is hidden, of both plates: `offset` along its outward normal, m, for the tip's middle.

    A plate is felt where normal . x = offset; `angle` (rad) is the normal's.
    """

    angle: Float[np.ndarray, "2"]
    offset: Float[np.ndarray, "2"]
    stiffness: Float[np.ndarray, "2"]
    damping: Float[np.ndarray, "2"]
    friction: Float[np.ndarray, "2"]
    mass: Float[np.ndarray, "2"]
    tip_mass: float
    tool_mass: float
    damping_ratio: float
    bias: Float[np.ndarray, "2"]


@dataclasses.dataclass(frozen=True)
class PlatesObservation:
    """At `time` (s): the tip's position (2,) in m and the force on it (2,) in N, as sensed."""

    time: float
    position: Float[np.ndarray, "2"]
    force: Float[np.ndarray, "2"]


@dataclasses.dataclass(frozen=True)
class PlatesTruth:
    """The hidden plates, and the tip's position (m), velocity (m/s) and contact force (N)."""

    plates: Plates
    position: Float[np.ndarray, "2"]
    velocity: Float[np.ndarray, "2"]
    force: Float[np.ndarray, "2"]


class PlatesWorld(World):
    """A capsule that a robot moves in a plane by Cartesian impedance, between two plates.

    An action (4,) is the set-point (x and y, m) and the stiffness along x and y (N/m), each held
    for one control period. The tip starts at the origin, at rest; the plates are drawn by the seed
    and stay the same in all of its episodes. Before each the force sensor is tared, badly.
    """

    def __init__(self) -> None:
        self._plates: Plates | None = None
        self._seed: int | None = None
        self._model: mujoco.MjModel | None = None
        self._data: mujoco.MjData | None = None
        self._camera: OffscreenCamera | None = None

    @property
    def control_period(self) -> float:
        return CONTROL_PERIOD

    def reset(self, seed: int, *, episode: int = 0) -> PlatesObservation:
        """Start an episode with the plates of `seed`; `episode` draws the noise."""
        if seed != self._seed:
            self._seed, self._plates = seed, plates_of(seed)
            self._model = mujoco.MjModel.from_xml_string(scene(self._plates))
            self._camera = None
        assert self._model is not None
        assert self._plates is not None
        self._random = np.random.default_rng([seed, 1, episode])
        self._wandered = WANDERING * self._random.normal(size=2)
        self._data = mujoco.MjData(self._model)
        self._sensed = np.zeros(2)
        self._count = 0
        return self._observe()

    def step(self, action: Any) -> PlatesObservation:
        model, data, plates = self._now()
        action = np.asarray(action, float)
        if action.shape != (4,) or not np.isfinite(action).all() or np.any(action[2:] < 0.0):
            raise PalpateError(
                "an action is four finite numbers, set-point x and y (m) and stiffness along them "
                f"(N/m, not negative), got {action}"
            )
        setpoint, stiffness = action[:2], action[2:]
        damping = 2.0 * plates.damping_ratio * np.sqrt(stiffness * plates.tip_mass)
        pull = stiffness * (setpoint - data.qpos[:2]) - damping * data.qvel[:2]
        for _ in range(STEPS):
            speed = np.linalg.norm(data.qvel[:2])
            dry = ARM_FRICTION * math.tanh(speed / STICKS) / max(speed, 1e-9)
            data.qfrc_applied[:2] = pull - dry * data.qvel[:2]
            mujoco.mj_step(model, data)
            share = model.opt.timestep / LOW_PASS
            felt = data.qfrc_constraint[:2] - plates.tool_mass * data.qacc[:2]
            self._sensed = (1.0 - share) * self._sensed + share * felt
        if not np.abs(data.qvel[:2]).max() < FASTEST:
            raise DivergedError("the tip is faster than 20 m/s: lower the stiffness or the way")
        self._count += 1
        kept = math.exp(-CONTROL_PERIOD / CORRELATION)
        kick = WANDERING * math.sqrt(1.0 - kept**2) * self._random.normal(size=2)
        self._wandered = kept * self._wandered + kick
        return self._observe()

    def truth(self) -> PlatesTruth:
        _, data, plates = self._now()
        force = data.qfrc_constraint[:2].copy()
        return PlatesTruth(plates, data.qpos[:2].copy(), data.qvel[:2].copy(), force)

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        model, data, _ = self._now()
        camera = self._camera
        if camera is None or (camera.width, camera.height) != (width, height):
            self._camera = camera = OffscreenCamera(model, width, height)
        view = mujoco.MjvCamera()
        view.lookat = [0.02, 0.02, 0.0]
        view.distance, view.azimuth, view.elevation = 0.5, 90, -60
        return camera.picture(data, view)

    def _observe(self) -> PlatesObservation:
        _, data, plates = self._now()
        force = self._sensed + plates.bias + self._wandered
        return PlatesObservation(
            self._count * CONTROL_PERIOD,
            data.qpos[:2] + POSITION_NOISE * self._random.normal(size=2),
            force + FORCE_NOISE * self._random.normal(size=2),
        )

    def _now(self) -> tuple[mujoco.MjModel, mujoco.MjData, Plates]:
        if self._model is None or self._data is None or self._plates is None:
            raise PalpateError("a world of plates runs after reset(seed), not before")
        return self._model, self._data, self._plates


def plates_of(seed: int) -> Plates:
    """The plates and the tip of a world of this seed."""
    random = np.random.default_rng([seed, 0])

    def between(bounds: tuple[float, float], size: int | None = 2) -> Any:
        low, high = np.log(bounds)
        return np.exp(random.uniform(low, high, size))

    angle = np.array(NOMINAL) + random.uniform(-TURNED, TURNED, 2)
    return Plates(
        angle=angle,
        # The plate turns about where its nominal normal through the origin meets it.
        offset=-(DISTANCE + random.uniform(-SPREAD, SPREAD, 2)) * np.cos(angle - NOMINAL),
        stiffness=between(STIFFNESS),
        damping=between(DAMPING),
        friction=between(FRICTION),
        mass=between(MASS),
        tip_mass=float(between(TIP_MASS, None)),
        tool_mass=float(between(TOOL_MASS, None)),
        damping_ratio=float(between(DAMPING_RATIO, None)),
        bias=random.normal(0.0, BIAS, 2),
    )


def scene(plates: Plates) -> str:
    """The MJCF: plates 40 cm wide that slide along their normals, and the tip."""
    bodies = []
    for number in range(2):
        normal = np.array([math.cos(plates.angle[number]), math.sin(plates.angle[number])])
        thick = 0.01
        x, y = normal * (plates.offset[number] - RADIUS - thick)
        bodies.append(
            f'<body pos="{x} {y} 0" euler="0 0 {plates.angle[number]}">'
            f'<joint type="slide" axis="1 0 0" stiffness="{plates.stiffness[number]}" '
            f'damping="{plates.damping[number]}"/>'
            f'<geom type="box" size="{thick} 0.2 0.04" mass="{plates.mass[number]}" '
            f'friction="{plates.friction[number]} 0 0" contype="1" conaffinity="2" '
            f'rgba="0.5 0.6 0.7 1"/></body>'
        )
    return f"""<mujoco><compiler angle="radian"/>
      <option timestep="{CONTROL_PERIOD / STEPS}" gravity="0 0 0" cone="elliptic" impratio="100"/>
      <default><geom condim="3" solref="0.0004 1" solimp="0.999 0.9999 1e-5"/></default>
      <worldbody><light pos="0 0 1"/>
      <body><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
      <geom type="capsule" size="{RADIUS} 0.03" mass="{plates.tip_mass}" friction="0 0 0"
        contype="2" conaffinity="1" rgba="0.8 0.4 0.2 1"/></body>{"".join(bodies)}
      </worldbody></mujoco>"""
