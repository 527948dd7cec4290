"""What an appliance is made of: parts of boxes and rods, joints, and what resists at them.

Everything is described in one frame, that of the appliance with all of its parts closed: x out of
its front, y to its left, z up, lengths in m.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

Triple = Float[np.ndarray, "3"]
Square = Float[np.ndarray, "3 3"]

MOST_FORCE = 40.0  # N that the hand has; every part moves under `EASY` of it, at the right place
EASY = 0.7
GRAVITY = 9.81  # m/s^2

# kg/m^3; what is made of sheets of metal has the density of its walls with their filling
DENSITIES = {"wood": 620.0, "board": 700.0, "sheet": 900.0, "plastic": 950.0, "glass": 1600.0}


@dataclasses.dataclass(frozen=True)
class Shape:
    """A box (`size`: its edges) or a rod (`size`: radius, radius, length along z) in its place."""

    kind: Literal["box", "rod"]
    size: tuple[float, float, float]
    centre: Triple
    rotation: Square


@dataclasses.dataclass(frozen=True)
class Resistance:
    """What a joint does against being moved, in N m or N and the units that follow from it.

    A latch pulls a part shut with `latch` at rest and with 1/e of it when open by `reach`. A
    spring drives it to `rest`.
    """

    friction: float
    damping: float
    latch: float = 0.0
    reach: float = 1.0
    stiffness: float = 0.0
    rest: float = 0.0


@dataclasses.dataclass(frozen=True)
class Part:
    """A part that moves on its parent, a part before it (-1: on what stands still), from 0 on."""

    name: str
    parent: int
    joint: Literal["revolute", "prismatic"]
    axis: Triple
    position: Triple  # a point of the axis
    range: float  # rad or m
    shapes: tuple[Shape, ...]
    density: float  # kg/m^3
    resistance: Resistance
    lever: float = 1.0  # m, of a force at its edge about the axis; 1 of a slide


@dataclasses.dataclass(frozen=True)
class Design:
    """An appliance of a category: what stands still, and what moves."""

    category: str
    body: tuple[Shape, ...]
    parts: tuple[Part, ...]
    height: float  # m over the floor at which it stands

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """The least and the greatest corner of a box around what stands still, m."""
        corners = np.concatenate([corners_of(shape) for shape in self.body])
        return np.array([corners.min(0), corners.max(0)])


@dataclasses.dataclass(frozen=True)
class Front:
    """A rectangle of a front that one part may fill, by its lower corner on the appliance's right.

    The columns of `rotation` are out of the front, to the appliance's left, and upwards along it.
    """

    origin: Triple
    rotation: Square
    width: float
    height: float

    def at(self, out: float, left: float, up: float) -> Triple:
        """A point of the appliance's frame from one of the front's, m."""
        return self.origin + self.rotation @ np.array([out, left, up])

    def box(self, low: tuple[float, float, float], high: tuple[float, float, float]) -> Shape:
        """The box between two corners in the front's axes."""
        size = np.subtract(high, low)
        middle = self.at(*(0.5 * np.add(low, high)))
        return Shape("box", (size[0], size[1], size[2]), middle, self.rotation)

    def rod(self, middle: tuple[float, float, float], along: int, radius: float, length: float):
        """A rod along one of the front's axes."""
        turn = np.roll(np.eye(3), along - 2, axis=0)  # its own z onto that axis, a rotation
        size = (radius, radius, length)
        return Shape("rod", size, self.at(*middle), self.rotation @ turn)

    def part(self, right: float, low: float, width: float, height: float) -> "Front":
        """A rectangle of this one, by its lower corner on the right and its size, m."""
        return dataclasses.replace(
            self, origin=self.at(0.0, right, low), width=width, height=height
        )


def corners_of(shape: Shape) -> Float[np.ndarray, "8 3"]:
    """The corners of a box, or of one around a rod."""
    half = 0.5 * np.array(shape.size)
    if shape.kind == "rod":
        half[:2] *= 2.0
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return shape.centre + (signs * half) @ shape.rotation.T


def mass_of(shapes: Sequence[Shape], density: float) -> float:
    """kg, of shapes of one density, kg/m^3."""
    round_ones = {"box": 1.0, "rod": math.pi}
    return density * sum(math.prod(shape.size) * round_ones[shape.kind] for shape in shapes)
