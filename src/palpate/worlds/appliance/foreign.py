"""The scene of a file that somebody else wrote, whole or one object of it.

What the file says of an object stays as it is: shapes, contacts, resistance. Scenery, which carries
nothing with a hinge or a slide, is left out: tables, walls, and robots, as a joint that an actuator
drives is taken for one of theirs. What is left stands on a floor of its own. Shapes that viewers
hide by default, those of collisions, are felt and not seen, unless nothing else of what moves is.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.family import check_name
from palpate.numerics.pinhole import Pinhole
from palpate.worlds.appliance.scene import Latches, MovingPart, Scene, labels_of
from palpate.worlds.camera import cast

KINDS: dict[int, Literal["revolute", "prismatic"]] = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic",
}
SHOWN = 3  # groups of shapes that viewers show, from the first on
TURN, TRAVEL = math.pi, 1.0  # rad and m, to both sides: of a joint without an end
STEP = 5e-3  # s: longest time step
DIRECTIONS, PIXELS = 16, 48  # from which an object is looked at, to find where most of it is seen
ELEVATIONS = 0.35, 0.9  # rad, of cameras that stand level and above
NEAR = 0.35 * math.pi  # rad about its front: where cameras stand
FEET = 0.05  # m over its floor: what is lower is not told from the floor


def foreign_scene(spec: mujoco.MjSpec, file: Path, body: str | None = None) -> Scene:
    """The scene of what a file says, which is changed; `body` names what is kept of it.

    Raises `PalpateError` for what MuJoCo does not take, an unknown body, a body with several
    joints, and where no hinge or slide moves.
    """
    if body is not None:
        _keep(spec, body, file)
    _hold_robots(spec)
    for key in list(spec.keys):
        spec.delete(key)
    _leave_out_scenery(spec)
    model = _compile(spec, file)
    joints = [joint for joint in range(model.njnt) if int(model.jnt_type[joint]) in KINDS]
    if not joints:
        raise PalpateError(f"nothing moves in {file}: expected at least one hinge or slide")
    for one in set(model.jnt_bodyid[joints]):
        if (count := model.body_jntnum[one]) > 1:
            raise PalpateError(
                f"the body '{model.body(one).name}' of {file} has {count} joints: expected one "
                "hinge or slide of each; bodies in between do the same"
            )
    low, _ = _Parts(model, joints).bounds()
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=(8.0, 8.0, 0.1), pos=(0.0, 0.0, low[2] - FEET),
        contype=0, conaffinity=0, rgba=(0.8, 0.8, 0.78, 1.0),
    )  # fmt: skip
    model = _compile(spec, file)
    return _scene(body or file.stem, model, joints)


def _compile(spec: mujoco.MjSpec, file: Path) -> mujoco.MjModel:
    """A model in which what viewers hide cannot be seen."""
    try:
        model = spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise PalpateError(f"MuJoCo cannot use {file}: {reason}") from error
    model.opt.timestep = min(model.opt.timestep, STEP)
    moves = model.body_weldid[model.geom_bodyid] > 0
    if (moves & (model.geom_group < SHOWN)).any():
        hidden = model.geom_group >= SHOWN
        model.geom_matid[hidden], model.geom_rgba[hidden, 3] = -1, 0.0
    return model


def _keep(spec: mujoco.MjSpec, name: str, file: Path) -> None:
    """Take out of a scene all that neither carries a body nor hangs on it."""
    names = [body.name for body in spec.bodies if body.name and body.name != "world"]
    above, kept = spec.body(check_name(f"body of {file}", name, names)).parent, {name}
    while above is not None and above.name != "world":
        for geom in list(above.geoms):
            spec.delete(geom)
        for other in list(above.bodies):
            if other.name not in kept:
                spec.delete(other)
        kept, above = {above.name}, above.parent
    for other in list(spec.worldbody.bodies):
        if other.name not in kept:
            spec.delete(other)


def _leave_out_scenery(spec: mujoco.MjSpec) -> None:
    """Take out what hangs on the world and carries nothing that moves, and floors."""
    for body in list(spec.worldbody.bodies):
        if not any(int(joint.type) in KINDS for each in _tree(body) for joint in each.joints):
            spec.delete(body)
    for geom in list(spec.worldbody.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            spec.delete(geom)


def _tree(body: mujoco.MjsBody) -> Iterator[mujoco.MjsBody]:
    """A body and all that hangs on it."""
    yield body
    for below in body.bodies:
        yield from _tree(below)


def _hold_robots(spec: mujoco.MjSpec) -> None:
    """Take out the joints that actuators drive, and the actuators."""
    driven = {each.target for each in spec.actuators}
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for joint in list(spec.joints):
        if joint.name and joint.name in driven:
            spec.delete(joint)


def _scene(name: str, model: mujoco.MjModel, joints: list[int]) -> Scene:
    """What is known of a compiled model, and where cameras see most of what moves."""
    of = _Parts(model, joints)
    low, high = of.bounds()
    middle, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    front, above = _front(model, of.data, of.labels, middle, size)
    count = len(joints)
    return Scene(
        name, model, tuple(of.part(number) for number in range(count)), np.array(joints),
        Latches(np.zeros(count), np.ones(count)), of.closed, middle, size, front, above,
    )  # fmt: skip


class _Parts:
    """The parts of a model with all of them closed."""

    def __init__(self, model: mujoco.MjModel, joints: list[int]) -> None:
        self.model, self.joints = model, joints
        self.bodies = model.jnt_bodyid[joints]
        self.labels = labels_of(model, self.bodies)
        self.ends = np.array([_range(model, joint) for joint in joints])
        addresses = model.jnt_qposadr[joints]
        self.closed = np.clip(model.qpos0[addresses], *self.ends.T)
        self.data = mujoco.MjData(model)
        self.data.qpos[addresses] = self.closed
        mujoco.mj_forward(model, self.data)

    def part(self, number: int) -> MovingPart:
        """What is known of one of them."""
        model, joint, body = self.model, self.joints[number], int(self.bodies[number])
        low, high = self.ends[number].tolist()
        freedom = model.jnt_dofadr[joint]
        corners = seen_corners(model, self.data, self.labels == number)
        return MovingPart(
            model.joint(joint).name or model.body(body).name,
            int(self.labels[model.body_parentid[body]]),
            KINDS[int(model.jnt_type[joint])],
            low,
            high,
            float(model.dof_frictionloss[freedom]),
            float(model.dof_damping[freedom]),
            float(np.ptp(corners, axis=0).max()) if len(corners) else 0.0,
        )

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """The least and greatest corner (m) of what moves and what carries it, as far as seen."""
        corners = seen_corners(self.model, self.data, _carrying(self.model, self.bodies))
        if not len(corners):
            raise PalpateError("what moves has no shape: expected geometry of links")
        return np.array([corners.min(axis=0), corners.max(axis=0)])


def _range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    if model.jnt_limited[joint]:
        low, high = model.jnt_range[joint].tolist()
        return low, high
    most = TURN if KINDS[int(model.jnt_type[joint])] == "revolute" else TRAVEL
    return -most, most


def _carrying(model: mujoco.MjModel, bodies: np.ndarray) -> np.ndarray:
    """Whether each body moves or carries one that does; not the world."""
    found = np.zeros(model.nbody, bool)
    found[bodies] = True
    for body in range(1, model.nbody):
        found[body] |= found[model.body_parentid[body]]
    for body in range(model.nbody - 1, 0, -1):
        found[model.body_parentid[body]] |= found[body]
    found[0] = False
    return found


def seen_corners(
    model: mujoco.MjModel, data: mujoco.MjData, bodies: np.ndarray
) -> Float[np.ndarray, "corners 3"]:
    """Corners (m) of boxes around all shapes of these bodies that are seen."""
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    found = [np.empty((0, 3))]
    for geom in np.flatnonzero(bodies[model.geom_bodyid] & (model.geom_rgba[:, 3] > 0.0)):
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        turn = data.geom_xmat[geom].reshape(3, 3)
        found.append(data.geom_xpos[geom] + (centre + signs * half) @ turn.T)
    return np.concatenate(found)


def _front(
    model: mujoco.MjModel, data: mujoco.MjData, labels: np.ndarray, middle: np.ndarray, size: float
) -> tuple[float, bool]:
    """From where most of what moves is seen: the direction (rad), and whether from above."""
    angles = math.tau * np.arange(DIRECTIONS) / DIRECTIONS
    field = math.radians(58.0)
    seen = np.zeros((len(ELEVATIONS), DIRECTIONS))
    for row, elevation in enumerate(ELEVATIONS):
        for column, azimuth in enumerate(angles):
            away = (0.6 + 1.2 * size) * np.array([
                math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            ])  # fmt: skip
            camera = Pinhole.looking_at(
                middle.tolist(), (middle + away).tolist(), PIXELS, PIXELS, field
            )
            columns, rows = np.meshgrid(np.arange(PIXELS), np.arange(PIXELS))
            rays = camera.directions(np.stack([columns, rows], axis=-1)).reshape(-1, 3)
            geoms, *_ = cast(model, data, np.asarray(camera.position), rays, still=True)
            numbers = labels[model.geom_bodyid[geoms[geoms >= 0]]]
            # a small part counts as a large one does
            counts = np.bincount(numbers[numbers >= 0], minlength=int(labels.max()) + 1)
            seen[row, column] = np.sqrt(counts).sum()
    around = np.abs((angles[:, None] - angles + math.pi) % math.tau - math.pi) < NEAR
    value = seen @ around
    row, column = np.unravel_index(np.argmax(value), value.shape)
    return float(angles[column]), bool(row)
