"""A depth camera of a MuJoCo scene by ray casting: no OpenGL, no window.

Each pixel is one ray. What is measured has noise that grows with depth, flies between the two sides
of an edge, and is missing where the surface is seen at a grazing angle.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

from palpate.numerics.pinhole import DepthImage, Pinhole
from palpate.worlds.camera import cast, depth_deviation


@dataclass(frozen=True)
class DepthSensor:
    """What stands between a scene and its depth image.

    The standard deviation at z metres is 1.2 mm + 1.9 mm (z - 0.4)^2 (a structured-light sensor:
    Nguyen, Izadi and Lovell 2012, 3DIMPVT, eq. 4), and more by `grazing` where a surface is seen
    from the side, as in the same paper; beyond `steepest` (rad from its normal) and `farthest`
    nothing is seen.
    """

    noise: float = 1.0  # times the formula above; 0: none
    steepest: float = 1.45  # rad
    farthest: float = 6.0  # m along the optical axis
    edge: float = 0.04  # m between neighbouring pixels: an edge
    flying: float = 0.5  # share of the pixels on an edge that show a depth in between
    lost: float = 0.2  # share of those that show nothing


def depth_image(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    pinhole: Pinhole,
    sensor: DepthSensor,
    random: np.random.Generator,
) -> tuple[DepthImage, Int[np.ndarray, "height width"]]:
    """What the sensor shows, and the body that each of its pixels is of (-1: none), for judges."""
    columns, rows = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    rays = pinhole.directions(np.stack([columns, rows], axis=-1)).reshape(-1, 3)
    origin = np.asarray(pinhole.position)
    geoms, depth, normals = cast(model, data, origin, rays, still=True)
    length = np.linalg.norm(rays, axis=1)
    cosine = np.abs(np.sum(normals * rays, axis=1)) / length
    shape = pinhole.height, pinhole.width
    seen = measure(depth.reshape(shape), cosine.reshape(shape), sensor, random)
    bodies = np.where(geoms >= 0, model.geom_bodyid[geoms], -1).reshape(shape)
    return DepthImage(float(data.time), pinhole, seen), bodies


def measure(
    depth: Float[np.ndarray, "height width"],
    cosine: Float[np.ndarray, "height width"],
    sensor: DepthSensor,
    random: np.random.Generator,
) -> Float[np.ndarray, "height width"]:
    """Depths (m, infinite where nothing is) as the sensor shows them, NaN where it shows none.

    `cosine` is that of the angle between the ray and the surface's normal.
    """
    depth = np.minimum(depth, 1e3)  # what is not there is far away
    near, far = _extremes(depth, np.minimum), _extremes(depth, np.maximum)
    edge = far - near > sensor.edge
    chance, share = random.uniform(size=depth.shape), random.uniform(size=depth.shape)
    flies = edge & (chance < sensor.flying) & (far < sensor.farthest)
    seen = np.where(flies, near + share * (far - near), depth)
    steep = np.clip(np.arccos(np.clip(cosine, 0.0, 1.0)), 0.0, sensor.steepest)
    deviation = depth_deviation(seen)
    # the same paper's lateral term: a steep surface is noisier, sharply so near the end
    deviation *= 1.0 + 0.1 * steep**2 / (0.5 * np.pi - np.minimum(steep, 1.5)) ** 2
    seen = seen + sensor.noise * deviation * random.standard_normal(depth.shape)
    gone = (cosine < np.cos(sensor.steepest)) | (edge & (chance > 1.0 - sensor.lost))
    return np.where((seen < sensor.farthest) & ~gone, seen, np.nan).astype(np.float32)


def _extremes(depth: np.ndarray, pick: np.ufunc) -> np.ndarray:
    """Over each pixel and its four neighbours."""
    found = depth.copy()
    for axis in (0, 1):
        whole, first, last = depth.shape[axis], [slice(None)] * 2, [slice(None)] * 2
        first[axis], last[axis] = slice(0, whole - 1), slice(1, whole)
        ahead, behind = tuple(first), tuple(last)
        found[ahead] = pick(found[ahead], depth[behind])
        found[behind] = pick(found[behind], depth[ahead])
    return found
