"""How surfaces stand in their scene: what tells a part that moves from a wall, without scale."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from palpate.perception.clouds import Cloud, extent_of
from palpate.perception.surfaces import (
    FLAT,
    NEIGHBOURS,
    OUTLINE,
    STANDS_OFF,
    STEP,
    Surface,
)

BEHIND, BEFORE = 0.08, 0.3  # m from a surface, at which it is asked whether space is free
TOLERANCE = 3.0  # standard deviations of depth
BESIDE = 3.0  # of the distance between points, or `OUTLINE`: what is so near is around a surface
TURNS = np.radians(np.arange(0.0, 90.0, 1.5))  # of a scene about the vertical
SHARP = 8  # power of cosines by which the surfaces that are along its axes decide how it is turned
LEAST = 1e-3  # m and m^2: of what has no size

# Shares are of a surface's points, or of places just beside its outline; lengths are over the
# scene's extent.
FEATURES = (
    "faces the cameras",  # cosine
    "free before it",
    "free behind it",
    "goes on beside it",
    "of the scene before it",
    "has a handle",
    "off the scene's axes",  # rad
    "area",  # of all surfaces'
    "size",  # logarithm of the area over the square of the extent
    "aspect",  # logarithm of long over short
    "faces up",  # cosine
    "height",  # over the middle
    "distance",  # from the middle
    "fills its rectangle",
    "out of the middle",  # along its normal
    "on a part",  # that is known
    "largest of its part",
    "of its part",  # share of the area of the largest
    "turned against its part",  # rad, from the largest
    "before its part",  # along the normal of the largest
    "stands off what is around it",  # from -1 to 1
)


def features_of(cloud: Cloud, every: Sequence[Surface]) -> Float[np.ndarray, "surfaces features"]:
    """The features of all surfaces of a scene."""
    if not every:
        return np.empty((0, len(FEATURES)))
    extent, middle = extent_of(cloud.points), np.median(cloud.points, axis=0)
    axes = _axes(every)
    areas = np.array([one.area for one in every])
    cameras = np.mean([image.pinhole.position for image in cloud.images], axis=0)
    parts = np.array([one.part for one in every])
    found = []
    for one in every:
        toward, away = cameras - one.centre, one.centre - middle
        size = np.maximum(one.high - one.low, LEAST)
        largest = every[int(np.argmax(np.where(parts == one.part, areas, 0.0)))]
        turned = math.acos(float(np.clip(one.normal @ largest.normal, -1.0, 1.0)))
        found.append([
            one.normal @ toward / np.linalg.norm(toward),
            *_surroundings(cloud, one),
            float(len(one.handles) > 0),
            math.acos(min(float(np.abs(axes @ one.normal).max()), 1.0)),
            one.area / areas.sum(),
            math.log(max(one.area, LEAST**2) / extent**2),
            math.log(size.max() / size.min()),
            one.normal[2],
            away[2] / extent,
            np.linalg.norm(away) / extent,
            one.area / np.prod(size),
            away @ one.normal / extent,
            float(one.part >= 0),
            float(one.part >= 0 and one is largest),
            one.area / largest.area if one.part >= 0 else 0.0,
            turned if one.part >= 0 else 0.0,
            (one.centre - largest.centre) @ largest.normal / extent if one.part >= 0 else 0.0,
            _step_around(cloud, one),
        ])  # fmt: skip
    return np.array(found)


def _surroundings(cloud: Cloud, surface: Surface) -> list[float]:
    """Whether space is free before and behind, it goes on beside, and how much lies before it."""
    points = cloud.points[surface.members][::2]
    _, behind = cloud.surfaces(points - BEHIND * surface.normal, TOLERANCE)
    _, before = cloud.surfaces(points + BEFORE * surface.normal, TOLERANCE)
    angle = np.linspace(0.0, 2.0 * math.pi, 24, endpoint=False)
    ways = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ surface.sides
    furthest = points[np.argmax(points @ ways.T, axis=0)]
    goes_on, _ = cloud.surfaces(furthest + OUTLINE * ways, TOLERANCE)
    ahead = (cloud.points - surface.centre) @ surface.normal > OUTLINE
    return [float(each.mean()) for each in (before, behind, goes_on, ahead)]


def _step_around(cloud: Cloud, surface: Surface) -> float:
    """How far a surface stands off what is beside it and faces as it does; 0 for flush, and where
    nothing is.

    Near 1 or -1 is what is further than a surface may be from its plane.
    """
    own = cloud.points[surface.members]
    reach = max(OUTLINE, BESIDE * math.sqrt(surface.area / len(own)))
    distance = cKDTree(own[::2]).query(cloud.points, distance_upper_bound=reach)[0]
    beside = np.isfinite(distance)
    beside[surface.members] = False
    height = (cloud.points[beside] - surface.centre) @ surface.normal
    height = height[cloud.normals[beside] @ surface.normal > FLAT]
    height = height[np.abs(height) < STANDS_OFF[1]]
    if len(height) < NEIGHBOURS:
        return 0.0
    return math.tanh(-float(np.median(height)) / (STEP + 2.0 * cloud.error))


def _axes(every: Sequence[Surface]) -> Float[np.ndarray, "3 3"]:
    """The vertical and the two level axes that most of the surfaces lie along."""
    normals, areas = np.array([one.normal for one in every]), np.array([one.area for one in every])
    cosine, sine, none = np.cos(TURNS), np.sin(TURNS), 0.0 * TURNS
    first, second = np.stack([cosine, sine, none], 1), np.stack([-sine, cosine, none], 1)
    along = np.maximum(np.abs(normals @ first.T), np.abs(normals @ second.T))
    best = int(np.argmax(areas @ np.maximum(along, np.abs(normals[:, 2:])) ** SHARP))
    return np.array([first[best], second[best], [0.0, 0.0, 1.0]])
