"""A tree of links from a list of them, each described by itself."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from palpate.errors import PalpateError
from palpate.models.articulated.articulated import Articulated
from palpate.models.articulated.description import Place, Square, Triple
from palpate.parameters import as_floating

FREE = 1e6  # rad or m: where a joint without limits ends
ThreeNumbers = tuple[float, float, float] | Triple

LEAST = 1e-12  # kg m^2 or kg: what is less is no inertia
GRAVITY = (0.0, 0.0, -9.81)  # m/s^2


@dataclasses.dataclass(frozen=True)
class Link:
    """One link and the joint it hangs on; `parent` is its place in the list, -1 for the world.

    `origin` (m) and `rotation` place the joint's frame in the parent's, `axis` is in that frame.
    `inertia` (kg m^2) is about the centre of mass, in axes of the link's frame.
    """

    joint: Literal["fixed", "revolute", "prismatic"] = "revolute"
    parent: int = -1
    origin: ThreeNumbers = (0.0, 0.0, 0.0)
    rotation: Square = dataclasses.field(default_factory=lambda: np.eye(3))
    axis: ThreeNumbers = (0.0, 0.0, 1.0)
    mass: float = 1.0
    centre_of_mass: ThreeNumbers = (0.0, 0.0, 0.0)
    inertia: Square = dataclasses.field(default_factory=lambda: 1e-3 * np.eye(3))
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    lower: float = -FREE
    upper: float = FREE
    stop_stiffness: float = 1e3
    stop_damping: float = 10.0
    armature: float = 0.0

    @property
    def resisted(self) -> bool:
        """Whether it has dry friction or an end stop."""
        return self.friction > 0.0 or self.lower > -FREE or self.upper < FREE


FILLING = Link("fixed", mass=0.0, inertia=np.zeros((3, 3)))


def tree_of(
    links: Sequence[Link],
    *,
    size: int | None = None,
    gravity: ThreeNumbers = GRAVITY,
    **settings: Any,
) -> Articulated:
    """The model of these links, filled up to `size`; `settings` are fields of `Articulated`.

    Raises `PalpateError` for no link, more than `size`, a parent that does not come before, an axis
    without a direction, numbers that no rigid body has, and a joint that moves nothing inert.
    """
    size = len(links) if size is None else size
    if not 0 < len(links) <= size:
        raise PalpateError(f"expected between 1 and {size} links, got {len(links)}")
    for index, link in enumerate(links):
        _check(index, link)
    check_inert(links)
    filled = [*links, *[FILLING] * (size - len(links))]
    mass = np.array([link.mass for link in filled], float)
    unit = np.array([np.asarray(link.inertia, float) for link in filled])
    solid = mass > 0.0
    mass = np.where(solid, mass, 1.0)
    axes = np.array([link.axis for link in filled], float)
    length = np.linalg.norm(axes, axis=1, keepdims=True)
    columns = {
        name: np.array([getattr(link, name) for link in filled], float)
        for name in (
            *("centre_of_mass", "damping", "friction", "stiffness", "rest", "lower", "upper"),
            *("stop_stiffness", "stop_damping", "armature", "origin", "rotation"),
        )
    }
    fields: dict[str, Any] = {
        kind: np.array([link.joint == kind for link in filled], float)
        for kind in ("revolute", "prismatic")
    }
    fields |= columns | {"resisted": any(link.resisted for link in links)} | settings
    return Articulated(
        mass=as_floating(mass),
        gyration=as_floating(np.ones(size)),
        solid=as_floating(solid),
        shape_inertia=as_floating(unit / mass[:, None, None]),
        parent=jnp.array([link.parent for link in filled], jnp.int32),
        axis=as_floating(axes / np.where(length > 0.0, length, 1.0)),
        gravity=as_floating(np.asarray(gravity, float)),
        **fields,
    )


def free_links(body: Link, first: int = 0) -> list[Link]:
    """Six links for a body that nothing holds: slides along x, y and z, then turns about z, y, x.

    The body's mass is on the last, the others have none; `first` is the place of the first in the
    list that they are put into. Near a turn of 90 degrees about y the other two turns are about
    one axis, which this joint cannot tell apart.
    """
    bare = Link(mass=0.0, inertia=np.zeros((3, 3)))
    x, y, z = np.eye(3)
    kinds: list[tuple[Any, Any]] = [
        *(("prismatic", axis) for axis in (x, y, z)),
        *(("revolute", axis) for axis in (z, y, x)),
    ]
    chain = [
        dataclasses.replace(bare, joint=joint, axis=axis, parent=first + index - 1)
        for index, (joint, axis) in enumerate(kinds)
    ]
    held = {"origin": body.origin, "rotation": body.rotation, "parent": body.parent}
    own = {"mass": body.mass, "centre_of_mass": body.centre_of_mass, "inertia": body.inertia}
    return [
        dataclasses.replace(chain[0], **held), *chain[1:-1], dataclasses.replace(chain[-1], **own)
    ]  # fmt: skip


def _check(index: int, link: Link) -> None:
    what = f"link {index}"
    if not -1 <= link.parent < index:
        raise PalpateError(
            f"{what} hangs on {link.parent}: expected -1, the world, or a link before it"
        )
    numbers = np.concatenate(
        [np.ravel(np.asarray(getattr(link, field.name), float)) for field in _NUMBERS]
    )
    if not np.isfinite(numbers).all():
        raise PalpateError(f"{what} has numbers that are not finite: {link}")
    if link.joint != "fixed" and not np.linalg.norm(link.axis) > 1e-9:
        raise PalpateError(f"the axis of {what} has no direction: {tuple(link.axis)}")
    rotation = np.asarray(link.rotation, float)
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5) or np.linalg.det(rotation) < 0:
        raise PalpateError(f"the rotation of {what} is no rotation matrix: {rotation.tolist()}")
    for name in _POSITIVE:
        if getattr(link, name) < 0.0:
            raise PalpateError(f"the {name} of {what} is negative: {getattr(link, name)}")
    if link.lower > link.upper:
        raise PalpateError(f"{what} ends at {link.upper} before it begins at {link.lower}")
    check_inertia(what, link.mass, np.asarray(link.inertia, float))


def check_inert(links: Sequence[Link]) -> None:
    """Raise `PalpateError` for a joint along which nothing resists being accelerated.

    It would have no acceleration. As the tree is described, with all joints at zero.
    """
    places: list[Place] = []
    for link in links:
        above = places[link.parent] if link.parent >= 0 else Place()
        origin = np.asarray(link.origin, float)
        places.append(above @ Place(origin, np.asarray(link.rotation, float)))
    carried = [{index} for index in range(len(links))]
    for index in range(len(links) - 1, -1, -1):
        if links[index].parent >= 0:
            carried[links[index].parent] |= carried[index]
    for index, (link, place) in enumerate(zip(links, places, strict=True)):
        if link.joint == "fixed":
            continue
        axis = np.asarray(link.axis, float) / np.linalg.norm(link.axis)
        along, inert = place.rotation @ axis, link.armature
        for body, there in ((links[k], places[k]) for k in carried[index]):
            if link.joint == "prismatic":
                inert += body.mass
                continue
            centre = there.origin + there.rotation @ np.asarray(body.centre_of_mass, float)
            arm = np.cross(along, centre - place.origin)
            own = there.rotation.T @ along
            inert += body.mass * arm @ arm + own @ np.asarray(body.inertia, float) @ own
        if inert < LEAST:
            raise PalpateError(
                f"the joint of link {index} moves nothing with a mass or inertia about it: "
                "give the link, or one that it carries, a mass, or the joint an armature"
            )


def check_inertia(what: str, mass: float, inertia: Square) -> None:
    """Raise `PalpateError` for an inertia (kg m^2) that no body of this mass (kg) has.

    It has to be symmetric, and no principal moment larger than the sum of the other two.
    """
    size = float(np.abs(inertia).max(initial=0.0))
    if inertia.shape != (3, 3) or not np.allclose(inertia, inertia.T, atol=1e-6 * size):
        raise PalpateError(f"the inertia of {what} is not symmetric: {inertia.tolist()}")
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] < -1e-6 * size or moments[2] > (moments[0] + moments[1]) * (1.0 + 1e-4) + 1e-15:
        shown = ", ".join(f"{m:.3g}" for m in moments)
        raise PalpateError(
            f"the principal moments of {what}, {shown} kg m^2, are those of no rigid body: "
            "expected none below zero, and none above the sum of the other two"
        )
    if mass == 0.0 and not math.isclose(size, 0.0):
        raise PalpateError(f"{what} has an inertia and no mass")


_POSITIVE = (
    *("mass", "damping", "friction", "stiffness", "armature"),
    *("stop_stiffness", "stop_damping"),
)
_NUMBERS = [field for field in dataclasses.fields(Link) if field.name not in ("joint", "parent")]
