"""URDF: from a file to what it says, and back.

The format as urdfdom reads it (wiki.ros.org/urdf/XML). XML of others is parsed without entities,
document types or other files.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, SubElement, indent, tostring

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from palpate.errors import PalpateError
from palpate.models.articulated.description import (
    DescribedJoint,
    DescribedLink,
    Description,
    Geometry,
    Inertial,
    Place,
    Square,
    Triple,
)
from palpate.runs.storage import write_text

LARGEST = 50_000_000  # bytes
ENTRIES = ("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz")
Note = Callable[[str, str], None]  # where, and what is wrong


def read_urdf(path: str | Path, note: Note | None = None) -> Description:
    """What a file says. Numbers that are none are told to `note` and taken as missing.

    Raises `PalpateError` for what cannot be read or is no URDF, and without `note` for such a
    number.
    """
    path = Path(path)
    root = read_xml(path)
    if root.tag != "robot":
        raise PalpateError(f"{path} holds <{root.tag}>: expected URDF, which begins with <robot>")

    def refuse(where: str, what: str) -> None:
        raise PalpateError(f"{path}: {where}: {what}")

    reader = _Reader(note or refuse)
    return Description(
        name=root.get("name") or path.stem,
        links=tuple(reader.link(each) for each in root.findall("link")),
        joints=tuple(reader.joint(each) for each in root.findall("joint")),
        folder=path.parent,
    )


def read_xml(path: Path) -> Element:
    """The root of a file; raises `PalpateError` if it is no XML or too large for a description."""
    try:
        if path.stat().st_size > LARGEST:
            size = f"larger than {LARGEST / 1e6:g} MB"
            raise PalpateError(f"{path} is {size}: expected a description without its meshes")
        return fromstring(path.read_bytes(), forbid_dtd=True)
    except OSError as error:
        raise PalpateError(f"cannot read {path}: {error.strerror or error}") from error
    except (ParseError, DefusedXmlException, ValueError, LookupError) as error:
        if isinstance(error, PalpateError):
            raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise PalpateError(f"{path} is not plain XML: expected a description ({reason})") from error


class _Reader:
    """Reads elements, and notes what is wrong with a number."""

    def __init__(self, note: Note) -> None:
        self.note = note

    def numbers(self, node: Element | None, name: str, count: int, where: str) -> Any:
        """`count` finite numbers of an attribute; None where it is missing or they are none."""
        text = None if node is None else node.get(name)
        if text is None:
            return None
        try:
            values = [float(part) for part in text.split()]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            expected = "a number" if count == 1 else f"{count} numbers"
            self.note(where, f'{name}="{text[:40]}": expected {expected}')
            return None
        return values[0] if count == 1 else np.array(values)

    def place(self, node: Element | None, where: str) -> Place:
        """The frame of an <origin>, that of the parent where there is none."""
        origin = self.numbers(node, "xyz", 3, where)
        turn = self.numbers(node, "rpy", 3, where)
        return Place(
            np.zeros(3) if origin is None else origin,
            np.eye(3) if turn is None else rotation_of(turn),
        )

    def link(self, node: Element) -> DescribedLink:
        """A <link>."""
        name = node.get("name") or ""
        where = f"link '{name}'"
        return DescribedLink(
            name,
            self.inertial(node.find("inertial"), where),
            tuple(self.geometries(node, "visual", where)),
            tuple(self.geometries(node, "collision", where)),
        )

    def inertial(self, node: Element | None, where: str) -> Inertial | None:
        """An <inertial>, turned into the link's axes; None where there is none."""
        if node is None:
            return None
        mass = self.numbers(node.find("mass"), "value", 1, where)
        entries = node.find("inertia")
        values = [
            [self.numbers(entries, entry, 1, where) or 0.0 for entry in row] for row in ENTRIES
        ]
        place = self.place(node.find("origin"), where)
        inertia = place.rotation @ np.array(values) @ place.rotation.T
        return Inertial(mass or 0.0, place.origin, inertia)

    def geometries(self, node: Element, kind: str, where: str) -> list[Geometry]:
        """The shapes of a link's <visual> or <collision>s; those of no known form are noted."""
        found = []
        for each in node.findall(kind):
            place = self.place(each.find("origin"), where)
            shape = next(iter(each.find("geometry") or ()), None)
            read = None if shape is None else self.geometry(shape, place, where)
            if read is None:
                form = "nothing" if shape is None else f"<{shape.tag}>"
                self.note(where, f"its {kind} has the geometry {form}: expected a box, a sphere, "
                          "a cylinder or a mesh, with its size")  # fmt: skip
            else:
                found.append(read)
        return found

    def geometry(self, shape: Element, place: Place, where: str) -> Geometry | None:
        """A shape; None where it has no form or size."""
        if shape.tag == "mesh" and shape.get("filename"):
            scale = self.numbers(shape, "scale", 3, where)
            size = (1.0, 1.0, 1.0) if scale is None else tuple(map(float, scale))
            return Geometry("mesh", size, place, shape.get("filename") or "")
        if shape.tag == "box":
            size = self.numbers(shape, "size", 3, where)
            return None if size is None else Geometry("box", tuple(map(float, size)), place)
        radius = self.numbers(shape, "radius", 1, where)
        length = self.numbers(shape, "length", 1, where)
        if shape.tag == "sphere" and radius is not None:
            return Geometry("sphere", (radius,), place)
        if shape.tag == "cylinder" and radius is not None and length is not None:
            return Geometry("cylinder", (radius, length), place)
        return None

    def joint(self, node: Element) -> DescribedJoint:
        """A <joint>."""
        name = node.get("name") or ""
        where = f"joint '{name}'"
        ends = [
            "" if end is None else end.get("link") or ""
            for end in (node.find("parent"), node.find("child"))
        ]
        limit, dynamics, mimic = node.find("limit"), node.find("dynamics"), node.find("mimic")
        axis = self.numbers(node.find("axis"), "xyz", 3, where)
        return DescribedJoint(
            name,
            node.get("type") or "",
            *ends,
            place=self.place(node.find("origin"), where),
            axis=np.array([1.0, 0.0, 0.0]) if axis is None else axis,
            **{
                key: self.numbers(limit, key, 1, where)
                for key in ("lower", "upper", "effort", "velocity")
            },
            damping=self.numbers(dynamics, "damping", 1, where) or 0.0,
            friction=self.numbers(dynamics, "friction", 1, where) or 0.0,
            mimic="" if mimic is None else mimic.get("joint") or "",
        )


def write_urdf(path: str | Path, description: Description) -> None:
    """Write what a description says, whole or not at all; mesh files are named as it names them."""
    root = Element("robot", name=description.name)
    # MuJoCo looks for meshes beside the file only, unless it is told otherwise; others skip this
    SubElement(SubElement(root, "mujoco"), "compiler", strippath="false", discardvisual="false")
    for link in description.links:
        node = SubElement(root, "link", name=link.name)
        if link.inertial is not None:
            _write_inertial(SubElement(node, "inertial"), link.inertial)
        for kind, shapes in (("visual", link.visuals), ("collision", link.collisions)):
            for shape in shapes:
                _write_geometry(SubElement(node, kind), shape)
    for joint in description.joints:
        _write_joint(SubElement(root, "joint", name=joint.name, type=joint.kind), joint)
    indent(root)
    write_text(path, '<?xml version="1.0"?>\n' + tostring(root, encoding="unicode") + "\n")


def _write_inertial(node: Element, inertial: Inertial) -> None:
    SubElement(node, "origin", xyz=spell(inertial.centre))
    SubElement(node, "mass", value=spell([inertial.mass]))
    entries = {
        name: spell([inertial.inertia[i, k]])
        for i, row in enumerate(ENTRIES)
        for k, name in enumerate(row)
    }
    SubElement(node, "inertia", entries)


def _write_geometry(node: Element, shape: Geometry) -> None:
    _write_place(node, shape.place)
    form = SubElement(SubElement(node, "geometry"), shape.kind)
    if shape.kind == "mesh":
        form.set("filename", shape.file)
        form.set("scale", spell(shape.size))
    elif shape.kind == "box":
        form.set("size", spell(shape.size))
    else:
        for name, value in zip(("radius", "length"), shape.size, strict=False):
            form.set(name, spell([value]))


def _write_joint(node: Element, joint: DescribedJoint) -> None:
    SubElement(node, "parent", link=joint.parent)
    SubElement(node, "child", link=joint.child)
    _write_place(node, joint.place)
    if joint.kind != "fixed":
        SubElement(node, "axis", xyz=spell(joint.axis))
    limits = {
        name: spell([value])
        for name in ("lower", "upper", "effort", "velocity")
        if (value := getattr(joint, name)) is not None
    }
    if limits:
        SubElement(node, "limit", limits)
    if joint.damping or joint.friction:
        values = {"damping": spell([joint.damping]), "friction": spell([joint.friction])}
        SubElement(node, "dynamics", values)
    if joint.mimic:
        SubElement(node, "mimic", joint=joint.mimic)


def _write_place(node: Element, place: Place) -> None:
    SubElement(node, "origin", xyz=spell(place.origin), rpy=spell(turn_of(place.rotation)))


def spell(numbers: Any) -> str:
    """Numbers as XML has them, to twelve digits, and never minus zero."""
    return " ".join(f"{float(number) + 0.0:.12g}" for number in numbers)


def rotation_of(turn: Triple) -> Square:
    """The rotation of roll, pitch and yaw (rad): about the fixed axes x, then y, then z."""
    (a, b, c), (d, e, f) = np.cos(turn), np.sin(turn)
    return np.array(
        [
            [b * c, d * e * c - a * f, a * e * c + d * f],
            [b * f, d * e * f + a * c, a * e * f - d * c],
            [-e, d * b, a * b],
        ]
    )


def turn_of(rotation: Square) -> Triple:
    """Roll, pitch and yaw (rad) of a rotation; at a pitch of 90 degrees the roll is zero."""
    level = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(-rotation[2, 0], level)
    if level < 1e-9:
        return np.array([0.0, pitch, math.atan2(-rotation[0, 1], rotation[1, 1])])
    roll = math.atan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, math.atan2(rotation[1, 0], rotation[0, 0])])
