"""A colour and depth camera of a MuJoCo scene by ray casting: no OpenGL, no window.

Each sub-frame casts one ray through every pixel, at another place inside it and at another instant
of the exposure; their mean is the picture, so edges are soft and what moves is blurred. What does
not move is cast once; then only pixels near something that moves.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from palpate.errors import PalpateError
from palpate.numerics.pinhole import Frame, Pinhole

TO_LIGHT = np.array([-0.3, -0.7, 0.65]) / np.linalg.norm([-0.3, -0.7, 0.65])
AMBIENT = 0.45  # of the light on a surface that faces it
HORIZON = 12.0  # m: nothing further is seen
CHECKER = 0.25  # m, the side of the squares that still surfaces bear
SKY = np.array([0.78, 0.82, 0.86])


@dataclass(frozen=True)
class Sensor:
    """What stands between a scene and its picture.

    The depth's standard deviation at z metres is 1.2 mm + 1.9 mm (z - 0.4)^2 (a structured-light
    sensor: Nguyen, Izadi and Lovell 2012, 3DIMPVT, eq. 4; no less further in). A pixel on an edge
    shows the depth of one side or the other, at random, or, with `edge_loss`, none.
    """

    rate: float = 30.0  # Hz
    exposure: float = 8e-3  # s
    latency: float = 0.02  # s from the end of the exposure until the frame is there
    sub_frames: int = 8
    colour_noise: float = 4.0  # of 255, standard deviation
    depth_noise: float = 1.0  # times the formula above; 0: none
    edge_loss: float = 0.3  # probability
    has_depth: bool = True

    def __post_init__(self):
        if not (0 < self.rate < math.inf and 0 <= self.exposure < 1 / self.rate):
            raise PalpateError(
                "a sensor has a rate > 0 and an exposure within its period, "
                f"not {self.rate} Hz and {self.exposure} s"
            )
        if not 0 <= self.latency < math.inf or self.sub_frames < 1 or not 0 <= self.edge_loss <= 1:
            raise PalpateError(
                "a sensor has a latency >= 0, at least one sub-frame and an edge_loss of 0 to 1, "
                f"not {self.latency} s, {self.sub_frames} and {self.edge_loss}"
            )

    @property
    def instants(self) -> np.ndarray:
        """When each sub-frame is cast (sub_frames,), in s after the middle of the exposure."""
        return self.exposure * ((np.arange(self.sub_frames) + 0.5) / self.sub_frames - 0.5)


class Camera:
    """Pictures of a MuJoCo model before scenery that stands still and is no part of the physics."""

    def __init__(
        self,
        model: mujoco.MjModel,
        pinhole: Pinhole,
        sensor: Sensor,
        scenery: mujoco.MjModel | None = None,
    ):
        self.pinhole, self.sensor = pinhole, sensor
        self._model, self._data = model, mujoco.MjData(model)
        self._moving = np.flatnonzero(model.body_weldid[model.geom_bodyid])
        self._fixed = [_Still(model)] + ([] if scenery is None else [_Still(scenery)])
        columns, rows = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
        pixels = np.stack([columns, rows], axis=-1)
        places = _places(sensor.sub_frames)
        self._directions = [pinhole.directions(pixels + place) for place in places]
        self._background = [self._cast_background(rays) for rays in self._directions]

    def expose(
        self, poses: Sequence[np.ndarray], time: float, random: np.random.Generator
    ) -> Frame:
        """The picture with `poses`, the model's qpos at each of the sensor's instants."""
        colour = np.empty((len(poses), self.pinhole.height, self.pinhole.width, 3))
        depth = np.empty(colour.shape[:3])
        for index, pose in enumerate(poses):
            colour[index], depth[index] = self._sub_frame(index, pose)
        sensor = self.sensor
        picture = 255 * colour.mean(0)
        picture = picture + sensor.colour_noise * random.standard_normal(picture.shape)
        seen = self._measure(depth, random) if sensor.has_depth else None
        return Frame(time, np.clip(np.round(picture), 0, 255).astype(np.uint8), seen)

    def _measure(self, depth: np.ndarray, random: np.random.Generator) -> np.ndarray:
        chosen = random.integers(len(depth), size=depth.shape[1:])
        seen = np.take_along_axis(depth, chosen[None], axis=0)[0]
        noise = self.sensor.depth_noise * random.standard_normal(seen.shape)
        seen = seen + np.where(np.isfinite(seen), depth_deviation(seen) * noise, 0.0)
        edge = ~(depth.max(0) - depth.min(0) < 0.1)
        lost = edge & (random.uniform(size=seen.shape) < self.sensor.edge_loss)
        return np.where(np.isfinite(seen) & ~lost, seen, np.nan).astype(np.float32)

    def _sub_frame(self, index: int, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        colour, depth = (array.copy() for array in self._background[index])
        self._data.qpos[:] = pose
        mujoco.mj_kinematics(self._model, self._data)
        rows, columns = np.nonzero(self._near_what_moves())
        rays = self._directions[index][rows, columns]
        origin = self.pinhole.position
        geoms, distance, normals = cast(self._model, self._data, origin, rays, still=False)
        nearer = distance < depth[rows, columns]
        rows, columns, geoms = rows[nearer], columns[nearer], geoms[nearer]
        colour[rows, columns] = _lit(self._model.geom_rgba[geoms, :3], normals[nearer])
        depth[rows, columns] = distance[nearer]
        return colour, depth

    def _near_what_moves(self) -> np.ndarray:
        """Pixels (height, width) that a bounding sphere of something that moves may cover."""
        pixels, depth = self.pinhole.project(self._data.geom_xpos[self._moving])
        size = self._model.geom_rbound[self._moving] / np.maximum(depth, 1e-3)
        reach = 2.0 + 1.2 * np.outer(size, self.pinhole.focal)
        shape = self.pinhole.width, self.pinhole.height
        low = np.clip(np.floor(pixels - reach), 0, shape).astype(int)
        high = np.clip(np.ceil(pixels + reach) + 1, 0, shape).astype(int)
        mask = np.zeros((self.pinhole.height, self.pinhole.width), bool)
        for (left, top), (right, bottom) in zip(low, high, strict=True):
            mask[top:bottom, left:right] = True
        return mask

    def _cast_background(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flat = rays.reshape(-1, 3)
        colour = np.broadcast_to(SKY, flat.shape).copy()
        depth = np.full(len(flat), np.inf)
        for still in self._fixed:
            origin = self.pinhole.position
            geoms, distance, normals = cast(still.model, still.data, origin, flat, still=True)
            hit = (distance < depth) & still.fixed[geoms]
            points = origin + flat[hit] * distance[hit, None]
            squares = np.floor(points / CHECKER + 1e-3).sum(-1) % 2
            surface = still.model.geom_rgba[geoms[hit], :3] * (1 - 0.12 * squares[:, None])
            colour[hit], depth[hit] = _lit(surface, normals[hit]), distance[hit]
        return colour.reshape(rays.shape), depth.reshape(rays.shape[:2])


def depth_deviation(depth: np.ndarray) -> np.ndarray:
    """Standard deviation (m) of a depth (m), as `Sensor` says."""
    return 1.2e-3 + 1.9e-3 * np.maximum(depth - 0.4, 0.0) ** 2


class _Still:
    """A model as it stands before anything moves, and which of its geoms never do."""

    def __init__(self, model: mujoco.MjModel):
        self.model, self.data = model, mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.data)
        self.fixed = model.body_weldid[model.geom_bodyid] == 0
        # Hidden by what moves, nothing behind it would be seen: cast without it.
        for geom in np.flatnonzero(~self.fixed):
            self.data.geom_xpos[geom] = (0.0, 0.0, -1e3)


def cast(
    model: mujoco.MjModel, data: mujoco.MjData, origin, rays: np.ndarray, *, still: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `rays` (n, 3) of depth 1 meet first: geoms (n,), depths (n,) in m, normals (n, 3).

    A depth is infinite where nothing is met; `still`: whether what never moves is met.
    """
    count = len(rays)
    length = np.linalg.norm(rays, axis=-1)
    geoms = np.full(count, -1, np.int32)
    distance, normals = np.full(count, -1.0), np.zeros(3 * count)
    if count:
        mujoco.mj_multiRay(
            model, data, np.asarray(origin, float), (rays / length[:, None]).ravel(), None, still,
            -1, geoms, distance, normals, count, HORIZON,
        )  # fmt: skip
    return geoms, np.where(geoms >= 0, distance / length, np.inf), normals.reshape(-1, 3)


def _lit(colour: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Matt surfaces (n, 3) under one light (Lambert)."""
    return colour * (AMBIENT + (1 - AMBIENT) * np.clip(normals @ TO_LIGHT, 0, 1))[:, None]


def _places(count: int) -> np.ndarray:
    """Where in a pixel each sub-frame looks (count, 2), within half a pixel of its middle.

    The Halton sequence in bases 2 and 3 (Halton 1960, Numer. Math. 2:84-90), whose order goes back
    and forth, so that place does not follow time.
    """

    def inverse(index: int, base: int) -> float:
        share, digit = 0.0, 1.0 / base
        while index:
            index, rest = divmod(index, base)
            share, digit = share + rest * digit, digit / base
        return share

    places = np.array([[inverse(i + 1, 2), inverse(i + 1, 3)] for i in range(count)])
    return places - places.mean(0)
