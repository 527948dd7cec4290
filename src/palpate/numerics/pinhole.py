"""A calibrated pinhole camera: where points of the world appear in its picture, and back.

The camera's frame has x to the right, y down and z forward. With the focal lengths f and the
principal point c in pixels, a point (x, y, z) of that frame appears at

    u = c_u + f_u x / z,    v = c_v + f_v y / z

where the centre of the upper left pixel is (0, 0). Pictures have to be without lens distortion.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpate.errors import PalpateError


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics in pixels and the pose of a camera in the world.

    `position` (3,) is its centre in m; the columns of `world_from_camera` (3, 3), a rotation, are
    its right, down and forward directions. Raises `PalpateError` for what is no such camera.
    """

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    position: tuple[float, float, float]
    world_from_camera: tuple[tuple[float, float, float], ...]

    def __post_init__(self):
        if min(self.width, self.height) < 1 or not all(0 < f < math.inf for f in self.focal):
            raise PalpateError(
                "a camera has a picture of at least 1 x 1 pixel and finite focal lengths > 0, "
                f"not {self.width} x {self.height} and {self.focal}"
            )
        if len(self.centre) != 2 or not np.isfinite((*self.centre, *self.position)).all():
            raise PalpateError(
                "a camera's centre is 2 finite pixels and its position 3 finite metres, "
                f"not {self.centre} and {self.position}"
            )
        rotation = np.asarray(self.world_from_camera, float)
        if rotation.shape != (3, 3) or not (
            np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0
        ):
            raise PalpateError(
                "world_from_camera is a rotation matrix of shape (3, 3), "
                f"not {np.array2string(rotation, precision=3)}"
            )

    @classmethod
    def looking_at(
        cls,
        target: Sequence[float],
        position: Sequence[float],
        width: int,
        height: int,
        field_of_view: float,
    ) -> "Pinhole":
        """A camera at `position` (m) with `target` in the middle of an upright picture.

        `field_of_view` is the horizontal one in radians. Raises `PalpateError` when the camera
        would look straight up or down, where upright means nothing.
        """
        forward = np.subtract(target, position, dtype=float)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
            raise PalpateError(
                f"a camera at {position} that looks at {target} has no upright picture: "
                "move it aside"
            )
        forward /= np.linalg.norm(forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
        focal = 0.5 * width / math.tan(0.5 * field_of_view)
        middle = (width - 1) / 2, (height - 1) / 2
        x, y, z = map(float, position)
        rows = tuple(map(tuple, rotation.tolist()))
        return cls(width, height, (focal, focal), middle, (x, y, z), rows)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (..., 2), as (u, v), and depths (...) in m along the axis, of points (..., 3).

        Pixels of points at or behind the camera (depth <= 0) mean nothing.
        """
        local = (np.asarray(points, float) - self.position) @ np.asarray(self.world_from_camera)
        depth = local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = self.centre + local[..., :2] / depth[..., None] * self.focal
        return pixels, depth

    def back_project(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """The points (..., 3) in m that appear at `pixels` (..., 2) with `depth` (...) in m."""
        return self.position + self.directions(pixels) * np.asarray(depth)[..., None]

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """From the camera towards `pixels` (..., 2), in the world, with a depth of 1: (..., 3)."""
        local = (np.asarray(pixels, float) - self.centre) / self.focal
        local = np.concatenate([local, np.ones_like(local[..., :1])], axis=-1)
        return local @ np.asarray(self.world_from_camera).T


@dataclass(frozen=True)
class Frame:
    """One picture; raises `PalpateError` when colour and depth do not fit together.

    `time` (s) is the middle of the exposure, `colour` (height, width, 3) uint8, `depth` (height,
    width) in m along the optical axis, NaN where there was none; None from a colour camera.
    """

    time: float
    colour: np.ndarray
    depth: np.ndarray | None

    def __post_init__(self):
        if self.colour.ndim != 3 or self.colour.shape[2] != 3 or self.colour.dtype != np.uint8:
            raise PalpateError(
                "a frame's colour is uint8 of shape (height, width, 3), "
                f"not {self.colour.dtype} of shape {self.colour.shape}"
            )
        if self.depth is not None and self.depth.shape != self.colour.shape[:2]:
            raise PalpateError(
                f"a frame's depth has the shape of its colour, {self.colour.shape[:2]}, "
                f"not {self.depth.shape}"
            )


@dataclass(frozen=True)
class DepthImage:
    """What a depth camera saw at `time` (s): `depth` (height, width) m along the optical axis.

    NaN where it saw nothing. Raises `PalpateError` where the depth is not of the camera's size.
    """

    time: float
    pinhole: Pinhole
    depth: np.ndarray

    def __post_init__(self):
        if self.depth.shape != (self.pinhole.height, self.pinhole.width):
            raise PalpateError(
                f"a depth image has the shape of its camera, ({self.pinhole.height}, "
                f"{self.pinhole.width}), not {self.depth.shape}"
            )
