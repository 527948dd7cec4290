"""Reads off a running furniture scene where the pieces are and what they weigh."""

from collections.abc import Sequence

import mujoco
import numpy as np

from palpate.worlds.furniture.pieces import PieceKind, PieceParameters


class Bodies:
    """The pieces of a compiled scene, by their names in it.

    Angles are unwrapped from call to call of `poses`, between which a piece turns by less than half
    a turn, from `yaw` (bodies,) rad on, where the pieces start.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        names: Sequence[str],
        kinds: Sequence[PieceKind],
        yaw: np.ndarray,
    ):
        self._model, self._data = model, data
        self.names, self._kinds = names, kinds
        self._yaw = yaw.copy()
        self.ids = np.array([model.body(name).id for name in names])
        self._free = np.array([not kind.bolted for kind in kinds])  # the others have no joint
        joints = model.body_jntadr[self.ids[self._free]]
        self._positions = model.jnt_qposadr[joints][:, None] + np.arange(7)
        self._velocities = model.jnt_dofadr[joints][:, None] + np.arange(6)

    def poses(self) -> np.ndarray:
        """(bodies, 3) m, m, rad; right after a step, before `data.xpos` is up to date."""
        fixed = self.ids[~self._free]
        poses = np.empty((len(self.ids), 3))
        quaternion = np.empty((len(poses), 4))
        poses[~self._free, :2] = self._model.body_pos[fixed, :2]
        quaternion[~self._free] = self._model.body_quat[fixed]
        rows = self._data.qpos[self._positions]
        poses[self._free, :2] = rows[:, :2]
        quaternion[self._free] = rows[:, 3:]
        w, x, y, z = quaternion.T
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        self._yaw = self._yaw + (yaw - self._yaw + np.pi) % (2 * np.pi) - np.pi
        poses[:, 2] = self._yaw
        return poses

    def tilts(self) -> np.ndarray:
        """(bodies,) cosine of the angle by which each leans; 0 when it lies on its side."""
        tilts = np.ones(len(self.ids))
        tilts[self._free] = 1 - 2 * (self._data.qpos[self._positions[:, 4:6]] ** 2).sum(-1)
        return tilts

    def velocities(self) -> np.ndarray:
        """(bodies, 3) m/s, m/s, rad/s of the body frames' origins, in world axes."""
        velocities = np.zeros((len(self.ids), 3))
        rows = self._data.qvel[self._velocities]
        velocities[self._free, :2] = rows[:, :2]
        # A free joint's angular velocity stands in the body's axes.
        upwards = self._data.xmat[self.ids[self._free], 6:]
        velocities[self._free, 2] = (upwards * rows[:, 3:]).sum(-1)
        return velocities

    def centres(self) -> np.ndarray:
        """(bodies, 2) m, centre of mass of all that belongs to a piece, in its body frame."""
        levers = self._data.subtree_com[self.ids] - self._data.xpos[self.ids]
        rotations = self._data.xmat[self.ids].reshape(-1, 3, 3)
        return np.einsum("bji,bj->bi", rotations, levers)[:, :2]

    def inertias(self) -> np.ndarray:
        """(bodies,) kg m^2 about the vertical through the centre of mass, wheels included."""
        model, data = self._model, self._data
        roots = model.body_rootid
        levers = (data.xipos - data.subtree_com[roots])[:, :2]
        upwards = data.ximat[:, 6:]  # the vertical in each body's principal axes
        about_own = (upwards**2 * model.body_inertia).sum(-1)
        about_root = about_own + model.body_mass * (levers**2).sum(-1)
        return np.bincount(roots, about_root, model.nbody)[self.ids]

    def wheel_places(self) -> tuple[np.ndarray, ...]:
        """Per body (mounts, 2) m, where wheels and feet touch the floor, in its body frame."""
        places = []
        for body, name, kind in zip(self.ids, self.names, self._kinds, strict=True):
            here = np.array([mount.place for mount in kind.mounts]).reshape(-1, 2)
            rotation = self._data.xmat[body].reshape(3, 3)
            for number, mount in enumerate(kind.mounts):
                if mount.type != "foot":
                    wheel = self._data.body(f"{name} wheel {number}").xpos
                    here[number] = (rotation.T @ (wheel - self._data.xpos[body]))[:2]
            places.append(here)
        return tuple(places)

    def anchors(self, parameters: Sequence[PieceParameters]) -> np.ndarray:
        """(bodies, 2) m, world: the point a hinge holds each piece at; NaN for the others."""
        anchors = np.full((len(self.ids), 2), np.nan)
        for i, (name, piece) in enumerate(zip(self.names, parameters, strict=True)):
            if piece.anchor is not None:
                anchors[i] = self._model.equality(f"{name} hinge").data[3:5]
        return anchors
