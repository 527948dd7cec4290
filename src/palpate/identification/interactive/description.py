"""A twin as links and joints, to be written as URDF or MJCF.

Each part is a box around what was seen of it, which is closed and has a true volume. A joint's zero
is where the part was when it was found, its range is as far as it was seen to move.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.identification.interactive.twin import Twin
from palpate.models.articulated.description import (
    DescribedJoint,
    DescribedLink,
    Description,
    Geometry,
    Place,
)
from palpate.models.articulated.faults import usable

BODY = "body"
THINNEST = 0.01  # m
SHARE = 0.01  # of the points at each side of a box that may be outside: stray ones
ROOM = 0.01  # rad or m by which a range ends further out than anything was seen


def describe(twin: Twin, name: str) -> Description:
    """The twin's last look as a description without faults.

    Masses are those of its boxes, see `palpate check`. Raises `PalpateError` where no part was
    found.
    """
    if not twin.parts:
        raise PalpateError("no part was found that moves: expected at least one; try more pushes")
    look = len(twin.looks) - 1
    cloud, labels = twin.looks[look], twin.labels[look]
    still = cloud.points[labels < 0]
    links = [_link(BODY, still, np.zeros(3))]
    joints = []
    for number, part in enumerate(twin.parts):
        points = _points(twin, number)
        links.append(_link(f"part {number + 1}", points, part.screw.point))
        carrier = twin.parts[part.parent].screw.point if part.parent >= 0 else np.zeros(3)
        low, high = part.range
        joints.append(
            DescribedJoint(
                f"joint {number + 1}",
                part.screw.joint,
                BODY if part.parent < 0 else f"part {part.parent + 1}",
                f"part {number + 1}",
                place=Place(part.screw.point - carrier),
                axis=part.screw.axis,
                lower=low - ROOM,
                upper=high + ROOM,
            )
        )
    return usable(Description(name, tuple(links), tuple(joints), Path()))


def _points(twin: Twin, part: int) -> Float[np.ndarray, "n 3"]:
    """What was seen of a part in the look that shows most of it, as the part was described."""
    look = max(twin.parts[part].seen, key=lambda one: len(twin.parts[part].seen[one]))
    chosen = twin.parts[part].seen[look]
    return twin.pose(part, look).inverse.at(twin.looks[look].points[chosen])


def _link(name: str, points: np.ndarray, origin: np.ndarray) -> DescribedLink:
    """A box around points, along their principal directions; nothing around too few."""
    if len(points) < 4:
        return DescribedLink(name)
    middle = np.median(points, axis=0)
    axes = np.linalg.svd((points - middle)[:: max(1, len(points) // 2000)], full_matrices=False)[2]
    axes[2] = np.cross(axes[0], axes[1])
    along = (points - middle) @ axes.T
    low, high = np.quantile(along, (SHARE, 1.0 - SHARE), axis=0)
    size = np.maximum(high - low, THINNEST)
    place = Place(middle + 0.5 * (low + high) @ axes - origin, axes.T)
    box = Geometry("box", (float(size[0]), float(size[1]), float(size[2])), place)
    return DescribedLink(name, None, (box,), (box,))
