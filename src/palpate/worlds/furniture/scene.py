"""A MuJoCo scene of furniture on a floor among walls.

Recipe of the rolling wheels: the floor has no friction of its own (MuJoCo takes the greater of
two), wheels are ellipsoids on hinges, because cylinders scrub and lock casters; a caster's fork
turns about a vertical hinge with the wheel trailing behind, and a locked caster has no joints.
What collides with what besides: the bands of the pieces, walls and the robot, with each other.
"""

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import shapely

from palpate.errors import PalpateError
from palpate.worlds.furniture.pieces import BAND, HANDLE_HEIGHT, Mount, PieceKind, PieceParameters

TIME_STEP = 2e-3  # s
GRAVITY = 9.81  # m/s^2
WHEEL_MASS = 0.1  # kg
FORK_MASS = 0.05  # kg
BEARING_DAMPING = 2e-3  # N m s/rad, of every roll and swivel joint
SWIVEL_FRICTION = 0.01  # N m, dry, of every swivel joint
CONTACT_FRICTION = 0.3  # between pieces, walls and robot
LOAD_SIZE = 0.1  # m, half the side of the cube that stands on a piece
# Critically damped; stiff enough for a millimetre of sinking, slow enough for the time step.
GROUND_SOLREF = (0.01, 1.0)
HINGE_SOLREF = (0.008, 1.0)

FLOOR_BIT, BODY_BIT = 1, 2  # who collides: wheels and feet with the floor, bands with bands
_COLLIDES = {"contype": BODY_BIT, "conaffinity": BODY_BIT, "condim": 3}
SOLID: dict[str, Any] = _COLLIDES | {"friction": (CONTACT_FRICTION, 0, 0)}  # of a band
DRAWN: dict[str, Any] = {"contype": 0, "conaffinity": 0}  # of what only a picture shows
WALL_HEIGHT = 0.6  # m
COLOURS = (
    (0.80, 0.45, 0.20), (0.25, 0.50, 0.75), (0.45, 0.65, 0.30), (0.65, 0.40, 0.65),
    (0.85, 0.70, 0.25), (0.35, 0.65, 0.65), (0.70, 0.35, 0.35), (0.50, 0.50, 0.50),
)  # fmt: skip


def furniture_scene(
    names: Sequence[str],
    kinds: Sequence[PieceKind],
    parameters: Sequence[PieceParameters],
    swivels: Sequence[Sequence[float]],
    poses: np.ndarray,
    walls: Sequence[np.ndarray],
) -> mujoco.MjSpec:
    """The scene, uncompiled, with each body called by its name in `names`.

    Its first 3 * bodies controls are each body's wrench (N, N, N m), in world axes about the
    body's origin at `HANDLE_HEIGHT`. Casters start at `swivels` (rad, per body and mount), bodies
    at `poses` (bodies, 3) m, m, rad; `walls` are simple polygons (points, 2) m.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "furniture"
    spec.compiler.degree = False
    option = spec.option
    option.timestep, option.gravity = TIME_STEP, (0, 0, -GRAVITY)
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Elliptic cones with this ratio let feet and locked wheels creep by micrometres per second.
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10
    option.disableflags = mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.worldbody.add_light(pos=(0, -3, 6), dir=(0, 0.45, -1))
    _add_floor(spec)
    for number, polygon in enumerate(walls):
        for part, convex in enumerate(convex_parts(polygon)):
            _add_prism(
                spec, spec.worldbody, f"wall {number}.{part}", convex, (0.0, WALL_HEIGHT),
                rgba=(0.85, 0.85, 0.82, 1), **SOLID,
            )  # fmt: skip
    for number, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        _add_piece(
            spec, name, kind, parameters[number], swivels[number], poses[number],
            (*COLOURS[number % len(COLOURS)], 1.0),
        )  # fmt: skip
    return spec


def convex_parts(polygon: np.ndarray) -> list[np.ndarray]:
    """A simple polygon (points, 2) as convex ones that cover it: itself, or triangles.

    Raises `PalpateError` for a polygon with fewer than three points, without area, that crosses
    itself or is not finite.
    """
    points = np.asarray(polygon, float)
    if points.ndim != 2 or points.shape[1:] != (2,) or len(points) < 3:
        raise PalpateError(f"a wall has 3 or more points (x, y), not shape {points.shape}")
    shape = shapely.Polygon(points) if np.isfinite(points).all() else shapely.Polygon()
    if not shape.is_valid or shape.area < 1e-8:
        raise PalpateError(
            f"a wall is a polygon with an area that does not cross itself, not {points.tolist()}"
        )
    whole = shape.convex_hull
    if whole.area - shape.area < 1e-6 * whole.area:
        shapes = [whole]
    else:
        shapes = shapely.get_parts(shapely.constrained_delaunay_triangles(shape))
    # Coordinates of a ring repeat the first point at the end.
    return [shapely.get_coordinates(shapely.orient_polygons(part))[:-1] for part in shapes]


def _add_floor(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, width=256, height=256,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.85, 0.85, 0.85), rgb2=(0.78, 0.78, 0.78),
    )  # fmt: skip
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=256, height=256,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, rgb1=(1, 1, 1), rgb2=(0.8, 0.85, 0.9),
    )  # fmt: skip
    material = spec.add_material(name="floor", texrepeat=(20, 20))
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=(20, 20, 0.1), material="floor",
        contype=FLOOR_BIT, conaffinity=0, condim=1, friction=(0, 0, 0), solref=GROUND_SOLREF,
    )  # fmt: skip


def _add_piece(
    spec: mujoco.MjSpec,
    name: str,
    kind: PieceKind,
    parameters: PieceParameters,
    swivels: Sequence[float],
    pose: np.ndarray,
    colour: tuple[float, ...],
) -> None:
    x, y, yaw = map(float, pose)
    body = spec.worldbody.add_body(
        name=name, pos=(x, y, 0), quat=(math.cos(yaw / 2), 0, 0, math.sin(yaw / 2))
    )
    if not kind.bolted:
        body.add_freejoint(name=name)
    wheels = [mount for mount in kind.mounts if mount.type != "foot"]
    load = kind.load_fraction * parameters.mass
    rest = parameters.mass - load
    rest -= sum(WHEEL_MASS + (FORK_MASS if m.type == "caster" else 0) for m in wheels)
    if rest <= 0:
        raise PalpateError(f"a '{kind.name}' of {parameters.mass} kg is lighter than its wheels")
    outline = np.asarray(kind.outline, float)
    _add_prism(spec, body, f"{name} band", outline, BAND, rgba=colour, mass=rest, **SOLID)
    if load:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, pos=(*parameters.load_place, HANDLE_HEIGHT),
            size=(LOAD_SIZE,) * 3, mass=load, rgba=colour, **DRAWN,
        )  # fmt: skip
    below = kind.height - 0.04 if kind.mounts else BAND[1]  # a top on legs, or all of a chest
    _add_prism(
        spec, body, f"{name} top", outline, (below, kind.height), rgba=colour,
        mass=0, **DRAWN,
    )  # fmt: skip
    for mount in kind.mounts:
        middle = (BAND[1] + kind.height) / 2
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=(*mount.place, middle), mass=0,
            size=(0.015, max(kind.height - BAND[1], 0.01) / 2, 0), rgba=colour, **DRAWN,
        )  # fmt: skip
    weight = parameters.mass * GRAVITY
    for number, (mount, angle) in enumerate(zip(kind.mounts, swivels, strict=True)):
        friction = parameters.friction
        if mount.type == "foot":
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=(*mount.place, mount.radius), mass=0,
                size=(mount.radius, 0, 0), rgba=(0.2, 0.2, 0.2, 1), **_standing(friction),
            )  # fmt: skip
            continue
        dry = parameters.rolling_resistance * weight / len(wheels) * mount.radius
        locked = parameters.locked[number] is not None
        _add_wheel(body, f"{name} wheel {number}", mount, angle, locked, dry, friction)
    _add_handle(spec, body, name)
    if parameters.anchor is not None:
        anchor = (*parameters.anchor, HANDLE_HEIGHT)
        spec.add_equality(
            name=f"{name} hinge", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=name, name2="world", data=[*anchor, *(0,) * 9], solref=HINGE_SOLREF,
        )  # fmt: skip


def _add_wheel(
    body: mujoco.MjsBody,
    name: str,
    mount: Mount,
    angle: float,
    locked: bool,
    dry: float,
    friction: float,
) -> None:
    caster = mount.type == "caster"
    hinge: dict[str, Any] = {
        "type": mujoco.mjtJoint.mjJNT_HINGE, "damping": (BEARING_DAMPING, 0, 0)
    }  # fmt: skip
    fork = body.add_body(
        name=f"{name} fork", pos=(*mount.place, mount.radius),
        quat=(math.cos(angle / 2), 0, 0, math.sin(angle / 2)),
    )  # fmt: skip
    if caster:
        fork.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=(0, 0, mount.radius), mass=FORK_MASS,
            size=(0.01, mount.radius, 0), rgba=(0.5, 0.5, 0.5, 1), **DRAWN,
        )  # fmt: skip
        if not locked:
            swivel = f"{name} swivel"
            fork.add_joint(name=swivel, axis=(0, 0, 1), frictionloss=SWIVEL_FRICTION, **hinge)
    wheel = fork.add_body(name=name, pos=(-mount.trail if caster else 0, 0, 0))
    if not locked:
        wheel.add_joint(name=f"{name} roll", axis=(0, 1, 0), frictionloss=dry, **hinge)
    wheel.add_geom(
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, mass=WHEEL_MASS,
        size=(mount.radius, 0.3 * mount.radius, mount.radius), rgba=(0.2, 0.2, 0.2, 1),
        **_standing(friction),
    )  # fmt: skip


def _add_handle(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str) -> None:
    """Three motors that apply a wrench at the handle, in the axes of the site "axes" of the world.

    As controls they are held within MuJoCo while the body moves on, at the point they hold.
    """
    if spec.site("axes") is None:
        spec.worldbody.add_site(name="axes")
    body.add_site(name=f"{name} handle", pos=(0, 0, HANDLE_HEIGHT))
    for component in (0, 1, 5):
        gear = np.zeros(6)
        gear[component] = 1
        motor = spec.add_actuator(
            name=f"{name} handle {component}", trntype=mujoco.mjtTrn.mjTRN_SITE,
            target=f"{name} handle", refsite="axes", gear=gear,
        )  # fmt: skip
        motor.set_to_motor()


def _add_prism(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    polygon: np.ndarray,
    heights: tuple[float, float],
    **properties,
) -> None:
    """A geom over a convex, counterclockwise polygon; a box where it is a rectangle.

    Boxes touch each other flush, with several points at once.
    """
    low, high = heights
    middle, half_height = (low + high) / 2, (high - low) / 2
    if len(polygon) == 4 and np.allclose(
        polygon[0] + polygon[2], polygon[1] + polygon[3], atol=1e-9
    ):
        along, across = polygon[1] - polygon[0], polygon[2] - polygon[1]
        if abs(along @ across) < 1e-9 * (along @ along):
            angle = math.atan2(along[1], along[0])
            body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=(*polygon.mean(0), middle),
                quat=(math.cos(angle / 2), 0, 0, math.sin(angle / 2)),
                size=(np.linalg.norm(along) / 2, np.linalg.norm(across) / 2, half_height),
                **properties,
            )  # fmt: skip
            return
    corners = [(*point, height) for height in heights for point in polygon.tolist()]
    spec.add_mesh(name=name, uservert=np.ravel(corners))
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **properties)


def _standing(friction: float) -> dict[str, Any]:
    """What touches the floor, and nothing else."""
    touches = {"contype": 0, "conaffinity": FLOOR_BIT, "condim": 3}
    return touches | {"friction": (friction, 0, 0), "solref": GROUND_SOLREF}
