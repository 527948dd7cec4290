"""From a description of links and joints to the model of the tree."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from palpate.models.articulated.articulated import Articulated
from palpate.models.articulated.description import DescribedJoint, Description, Inertial, Place
from palpate.models.articulated.faults import usable
from palpate.models.articulated.links import FREE, Link, free_links, tree_of
from palpate.models.articulated.urdf import read_urdf


class Assembly(NamedTuple):
    """Links in an order that parents come first, and the joint that each hangs on by name.

    What is fixed to a link is part of it, and what is fixed to the world is left out. `frames` is
    where each described link is: on which of the links (-1: the world), and where in its frame.
    """

    links: list[Link]
    joints: list[str]
    frames: dict[str, tuple[int, Place]]


def read_articulated(path: str | Path, **settings: Any) -> Articulated:
    """The model of a URDF file, mended where it has to be; `settings` as of `tree_of`.

    Raises `PalpateError` for a file that is no URDF, has a fault that cannot be mended by itself,
    or in which nothing moves.
    """
    return tree_of(assemble(usable(read_urdf(path))).links, **settings)


def assemble(description: Description) -> Assembly:
    """The links of a description without faults. Floating ones are six links in a row."""
    below: dict[str, list[DescribedJoint]] = {}
    for joint in description.joints:
        below.setdefault(joint.parent, []).append(joint)
    inertials = {link.name: link.inertial for link in description.links}
    joints: list[tuple[DescribedJoint, int, Place]] = []  # and what they hang on
    frames: dict[str, tuple[int, Place]] = {name: (-1, Place()) for name in description.roots}
    weights: list[list[tuple[Inertial, Place]]] = []
    waiting = list(frames)
    while waiting:
        name = waiting.pop(0)
        carrier, place = frames[name]
        own = inertials[name]
        if carrier >= 0 and own is not None:
            weights[carrier].append((own, place))
        for joint in below.get(name, []):
            frame = place @ joint.place
            if joint.kind == "fixed":
                frames[joint.child] = carrier, frame
            else:
                frames[joint.child] = len(joints), Place()
                joints.append((joint, carrier, frame))
                weights.append([])
            waiting.append(joint.child)
    links: list[Link] = []
    names: list[str] = []
    ends: list[int] = []  # where the last link of each joint is among the links
    for (joint, carrier, frame), parts in zip(joints, weights, strict=True):
        link = _link(joint, ends[carrier] if carrier >= 0 else -1, frame, together(parts))
        chain = free_links(link, len(links)) if joint.kind == "floating" else [link]
        links += chain
        names += [joint.name] * len(chain)
        ends.append(len(links) - 1)
    placed = {
        name: (ends[carrier] if carrier >= 0 else -1, place)
        for name, (carrier, place) in frames.items()
    }
    return Assembly(links, names, placed)


def _link(joint: DescribedJoint, parent: int, frame: Place, weight: Inertial | None) -> Link:
    ends = joint.kind in ("revolute", "prismatic")
    body: dict[str, Any] = {"mass": 0.0, "inertia": np.zeros((3, 3))}
    if weight is not None:
        body = {"mass": weight.mass, "centre_of_mass": weight.centre, "inertia": weight.inertia}
    return Link(
        joint="prismatic" if joint.kind == "prismatic" else "revolute",
        parent=parent,
        origin=frame.origin,
        rotation=frame.rotation,
        axis=joint.axis,
        damping=joint.damping,
        friction=joint.friction,
        lower=-FREE if not ends or joint.lower is None else joint.lower,
        upper=FREE if not ends or joint.upper is None else joint.upper,
        **body,
    )


def together(parts: Sequence[tuple[Inertial, Place]]) -> Inertial | None:
    """Bodies that are one, each placed in its frame; None of none."""
    if not parts:
        return None
    masses = np.array([part.mass for part, _ in parts])
    centres = np.array([place.origin + place.rotation @ part.centre for part, place in parts])
    mass = float(masses.sum())
    centre = masses @ centres / mass
    inertia = np.zeros((3, 3))
    for (part, place), own, middle in zip(parts, masses, centres, strict=True):
        arm = middle - centre
        inertia += place.rotation @ part.inertia @ place.rotation.T
        inertia += own * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Inertial(mass, centre, inertia)
