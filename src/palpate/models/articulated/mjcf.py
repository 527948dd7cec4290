"""MJCF, MuJoCo's own format, of a description of links and joints."""

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from palpate.models.articulated.description import DescribedJoint, Description, Geometry, Place
from palpate.models.articulated.urdf import spell, turn_of
from palpate.runs.storage import write_text

TYPES = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}
GROUPS = {"visuals": "2", "collisions": "3"}  # as MuJoCo's viewer shows and hides them


def write_mjcf(path: str | Path, description: Description) -> None:
    """Write a description without faults, whole or not at all; meshes are named as it names them.

    Efforts are the limits of the forces that actuators may have at a joint. MJCF has no limit of
    velocities: they stand as numbers called `velocity JOINT`.
    """
    root = Element("mujoco", model=description.name)
    # Euler angles as URDF has them: about the fixed axes x, then y, then z
    SubElement(
        root, "compiler", angle="radian", eulerseq="XYZ", autolimits="true", inertiafromgeom="false"
    )
    assets, world = Element("asset"), SubElement(root, "worldbody")
    meshes: dict[tuple[str, tuple[float, ...]], str] = {}
    links = {link.name: link for link in description.links}
    velocities = Element("custom")

    def add_shapes(body: Element, link: str) -> None:
        for kind, group in GROUPS.items():
            for shape in getattr(links[link], kind):
                geom = SubElement(body, "geom", group=group, **_geometry(shape, meshes, assets))
                if kind == "visuals":
                    geom.attrib |= {"contype": "0", "conaffinity": "0"}

    def add(parent: Element, name: str, joint: DescribedJoint | None) -> None:
        body = SubElement(parent, "body", name=name)
        if joint is not None:
            body.attrib |= _place(joint.place)
            if joint.kind == "floating":
                SubElement(body, "freejoint", name=joint.name)
            elif joint.kind != "fixed":
                SubElement(body, "joint", **_joint(joint))
            if joint.velocity is not None:
                what = f"velocity {joint.name}"
                SubElement(velocities, "numeric", name=what, data=spell([joint.velocity]))
        inertial = links[name].inertial
        if inertial is not None:
            entries = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
            SubElement(
                body, "inertial", pos=spell(inertial.centre), mass=spell([inertial.mass]),
                fullinertia=spell(inertial.inertia[entry] for entry in entries),
            )  # fmt: skip
        add_shapes(body, name)
        for below in description.joints:
            if below.parent == name:
                add(body, below.child, below)

    for name in description.roots:
        add(world, name, None)
    for part in (assets, velocities):
        if len(part):
            root.append(part)
    indent(root)
    write_text(path, tostring(root, encoding="unicode") + "\n")


def _place(place: Place) -> dict[str, str]:
    return {"pos": spell(place.origin), "euler": spell(turn_of(place.rotation))}


def _joint(joint: DescribedJoint) -> dict[str, Any]:
    found = {
        "name": joint.name,
        "type": TYPES[joint.kind],
        "axis": spell(joint.axis),
        "damping": spell([joint.damping]),
        "frictionloss": spell([joint.friction]),
    }
    if joint.limited and joint.lower is not None and joint.upper is not None:
        found["range"] = spell([joint.lower, joint.upper])
    if joint.effort is not None:
        found["actuatorfrcrange"] = spell([-joint.effort, joint.effort])
    return found


def _geometry(
    shape: Geometry, meshes: dict[tuple[str, tuple[float, ...]], str], assets: Element
) -> dict[str, Any]:
    """The attributes of a <geom>; a mesh joins the assets, once for each scale."""
    found = {"type": shape.kind, **_place(shape.place)}
    if shape.kind == "mesh":
        key = shape.file, shape.size
        if key not in meshes:
            meshes[key] = f"mesh {len(meshes)}"
            file, scale = shape.file, spell(shape.size)
            SubElement(assets, "mesh", name=meshes[key], file=file, scale=scale)
        return found | {"mesh": meshes[key]}
    halves = {"box": [0.5 * edge for edge in shape.size], "sphere": shape.size}
    size = halves.get(shape.kind) or (shape.size[0], 0.5 * shape.size[-1])
    return found | {"size": spell(size)}
