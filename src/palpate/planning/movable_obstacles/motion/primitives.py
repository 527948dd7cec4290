"""What may be done with an object, by the kind of its constraint: the deck's table.

Scholz et al.'s manipulation primitives: linear velocities along the object's free directions and a
turn about one point, and where to hold it. Free: any direction, a turn about the centroid, held
anywhere. A free axis (fixed wheels): along it, a turn about a point beside the wheels' middle. A
fixed point (a locked caster, a hinge): a turn about it, held away from it. Static: none.

The deck holds a piece on wheels at faces across the axis alone; here it may be pulled along from
any face, as often only another one can be reached in a doorway.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from palpate.planning.movable_obstacles.motion.manipulation import Grasp, Primitive

Kind = Literal["free", "axis", "pivot", "static"]
LEVER = 0.2  # m between hand and fixed point: nearer, the hand's own torque would have to turn it
FACING = math.cos(math.radians(50))  # between a face's normal and the free axis
ASIDE = 0.5  # m beside the wheels of an axis
SEPARATION = 0.15  # m between points worth turning about


@dataclass(frozen=True)
class Constraint:
    """How one object can move: a draw of a belief, or the truth.

    `anchor` (x, y) in m and `direction` in rad are in the body frame: the fixed point; of an axis
    the middle of its wheels, and where they roll. `force` in N is what it takes to move it.
    """

    kind: Kind
    anchor: tuple[float, float] = (0.0, 0.0)
    direction: float = 0.0
    force: float = 0.0


@dataclass(frozen=True)
class Turn(Primitive):
    """A turn of object and robot together about `anchor` (x, y), m in the body frame."""

    anchor: tuple[float, float] = (0.0, 0.0)


def turning_points(constraint: Constraint) -> list[tuple[float, float]]:
    """Points (x, y), m, that an object so constrained can be turned about.

    What rolls along an axis turns about any point across it, beside the middle of its wheels.
    """
    x, y = constraint.anchor
    if constraint.kind == "static":
        return []
    if constraint.kind != "axis":
        return [(x, y)]
    across = -math.sin(constraint.direction), math.cos(constraint.direction)
    return [(x + aside * across[0], y + aside * across[1]) for aside in (0.0, ASIDE, -ASIDE)]


def anchors(constraints: Sequence[Constraint], most: int = 5) -> list[tuple[float, float]]:
    """Points that any of them can be turned about, m: the more often they come, the sooner.

    Points nearer than `SEPARATION` to one another are one, at their mean.
    """
    groups: list[list[tuple[float, float]]] = []
    for point in (point for one in constraints for point in turning_points(one)):
        near = (group for group in groups if math.dist(np.mean(group, axis=0), point) < SEPARATION)
        group = next(near, None)
        if group is None:
            groups.append([point])
        else:
            group.append(point)
    groups.sort(key=len, reverse=True)
    means = [np.mean(group, axis=0) for group in groups[:most]]
    return [(float(x), float(y)) for x, y in means]


def turns(constraints: Sequence[Constraint]) -> list[Turn]:
    """Both ways about each anchor."""
    return [
        Turn(f"turn {name} about {number}", turn=turn, anchor=anchor)
        for number, anchor in enumerate(anchors(constraints))
        for name, turn in (("left", 1.0), ("right", -1.0))
    ]


def grasp_share(constraint: Constraint, grasps: Sequence[Grasp]) -> np.ndarray:
    """The distribution (grasps,) of where to hold an object so constrained; 0 for a static one."""
    if constraint.kind == "static":
        return np.zeros(len(grasps))
    if constraint.kind == "pivot":
        levers = np.array([math.dist(grasp.point, constraint.anchor) for grasp in grasps])
        weights = (levers >= LEVER).astype(float)
    else:
        weights = np.ones(len(grasps))
    return weights / max(weights.sum(), 1.0)


def twist(constraint: Constraint, wanted: np.ndarray, lever: float, yielding: float) -> np.ndarray:
    """What becomes of a twist (vx, vy, rate) in the body frame that a hand wants, m and rad.

    Zero where the constraint holds it: where more than the share `yielding` of the hand's way,
    `lever` m per rad from the point turned about, would go against it.
    """
    if constraint.kind == "static":
        return np.zeros(3)
    if constraint.kind == "free":
        return wanted
    x, y = constraint.anchor
    at_anchor = np.array([wanted[0] - wanted[2] * y, wanted[1] + wanted[2] * x])
    hand = max(float(np.hypot(*wanted[:2])) if not wanted[2] else abs(wanted[2]) * lever, 1e-9)
    off = at_anchor
    if constraint.kind == "axis":
        along = np.array([math.cos(constraint.direction), math.sin(constraint.direction)])
        off = at_anchor - along * (along @ at_anchor)
    if np.hypot(*off) > yielding * hand:
        return np.zeros(3)
    return np.array([wanted[0] - off[0], wanted[1] - off[1], wanted[2]])
