"""What is wrong with a description of links and joints, where it would fail, and the mend.

Each rule looks at one thing, notes the fault, and gives the thing back as it should be: what is
found and what is mended can never be two matters. A fault without a mend is one that only somebody
who knows the object can put right; nothing is made of such a description.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from palpate.errors import PalpateError
from palpate.models.articulated.description import (
    KINDS,
    MOVING,
    DescribedJoint,
    DescribedLink,
    Description,
    Geometry,
    Inertial,
    Place,
    Square,
)
from palpate.models.articulated.meshes import (
    MOST_FACES,
    READ_BY_MUJOCO,
    estimated_inertial,
    find_mesh,
    flat_box,
    read_mesh,
)

MUJOCO, PINOCCHIO, URDFDOM, PALPATE = "MuJoCo", "Pinocchio", "urdfdom", "palpate"
READERS = (URDFDOM, PINOCCHIO)  # Pinocchio reads through urdfdom
EVERYWHERE = (MUJOCO, *READERS, PALPATE)
EFFORT, VELOCITY = 100.0, 10.0  # N m or N, rad/s or m/s: of a joint that says none
TRAVEL = 1.0  # m, to both sides: of a slide that says no range
LIGHTEST = 1e-6  # kg: what is less is no mass
SMALL = Inertial(0.01, np.zeros(3), 1e-6 * np.eye(3))  # of a link without any shape
SLIMMEST = 1e-6  # of the largest second moment: what each has at least


class Fault(NamedTuple):
    """Where something is wrong and what, which readers fail on it, and what would mend it.

    Without a reader nothing fails, but it does not mean what it says.
    """

    where: str
    what: str
    fails: tuple[str, ...]
    mend: str

    def __str__(self) -> str:
        fails = f" (fails in {', '.join(self.fails)})" if self.fails else ""
        mend = f"mend: {self.mend}" if self.mend else "cannot be mended by itself"
        return f"{self.where}: {self.what}{fails}; {mend}"


Faults = list[Fault]


def mend(description: Description) -> tuple[Description, Faults]:
    """The description with all mended that can be, and every fault that was found."""
    faults: Faults = []
    faults += structure_faults(description)
    if any(not fault.mend for fault in faults):
        return description, faults
    joints = tuple(mend_joint(joint, description, faults) for joint in description.joints)
    joints = tuple(_with_own_names(joints, faults))
    links = tuple(mend_shapes(link, description, faults) for link in description.links)
    whole = dataclasses.replace(description, links=links, joints=joints)
    links = tuple(mend_inertia(link, whole, faults) for link in links)
    return _with_one_root(dataclasses.replace(whole, links=links), faults), faults


def usable(description: Description) -> Description:
    """The description, mended; raises `PalpateError` for the first fault without a mend."""
    whole, faults = mend(description)
    for fault in faults:
        if not fault.mend:
            raise PalpateError(str(fault))
    return whole


# --- the tree ---------------------------------------------------------------------------------


def structure_faults(description: Description) -> Faults:
    """What keeps links and joints from being a tree: nobody but its author can put it right."""
    faults: Faults = []
    names = [link.name for link in description.links]
    if not names:
        faults.append(Fault("the file", "it has no link", EVERYWHERE, ""))
    faults += [
        Fault(f"link '{name}'", f"{count} links have this name", EVERYWHERE, "")
        for name, count in Counter(names).items()
        if count > 1
    ]
    known = set(names)
    for joint in description.joints:
        where = f"joint '{joint.name}'"
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in known:
                faults.append(Fault(where, f"its {role} '{name}' is no link", EVERYWHERE, ""))
        if joint.kind not in KINDS:
            kinds = ", ".join(KINDS)
            what = f"its type is '{joint.kind}': expected one of {kinds}"
            faults.append(Fault(where, what, EVERYWHERE, ""))
        elif joint.kind == "planar":
            what = "palpate has no planar joints: two slides in a row do the same"
            faults.append(Fault(where, what, (PALPATE,), ""))
    children = Counter(joint.child for joint in description.joints)
    faults += [
        Fault(
            f"link '{name}'", f"{count} joints hold it: a closed chain is no tree", EVERYWHERE, ""
        )
        for name, count in children.items()
        if count > 1
    ]
    if not faults and (ring := _ring(description)):
        what = "it hangs on itself, by " + ", ".join(ring)
        faults.append(Fault(f"link '{ring[0]}'", what, EVERYWHERE, ""))
    return faults


def _ring(description: Description) -> list[str]:
    """Links that hang on one another in a ring; none in a tree."""
    above = {joint.child: joint.parent for joint in description.joints}
    rooted: set[str] = set()
    for start in list(above):
        path, name = [], start
        while name in above and name not in rooted and name not in path:
            path.append(name)
            name = above[name]
        if name in path:
            return path[path.index(name) :]
        rooted.update(path)
    return []


def _with_one_root(description: Description, faults: Faults) -> Description:
    roots = description.roots
    if len(roots) < 2:
        return description
    taken = {link.name for link in description.links}
    base = next(name for name in _numbers_of("base") if name not in taken)
    used = {joint.name for joint in description.joints}
    what = f"{len(roots)} links hang on none: {', '.join(roots[:4])}"
    faults.append(Fault("the file", what, (*READERS, MUJOCO), f"hung on a new link '{base}'"))
    added = []
    for root in roots:
        name = next(n for n in _numbers_of(f"{base}_to_{root}") if n not in used)
        used.add(name)
        added.append(DescribedJoint(name, "fixed", base, root))
    return dataclasses.replace(
        description,
        links=(DescribedLink(base), *description.links),
        joints=(*added, *description.joints),
    )


def _numbers_of(name: str) -> Iterable[str]:
    yield name
    yield from (f"{name}_{number}" for number in range(2, 1_000_000))


def _with_own_names(joints: Sequence[DescribedJoint], faults: Faults) -> Iterable[DescribedJoint]:
    used: set[str] = set()
    for index, joint in enumerate(joints):
        wanted = joint.name or f"joint_{index}"
        name = next(each for each in _numbers_of(wanted) if each not in used)
        used.add(name)
        if name != joint.name:
            what = "another joint has this name" if joint.name else "it has no name"
            faults.append(Fault(f"joint '{joint.name}'", what, EVERYWHERE[:3], f"called '{name}'"))
        yield dataclasses.replace(joint, name=name)


# --- joints -----------------------------------------------------------------------------------


def mend_joint(joint: DescribedJoint, of: Description, faults: Faults) -> DescribedJoint:
    """A joint with an axis, a range and limits that every reader takes."""
    where = f"joint '{joint.name}'"

    def note(what: str, fails: tuple[str, ...], mend: str, **changes: object) -> None:
        nonlocal joint
        faults.append(Fault(where, what, fails, mend))
        joint = dataclasses.replace(joint, **changes)  # type: ignore[arg-type]

    if joint.kind in MOVING:
        length = float(np.linalg.norm(joint.axis))
        if length < 1e-9:
            axis = np.array([1.0, 0.0, 0.0])
            note("its axis has no direction", EVERYWHERE, "along x, the default", axis=axis)
        elif not math.isclose(length, 1.0, rel_tol=1e-3):
            what = f"its axis is {length:.4g} long: expected a unit vector"
            note(what, (PINOCCHIO,), "made one long", axis=joint.axis / length)
    if joint.limited and joint.lower is None and joint.upper is None:
        if joint.kind == "revolute":
            note("it has no range", READERS, "turns freely", kind="continuous")
        else:
            said = f"from {-TRAVEL:g} to {TRAVEL:g} m"
            note("it has no range", (*READERS, MUJOCO), said, lower=-TRAVEL, upper=TRAVEL)
    if joint.limited:
        low, high = joint.lower or 0.0, joint.upper or 0.0
        if low > high:
            what = f"its range begins at {low:g} and ends at {high:g}"
            note(what, (MUJOCO, PALPATE), "exchanged", lower=high, upper=low)
        elif low == high:
            note(f"its range is empty, {low:g} to {high:g}", (MUJOCO,), "fixed there", kind="fixed",
                 place=_frame_at(joint, low), lower=None, upper=None)  # fmt: skip
        else:
            joint = dataclasses.replace(joint, lower=low, upper=high)
    if joint.kind in MOVING:
        for name, default in (("effort", EFFORT), ("velocity", VELOCITY)):
            value = getattr(joint, name)
            if value is None and joint.limited:
                note(f"it has no {name} limit", READERS, f"{default:g}", **{name: default})
            elif value is not None and value <= 0.0:
                what = f"its {name} limit is {value:g}: nothing could move it"
                note(what, (), f"{default:g}", **{name: default})
        for name in ("damping", "friction"):
            if getattr(joint, name) < 0.0:
                note(f"its {name} is negative", (MUJOCO, PALPATE), "left out", **{name: 0.0})
    names = {other.name for other in of.joints} - {joint.name}
    if joint.mimic and joint.mimic not in names:
        note(f"it mimics '{joint.mimic}', which is no other joint", READERS, "moves by itself",
             mimic="")  # fmt: skip
    return joint


def _frame_at(joint: DescribedJoint, position: float) -> Place:
    """The frame of a joint's child where the joint is at `position` (rad or m)."""
    axis = joint.axis / np.linalg.norm(joint.axis)
    if joint.kind == "prismatic":
        return joint.place @ Place(axis * position)
    x, y, z = axis
    turning = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + math.sin(position) * turning
    turn += (1.0 - math.cos(position)) * turning @ turning
    return joint.place @ Place(rotation=turn)


# --- links ------------------------------------------------------------------------------------


def mend_shapes(link: DescribedLink, of: Description, faults: Faults) -> DescribedLink:
    """A link with shapes that MuJoCo can make hulls of."""
    kept = {
        kind: tuple(
            sound
            for shape in getattr(link, kind)
            if (sound := _mend_shape(f"link '{link.name}'", shape, of, faults)) is not None
        )
        for kind in ("visuals", "collisions")
    }
    return dataclasses.replace(link, **kept)


def _mend_shape(where: str, shape: Geometry, of: Description, faults: Faults) -> Geometry | None:
    if not all(abs(value) > 0.0 for value in shape.size):
        faults.append(Fault(where, f"a {shape.kind} has no size", (MUJOCO,), "left out"))
        return None
    if shape.kind != "mesh":
        return dataclasses.replace(shape, size=tuple(abs(value) for value in shape.size))
    name = f"the mesh {shape.file}"
    path = find_mesh(shape.file, of.folder)
    if path is None:
        faults.append(Fault(where, f"{name} is not there", (MUJOCO, PINOCCHIO), "left out"))
        return None
    if "://" in shape.file:
        mend = "named by where it is"
        faults.append(Fault(where, f"{name} is named by its package", (MUJOCO, PINOCCHIO), mend))
    try:
        mesh = read_mesh(path)
    except PalpateError as error:
        faults.append(Fault(where, f"{name} is {error}", (MUJOCO, PINOCCHIO), "left out"))
        return None
    corners = np.asarray(mesh.vertices) * np.array(shape.size)
    if (box := flat_box(corners, shape.place)) is not None:
        what = f"{name} is flat, which has no convex hull"
        faults.append(Fault(where, what, (MUJOCO,), "a thin box as large"))
        return box
    if path.suffix.lower() not in READ_BY_MUJOCO:
        what = f"{name} is a {path.suffix} file: MuJoCo reads {' and '.join(READ_BY_MUJOCO)}"
        faults.append(Fault(where, what, (MUJOCO,), "written as STL"))
    if len(mesh.faces) > MOST_FACES:
        what = f"{name} has {len(mesh.faces)} faces, above {MOST_FACES}"
        faults.append(Fault(where, what, (MUJOCO,), "its convex hull"))
    return dataclasses.replace(shape, file=str(path))


def mend_inertia(link: DescribedLink, of: Description, faults: Faults) -> DescribedLink:
    """A link with a mass and an inertia that a rigid body can have, where it has to have them.

    That is where a joint moves it; one that is fixed to a link with a mass needs none.
    """
    where = f"link '{link.name}'"
    inertial = link.inertial
    shapes = link.collisions or link.visuals
    if inertial is None or inertial.mass < LIGHTEST:
        if not _has_to_weigh(link, of):
            return dataclasses.replace(link, inertial=None)
        came = "it has no mass" if inertial is None else f"its mass is {inertial.mass:g} kg"
        guess = estimated_inertial(shapes, of.folder) or SMALL
        source = "of its shapes' size" if guess is not SMALL else "as of a small thing"
        faults.append(Fault(where, came, (MUJOCO, PALPATE), f"{guess.mass:.3g} kg, {source}"))
        return dataclasses.replace(link, inertial=guess)
    size = float(np.abs(inertial.inertia).max())
    if size == 0.0:
        guess = estimated_inertial(shapes, of.folder, inertial.mass)
        inertia = inertial.mass * 1e-4 * np.eye(3) if guess is None else guess.inertia
        faults.append(Fault(where, "it has no inertia", (MUJOCO,), "as a box of its shapes' size"))
        return dataclasses.replace(link, inertial=dataclasses.replace(inertial, inertia=inertia))
    nearest = legal_inertia(inertial.inertia)
    if not np.allclose(nearest, inertial.inertia, atol=1e-3 * size):
        what = "no rigid body has its inertia"
        faults.append(Fault(where, what, (MUJOCO, PALPATE), "the nearest that one can have"))
    return dataclasses.replace(link, inertial=dataclasses.replace(inertial, inertia=nearest))


def _has_to_weigh(link: DescribedLink, of: Description) -> bool:
    """Whether a joint moves this link and nothing that is fixed to it has a mass."""
    joint = of.joint_of(link.name)
    if joint is None or joint.kind == "fixed":
        return False
    fixed, found = {link.name}, True
    while found:
        held = {
            joint.child for joint in of.joints if joint.kind == "fixed" and joint.parent in fixed
        }
        found = not held <= fixed
        fixed |= held
    masses = (each.inertial.mass for each in of.links if each.name in fixed and each.inertial)
    return not any(mass >= LIGHTEST for mass in masses)


def legal_inertia(inertia: Square) -> Square:
    """The nearest inertia (kg m^2) whose second moments of mass are all positive."""
    moments, axes = np.linalg.eigh(0.5 * (inertia + inertia.T))
    second = 0.5 * moments.sum() - moments
    second = np.maximum(second, SLIMMEST * max(float(second.max()), 1e-12))
    return axes @ np.diag(second.sum() - second) @ axes.T
