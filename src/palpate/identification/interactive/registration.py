"""Where a camera that moves has been, made exact: what it saw is laid onto what was seen before.

Iterated closest points with distances to the other's planes (Chen and Medioni 1992). Outliers are
weighed down by Tukey's biweight: what has moved between the looks counts for nothing.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from palpate.errors import PalpateError
from palpate.identification.interactive.screws import NOWHERE, Pose
from palpate.numerics.pinhole import DepthImage
from palpate.perception.clouds import Cloud, cloud_of

GIVEN = np.array([0.005, 0.005, 0.005, 0.01, 0.01, 0.01])  # rad and m: how well a pose is known
POINTS = 4000  # of a cloud that are laid onto another
ROUNDS, REACH = 30, 0.03  # m to what may be the same surface
AGREES = 0.95  # cosine between the normals of what may be the same surface
CUTOFF = 4.0  # standard deviations from which on a point counts for nothing
PATCH = 30.0  # neighbouring points have nearly the same error: so many count once
FEWEST = 100  # points that meet something
DONE = 1e-6  # rad or m of a round's change: less changes nothing


def exact_poses(images: Sequence[DepthImage], onto: Sequence[Cloud]) -> list[DepthImage]:
    """A look's images from where they must have been seen, by the looks in which more is met.

    An image that shows too little of what was seen before stays as it is.
    """
    found = []
    for image in images:
        try:
            own = cloud_of([image])
        except PalpateError:  # too little to be laid onto anything
            found.append(image)
            continue
        pose, _ = max((register(own, other) for other in onto), key=lambda one: one[1])
        pinhole = image.pinhole
        position = pose.at(np.asarray(pinhole.position)[None])[0]
        rotation = pose.rotation @ np.asarray(pinhole.world_from_camera)
        moved = dataclasses.replace(
            pinhole,
            position=tuple(position.tolist()),
            world_from_camera=tuple(map(tuple, rotation.tolist())),
        )
        found.append(dataclasses.replace(image, pinhole=moved))
    return found


def register(cloud: Cloud, onto: Cloud) -> tuple[Pose, int]:
    """How a cloud has to be moved to lie on another, and how many of its points meet it then.

    It begins with both as they are, and directions in which nothing holds it stay so. It is not
    moved where fewer than `FEWEST` points meet.
    """
    chosen = slice(None, None, max(1, len(cloud.points) // POINTS))
    points, normals = cloud.points[chosen], cloud.normals[chosen]
    deviation, middle = cloud.deviation[chosen], points.mean(axis=0)
    change, count = np.zeros(6), 0
    for _ in range(ROUNDS):
        pose = _pose(change, middle)
        there, facing = pose.at(points), pose.turned(normals)
        distance, index = onto.tree.query(there, distance_upper_bound=REACH)
        met = np.flatnonzero(np.isfinite(distance))
        planes = onto.normals[index[met]]
        alike = np.vecdot(planes, facing[met]) > AGREES
        met, planes = met[alike], planes[alike]
        count = len(met)
        if count < FEWEST:
            return NOWHERE, count
        missed = np.vecdot(there[met] - onto.points[index[met]], planes)
        noise = np.hypot(deviation[met], onto.deviation[index[met]])
        spread = max(1.0, 1.48 * float(np.median(np.abs(missed) / noise)))
        standard = missed / (noise * spread)
        weight = np.clip(1.0 - (standard / CUTOFF) ** 2, 0.0, None) ** 2
        weight /= PATCH * np.square(noise * spread)
        slopes = np.concatenate([np.cross(there[met] - middle, planes), planes], axis=1)
        matrix = (slopes * weight[:, None]).T @ slopes + np.diag(GIVEN**-2.0)
        step = np.linalg.solve(matrix, -slopes.T @ (weight * missed) - change / GIVEN**2)
        change = _join(step, change)
        if float(np.abs(step).max()) < DONE:
            break
    return _pose(change, middle), count


def _pose(change: Float[np.ndarray, "6"], middle: Float[np.ndarray, "3"]) -> Pose:
    """Of a rotation vector about a point, and a way."""
    rotation = Rotation.from_rotvec(change[:3]).as_matrix()
    return Pose(rotation, middle - rotation @ middle + change[3:])


def _join(step: Float[np.ndarray, "6"], change: Float[np.ndarray, "6"]) -> np.ndarray:
    """First the change, then the step, both about the same point of the world."""
    turn = Rotation.from_rotvec(step[:3])
    both = turn * Rotation.from_rotvec(change[:3])
    return np.concatenate([both.as_rotvec(), turn.apply(change[3:]) + step[3:]])
