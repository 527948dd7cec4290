"""Random trees of links, and the same tree in MuJoCo and in Pinocchio."""

import dataclasses
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from palpate.errors import extra_module
from palpate.models.articulated import Link

MOST = 12  # joints
BRANCHES = 0.3  # how often a link hangs on any before it, not on the last


class Case(NamedTuple):
    """A tree and what is done to it: positions, velocities and forces of its joints; SI units.

    `push` is a force on each link (world's axes) and `point` where it acts, in the link's frame.
    """

    links: list[Link]
    position: Float[np.ndarray, " links"]
    velocity: Float[np.ndarray, " links"]
    torque: Float[np.ndarray, " links"]
    push: Float[np.ndarray, "links 3"]
    point: Float[np.ndarray, "links 3"]


def random_case(seed: int) -> Case:
    """A tree of 1 to 12 joints, hinges and slides at any axis, with dampers and springs."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, MOST + 1))
    links = []
    for index in range(count):
        parent = int(rng.integers(-1, index)) if rng.random() < BRANCHES else index - 1
        # of a box of this size, turned: no body has other moments
        size = rng.uniform(0.05, 0.5, 3)
        mass = float(rng.lognormal(0.0, 1.0))
        moments = mass / 12.0 * (np.sum(size**2) - size**2)
        turned = random_rotation(rng)
        links.append(
            Link(
                joint="revolute" if rng.random() < 0.6 else "prismatic",
                parent=parent,
                origin=rng.normal(0.0, 0.3, 3),
                rotation=random_rotation(rng),
                axis=rng.normal(size=3),
                mass=mass,
                centre_of_mass=rng.normal(0.0, 0.2, 3),
                inertia=turned @ np.diag(moments) @ turned.T,
                damping=float(rng.uniform(0.0, 2.0)),
                stiffness=float(rng.uniform(0.0, 5.0)),
                rest=float(rng.normal()),
                armature=float(rng.uniform(0.0, 0.05)),
            )
        )
    position, velocity, torque = rng.normal(size=(3, count))
    push, point = rng.normal(0.0, 3.0, (count, 3)), rng.normal(0.0, 0.2, (count, 3))
    return Case(links, position, velocity, torque, push, point)


def random_rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Any rotation, each as likely as the other."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def in_mujoco(links: list[Link]) -> mujoco.MjModel:
    """The tree as MuJoCo's, its joints in the same order."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    bodies = [spec.worldbody]
    for index, link in enumerate(links):
        body = bodies[link.parent + 1].add_body(name=f"link {index}", pos=link.origin)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, np.asarray(link.rotation, float).ravel())
        body.quat = quaternion
        body.mass, body.ipos = link.mass, link.centre_of_mass
        inertia = np.asarray(link.inertia, float)
        body.fullinertia = [
            inertia[i, k] for i, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        ]
        body.explicitinertial = True
        joint = body.add_joint(name=f"joint {index}", axis=link.axis)
        joint.type = (
            mujoco.mjtJoint.mjJNT_HINGE if link.joint == "revolute" else mujoco.mjtJoint.mjJNT_SLIDE
        )
        joint.damping[0], joint.stiffness[0] = link.damping, link.stiffness
        joint.springref, joint.armature = link.rest, link.armature
        bodies.append(body)
    return spec.compile()


def mujoco_acceleration(case: Case) -> Float[np.ndarray, " links"]:
    """What MuJoCo computes for the joints, rad/s^2 or m/s^2, in the order of the links."""
    model = in_mujoco(case.links)
    data = mujoco.MjData(model)
    order = np.array([model.joint(f"joint {i}").dofadr[0] for i in range(len(case.links))])
    data.qpos[order], data.qvel[order] = case.position, case.velocity
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    applied = np.zeros(model.nv)
    for index, (push, point) in enumerate(zip(case.push, case.point, strict=True)):
        body = model.body(f"link {index}").id
        at = data.xpos[body] + data.xmat[body].reshape(3, 3) @ point
        mujoco.mj_applyFT(model, data, push, np.zeros(3), at, body, applied)
    data.qfrc_applied[:] = applied
    data.qfrc_applied[order] += case.torque
    mujoco.mj_forward(model, data)
    return data.qacc[order]


def pinocchio_acceleration(case: Case) -> Float[np.ndarray, " links"]:
    """What Pinocchio's articulated body algorithm computes, in the order of the links.

    Raises `PalpateError` where it is not installed.
    """
    pin = extra_module("pinocchio", "pinocchio", "Pinocchio")
    pin_model: Any = pin.Model()
    ids = [0]
    for index, link in enumerate(case.links):
        axis = np.asarray(link.axis, float) / np.linalg.norm(link.axis)
        kind = (
            pin.JointModelRevoluteUnaligned
            if link.joint == "revolute"
            else pin.JointModelPrismaticUnaligned
        )
        place = pin.SE3(np.asarray(link.rotation, float), np.asarray(link.origin, float))
        ids.append(pin_model.addJoint(ids[link.parent + 1], kind(axis), place, f"joint {index}"))
        centre = np.asarray(link.centre_of_mass, float)
        inertia = pin.Inertia(link.mass, centre, np.asarray(link.inertia, float))
        pin_model.appendBodyToJoint(ids[-1], inertia, pin.SE3.Identity())
    order = np.array([pin_model.joints[each].idx_v for each in ids[1:]])
    pin_model.armature[order] = [link.armature for link in case.links]
    position, velocity, torque = (np.zeros(pin_model.nv) for _ in range(3))
    position[order], velocity[order] = case.position, case.velocity
    resisted = [
        link.damping * v + link.stiffness * (q - link.rest)
        for link, q, v in zip(case.links, case.position, case.velocity, strict=True)
    ]
    torque[order] = case.torque - resisted
    data: Any = pin_model.createData()
    pin.forwardKinematics(pin_model, data, position)
    forces = pin.StdVec_Force()
    forces.extend(pin.Force.Zero() for _ in range(pin_model.njoints))
    for each, push, point in zip(ids[1:], case.push, case.point, strict=True):
        local = data.oMi[each].rotation.T @ push
        forces[each] = pin.Force(local, np.cross(point, local))
    return pin.aba(pin_model, data, position, velocity, torque, forces)[order]


def chain(links: int, length: float = 0.3) -> list[Link]:
    """A pendulum of so many equal rods without friction, hinges across gravity."""
    rod = Link(
        parent=-1,
        axis=(0.0, 1.0, 0.0),
        mass=0.5,
        centre_of_mass=(0.0, 0.0, -0.5 * length),
        inertia=0.5 * length**2 / 12.0 * np.diag([1.0, 1.0, 1e-3]),
    )
    below = dataclasses.replace(rod, origin=(0.0, 0.0, -length))
    return [rod, *(dataclasses.replace(below, parent=index) for index in range(links - 1))]
