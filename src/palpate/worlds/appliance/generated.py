"""The scene of a design: an appliance on a floor, or on a block where it stands higher.

Nothing collides: a part ends at the stops of its joint. The frames of all bodies are that of the
appliance with its parts closed.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from palpate.worlds.appliance.design import Design, Shape, corners_of
from palpate.worlds.appliance.scene import Latches, MovingPart, Scene

TIME_STEP = 2e-3  # s
STOP_SOLREF = (0.02, 1.0)  # of an end stop: critically damped
GIVES = (0.9, 0.95, 0.002, 0.5, 2.0)  # how soft an end stop is (solimp)
COLOURS = (
    (0.86, 0.62, 0.35), (0.36, 0.58, 0.80), (0.52, 0.71, 0.42), (0.72, 0.51, 0.72),
    (0.88, 0.76, 0.36), (0.42, 0.71, 0.71),
)  # fmt: skip


def generated_scene(design: Design, yaw: float) -> Scene:
    """The scene, compiled; `yaw` (rad) turns it about the vertical through the design's origin."""
    low, high = design.bounds
    x, y, z = 0.5 * (low + high)
    resists = [part.resistance for part in design.parts]
    latches = [np.array([getattr(one, of) for one in resists]) for of in ("latch", "reach")]
    return Scene(
        design.category,
        _compile(design, yaw),
        tuple(
            MovingPart(
                part.name, part.parent, part.joint, 0.0, part.range, part.resistance.friction,
                part.resistance.damping, float(np.ptp(_corners(part.shapes), axis=0).max()),
            )
            for part in design.parts
        ),
        joints=np.arange(len(design.parts)),
        latches=Latches(*latches),
        closed=np.zeros(len(design.parts)),
        middle=np.array([
            math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y,
            design.height + z,
        ]),
        size=float(np.linalg.norm(high - low)),
        front=yaw,
        above=design.category == "box",
    )  # fmt: skip


def _corners(shapes: Sequence[Shape]) -> Float[np.ndarray, "corners 3"]:
    return np.concatenate([corners_of(shape) for shape in shapes])


def _compile(design: Design, yaw: float) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.modelname = design.category
    spec.compiler.degree = False
    spec.option.timestep = TIME_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_light(pos=(2, -2, 4), dir=(-0.4, 0.4, -1))
    _add(spec.worldbody, mujoco.mjtGeom.mjGEOM_PLANE, (8.0, 8.0, 0.1), rgba=(0.8, 0.8, 0.78, 1))
    body = spec.worldbody.add_body(
        name="body",
        pos=(0.0, 0.0, design.height),
        quat=(np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)),
    )
    for shape in design.body:
        _add_shape(body, shape, 500.0, (0.75, 0.74, 0.72, 1.0))
    if design.height > 0.0:
        low, high = design.bounds
        half = 0.5 * (high - low) + (0.1, 0.1, 0.0)
        centre = 0.5 * (low + high)
        size = (half[0], half[1], 0.5 * design.height)
        place = (centre[0], centre[1], -0.5 * design.height)
        _add(body, mujoco.mjtGeom.mjGEOM_BOX, size, pos=place, rgba=(0.6, 0.55, 0.5, 1))
    bodies = []
    for number, part in enumerate(design.parts):
        parent = body if part.parent < 0 else bodies[part.parent]
        moving = parent.add_body(name=part.name)
        bodies.append(moving)
        kinds = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}
        joint = moving.add_joint(
            name=part.name, type=kinds[part.joint], axis=part.axis, pos=part.position
        )
        joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, (0.0, part.range)
        joint.solref_limit, joint.solimp_limit = STOP_SOLREF, GIVES
        resistance = part.resistance
        joint.damping[0], joint.frictionloss = resistance.damping, resistance.friction
        joint.stiffness[0], joint.springref = resistance.stiffness, resistance.rest
        for shape in part.shapes:
            _add_shape(moving, shape, part.density, (*COLOURS[number], 1.0))
    return spec.compile()


def _add_shape(body: mujoco.MjsBody, shape: Shape, density: float, rgba: tuple[float, ...]) -> None:
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(shape.rotation).ravel())
    x, y, z = shape.size
    if shape.kind == "box":
        kind, size = mujoco.mjtGeom.mjGEOM_BOX, (0.5 * x, 0.5 * y, 0.5 * z)
    else:
        kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, (x, 0.5 * z, 0.0)
    _add(body, kind, size, pos=shape.centre, quat=quaternion, density=density, rgba=rgba)


def _add(body: mujoco.MjsBody, kind: mujoco.mjtGeom, size: tuple[float, ...], **more) -> None:
    body.add_geom(type=kind, size=size, contype=0, conaffinity=0, **more)
