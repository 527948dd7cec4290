"""A piece of furniture whose structure is told, as the MuJoCo scene it is: what is free in it.

What the start of a piece of motion does not show is where free casters point: that follows from the
way they were dragged before (`caster_angles`).
"""

import dataclasses
from typing import Any

import mujoco
import numpy as np
import scipy.signal
from jaxtyping import Float

from palpate.numerics.polygons import place_points
from palpate.worlds.furniture.furniture import SETTLING, STEPS_PER_PERIOD
from palpate.worlds.furniture.pieces import (
    LOAD_REACH,
    MASS_SPREAD,
    PieceKind,
    PieceParameters,
)
from palpate.worlds.furniture.scene import TIME_STEP, furniture_scene

SMOOTHING = 21  # frames of the cubic by which the way of casters is smoothed
STARTS = 16  # angles that a caster of unknown angle is dragged from
# Bounds: the mass as a share of the kind's nominal one, the load as shares of its half extent.
MASS, LOAD, FRICTION, ROLLING = (1 / 3, 3.0), (-1.0, 1.0), (0.02, 1.5), (0.0, 0.1)
BODY = "body"  # what the piece is called in its scene
MEASURED = "pose and deviation"


@dataclasses.dataclass(frozen=True)
class ToldScene:
    """A piece whose structure is known, standing at `pose` (3,) m, m, rad where it is hinged.

    Its constants are counted in shares of their bounds, from 0 to 1, in the order of `bounds`, so
    that one step and one tolerance suit them all.
    """

    kind: PieceKind
    locked: tuple[float | None, ...]
    anchor: tuple[float, float] | None
    pose: tuple[float, float, float]

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """What is fitted, and from where to where; rolling resistance only where wheels roll."""
        x, y = self.kind.half_extent.tolist()
        bounds = {
            "mass": (MASS[0] * self.kind.mass, MASS[1] * self.kind.mass),
            "load x": (LOAD[0] * x, LOAD[1] * x),
            "load y": (LOAD[0] * y, LOAD[1] * y),
            "friction": FRICTION,
        }
        if any(mount.type != "foot" for mount in self.kind.mounts):
            bounds["rolling resistance"] = ROLLING
        return bounds

    def shares(self, parameters: PieceParameters) -> list[float]:
        """Where constants stand within their bounds."""
        low, high = np.array([*self.bounds.values()]).T
        values = [parameters.mass, *parameters.load_place]
        values += [parameters.friction, parameters.rolling_resistance]
        return ((values[: len(low)] - low) / (high - low)).tolist()

    @property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Middle and half width of the kind's own ranges, in shares of the bounds."""
        kind = self.kind
        ends = []
        for end, side in enumerate((-1, 1)):
            x, y = (side * LOAD_REACH * kind.half_extent).tolist()
            mass = kind.mass * (1 + side * MASS_SPREAD)
            friction, rolling = kind.friction[end], kind.rolling_resistance[end]
            parameters = PieceParameters(mass, (x, y), friction, rolling, self.locked, self.anchor)
            ends.append(self.shares(parameters))
        low, high = np.array(ends)
        return (low + high) / 2, (high - low) / 2

    @property
    def free(self) -> list[int]:
        """The mounts that swivel."""
        pairs = zip(self.kind.mounts, self.locked, strict=True)
        return [i for i, (m, angle) in enumerate(pairs) if m.type == "caster" and angle is None]

    def parameters(self, *shares: float) -> PieceParameters:
        """The constants at these shares."""
        low, high = np.array([*self.bounds.values()]).T
        mass, x, y, friction, *rolling = (low + np.array(shares) * (high - low)).tolist()
        resistance = rolling[0] if rolling else 0.0
        return PieceParameters(mass, (x, y), friction, resistance, self.locked, self.anchor)

    def spec(self, parameters: PieceParameters) -> mujoco.MjSpec:
        """The scene, free casters at 0, with room for what is measured as sensor data."""
        swivels = [0.0 if angle is None else angle for angle in self.locked]
        spec = furniture_scene(
            [BODY], [self.kind], [parameters], [swivels], np.array([self.pose]), []
        )
        spec.add_sensor(name=MEASURED, type=mujoco.mjtSensor.mjSENS_USER, dim=6)
        return spec

    def model(self, *shares: float) -> mujoco.MjModel:
        """The compiled scene at these shares."""
        return self.spec(self.parameters(*shares)).compile()


def caster_angles(
    way: Float[np.ndarray, "frames 3"], place: tuple[float, float], trail: float
) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]]:
    """Swivel angle (rad, body frame) of a free caster along the way of its body, and how known.

    A wheel that does not slip sideways is dragged by its pivot like a point by a string of length
    `trail`. On a straight line the angle between them goes as tan(angle / 2) ~ exp(-path / trail),
    the tractrix: within a few trails it forgets where it began. Here it begins at `STARTS` angles;
    their mean is returned, with the length of their mean unit vector, 1 where all agree.
    """
    pivots = np.array([place_points(np.array([place]), pose)[0] for pose in way])
    moved = np.diff(pivots, axis=0)
    path, heading = np.linalg.norm(moved, axis=1), np.arctan2(moved[:, 1], moved[:, 0])
    angles = np.empty((len(way), STARTS))  # in the world
    # None of them straight ahead on a way along an axis: a wheel pushed from behind stays there.
    angles[0] = 2 * np.pi * (np.arange(STARTS) + 0.5) / STARTS
    for frame in range(len(moved)):
        lag = (angles[frame] - heading[frame] + np.pi) % (2 * np.pi) - np.pi
        lag = 2 * np.arctan(np.tan(lag / 2) * np.exp(-path[frame] / trail))
        angles[frame + 1] = heading[frame] + lag
    mean = np.exp(1j * (angles - way[:, 2:])).mean(1)
    return np.angle(mean), np.abs(mean)


def caster_tracks(scene: ToldScene, poses: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Angles of each free caster along measured poses (frames, 3), and how known they are."""
    way = scipy.signal.savgol_filter(np.asarray(poses, float), SMOOTHING, 3, axis=0)
    mounts = [scene.kind.mounts[i] for i in scene.free]
    return [caster_angles(way, mount.place, mount.trail) for mount in mounts]


def settled_positions(model: mujoco.MjModel) -> np.ndarray:
    """Positions (nq,) of everything once it has sunk into the floor."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, round(SETTLING / TIME_STEP))
    return data.qpos.copy()


def rolling_state(
    sysid: Any,
    scene: ToldScene,
    model: mujoco.MjModel,
    settled: np.ndarray,
    pose: np.ndarray,
    rate: np.ndarray,
    angles: np.ndarray,
) -> np.ndarray:
    """mujoco.sysid's state (state,) of a piece that rolls without slipping.

    It stands at `pose` (3,) and moves at `rate` (3,), m and rad and by s; all else is as in the
    `settled` positions (nq,), free casters at `angles` (casters,) in rad.
    """
    qpos, qvel = settled.copy(), np.zeros(model.nv)
    joint = model.joint(BODY)
    first, speed = joint.qposadr[0], joint.dofadr[0]
    turn = np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0, 1]), float(pose[2]) - scene.pose[2])
    mujoco.mju_mulQuat(qpos[first + 3 : first + 7], turn, settled[first + 3 : first + 7])
    qpos[first : first + 2] = pose[:2]
    qvel[speed : speed + 2], qvel[speed + 5] = rate[:2], rate[2]
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    forward, left = cosine * rate[0] + sine * rate[1], cosine * rate[1] - sine * rate[0]
    pointing = dict(zip(scene.free, angles, strict=True))
    for number, (mount, locked) in enumerate(zip(scene.kind.mounts, scene.locked, strict=True)):
        if mount.type == "foot" or locked is not None:
            continue
        along, across = forward - rate[2] * mount.place[1], left + rate[2] * mount.place[0]
        if mount.type == "caster":
            angle = pointing[number]
            cosine, sine = np.cos(angle), np.sin(angle)
            along, across = cosine * along + sine * across, cosine * across - sine * along
            swivel = model.joint(f"{BODY} wheel {number} swivel")
            qpos[swivel.qposadr[0]] = angle
            qvel[swivel.dofadr[0]] = across / mount.trail - rate[2]
        qvel[model.joint(f"{BODY} wheel {number} roll").dofadr[0]] = along / mount.radius
    return sysid.create_initial_state(model, qpos, qvel)


def poses_of(model: mujoco.MjModel, states: np.ndarray, yaw: float) -> np.ndarray:
    """Poses (..., periods, 3) at the end of each control period of states (..., steps, state).

    Angles count on from `yaw` in rad.
    """
    first = 1 + model.joint(BODY).qposadr[0]  # a state begins with the time
    ends = states[..., STEPS_PER_PERIOD - 1 :: STEPS_PER_PERIOD, first : first + 7]
    w, x, y, z = np.moveaxis(ends[..., 3:], -1, 0)
    angle = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    begun = np.concatenate([np.full((*angle.shape[:-1], 1), yaw), angle], axis=-1)
    return np.concatenate([ends[..., :2], np.unwrap(begun, axis=-1)[..., 1:, None]], axis=-1)
