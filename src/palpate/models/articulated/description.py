"""What a file says of links and joints, before anything is made of it: what is missing is None."""

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

Triple = Float[np.ndarray, "3"]
Square = Float[np.ndarray, "3 3"]

MOVING = ("revolute", "continuous", "prismatic")
KINDS = (*MOVING, "fixed", "floating", "planar")


@dataclasses.dataclass(frozen=True)
class Place:
    """A frame in another: its origin (m) and rotation."""

    origin: Triple = dataclasses.field(default_factory=lambda: np.zeros(3))
    rotation: Square = dataclasses.field(default_factory=lambda: np.eye(3))

    def __matmul__(self, other: "Place") -> "Place":
        """The frame `other` of this one."""
        origin = self.origin + self.rotation @ other.origin
        return Place(origin, self.rotation @ other.rotation)


@dataclasses.dataclass(frozen=True)
class Geometry:
    """One shape of a link, in its frame.

    `size` (m) is a box's three edges, a sphere's radius, a cylinder's radius and
    length, or a mesh's scale. `file` is what a mesh is called.
    """

    kind: Literal["box", "sphere", "cylinder", "mesh"]
    size: tuple[float, ...]
    place: Place = dataclasses.field(default_factory=Place)
    file: str = ""


@dataclasses.dataclass(frozen=True)
class Inertial:
    """Mass (kg), centre of mass (m), and inertia about it (kg m^2), in the link's axes."""

    mass: float
    centre: Triple
    inertia: Square


@dataclasses.dataclass(frozen=True)
class DescribedLink:
    """A link's name, inertia and shapes: those that are seen, and those that touch."""

    name: str
    inertial: Inertial | None = None
    visuals: tuple[Geometry, ...] = ()
    collisions: tuple[Geometry, ...] = ()


@dataclasses.dataclass(frozen=True)
class DescribedJoint:
    """A joint's name and kind, the links it joins, and its frame in the parent's.

    Ranges are in rad or m, `effort` in N m or N, `velocity` in rad/s or m/s, damping and friction
    in their SI units.
    """

    name: str
    kind: str
    parent: str
    child: str
    place: Place = dataclasses.field(default_factory=Place)
    axis: Triple = dataclasses.field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    lower: float | None = None
    upper: float | None = None
    effort: float | None = None
    velocity: float | None = None
    damping: float = 0.0
    friction: float = 0.0
    mimic: str = ""

    @property
    def limited(self) -> bool:
        """Whether a joint of this kind ends somewhere."""
        return self.kind in ("revolute", "prismatic")


@dataclasses.dataclass(frozen=True)
class Description:
    """A file's links and joints, in its order, and the folder that meshes are looked for from."""

    name: str
    links: tuple[DescribedLink, ...]
    joints: tuple[DescribedJoint, ...]
    folder: Path

    @property
    def roots(self) -> list[str]:
        """The links that hang on none."""
        children = {joint.child for joint in self.joints}
        return [link.name for link in self.links if link.name not in children]

    def joint_of(self, link: str) -> DescribedJoint | None:
        """The joint that a link hangs on, None of a root."""
        return next((joint for joint in self.joints if joint.child == link), None)
