"""A twin as links and joints, to be written as URDF or MJCF.

Each part is made of boxes (`boxes_of`). A joint's zero is where the part was when it was found, its
range is as far as it was seen to move.
"""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.identification.interactive.shape import boxes_of
from palpate.identification.interactive.tree import PartTree
from palpate.identification.interactive.twin import Twin
from palpate.models.articulated.description import (
    DescribedJoint,
    DescribedLink,
    Description,
    Place,
)
from palpate.models.articulated.faults import usable

BODY = "body"
ROOM = 0.01  # rad or m by which a range ends further out than anything was seen


def describe(twin: Twin, name: str) -> Description:
    """The twin as a description without faults.

    Masses are those of its boxes, see `palpate check`. Raises `PalpateError` where no part was
    found.
    """
    if not twin.parts:
        raise PalpateError("no part was found that moves: expected at least one; try more pushes")
    links = [_link(BODY, twin, -1, np.zeros(3))]
    joints = []
    for number, part in enumerate(twin.parts):
        links.append(_link(f"part {number + 1}", twin, number, part.screw.point))
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


def _link(name: str, tree: PartTree, part: int, origin: Float[np.ndarray, "3"]) -> DescribedLink:
    """A link of a part's room, whose frame is at a point of the frame it is described in."""
    shapes = tuple(
        dataclasses.replace(box, place=Place(box.place.origin - origin, box.place.rotation))
        for box in boxes_of(tree, part)
    )
    return DescribedLink(name, None, shapes, shapes)
