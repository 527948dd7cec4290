"""The six categories, from which appliances are drawn: sizes, fronts, and what fills them.

Sizes are those of ordinary appliances. All of it was written down before the first fit and is not
moved to please a method.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable

import numpy as np

from palpate.family import check_name
from palpate.worlds.appliance.design import GRAVITY, Design, Front, Part, Shape, mass_of
from palpate.worlds.appliance.fittings import (
    Random,
    Side,
    chance,
    door,
    drawer,
    hatch,
    sliding_panel,
    uniform,
)

MOST_PARTS = 6
NESTED = 0.25  # share of appliances with a part on a part, where there is room for one
TILTED = 0.2  # share of those that can be tilted


def draw_design(category: str, seed: int) -> Design:
    """An appliance of a category; the same seed gives the same one.

    Raises `PalpateError` for a category that there is not.
    """
    check_name("category", category, CATEGORIES)
    number = list(CATEGORIES).index(category)
    return CATEGORIES[category](np.random.default_rng([seed, number]))


def box(random: Random) -> Design:
    """A chest or a carton: one lid, two, a lid that slides, one that folds, or one in a slope."""
    width, depth = uniform(random, 0.3, 0.7), uniform(random, 0.25, 0.5)
    height, wall = uniform(random, 0.15, 0.4), uniform(random, 0.008, 0.015)
    material = str(random.choice(["wood", "board", "plastic"]))
    slope = math.radians(uniform(random, 10.0, 30.0)) if chance(random, TILTED) else 0.0
    low = max(height - depth * math.tan(slope), 0.4 * height)  # of the front
    slope = math.atan2(height - low, depth)
    body = _open_box(width, depth, low, height, wall)
    # the top as a front: out of it is up, and up along it is to the back
    turn = _about_y(slope - 0.5 * math.pi)
    top = Front(np.array([0.0, -0.5 * width, low]), turn, width, depth / math.cos(slope))
    kind = random.choice(["lid", "two", "slide", "fold"], p=[0.45, 0.25, 0.15, 0.15])
    thickness = uniform(random, 0.008, 0.018)
    parts: list[Part] = []
    if kind == "lid":
        side: Side = random.choice(["top", "left", "right"], p=[0.8, 0.1, 0.1])
        parts = [door(random, top, "lid", side, material, thickness=thickness)]
        parts += _nested_flaps(random, top, thickness, parts, material)
    elif kind == "two":
        half = top.width / 2
        sides: list[Side] = ["right", "left"]
        for index, side in enumerate(sides):
            flap = top.part(index * half, 0.0, half, top.height)
            parts.append(
                door(random, flap, f"flap {index + 1}", side, material, thickness=thickness)
            )
    elif kind == "slide":
        parts = [sliding_panel(random, top, "lid", float(random.choice([-1, 1])), material)]
    else:
        half = top.height / 2
        back = top.part(0.0, half, top.width, half)
        front = top.part(0.0, 0.0, top.width, half)
        parts = [
            door(random, back, "lid", "top", material, thickness=thickness, with_handle=False),
            door(random, front, "leaf", "top", material, thickness=thickness, parent=0),
        ]
    return Design("box", body, tuple(parts), float(random.choice([0.0, uniform(random, 0.3, 0.8)])))


def door_frame(random: Random) -> Design:
    """A door in a piece of wall: one leaf or two on hinges, or a leaf that slides."""
    width, height = uniform(random, 0.65, 1.0), uniform(random, 1.7, 2.1)
    post, thick = uniform(random, 0.06, 0.3), uniform(random, 0.08, 0.15)
    double = chance(random, 0.25)
    whole = width * (1.7 if double else 1.0)
    material = str(random.choice(["wood", "board"]))
    half = 0.5 * whole
    body = [
        _slab((-thick, -half - post, 0.0), (0.0, -half, height)),
        _slab((-thick, half, 0.0), (0.0, half + post, height)),
        _slab((-thick, -half - post, height), (0.0, half + post, height + 0.15)),
    ]
    front = Front(np.array([0.0, -half, 0.0]), np.eye(3), whole, height)
    parts: list[Part] = []
    thickness = uniform(random, 0.03, 0.045)
    if double:
        sides: list[Side] = ["right", "left"]
        for index, side in enumerate(sides):
            leaf = front.part(index * half, 0.0, half, height)
            name = f"leaf {index + 1}"
            parts.append(door(random, leaf, name, side, material, thickness=thickness, inset=True))
    elif chance(random, 0.25):
        toward = float(random.choice([-1, 1]))
        parts = [sliding_panel(random, front, "leaf", toward, material)]
    else:
        side = "left" if chance(random, 0.5) else "right"
        inset = chance(random, 0.7)
        leaf_door = door(random, front, "leaf", side, material, thickness=thickness, inset=inset)
        parts = [leaf_door]
        face = 0.0 if inset else thickness
        parts += _nested_flaps(random, front, face, parts, material)
    return Design("door", tuple(body), tuple(parts), 0.0)


def microwave(random: Random) -> Design:
    """A cavity with a door beside a panel of controls, perhaps over a drawer."""
    width, depth = uniform(random, 0.42, 0.6), uniform(random, 0.3, 0.45)
    height = uniform(random, 0.25, 0.36)
    below = uniform(random, 0.1, 0.16) if chance(random, 0.25) else 0.0
    wall, panel = 0.02, uniform(random, 0.09, 0.14)
    body = _shell(width, depth, height + below, wall)
    hinge: Side = "left" if chance(random, 0.2) else "right"  # most of them: panel on the right
    whole = Front(np.array([0.0, -0.5 * width, 0.0]), np.eye(3), width, height + below)
    at = 0.0 if hinge == "left" else width - panel
    body.append(whole.part(at, below, panel, height).box((-0.03, 0.0, 0.0), (0.0, panel, height)))
    for row in range(int(random.integers(0, 3))):
        knob = (0.008, at + 0.5 * panel, below + (0.25 + 0.3 * row) * height)
        body.append(whole.rod(knob, 0, 0.018, 0.016))
    opening = whole.part(panel if hinge == "left" else 0.0, below, width - panel, height)
    inset, thickness = chance(random, 0.3), uniform(random, 0.02, 0.035)
    if inset:
        opening = opening.part(wall, wall, opening.width - 2 * wall, height - 2 * wall)
    parts = [door(random, opening, "door", hinge, "plastic", thickness=thickness, inset=inset)]
    if below:
        parts.append(drawer(random, whole.part(0.0, 0.0, width, below), "drawer", depth, "sheet"))
    return Design("microwave", tuple(body), tuple(parts), uniform(random, 0.0, 0.9))


def oven(random: Random) -> Design:
    """A door that opens downwards below a panel of controls; perhaps two, perhaps a drawer."""
    width, depth = uniform(random, 0.5, 0.76), uniform(random, 0.5, 0.62)
    panel, second = uniform(random, 0.08, 0.14), chance(random, 0.3)
    low = uniform(random, 0.12, 0.2) if chance(random, 0.5) else 0.0
    tall = uniform(random, 0.42, 0.55)
    upper = uniform(random, 0.28, 0.35) if second else 0.0
    height = low + tall + upper + panel
    body = _shell(width, depth, height, 0.025)
    whole = Front(np.array([0.0, -0.5 * width, 0.0]), np.eye(3), width, height)
    body.append(
        whole.part(0.0, height - panel, width, panel).box((-0.03, 0.0, 0.0), (0.02, width, panel))
    )
    for place in np.linspace(0.15, 0.85, int(random.integers(2, 6))):
        body.append(whole.rod((0.032, place * width, height - 0.5 * panel), 0, 0.02, 0.025))
    thickness = uniform(random, 0.03, 0.045)
    most = math.radians(95.0)
    front = whole.part(0.0, low, width, tall)
    parts = [door(random, front, "door", "bottom", "sheet", thickness=thickness, most=most)]
    if second:
        front = whole.part(0.0, low + tall, width, upper)
        parts.append(
            door(random, front, "upper door", "bottom", "sheet", thickness=thickness, most=most)
        )
    if low:
        parts.append(drawer(random, whole.part(0.0, 0.0, width, low), "drawer", depth, "sheet"))
    stands = uniform(random, 0.0, 0.8) if not low and not second else 0.0
    return Design("oven", tuple(body), tuple(parts), stands)


def refrigerator(random: Random) -> Design:
    """One door, two above or beside each other, drawers below; perhaps a flap in a door."""
    width, depth = uniform(random, 0.5, 0.9), uniform(random, 0.5, 0.65)
    height = uniform(random, 0.85, 1.9)
    body = _shell(width, depth, height, 0.05)
    whole = Front(np.array([0.0, -0.5 * width, 0.0]), np.eye(3), width, height)
    thickness = uniform(random, 0.04, 0.07)
    kind = random.choice(["one", "above", "beside", "drawers"], p=[0.25, 0.3, 0.25, 0.2])
    side: Side = "left" if chance(random, 0.5) else "right"
    parts: list[Part] = []
    front = whole  # of the last door

    def leaf(name: str, front: Front, hinge: Side) -> None:
        parts.append(door(random, front, name, hinge, "sheet", thickness=thickness))

    if kind == "one":
        leaf("door", whole, side)
    elif kind == "above":
        split = uniform(random, 0.55, 0.75) * height
        leaf("door", whole.part(0.0, 0.0, width, split), side)
        front = whole.part(0.0, split, width, height - split)
        leaf("freezer", front, side)
    elif kind == "beside":
        split = uniform(random, 0.4, 0.6) * width
        leaf("right door", whole.part(0.0, 0.0, split, height), "right")
        leaf("left door", whole.part(split, 0.0, width - split, height), "left")
    else:
        count = int(random.integers(1, 3))
        tall = uniform(random, 0.22, 0.3)
        leaf("door", whole.part(0.0, count * tall, width, height - count * tall), side)
        for index in range(count):
            front = whole.part(0.0, index * tall, width, tall)
            parts.append(drawer(random, front, f"drawer {index + 1}", depth - 0.08, "sheet"))
    if kind in ("one", "above"):
        parts += _nested_flaps(random, front, 0.003 + thickness, parts, "plastic")
    return Design("refrigerator", tuple(body), tuple(parts), 0.0)


def storage_furniture(random: Random) -> Design:
    """A cabinet: columns and rows of doors, drawers and open shelves, perhaps with a front that
    leans back."""
    width, depth = uniform(random, 0.4, 1.2), uniform(random, 0.3, 0.6)
    height = uniform(random, 0.4, 1.4)
    columns = 1 if width < 0.6 else int(random.integers(1, 4))
    rows = int(random.integers(1, min(int(height / 0.2), 4) + 1))
    lean = math.radians(uniform(random, 5.0, 20.0)) if chance(random, TILTED) else 0.0
    body = _shell(width, depth, height, 0.018)
    material = str(random.choice(["wood", "board"]))
    # a front that leans stands before the box, its lower edge further out
    out = height * math.tan(lean)
    corner, slope = np.array([out, -0.5 * width, 0.0]), height / math.cos(lean)
    whole = Front(corner, _about_y(-lean), width, slope)
    if lean:
        body += _wedges(width, height, out)
    rails = 0.015
    parts: list[Part] = []
    merged = rows > 1 and chance(random, 0.4)  # rows of one column as one tall door
    for column in range(columns):
        wide = (width - rails) / columns
        tall = (slope - rails) / rows
        heights = [rows * tall] if merged and column == columns - 1 else [tall] * rows
        for row, high in enumerate(heights):
            cell = whole.part(rails + column * wide, rails + row * tall, wide - rails, high - rails)
            name = f"{column + 1}.{row + 1}"
            fill = random.choice(["drawer", "door", "flap", "open"], p=[0.4, 0.4, 0.1, 0.1])
            if len(parts) == MOST_PARTS or (fill == "open" and parts):
                continue
            if fill in ("drawer", "open") and cell.height < 0.45:
                parts.append(drawer(random, cell, f"drawer {name}", depth, material))
            elif fill == "flap" and cell.height < 0.6:
                side: Side = "top" if chance(random, 0.5) else "bottom"
                most = math.radians(100.0)
                parts.append(door(random, cell, f"flap {name}", side, material, most=most))
            else:
                hinge: Side = "left" if chance(random, 0.5) else "right"
                inset = chance(random, 0.3)
                parts.append(door(random, cell, f"door {name}", hinge, material, inset=inset))
                if not inset and len(parts) < MOST_PARTS and min(cell.width, cell.height) > 0.3:
                    parts += _nested_flaps(random, cell, 0.023, parts, material)
    for column in range(columns + 1):
        at = column * (width - rails) / columns
        body.append(
            whole.part(at, 0.0, rails, whole.height).box(
                (-0.018, 0.0, 0.0), (0.0, rails, whole.height)
            )
        )
    for row in range(rows + 1):
        at = row * (slope - rails) / rows
        if 0 < row < rows and merged and columns == 1:
            continue
        wide = width if not merged or row in (0, rows) else width * (columns - 1) / columns
        body.append(whole.part(0.0, at, wide, rails).box((-0.018, 0.0, 0.0), (0.0, wide, rails)))
    stands = uniform(random, 0.5, 1.2) if height < 0.7 and chance(random, 0.3) else 0.0
    return Design("storage furniture", tuple(body), tuple(parts), stands)


CATEGORIES: dict[str, Callable[[Random], Design]] = {
    "box": box,
    "door": door_frame,
    "microwave": microwave,
    "oven": oven,
    "refrigerator": refrigerator,
    "storage furniture": storage_furniture,
}


def _nested_flaps(
    random: Random, front: Front, face: float, parts: list[Part], material: str
) -> list[Part]:
    """A flap on the last of the parts, or none. That part has to carry it, too."""
    if not chance(random, NESTED) or min(front.width, front.height) < 0.28:
        return []
    carrier = parts[-1]
    flap = hatch(random, front, face, f"flap of {carrier.name}", len(parts) - 1, material)
    weight = math.hypot(*carrier.axis[:2]) * GRAVITY * mass_of(flap.shapes, flap.density)
    resists = carrier.resistance
    more = dataclasses.replace(resists, friction=resists.friction + 0.5 * weight * carrier.lever)
    # what stands off the carrier where the flap is would go through it
    panel, *others = carrier.shapes
    kept = (panel, *(shape for shape in others if not _within(shape, flap.shapes[0])))
    parts[-1] = dataclasses.replace(carrier, resistance=more, shapes=kept)
    return [flap]


def _within(shape: Shape, panel: Shape) -> bool:
    """Whether a shape stands where a panel is, seen along the panel's least edge."""
    away = np.abs(panel.rotation.T @ (shape.centre - panel.centre))
    room = 0.5 * np.array(panel.size) + 0.5 * max(shape.size)
    flat = np.argsort(panel.size)[1:]
    return bool((away[flat] < room[flat]).all())


def _slab(low: tuple[float, float, float], high: tuple[float, float, float]) -> Shape:
    size = np.subtract(high, low)
    return Shape("box", (size[0], size[1], size[2]), 0.5 * np.add(low, high), np.eye(3))


def _shell(width: float, depth: float, height: float, wall: float) -> list[Shape]:
    """A box that is open at the front, x = 0."""
    half = 0.5 * width
    return [
        _slab((-depth, -half, 0.0), (-depth + wall, half, height)),
        _slab((-depth, -half, 0.0), (0.0, -half + wall, height)),
        _slab((-depth, half - wall, 0.0), (0.0, half, height)),
        _slab((-depth, -half, 0.0), (0.0, half, wall)),
        _slab((-depth, -half, height - wall), (0.0, half, height)),
    ]


def _open_box(
    width: float, depth: float, low: float, high: float, wall: float
) -> tuple[Shape, ...]:
    """A box that is open above, its front lower than its back; its sides in steps below a slope."""
    half = 0.5 * width
    shapes = [
        _slab((-depth, -half, 0.0), (-depth + wall, half, high)),
        _slab((-wall, -half, 0.0), (0.0, half, low)),
        _slab((-depth, -half, 0.0), (0.0, half, wall)),
    ]
    steps = 1 if high - low < 1e-6 else 8
    edges = np.linspace(0.0, -depth, steps + 1)
    for front, back in itertools.pairwise(edges):
        tall = low + (high - low) * -front / depth
        for side in (-half, half - wall):
            shapes.append(_slab((back, side, 0.0), (front, side + wall, tall)))
    return tuple(shapes)


def _wedges(width: float, height: float, out: float) -> list[Shape]:
    """Sides, in steps, between an upright box and a front that leans to its upper edge."""
    half, wall, steps = 0.5 * width, 0.018, 8
    edges = np.linspace(0.0, height, steps + 1)
    shapes = [_slab((0.0, -half, 0.0), (out, half, wall))]
    for low, high in itertools.pairwise(edges):
        reach = out * (1.0 - high / height)
        if reach > 1e-3:
            for side in (-half, half - wall):
                shapes.append(_slab((0.0, side, low), (reach, side + wall, high)))
    return shapes


def _about_y(angle: float) -> np.ndarray:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
