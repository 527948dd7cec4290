"""A seven-axis arm with a parallel gripper and a wrist sensor, of primitive shapes.

Kinematics and limits are those that the manufacturer publishes for the Panda (Franka Emika, "Robot
and interface specifications"; Denavit-Hartenberg in Craig's convention). Inertias of the links are
those identified by Gaz et al. 2019 ("Dynamic Identification of the Franka Emika Panda Robot With
Retrieval of Feasible Parameters Using Penalty-Based Optimization", RA-L 4), those of the hand the
manufacturer's. Armature and damping are those of MuJoCo Menagerie's Panda.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

QUARTER = math.pi / 2


class Link(NamedTuple):
    """A link, in the frame of the joint before it."""

    before: tuple[float, float, float]  # a m, d m and alpha rad that lead to that joint
    range: tuple[float, float]  # rad
    torque: float  # N m, the most that the joint gives
    mass: float  # kg
    centre: tuple[float, float, float]  # m, of mass
    # kg m^2 about the centre of mass: xx, yy, zz, xy, xz, yz.
    inertia: tuple[float, float, float, float, float, float]
    capsule: tuple[float, ...]  # what is drawn: from, to and radius, m


LINKS = (
    Link(
        (0, 0.333, 0), (-2.8973, 2.8973), 87, 4.970684, (3.875e-3, 2.081e-3, -0.175),
        (7.0337e-1, 7.0661e-1, 9.117e-3, -1.39e-4, 6.772e-3, 1.9169e-2),
        (0, 0, -0.19, 0, 0, 0, 0.06),
    ),
    Link(
        (0, 0, -QUARTER), (-1.7628, 1.7628), 87, 0.646926, (-3.141e-3, -2.872e-2, 3.495e-3),
        (7.962e-3, 2.811e-2, 2.5995e-2, -3.925e-3, 1.0254e-2, 7.04e-4),
        (0, 0, -0.06, 0, 0, 0.06, 0.06),
    ),
    Link(
        (0, 0.316, QUARTER), (-2.8973, 2.8973), 87, 3.228604, (2.7518e-2, 3.9252e-2, -6.6502e-2),
        (3.7242e-2, 3.6155e-2, 1.083e-2, -4.761e-3, -1.1396e-2, -1.2805e-2),
        (0, 0, -0.2, 0, 0, -0.06, 0.06),
    ),
    Link(
        (0.0825, 0, QUARTER), (-3.0718, -0.0698), 87, 3.587895, (-5.317e-2, 1.04419e-1, 2.7454e-2),
        (2.5853e-2, 1.9552e-2, 2.8323e-2, 7.796e-3, -1.332e-3, 8.641e-3),
        (0, 0, -0.05, 0, 0, 0.05, 0.055),
    ),
    Link(
        (-0.0825, 0.384, -QUARTER), (-2.8973, 2.8973), 12, 1.225946,
        (-1.1953e-2, 4.1065e-2, -3.8437e-2),
        (3.5549e-2, 2.9474e-2, 8.627e-3, -2.117e-3, -4.037e-3, 2.29e-4),
        (0, 0.02, -0.26, 0, 0.05, -0.05, 0.05),
    ),
    Link(
        (0, 0, QUARTER), (-0.0175, 3.7525), 12, 1.666555, (6.0149e-2, -1.4117e-2, -1.0517e-2),
        (1.964e-3, 4.354e-3, 5.433e-3, 1.09e-4, -1.158e-3, 3.41e-4),
        (0, 0, -0.03, 0.088, 0, 0, 0.045),
    ),
    Link(
        (0.088, 0, QUARTER), (-2.8973, 2.8973), 12, 0.735522, (1.0517e-2, -4.252e-3, 6.1597e-2),
        (1.2516e-2, 1.0027e-2, 4.815e-3, -4.28e-4, -1.196e-3, -7.41e-4),
        (0, 0, 0, 0, 0, 0.07, 0.045),
    ),
)  # fmt: skip
TORQUE_LIMITS = np.array([link.torque for link in LINKS], float)  # N m
RANGE = np.array([link.range for link in LINKS]).T  # rad
FLANGE = 0.107  # m from the last joint, along its axis
ARMATURE, DAMPING = 0.1, 1.0  # kg m^2 and N m s/rad, of every joint

HAND_YAW = -math.pi / 4  # rad, about the flange's axis
HAND_MASS, HAND_CENTRE, HAND_INERTIA = 0.73, (-0.01, 0, 0.03), (0.001, 0.0025, 0.0017)
FINGER_MASS, FINGER_INERTIA, FINGER_Z = 0.015, (2.375e-6, 2.375e-6, 7.5e-7), 0.0584  # kg, m
GRIP_Z = 0.1034  # m from flange to where the fingers hold
WIDEST = 0.04  # m by which either finger opens
MASS = sum(link.mass for link in LINKS) + HAND_MASS + 2 * FINGER_MASS  # kg, of all that moves

JOINTS = tuple(f"arm {number}" for number in range(1, 8))
HAND, BALANCE = "hand", "hand balance"
WRIST_FORCE, WRIST_TORQUE, WRIST_ACCELERATION = "wrist force", "wrist torque", "wrist acceleration"
_SHELL, _DARK = (0.92, 0.92, 0.92, 1), (0.25, 0.27, 0.3, 1)
_DRAWN = {"contype": 0, "conaffinity": 0, "mass": 0.0}


def add_panda(
    spec: mujoco.MjSpec,
    mount: mujoco.MjsBody,
    position: Sequence[float],
    yaw: float,
    opening: float,
) -> mujoco.MjsBody:
    """Put an arm on the body `mount` at `position` (3,) m, turned by `yaw` rad; returns its hand.

    Its joints are called `JOINTS` and driven by `qfrc_applied`. Either finger is fixed at `opening`
    m, 0 to 0.04, from the middle, and what they hold is added to the hand, `GRIP_Z` along its z.
    Nothing of the arm collides. Sensors between flange and hand, in the hand's axes: force, torque
    (of the hand on the arm) and acceleration less gravity.
    """
    capsule, box = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX
    body = mount.add_body(
        name="arm", pos=position, quat=(math.cos(yaw / 2), 0, 0, math.sin(yaw / 2))
    )
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=(0.09, 0.07, 0), pos=(0, 0, 0.07),
                  rgba=_DARK, **_DRAWN)  # fmt: skip
    for number, (joint, link) in enumerate(zip(JOINTS, LINKS, strict=True)):
        a, d, alpha = link.before
        s, c = math.sin(alpha), math.cos(alpha)
        body = body.add_body(
            name=f"link {number + 1}", pos=(a, -d * s, d * c),
            quat=(math.cos(alpha / 2), math.sin(alpha / 2), 0, 0),
            mass=link.mass, ipos=link.centre, fullinertia=link.inertia,
        )  # fmt: skip
        body.explicitinertial = True
        body.add_joint(
            name=joint, type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1), limited=1,
            range=link.range, armature=ARMATURE, damping=DAMPING,
        )  # fmt: skip
        body.add_geom(
            type=capsule, fromto=link.capsule[:6], size=(link.capsule[6], 0, 0), rgba=_SHELL,
            **_DRAWN,
        )  # fmt: skip
    hand = body.add_body(
        name=HAND, pos=(0, 0, FLANGE),
        quat=(math.cos(HAND_YAW / 2), 0, 0, math.sin(HAND_YAW / 2)),
        mass=HAND_MASS, ipos=HAND_CENTRE, inertia=HAND_INERTIA,
    )  # fmt: skip
    hand.explicitinertial = True
    hand.add_geom(
        type=box, size=(0.03, 0.1, 0.03), pos=(0, 0, 0.032), rgba=_SHELL, **_DRAWN
    )  # fmt: skip
    for side in (-1, 1):
        finger = hand.add_body(
            name=f"finger {side}", pos=(0, side * opening, FINGER_Z), mass=FINGER_MASS,
            ipos=(0, 0, 0), inertia=FINGER_INERTIA,
        )  # fmt: skip
        finger.explicitinertial = True
        finger.add_geom(
            type=box, size=(0.009, 0.006, 0.027), pos=(0, side * 0.006, 0.027), rgba=_DARK, **_DRAWN
        )  # fmt: skip
    hand.add_site(name=HAND)
    hand.add_site(name=BALANCE)
    kind, site = mujoco.mjtSensor, mujoco.mjtObj.mjOBJ_SITE
    for name, of, place in (
        (WRIST_FORCE, kind.mjSENS_FORCE, HAND),
        (WRIST_TORQUE, kind.mjSENS_TORQUE, HAND),
        (WRIST_ACCELERATION, kind.mjSENS_ACCELEROMETER, BALANCE),
    ):
        spec.add_sensor(name=name, type=of, objtype=site, objname=place)
    return hand


def wrist(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """What the wrist's sensors show, as a view (9,): force N, torque N m, acceleration m/s^2."""
    first = model.sensor(WRIST_FORCE).adr[0]
    return data.sensordata[first : first + 9]


def balance(model: mujoco.MjModel, height: float) -> np.ndarray:
    """(6, 9) that makes of `wrist` the force and torque of contact, in the hand's axes.

    The torque is about the point `height` m along the hand's z. Gravity and inertia of all that is
    beyond the sensor are taken off, as an accelerometer beside the sensor allows it; what turning
    faster and faster takes is not, which an upright hand hardly does. The accelerometer is placed
    at the centre of mass of what is beyond.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hand, site = model.body(HAND).id, model.site(BALANCE).id
    axes = data.xmat[hand].reshape(3, 3)
    centre = model.site_pos[site] = axes.T @ (data.subtree_com[hand] - data.xpos[hand])
    mass, one = model.body_subtreemass[hand], np.eye(3)
    force = np.hstack([-one, np.zeros((3, 3)), mass * one])
    torque = np.hstack([np.zeros((3, 3)), -one, mass * _cross(centre)])
    return np.vstack([force, torque - _cross(np.array([0.0, 0.0, height])) @ force])


def _cross(arm: np.ndarray) -> np.ndarray:
    x, y, z = arm
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
