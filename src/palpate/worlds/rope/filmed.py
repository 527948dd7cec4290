"""The MuJoCo rope as a camera sees it: no markers, but pictures before a cluttered background."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from palpate.numerics.pinhole import Frame, Pinhole
from palpate.worlds.camera import Camera, Sensor
from palpate.worlds.rope.rope import RopeConfiguration, RopeTruth, RopeWorld
from palpate.worlds.world import World

# As a camera on a tripod: 2.5 m before the gripper, level with the middle of a 1 m rope, so that
# one pixel is 9 mm wide there and the rope 1.1 pixels.
TRIPOD = Pinhole.looking_at((0.0, 0.0, 1.15), (0.3, -2.5, 1.35), 320, 240, math.radians(60))
ROPE_COLOUR = (0.85, 0.45, 0.15)  # as RopeWorld paints it
CLUTTER = 24  # objects behind the rope, a quarter of them of its colour
HIDDEN = 0.2  # m, of the plane in which the rope hangs: a fifth of it, in its middle
BAR_AT = -1.2  # m, along y, where a bar hides that much

Background = Literal["plain", "clutter", "occluder"]


@dataclass(frozen=True)
class FilmedObservation:
    """What the gripper's encoder shows now, and the picture that has just arrived.

    `frame` is None between pictures; its own time is earlier than `time`.
    """

    time: float  # s since reset
    gripper_position: np.ndarray  # (3,) m
    gripper_velocity: np.ndarray  # (3,) m/s
    frame: Frame | None


class FilmedRope(World):
    """A rope world that is seen by one camera instead of by markers.

    The middle of the n-th exposure is n / rate after reset; a frame comes with the first control
    period that ends `latency` or more after its exposure. The first one is there at reset.

    `background` is "plain" (floor and wall), "clutter" (boxes, balls and posts on them, drawn by
    the seed of each reset, out of the rope's reach), or "occluder" (clutter, and a bar between
    camera and rope).
    """

    def __init__(
        self,
        configuration: RopeConfiguration | None = None,
        sensor: Sensor | None = None,
        pinhole: Pinhole = TRIPOD,
        background: Background = "clutter",
    ):
        self._world = RopeWorld(configuration)
        self._sensor = sensor or Sensor()
        self.pinhole = pinhole
        self._background: Background = background

    @property
    def control_period(self) -> float:
        return self._world.control_period

    def reset(self, seed: int, start: str = "hanging") -> FilmedObservation:
        """As `RopeWorld.reset`; `seed` draws the clutter and the camera's noise too."""
        observation = self._world.reset(seed, start=start)
        self._random = np.random.default_rng((seed, 2))
        scenery = _scenery(self._background, self._random)
        self._camera = Camera(self._world._model, self.pinhole, self._sensor, scenery)
        reach = self.control_period + 0.5 * self._sensor.exposure
        back = -np.arange(math.ceil(reach / self.control_period), -2, -1) * self.control_period
        # Before and after the start: as if it went on at its velocity.
        self._poses = deque(((time, self._move(time)) for time in back), maxlen=len(back))
        first = self._film(0.0)
        while self._poses[-1][0] > 0:
            self._poses.pop()
        self._taken, self._waiting = 1, deque[Frame]()
        return self._observe(observation, first)

    def step(self, action: np.ndarray) -> FilmedObservation:
        """See `RopeWorld.step`."""
        observation = self._world.step(action)
        now = observation.time
        self._poses.append((now, self._world._data.qpos.copy()))
        due = self._taken / self._sensor.rate
        if due + 0.5 * self._sensor.exposure <= now + 1e-9:
            self._waiting.append(self._film(due))
            self._taken += 1
        frame = None
        ready = now - 0.5 * self._sensor.exposure - self._sensor.latency + 1e-9
        if self._waiting and self._waiting[0].time <= ready:
            frame = self._waiting.popleft()
        return self._observe(observation, frame)

    def truth(self) -> RopeTruth:
        return self._world.truth()

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        return self._world.render(width, height)

    def _observe(self, observation, frame: Frame | None) -> FilmedObservation:
        seen = observation.time, observation.gripper_position, observation.gripper_velocity
        return FilmedObservation(*seen, frame)

    def _film(self, time: float) -> Frame:
        poses = [self._pose(time + instant) for instant in self._sensor.instants]
        return self._camera.expose(poses, time, self._random)

    def _move(self, time: float) -> np.ndarray:
        """The present pose, moved on at its velocity for `time` seconds."""
        data = self._world._data
        pose = data.qpos.copy()
        mujoco.mj_integratePos(self._world._model, pose, data.qvel, time)
        return pose

    def _pose(self, time: float) -> np.ndarray:
        """The pose at `time`, between the two kept ones around it."""
        model = self._world._model
        times = [kept for kept, _ in self._poses]
        after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
        (begin, first), (end, second) = self._poses[after - 1], self._poses[after]
        rate = np.empty(model.nv)
        mujoco.mj_differentiatePos(model, rate, end - begin, first, second)
        pose = first.copy()
        mujoco.mj_integratePos(model, pose, rate, time - begin)
        return pose


def _scenery(background: Background, random: np.random.Generator) -> mujoco.MjModel:
    geoms = ['<geom type="plane" size="5 5 0.1" pos="0 2.6 0" euler="90 0 0" rgba=".8 .8 .75 1"/>']
    if background != "plain":
        geoms += [_object(random, index % 4 == 0) for index in range(CLUTTER)]
    if background == "occluder":
        geoms.append(_bar())
    scene = f"<mujoco><worldbody>{''.join(geoms)}</worldbody></mujoco>"
    return mujoco.MjModel.from_xml_string(scene)


def _bar() -> str:
    """What hides the middle of a hanging rope from the camera `TRIPOD`."""
    eye, middle = np.array(TRIPOD.position), np.array([0.0, 0.0, 1.0])
    share = (BAR_AT - eye[1]) / (middle[1] - eye[1])
    x, y, z = eye + share * (middle - eye)
    size = f"1 0.01 {0.5 * HIDDEN * share}"
    return f'<geom type="box" size="{size}" pos="{x} {y} {z}" rgba=".4 .4 .5 1"/>'


def _object(random: np.random.Generator, like_rope: bool) -> str:
    """A box, ball or post, 1.2 m or more behind the gripper."""
    kind = random.choice(["box", "sphere", "capsule"])
    x, y, z = random.uniform((-2.2, 1.2, 0.1), (2.2, 2.4, 2.4))
    radius, half = random.uniform(0.02, 0.15), random.uniform(0.1, 0.5)
    size = {"box": f"{radius} 0.05 {half}", "sphere": f"{radius}", "capsule": f"{radius} {half}"}
    colour = np.asarray(ROPE_COLOUR) if like_rope else random.uniform(0.05, 0.95, 3)
    return (
        f'<geom type="{kind}" size="{size[str(kind)]}" pos="{x} {y} {z}" '
        f'euler="{random.uniform(0, 90)} {random.uniform(0, 90)} 0" '
        f'rgba="{" ".join(map(str, colour))} 1"/>'
    )
