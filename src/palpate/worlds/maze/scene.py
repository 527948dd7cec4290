"""The MuJoCo scene of a maze: a tip on a swaying base, soft walls and a block that slides."""

import math
from collections.abc import Callable

import mujoco

from palpate.worlds.maze.layout import ARENA, TIP_RADIUS, Layout

TIME_STEP = 1e-3  # s
TIP_MASS = 1.0  # kg
# Where the base sways: 20 degrees off y, so that it drives the tip across the channel and along it.
SWAY_AXIS = (math.sin(math.radians(20)), math.cos(math.radians(20)))
BASE_MASS = 1000.0  # kg: what the tip's force does to it is micrometres

# The tip's rubber on any wall: a spring and a damper, a fifth of the critical one. A critical one
# answers a wall that the swaying base brings up with 21 N at once, however soft the tip is held.
CONTACT_STIFFNESS = 3000.0  # N/m
CONTACT_DAMPING = 0.2 * 2 * math.sqrt(CONTACT_STIFFNESS * TIP_MASS)  # N s/m
# MuJoCo's direct form takes both per effective mass. An impedance near 0 makes the contact that
# spring, whatever else pushes; near 1 it would be a rigid constraint (Todorov 2014, ICRA).
CONTACT_IMPEDANCE = 0.01
# Dry friction holds by a damper between rubber and wall; a stiffer one would, in MuJoCo's convex
# contacts, lift what slides off the wall by its speed times coefficient, damping over stiffness.
SLIP_DAMPING = 5.0  # N s/m
FRICTION_RATIO = 1000  # by which friction is held harder than the normal direction
PLANE_STIFFNESS = 1e4  # N/m, holds the tip at its height
HALF_HEIGHT = 0.03  # m, of walls
# The block stands higher than walls and meets the peg at its shaft: its torque tells it from one.
SHAFT_HEIGHT, BLOCK_HALF_HEIGHT = 0.04, 0.02  # m, above the tip: where it meets it; of the block
REFERENCE_HEIGHT = 0.05  # m above the contact: the point that torques are felt about

TIP, SHAFT, BLOCK, FEELER = "tip", "shaft", "block", "feeler"
# Springs and dampers that a rollout switches on: of the base's servo, and of the tip's impedance,
# whose coupling of x and y acts on their sum.
BASE_SERVO, SPRINGS = "base servo", ("spring x", "spring y", "spring x + y")


def contact_solref(inverse_mass: float) -> tuple[float, float]:
    """(-stiffness, -damping) per effective mass, as MuJoCo takes them, for a contact's spring.

    `inverse_mass`, 1/kg, is that of the two bodies together: MuJoCo divides by it.
    """
    return (-CONTACT_STIFFNESS * inverse_mass, -CONTACT_DAMPING * inverse_mass)


def add_sliding_tip(spec: mujoco.MjSpec, base: mujoco.MjsBody) -> None:
    """A tip on three slides: x, y, and z, in which a spring holds it at its height."""
    tip = base.add_body(name=TIP, mass=TIP_MASS, inertia=(1e-3, 1e-3, 1e-3))
    tip.explicitinertial = True
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    for axis, name in zip(((1, 0, 0), (0, 1, 0)), "xy", strict=True):
        tip.add_joint(name=f"tip {name}", type=slide, axis=axis)
    tip.add_joint(
        name="tip z", type=slide, axis=(0, 0, 1), stiffness=PLANE_STIFFNESS,
        damping=2 * math.sqrt(PLANE_STIFFNESS * TIP_MASS),
    )  # fmt: skip
    both = spec.add_tendon(name=SPRINGS[2])
    for name in ("tip x", "tip y"):
        both.wrap_joint(name, 1.0)
    of_joint, of_tendon = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_TENDON
    for name, kind, on in zip(
        SPRINGS, (of_joint, of_joint, of_tendon), ("tip x", "tip y", SPRINGS[2]), strict=True
    ):
        _add_spring(spec, name, kind, on)
    add_peg(tip)


def _add_spring(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtTrn, on: str) -> None:
    """An actuator that gives no force until its bias is told a stiffness and a damping."""
    spec.add_actuator(
        name=name, trntype=kind, target=on, gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        gainprm=[0.0] * 10, biastype=mujoco.mjtBias.mjBIAS_AFFINE, biasprm=[0.0] * 10,
    )  # fmt: skip


def add_peg(tip: mujoco.MjsBody, up: float = 1.0) -> None:
    """What touches: a vertical capsule whose lower end, a ball at the body's origin, is the tip.

    Walls meet that, and the block meets a ball further up, on the shaft. A whole capsule would
    touch a wall at one or two points, and be twice as stiff at two. `up` is 1 or -1: where the
    body's z axis points.
    """
    for name, height in ((TIP, 0.0), (SHAFT, up * SHAFT_HEIGHT)):
        tip.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(TIP_RADIUS, 0, 0),
            pos=(0, 0, height), contype=0, conaffinity=0, rgba=(0.2, 0.3, 0.7, 1),
        )  # fmt: skip
    tip.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=(TIP_RADIUS, 0, 0),
        fromto=(0, 0, 0, 0, 0, up * 2 * REFERENCE_HEIGHT),
        contype=0, conaffinity=0, rgba=(0.2, 0.3, 0.7, 1),
    )  # fmt: skip


def maze_scene(
    layout: Layout, add_tip: Callable[[mujoco.MjSpec, mujoco.MjsBody], None] = add_sliding_tip
) -> mujoco.MjSpec:
    """The scene, uncompiled: joints of the base, of what carries the tip, of the block (x).

    `add_tip` puts what carries the tip on the base: a body and a geom called `TIP` (`add_peg`).
    """
    spec = mujoco.MjSpec()
    spec.modelname = "maze"
    spec.compiler.degree = False
    spec.memory = 2**20  # bytes, of which 17 kB are used
    option = spec.option
    option.timestep, option.gravity = TIME_STEP, (0, 0, 0)  # compensated by the robot
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = FRICTION_RATIO
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.disableflags = mujoco.mjtDisableBit.mjDSBL_AUTORESET
    world, box = spec.worldbody, mujoco.mjtGeom.mjGEOM_BOX
    world.add_light(pos=(-0.2, -0.3, 1), dir=(0.2, 0.3, -1))
    world.add_geom(
        type=box, size=(ARENA[0] + 0.1, ARENA[1] + 0.05, 0.005), pos=(0, 0, -HALF_HEIGHT - 0.005),
        contype=0, conaffinity=0, rgba=(0.93, 0.93, 0.9, 1),
    )  # fmt: skip
    x, y = layout.goal
    world.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=(layout.goal_radius, 0.001, 0),
        pos=(x, y, -HALF_HEIGHT), contype=0, conaffinity=0, rgba=(0.3, 0.7, 0.4, 1),
    )  # fmt: skip
    for number, wall in enumerate(layout.walls):
        world.add_geom(
            name=f"wall {number}", type=box, size=(*wall.half_sizes, HALF_HEIGHT),
            pos=(*wall.position, 0), quat=(math.cos(wall.yaw / 2), 0, 0, math.sin(wall.yaw / 2)),
            contype=0, conaffinity=0, rgba=(0.55, 0.55, 0.6, 1),
        )  # fmt: skip
    base = world.add_body(name="base", mass=BASE_MASS, inertia=(1, 1, 1))
    base.explicitinertial = True
    base.add_joint(name="base", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(*SWAY_AXIS, 0))
    _add_spring(spec, BASE_SERVO, mujoco.mjtTrn.mjTRN_JOINT, "base")
    add_tip(spec, base)
    block = world.add_body(name=BLOCK, pos=(*layout.obstacle.position, 0))
    block.add_joint(
        name=BLOCK, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(1, 0, 0),
        limited=1, range=(0, layout.obstacle.travel), solref_limit=(0.004, 1),
        # Stiff: with MuJoCo's own values a block that is pushed less than it resists creeps 1 cm/s.
        solref_friction=(2 * TIME_STEP, 1), solimp_friction=(0.9999, 0.9999, 0.001, 0.5, 2),
        frictionloss=1.0,
    )  # fmt: skip
    block.add_geom(
        name=BLOCK, type=box, size=(*layout.obstacle.half_sizes, BLOCK_HALF_HEIGHT), mass=1.0,
        pos=(0, 0, SHAFT_HEIGHT),
        contype=0, conaffinity=0, rgba=(0.85, 0.5, 0.2, 1),
    )  # fmt: skip
    for touched in (BLOCK, *(f"wall {number}" for number in range(len(layout.walls)))):
        spec.add_pair(
            name=touched, geomname1=SHAFT if touched == BLOCK else TIP, geomname2=touched, condim=3,
            solref=contact_solref(1 / TIP_MASS), solreffriction=(-SLIP_DAMPING, -SLIP_DAMPING),
            solimp=(CONTACT_IMPEDANCE, CONTACT_IMPEDANCE, 0.01, 0.5, 2),
        )  # fmt: skip
    data = mujoco.mjtConDataField
    spec.add_sensor(
        name=FEELER, type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_BODY, objname=TIP,
        # Force, torque and place of all contacts together ("netforce"), in world axes.
        intprm=(
            sum(1 << int(f) for f in (
                data.mjCONDATA_FORCE, data.mjCONDATA_TORQUE, data.mjCONDATA_POS)),
            3, 1,
        ),
    )  # fmt: skip
    return spec
