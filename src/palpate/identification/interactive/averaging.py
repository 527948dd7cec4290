"""One look made less noisy by others: what has moved together is one surface in all of them.

Steps that are no larger than the noise of a look, as around a flap on a door, show in the mean of
some looks.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int
from scipy.spatial import cKDTree

from palpate.identification.interactive.screws import Pose
from palpate.perception.clouds import Cloud

AROUND = 0.02  # m beside a point: whose heights over its surface are averaged
MOST = 32  # of them
ALIKE = 0.8  # cosine between the normals of one surface
FURTHEST = 3.0  # standard deviations: what is further off is of another surface


def average(
    looks: Sequence[Cloud],
    labels: Sequence[Int[np.ndarray, " _"]],
    look: int,
    motions: Mapping[int, Sequence[Pose]],
) -> Cloud:
    """The points of a look, each moved along its normal to the median height of those beside it.

    `labels` say which points of each look go together, and `motions` how what has a label has gone
    from each look to this one. The deviations of the points are less, as those of means.
    """
    cloud = looks[look]
    points, deviation = cloud.points.copy(), cloud.deviation.copy()
    beside = max(AROUND, 2.0 * cloud.error)
    reach = float(np.hypot(beside, FURTHEST * cloud.error))
    for label in np.unique(labels[look]):
        chosen = labels[look] == label
        own, normals = cloud.points[chosen], cloud.normals[chosen, None]
        others = _together(looks, [one == label for one in labels], motions[int(label)])
        distance, index = cKDTree(others[0]).query(own, MOST, distance_upper_bound=reach)
        near = np.isfinite(distance)
        away, turned, spread = (one[np.where(near, index, 0)] for one in others)
        away -= own[:, None]
        height = np.vecdot(away, normals)
        near &= np.vecdot(turned, normals) > ALIKE
        near &= np.vecdot(away, away) - height**2 < beside**2
        near &= np.abs(height) < FURTHEST * np.hypot(deviation[chosen, None], spread)
        middle = np.nanmedian(np.where(near, height, np.nan), axis=1)  # each is beside itself
        points[chosen] += middle[:, None] * normals[:, 0]
        deviation[chosen] /= np.sqrt(np.maximum(near.sum(axis=1), 1))
    return dataclasses.replace(cloud, points=points, deviation=deviation, tree=cKDTree(points))


def _together(
    looks: Sequence[Cloud], chosen: Sequence[np.ndarray], motions: Sequence[Pose]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and deviations of what goes together, all as in one look."""
    each = list(zip(looks, chosen, motions, strict=True))
    return (
        np.concatenate([pose.at(one.points[own]) for one, own, pose in each]),
        np.concatenate([pose.turned(one.normals[own]) for one, own, pose in each]),
        np.concatenate([one.deviation[own] for one, own, _ in each]),
    )
