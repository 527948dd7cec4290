"""An appliance before depth cameras, and a hand that presses on it or holds it at a point."""

import copy
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

from palpate.errors import PalpateError
from palpate.numerics.pinhole import DepthImage, Pinhole
from palpate.worlds.appliance.categories import draw_design
from palpate.worlds.appliance.design import MOST_FORCE, Design
from palpate.worlds.appliance.generated import generated_scene
from palpate.worlds.appliance.scene import MovingPart, Scene, labels_of
from palpate.worlds.depth import DepthSensor, depth_image
from palpate.worlds.world import DivergedError, OffscreenCamera, World

CONTROL_PERIOD = 0.02  # s
HOLD, PRESS = 1, 2  # what a hand does at a point
MISSES = 0.1  # share of the attempts at which a hand gets no hold
SLIP = math.radians(40.0)  # from the normal: a finger that presses more to the side slips off
REACH = 0.06  # m from where a point was seen: a hand goes on until it meets something
HAND_NOISE, FORCE_NOISE = 5e-4, 0.2  # m and N: of what the hand knows of itself
HAND_CREEP = 3e-3  # m that a hold has crept on its surface after `CREEP_TRAVEL`, as a random walk
CREEP_TRAVEL = 0.3  # m
HAND_OFFSET = 2e-3  # m, from the hand's frame to the cameras': the same for an episode
STILL = 0.5  # share of the parts that begin closed
SETTLING = 1.0  # s before the first observation
WIDTH, HEIGHT = 320, 240  # pixels
FIELD_OF_VIEW = math.radians(58.0)
LEVEL, HIGH = (0.15, 0.6), (0.7, 1.1)  # rad: from how high cameras look


class HandAction(NamedTuple):
    """What the hand does for a control period: nothing (0), `HOLD` or `PRESS`, and how.

    `point` (m) is where it begins, and counts only then; `force` (N) is in the world's axes.
    """

    does: int = 0
    point: Sequence[float] | Float[np.ndarray, "3"] = (0.0, 0.0, 0.0)
    force: Sequence[float] | Float[np.ndarray, "3"] = (0.0, 0.0, 0.0)


class HandObservation(NamedTuple):
    """What the hand knows: whether it has something, where it is, and what force it gave."""

    time: float  # s since reset
    holding: bool
    point: Float[np.ndarray, "3"]  # m, NaN where it has nothing
    force: Float[np.ndarray, "3"]  # N, over the last control period


class ApplianceTruth(NamedTuple):
    """The hidden state and constants, for experiments and tests alone; world axes throughout."""

    parts: tuple[MovingPart, ...]
    position: Float[np.ndarray, " parts"]  # rad or m
    velocity: Float[np.ndarray, " parts"]
    inertia: Float[np.ndarray, " parts"]  # kg m^2 or kg that each joint moves, all closed
    axis: Float[np.ndarray, "parts 3"]  # now
    anchor: Float[np.ndarray, "parts 3"]  # m, a point of each axis, now
    rotation: Float[np.ndarray, "parts 3 3"]  # world from the appliance's frame on each part, now
    origin: Float[np.ndarray, "parts 3"]  # m
    labels: list[Int[np.ndarray, "height width"]]  # of the last look: the part at each pixel,
    # -1 of what stands still and -2 of nothing


class ApplianceWorld(World):
    """An appliance of a category that is drawn by a seed, one of a design, or any scene.

    `step` takes a `HandAction` and gives a `HandObservation`; `look` takes a depth image from each
    of the cameras, one to four, which stand before it. Where it stands, how far its parts are open,
    its cameras and all noise are drawn by the seed of `reset`.

    Raises `PalpateError` for an action that is none and `DivergedError`.
    """

    def __init__(
        self,
        source: Design | Scene | str = "microwave",
        seed: int = 0,
        *,
        views: int | None = None,
        sensor: DepthSensor | None = None,
    ):
        self.source = draw_design(source, seed) if isinstance(source, str) else source
        self.scene = self._scene(0.0)
        self.sensor, self._views = sensor or DepthSensor(), views
        if views is not None and not 1 <= views <= 4:
            raise PalpateError(f"an appliance is seen by 1 to 4 cameras, not {views}")
        self._camera: OffscreenCamera | None = None
        self._ready = False

    @property
    def parts(self) -> tuple[MovingPart, ...]:
        """What moves; for experiments and tests alone, as `truth` is."""
        return self.scene.parts

    def _scene(self, yaw: float) -> Scene:
        if isinstance(self.source, Scene):
            return self.source
        return generated_scene(self.source, yaw)

    @property
    def control_period(self) -> float:
        return CONTROL_PERIOD

    def reset(self, seed: int, **options: Any) -> HandObservation:
        """Draw where it stands and how far it is open; `position` (parts,) sets that instead."""
        self._random = random = np.random.default_rng([seed, 0])
        self._sensor_random = np.random.default_rng([seed, 1])
        self.scene = self._scene(float(random.uniform(-0.6, 0.6)))
        self.model = self.scene.model
        self.data = mujoco.MjData(self.model)
        self._steps = max(1, round(CONTROL_PERIOD / self.model.opt.timestep))
        self._label_of = labels_of(self.model, self.scene.bodies)
        count = len(self.parts)
        open_share = random.uniform(size=count) * (random.uniform(size=count) > STILL)
        position = options.get("position")
        if position is None:
            position = self.scene.closed + open_share * self.scene.travel
        self.data.qpos[self.scene.addresses] = position
        self.cameras = self._draw_cameras(random)
        self._offset = HAND_OFFSET * random.standard_normal(3)
        self._held: tuple[int, np.ndarray, np.ndarray] | None = None  # body, point and normal on it
        self._tried = False
        self._last: np.ndarray | None = None  # where the hand was
        self._crept = np.zeros(3)
        self._labels: list[np.ndarray] = []
        self._ready = True
        for _ in range(round(SETTLING / self.model.opt.timestep)):
            self._advance(np.zeros(3))
        self.data.time = 0.0
        mujoco.mj_forward(self.model, self.data)
        return self._observation(np.zeros(3))

    def step(self, action: HandAction) -> HandObservation:
        if not self._ready:
            raise PalpateError("an appliance is reset before its first step")
        force = np.asarray(action.force, float)
        numbers = np.concatenate([force, np.asarray(action.point, float)])
        if (
            numbers.shape != (6,)
            or not np.isfinite(numbers).all()
            or action.does not in (0, HOLD, PRESS)
        ):
            raise PalpateError(f"a hand does 0, {HOLD} or {PRESS}, at 3 finite m with 3 finite N, "
                               f"not {action}")  # fmt: skip
        if (size := np.linalg.norm(force)) > MOST_FORCE:
            force = force * (MOST_FORCE / size)
        if not action.does:
            self._held, self._tried = None, False
        elif not self._tried:
            self._tried = True
            self._held = self._grasp(np.asarray(action.point, float), action.does)
            self._last, self._crept = None, np.zeros(3)
        given = np.zeros(3)
        for _ in range(self._steps):
            if self._held is not None and action.does == PRESS and self._slips(force):
                self._held = None
            applied = force if self._held is not None else np.zeros(3)
            self._advance(applied)
            given += applied
        return self._observation(given / self._steps)

    def look(self) -> list[DepthImage]:
        """A depth image from each camera."""
        taken = [
            depth_image(self.model, self.data, camera, self.sensor, self._sensor_random)
            for camera in self.cameras
        ]
        self._labels = [np.where(bodies < 0, -2, self._label_of[bodies]) for _, bodies in taken]
        return [image for image, _ in taken]

    def truth(self) -> ApplianceTruth:
        data, scene = copy.copy(self.data), self.scene  # so that who looks changes nothing
        mujoco.mj_kinematics(self.model, data)
        return ApplianceTruth(
            scene.parts,
            data.qpos[scene.addresses],
            data.qvel[scene.freedoms],
            self.model.dof_M0[scene.freedoms],
            data.xaxis[scene.joints],
            data.xanchor[scene.joints],
            data.xmat[scene.bodies].reshape(-1, 3, 3),
            data.xpos[scene.bodies],
            list(self._labels),
        )

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        if self._camera is None or (self._camera.width, self._camera.height) != (width, height):
            self._camera = OffscreenCamera(self.model, width, height)
        view = mujoco.MjvCamera()
        first = self.cameras[0]
        target = self.scene.middle
        away = np.subtract(first.position, target)
        view.lookat, view.distance = target, float(np.linalg.norm(away))
        view.azimuth = math.degrees(math.atan2(-away[1], -away[0]))
        view.elevation = -math.degrees(math.asin(away[2] / view.distance))
        return self._camera.picture(self.data, view)

    def _draw_cameras(self, random: np.random.Generator) -> list[Pinhole]:
        """Before the appliance and above its middle, as far as it takes to see it open."""
        count = self._views or int(random.integers(1, 5))
        middle, size, front = self.scene.middle, self.scene.size, self.scene.front
        spread = np.linspace(-0.9, 0.9, count + 2)[1:-1] if count > 1 else np.zeros(1)
        found = []
        for azimuth in front + spread + random.uniform(-0.35, 0.35, count):
            elevation = random.uniform(*(HIGH if self.scene.above else LEVEL))
            distance = 0.6 + 1.2 * size * random.uniform(0.95, 1.15)
            flat = math.cos(elevation) * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            away = distance * (flat + np.array([0.0, 0.0, math.sin(elevation)]))
            aim = middle + 0.15 * size * np.array([math.cos(front), math.sin(front), 0.0])
            found.append(
                Pinhole.looking_at(
                    aim.tolist(), (middle + away).tolist(), WIDTH, HEIGHT, FIELD_OF_VIEW
                )
            )
        return found

    def _grasp(self, point: np.ndarray, does: int) -> tuple[int, np.ndarray, np.ndarray] | None:
        """The body that the hand meets at a point, where on it, and its normal there; or none."""
        missed = does == HOLD and self._random.uniform() < MISSES
        mujoco.mj_kinematics(self.model, self.data)
        nearest, found = REACH, None
        for camera in self.cameras:  # a point that is seen is met from where it is seen
            ray = point - camera.position
            length = float(np.linalg.norm(ray))
            geom, normal = np.full(1, -1, np.int32), np.zeros(3)
            distance = mujoco.mj_ray(
                self.model, self.data, np.asarray(camera.position), ray / length, None, True, -1,
                geom, normal,
            )  # fmt: skip
            if geom[0] < 0 or abs(distance - length) > nearest:
                continue
            nearest = abs(distance - length)
            body = int(self.model.geom_bodyid[geom[0]])
            turn = self.data.xmat[body].reshape(3, 3)
            met = np.asarray(camera.position) + ray / length * distance
            found = body, turn.T @ (met - self.data.xpos[body]), turn.T @ normal
        return None if missed else found

    def _slips(self, force: np.ndarray) -> bool:
        """Whether a finger that presses with this force leaves the surface."""
        assert self._held is not None
        body, _, normal = self._held
        outward = self.data.xmat[body].reshape(3, 3) @ normal
        size = float(np.linalg.norm(force))
        return size > 0.0 and -float(outward @ force) < math.cos(SLIP) * size

    def _advance(self, force: np.ndarray) -> None:
        model, data = self.model, self.data
        pull = self.scene.latches.pull(data.qpos[self.scene.addresses])
        data.qfrc_applied[self.scene.freedoms] = pull
        data.xfrc_applied[:] = 0.0
        if self._held is not None:
            body, point, _ = self._held
            at = data.xpos[body] + data.xmat[body].reshape(3, 3) @ point
            data.xfrc_applied[body, :3] = force
            data.xfrc_applied[body, 3:] = np.cross(at - data.xipos[body], force)
        mujoco.mj_step(model, data)
        if not np.isfinite(data.qpos).all() or np.abs(data.qvel).max(initial=0.0) > 200.0:
            self._ready = False
            raise DivergedError(f"the simulation of a {self.scene.name} diverged")

    def _observation(self, force: np.ndarray) -> HandObservation:
        noise, creep = self._random.standard_normal(6), self._random.standard_normal(3)
        point = np.full(3, np.nan)
        if self._held is not None:
            body, place, _ = self._held
            mujoco.mj_kinematics(self.model, self.data)
            point = self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ place
            gone = float(np.linalg.norm(point - self._last)) if self._last is not None else 0.0
            self._crept = self._crept + HAND_CREEP * math.sqrt(gone / CREEP_TRAVEL) * creep
            self._last = point
            point = point + self._offset + self._crept + HAND_NOISE * noise[:3]
            force = force + FORCE_NOISE * noise[3:]
        return HandObservation(float(self.data.time), self._held is not None, point, force)
