"""Trees of links out of MuJoCo's models: MJCF files of others, with joints as MuJoCo means them."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError, PalpateWarning, list_names
from palpate.models.articulated.assembly import together
from palpate.models.articulated.description import Inertial, Place
from palpate.models.articulated.links import FREE, Link, free_links

HINGE, SLIDE, FREELY = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("HINGE", "SLIDE", "FREE")
)
NOT_MODELLED = {"neq": "equality constraints", "ntendon": "tendons", "nflex": "flexible bodies"}


def read_mjcf_links(path: str | Path) -> tuple[list[Link], list[str]]:
    """The links of an MJCF file, and the name of the joint that each hangs on.

    Raises `PalpateError` for a file that MuJoCo does not take; else as `links_of`.
    """
    try:
        model = mujoco.MjSpec.from_file(str(path)).compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise PalpateError(f"MuJoCo cannot use {path}: {reason}") from error
    return links_of(model)


def links_of(model: mujoco.MjModel) -> tuple[list[Link], list[str]]:
    """The links of a compiled model, one for each joint, and the joints' names.

    A joint position is MuJoCo's `qpos`; what no joint moves is part of what it is fixed to. Warns
    of what the model of a tree lacks. Raises `PalpateError` for ball joints and a model in which
    nothing moves.
    """
    lacks = [what for name, what in NOT_MODELLED.items() if getattr(model, name, 0)]
    if lacks:
        said = f"the file has {list_names(lacks)}, which a tree of links is without"
        warnings.warn(said, PalpateWarning, stacklevel=2)
    links: list[Link] = []
    names: list[str] = []
    weights: dict[int, list[tuple[Inertial, Place]]] = {}
    frames: list[tuple[int, Place]] = [(-1, Place())]  # of each body: on which link, and where
    for body in range(1, model.nbody):
        carrier, above = frames[model.body_parentid[body]]
        place = above @ Place(model.body_pos[body].copy(), _matrix(model.body_quat[body]))
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            anchor = model.jnt_pos[joint].copy()
            found = _joint(model, joint, carrier, place @ Place(anchor), len(links))
            links += found
            names += [model.joint(joint).name] * len(found)
            carrier, place = len(links) - 1, Place(-anchor)
        frames.append((carrier, place))
        if carrier >= 0 and model.body_mass[body] > 0.0:
            turn = _matrix(model.body_iquat[body])
            inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
            own = Inertial(float(model.body_mass[body]), model.body_ipos[body].copy(), inertia)
            weights.setdefault(carrier, []).append((own, place))
    if not links:
        raise PalpateError("nothing moves in the file: expected at least one hinge or slide")
    for index, parts in weights.items():
        whole = together(parts)
        if whole is not None:
            body = {"mass": whole.mass, "centre_of_mass": whole.centre, "inertia": whole.inertia}
            links[index] = dataclasses.replace(links[index], **body)
    return links, names


def _joint(model: mujoco.MjModel, joint: int, parent: int, frame: Place, first: int) -> list[Link]:
    """The links of one joint at a frame of its parent, the first of that place in the list.

    They have no mass yet.
    """
    kind, name = model.jnt_type[joint], model.joint(joint).name
    empty: dict[str, Any] = {"mass": 0.0, "inertia": np.zeros((3, 3)), "parent": parent}
    if kind == FREELY:
        return free_links(Link(**empty), first)  # its position is in the world, from there
    if kind not in (HINGE, SLIDE):
        raise PalpateError(
            f"the joint '{name}' is a ball: expected hinges, slides and free bodies; three hinges "
            "in a row do nearly the same"
        )
    dof, at = model.jnt_dofadr[joint], model.jnt_qposadr[joint]
    if np.any(model.jnt_stiffnesspoly[joint]) or np.any(model.dof_dampingpoly[dof]):
        said = f"the joint '{name}' resists by more than a line, of which the rest is left out"
        warnings.warn(said, PalpateWarning, stacklevel=3)
    axis, start = model.jnt_axis[joint].copy(), float(model.qpos0[at])
    # MuJoCo counts from its reference: the frame is where the position is zero
    back = Place(-start * axis) if kind == SLIDE else Place(rotation=_about(axis, -start))
    frame = frame @ back
    limited = bool(model.jnt_limited[joint])
    return [
        Link(
            joint="revolute" if kind == HINGE else "prismatic",
            origin=frame.origin,
            rotation=frame.rotation,
            axis=axis,
            damping=float(model.dof_damping[dof]),
            friction=float(model.dof_frictionloss[dof]),
            stiffness=float(model.jnt_stiffness[joint]),
            rest=float(model.qpos_spring[at]),
            lower=float(model.jnt_range[joint, 0]) if limited else -FREE,
            upper=float(model.jnt_range[joint, 1]) if limited else FREE,
            armature=float(model.dof_armature[dof]),
            **empty,
        )
    ]


def _matrix(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    return flat.reshape(3, 3)


def _about(axis: Float[np.ndarray, "3"], angle: float) -> Float[np.ndarray, "3 3"]:
    quaternion = np.empty(4)
    mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
    return _matrix(quaternion)
