"""Doors, lids, drawers and sliding panels for a rectangle of a front, with handles.

Every range of numbers here was written down before anything was fitted to an appliance, and is not
moved to please a method. Friction, latches and springs are such that a hand with the force of
`design.MOST_FORCE` moves every part.
"""

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from palpate.worlds.appliance.design import (
    DENSITIES,
    EASY,
    GRAVITY,
    MOST_FORCE,
    Front,
    Part,
    Resistance,
    Shape,
    mass_of,
)

Random = np.random.Generator
Side = Literal["left", "right", "top", "bottom"]

GAP = 0.003  # m between a part and what is around it
HANDLE_REACH = (0.025, 0.05)  # m that a handle stands off


def uniform(random: Random, low: float, high: float) -> float:
    """A number between two."""
    return float(random.uniform(low, high))


def chance(random: Random, share: float) -> bool:
    """Whether something happens that does with this probability."""
    return bool(random.uniform() < share)


def handle(random: Random, front: Front, middle: tuple[float, float], along: int) -> list[Shape]:
    """A bar, a knob, a rail or nothing, on a panel whose face is at `out` = 0."""
    kind = random.choice(["bar", "knob", "rail", "none"], p=[0.5, 0.2, 0.15, 0.15])
    reach, radius = uniform(random, *HANDLE_REACH), uniform(random, 0.005, 0.011)
    room = front.height if along == 2 else front.width
    if kind == "none":
        return []
    left, up = middle
    if kind == "knob":
        radius = uniform(random, 0.012, 0.02)
        return [front.rod((0.5 * reach, left, up), 0, radius, reach)]
    length = min(uniform(random, 0.08, 0.35), 0.8 * room)
    if kind == "rail":
        half = 0.5 * length
        edges = (
            (left, up - half, left, up + half) if along == 2 else (left - half, up, left + half, up)
        )
        thick = 0.008
        low = (0.0, edges[0] - thick * (along == 2), edges[1] - thick * (along == 1))
        high = (0.6 * reach, edges[2] + thick * (along == 2), edges[3] + thick * (along == 1))
        return [front.box(low, high)]
    ends = [
        ((0.5 * reach, left, up + side * 0.45 * length) if along == 2
         else (0.5 * reach, left + side * 0.45 * length, up))
        for side in (-1, 1)
    ]  # fmt: skip
    return [
        front.rod((reach, left, up), along, radius, length),
        *(front.rod(end, 0, 0.8 * radius, reach) for end in ends),
    ]


def door(
    random: Random,
    front: Front,
    name: str,
    side: Side,
    material: str,
    *,
    parent: int = -1,
    thickness: float = 0.02,
    inset: bool = False,
    most: float = math.radians(130.0),
    with_handle: bool = True,
) -> Part:
    """A panel on hinges at one side, before the front or (`inset`) flush with it.

    The axis lies in the panel's middle or in one of its faces, up to a centimetre from its edge.
    """
    width, height = front.width, front.height
    low_out = -thickness if inset else GAP
    face = low_out + thickness
    panel = front.box((low_out, GAP, GAP), (face, width - GAP, height - GAP))
    upright = side in ("left", "right")
    away = uniform(random, 0.0, 0.01)
    out = low_out + thickness * float(random.choice([0.0, 0.5, 1.0]))
    length = width if upright else height
    if upright:
        left = width - away if side == "left" else away
        position, axis = front.at(out, left, 0.5 * height), front.rotation[:, 2]
        turn = 1.0 if side == "left" else -1.0  # so that a positive angle opens it outwards
        grip = 0.06 if side == "left" else width - 0.06, uniform(random, 0.3, 0.7) * height
    else:
        up = away if side == "bottom" else height - away
        position, axis = front.at(out, 0.5 * width, up), front.rotation[:, 1]
        turn = 1.0 if side == "bottom" else -1.0
        grip = 0.5 * width, height - 0.05 if side == "bottom" else 0.05
    shapes = [panel]
    if with_handle:
        raised = replace(front, origin=front.at(face, 0.0, 0.0))
        shapes += handle(random, raised, grip, 2 if upright else 1)
    reach = uniform(random, math.radians(70.0), most)
    resistance = Resistance(
        friction=uniform(random, 0.5, 3.0) * length, damping=uniform(random, 0.3, 2.0) * length**2
    )
    if chance(random, 0.35):
        latch, angle = uniform(random, 2.0, 8.0) * length, uniform(random, 0.03, 0.08)
        resistance = replace(resistance, latch=latch, reach=angle)
    if chance(random, 0.2):
        stiffness = uniform(random, 0.5, 2.0) * length
        resistance = replace(resistance, stiffness=stiffness, rest=uniform(random, -0.2, 0.3))
    share = math.hypot(axis[0], axis[1])  # of its weight that turns it
    weight = 0.5 * share * mass_of(shapes, DENSITIES[material]) * GRAVITY * length
    density, resistance = _hold_up(resistance, weight, length, DENSITIES[material])
    return Part(
        name, parent, "revolute", turn * axis, position, reach, tuple(shapes), density, resistance,
        lever=length,
    )  # fmt: skip


def drawer(
    random: Random, front: Front, name: str, depth: float, material: str, *, parent: int = -1
) -> Part:
    """A box without a lid behind a panel, which slides out of the front."""
    width, height = front.width, front.height
    thickness, wall = uniform(random, 0.015, 0.022), 0.01
    depth, tall = depth - 0.03, uniform(random, 0.5, 0.85) * height
    side = 0.012
    shapes = [
        front.box((GAP, GAP, GAP), (GAP + thickness, width - GAP, height - GAP)),
        front.box((-depth, side, side), (GAP, width - side, side + wall)),
        front.box((-depth, side, side), (-depth + wall, width - side, tall)),
        front.box((-depth, side, side), (GAP, side + wall, tall)),
        front.box((-depth, width - side - wall, side), (GAP, width - side, tall)),
    ]
    raised = replace(front, origin=front.at(GAP + thickness, 0.0, 0.0))
    place = (0.5 * width, uniform(random, 0.45, 0.85) * height)
    shapes += handle(random, raised, place, 1)
    resistance = Resistance(uniform(random, 1.0, 6.0), uniform(random, 1.0, 12.0))
    if chance(random, 0.35):
        latch, reach = uniform(random, 2.0, 7.0), uniform(random, 0.01, 0.03)
        resistance = replace(resistance, latch=latch, reach=reach)
    weight = abs(front.rotation[2, 0]) * mass_of(shapes, DENSITIES[material]) * GRAVITY
    density, resistance = _hold_up(resistance, weight, 1.0, DENSITIES[material])
    return Part(
        name, parent, "prismatic", front.rotation[:, 0], front.at(0.0, 0.5 * width, 0.5 * height),
        uniform(random, 0.55, 0.9) * depth, tuple(shapes), density, resistance,
    )  # fmt: skip


def sliding_panel(
    random: Random, front: Front, name: str, toward: float, material: str, *, parent: int = -1
) -> Part:
    """A panel before the front that slides along it, to the left (`toward` 1) or to the right."""
    thickness = uniform(random, 0.012, 0.025)
    width, height = front.width, front.height
    face = 2.0 * GAP + thickness
    raised = replace(front, origin=front.at(face, 0.0, 0.0))
    place = (0.06 if toward > 0 else width - 0.06, 0.5 * height)
    shapes = [
        front.box((2.0 * GAP, GAP, GAP), (face, width - GAP, height - GAP)),
        *handle(random, raised, place, 2),
    ]
    resistance = Resistance(uniform(random, 2.0, 8.0), uniform(random, 2.0, 15.0))
    return Part(
        name, parent, "prismatic", toward * front.rotation[:, 1],
        front.at(0.0, 0.5 * width, 0.5 * height), uniform(random, 0.6, 0.9) * width,
        tuple(shapes), DENSITIES[material], resistance,
    )  # fmt: skip


def hatch(random: Random, front: Front, face: float, name: str, parent: int, material: str) -> Part:
    """A flap on a panel of the front, whose face is at `face`: a part that another carries."""
    width = uniform(random, 0.35, 0.6) * front.width
    height = uniform(random, 0.25, 0.45) * front.height
    right = uniform(random, 0.15, 0.85) * (front.width - width)
    low = uniform(random, 0.15, 0.6) * (front.height - height)
    place = front.part(right, low, width, height)
    raised = replace(place, origin=place.at(face, 0.0, 0.0))
    side: Side = "top" if chance(random, 0.5) else str(random.choice(["left", "right"]))  # type: ignore[assignment]
    return door(random, raised, name, side, material, parent=parent, thickness=0.012)


def _hold_up(
    resistance: Resistance, weight: float, lever: float, density: float
) -> tuple[float, Resistance]:
    """A density, and resistance with the friction that keeps a part from falling.

    `weight` (N m or N) works against the hand at that density: a part that would be too heavy for
    it is hollow.
    """
    most = resistance.friction + resistance.latch + resistance.stiffness
    room = max(EASY * MOST_FORCE * lever - most, 1e-3)
    share = min(1.0, room / max(2.0 * weight, 1e-9))  # lifted, and its friction overcome
    friction = resistance.friction + share * weight
    return share * density, replace(resistance, friction=friction)
