"""A contact task of somebody's MJCF file: its own tip, what there is to touch, and a goal."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.worlds.maze.layout import SCATTER
from palpate.worlds.maze.scene import TIME_STEP, TIP
from palpate.worlds.maze.tip import TipObservation, TipWorld, not_negative
from palpate.worlds.mjcf import compile_model, read_mjcf

GOAL, START, SENSOR = "goal", "start", "palpate: net contact of the tip"
# kg. What is lighter a damper of the law would make unstable; what is heavier it cannot move.
LEAST_MASS, MOST_MASS = 0.02, 1000.0
DENT = 1e-3  # m by which a tip may overlap what it touches, or a joint its limit, at the start
DRAWS = 100  # of a place to start at, before there is taken to be none
FAR = 100.0  # of the world's extent
NEAREST = 1e-6  # m from where it is to start
STEPS = 50  # of Newton's method to a place, before it is taken to be out of reach
_DATA = mujoco.mjtConDataField
# Of a contact sensor: force, torque and place of all contacts together, in world axes.
_FIELDS = _DATA.mjCONDATA_FORCE, _DATA.mjCONDATA_TORQUE, _DATA.mjCONDATA_POS
NET_FORCE = sum(1 << int(field) for field in _FIELDS), 3, 1


@dataclass(frozen=True)
class OpenLayout:
    """Where the goal is, all in m from above; nobody has a map of what is between.

    `start` is where the tip begins, or the middle of where it may.
    """

    name: str
    start: tuple[float, float]
    goal: tuple[float, float]
    goal_radius: float
    entrance: float = -math.inf  # by which nobody leaves

    def distance(
        self, position: Float[np.ndarray, "*batch coordinates"]
    ) -> Float[np.ndarray, " *batch"]:
        """Straight, from (x, y) to the goal's middle."""
        away = np.asarray(position, float)[..., :2] - self.goal
        return np.asarray(np.linalg.norm(away, axis=-1))


class OpenTruth(NamedTuple):
    """The hidden state, for judges and tests alone. World frame."""

    time: float  # s since reset
    position: np.ndarray  # (3,) m
    velocity: np.ndarray  # (3,) m/s
    force: np.ndarray  # (3,) N, net contact force on the tip, at the end of the control period
    peak_force: float  # N, the greatest in the last control period, in any direction
    fault: bool  # whether the last command was not finite, and so no force was given
    layout: OpenLayout


class MjcfWorld(TipWorld):
    """The tip of an MJCF file, pushed through the file's own world by a force (3,) N.

    The file has
    - a body `tip`, on joints that let its origin move along x and y: two slides, or an arm. The
      force acts there, through all its joints, beside what acts by itself (gravity, springs,
      actuators). It feels all contacts of its geoms and of those of bodies on it;
    - a site `goal` that does not move: its place seen from above, and its size[0] the radius;
    - if wanted, a site `start` of type box that does not move: episodes begin with the tip anywhere
      above or below it. Without one they begin as the first keyframe has it, or the joints' zeros.

    Everything else is as the file has it, and the same in every episode. `scattered` lets them
    begin anywhere on the straight way to the goal too, and beside it, where nothing is touched.
    `control_period` in s is a whole number of the file's time steps. Position and
    velocity are the world's: the robot's base is at its origin, and does not move. All else is as
    `TipWorld` has it.

    Raises `PalpateError` for a file that MuJoCo cannot use, that names other files, or lacks one of
    these, and as `TipWorld`.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        noise: float = 1.0,
        scattered: bool = False,
        control_period: float = TIME_STEP,
    ):
        noise, spec = not_negative("noise", noise), read_mjcf(path)
        self._path, self._scattered = Path(path), scattered
        for name, found, example in (
            (TIP, spec.body(TIP), '<body name="tip"> on a joint along x and one along y'),
            (GOAL, spec.site(GOAL), '<site name="goal" pos="0.2 0 0" size="0.03"/>'),
        ):
            self._unless(found is not None, f"`{name}`, such as {example}; there is none")
        spec.add_sensor(
            name=SENSOR, type=mujoco.mjtSensor.mjSENS_CONTACT, objname=TIP,
            objtype=mujoco.mjtObj.mjOBJ_XBODY, intprm=NET_FORCE,
        )  # fmt: skip
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        model = self._model = compile_model(path, spec)
        try:
            super().__init__(noise, control_period, model.opt.timestep)
        except PalpateError as error:
            raise PalpateError(
                f'{path}: {error}; <option timestep="{control_period:g}"/> would work'
            ) from error
        data = self._data = mujoco.MjData(model)
        self._tip, self._jacobian = model.body(TIP).id, np.zeros((3, model.nv))
        self._felt, self._tip_place = data.sensor(SENSOR).data, data.xpos[self._tip]
        self._own = _bodies_on(model, self._tip)[model.geom_bodyid]
        touching = (model.geom_contype | model.geom_conaffinity) != 0
        touching[model.pair_geom1] = touching[model.pair_geom2] = True
        self._unless((touching & self._own).any(), "a geom in the body `tip` that collides")
        self._place(None)
        self._mass = self._mass_at_start()
        self._read_sites()
        self._view = tuple(model.stat.center), 1.5 * model.stat.extent, 90.0, -60.0
        self.reset(0)
        self._ready = False

    def _unless(self, possible: object, expected: str) -> None:
        if not possible:
            raise PalpateError(f"{self._path} cannot be felt through: expected {expected}")

    def _mass_at_start(self) -> np.ndarray:
        """(J M^-1 J^T)^-1 of x and y, (2, 2) kg."""
        plane = self._jacobian[:2].copy()
        solved = np.zeros_like(plane)
        mujoco.mj_solveM(self._model, self._data, solved, plane)
        mobility = solved @ plane.T
        heaviest, lightest = 1 / np.maximum(np.linalg.eigvalsh(mobility), 1e-9)
        self._unless(
            LEAST_MASS <= lightest <= heaviest <= MOST_MASS,
            f"`tip` to move along x and y like {LEAST_MASS:g} to {MOST_MASS:g} kg, such as on "
            '<joint type="slide" axis="1 0 0"/> and <joint type="slide" axis="0 1 0"/>, not like '
            f"{lightest:.3g} kg and square to that {heaviest:.3g} kg (1e+09: not at all)",
        )
        return np.linalg.inv(mobility)

    def _read_sites(self) -> None:
        model, start = self._model, self._tip_place[:2].copy()
        self._region: np.ndarray | None = None  # (2, 2): from its middle to two of its sides, m
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, START) >= 0:
            site = self._id_of_body(START)
            is_box = model.site_type[site] == mujoco.mjtGeom.mjGEOM_BOX
            self._unless(is_box, f'the site `{START}` with type="box"')
            turn = self._data.site_xmat[site].reshape(3, 3)[:2, :2]
            self._region, start = turn * model.site_size[site, :2], self._data.site_xpos[site, :2]
        site = self._id_of_body(GOAL)
        goal, radius = self._data.site_xpos[site, :2], float(model.site_size[site, 0])
        x, y = start.tolist()
        self._layout = OpenLayout(self._path.name, (x, y), (float(goal[0]), float(goal[1])), radius)
        away = math.dist(start, goal)
        self._unless(away > radius, f"a start outside the goal, not {away:.3g} m from its middle")

    def _id_of_body(self, name: str) -> int:
        site = self._model.site(name).id
        moves = self._model.body_weldid[self._model.site_bodyid[site]]
        self._unless(not moves, f"the site `{name}` on something that does not move")
        return site

    @property
    def effective_mass(self) -> np.ndarray:
        return self._mass

    def reset(
        self, seed: int, *, start: Sequence[float] | np.ndarray | None = None
    ) -> TipObservation:
        """Put the tip at rest where episodes begin, or its origin at `start` (x, y) m."""
        random = self._begin(seed)
        if start is not None:
            place = np.asarray(start, float)
            if not (place.shape == (2,) and np.isfinite(place).all() and self._place(place)):
                raise PalpateError(
                    f"the tip of {self._path} starts at (x, y) in m, where it can be and touches "
                    f"nothing, not at {start}"
                )
        elif not any(self._place(self._drawn_place(random)) for _ in range(DRAWS)):
            raise PalpateError(
                f"{self._path}: in {DRAWS} trials there was no place to start at: expected the tip "
                f"no more than {DENT:g} m in what it touches, and joints within their limits"
            )
        return self._start()

    def _drawn_place(self, random: np.random.Generator) -> np.ndarray | None:
        """(2,) m where an episode may begin; None: as the file has it."""
        layout = self._layout
        start, goal = np.array(layout.start), np.array(layout.goal)
        while self._scattered:
            place = start + random.uniform() * (goal - start) + SCATTER * random.standard_normal(2)
            if layout.distance(place) > layout.goal_radius:
                return place
        return None if self._region is None else start + self._region @ random.uniform(-1, 1, 2)

    def _place(self, place: np.ndarray | None) -> bool:
        """Everything as the file has it, and the tip at `place`; whether it may start there."""
        model, data = self._model, self._data
        if model.nkey:
            mujoco.mj_resetDataKeyframe(model, data, 0)
        else:
            mujoco.mj_resetData(model, data)
        self._refresh()
        short = np.zeros(2) if place is None else place - self._tip_place[:2]
        for _ in range(STEPS):
            if np.abs(short).max() < NEAREST:
                break
            step = np.linalg.lstsq(self._jacobian[:2], short)[0]
            mujoco.mj_integratePos(model, data.qpos, step, 1.0)
            self._refresh()
            short = np.asarray(place) - self._tip_place[:2]
        else:
            return False
        mujoco.mj_forward(model, data)
        contact, limits = data.contact, data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
        own = self._own[contact.geom] & (contact.geom >= 0)  # negative: of something flexible
        inside = own.any(axis=1) & (contact.dist < -DENT)
        return not inside.any() and not (limits & (data.efc_pos < -DENT)).any()

    def _refresh(self) -> None:
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacBody(model, data, self._jacobian, None, self._tip)

    def _advance(self, x: float, y: float, z: float) -> float:
        model, data, felt = self._model, self._data, self._felt
        force, peak = np.array([x, y, z]), 0.0
        for _ in range(self._substeps):
            data.qfrc_applied[:] = force @ self._jacobian
            mujoco.mj_step(model, data)
            self._refresh()
            peak = max(peak, felt.item(0) ** 2 + felt.item(1) ** 2 + felt.item(2) ** 2)
        return peak

    def _motion(self) -> tuple[np.ndarray, np.ndarray]:
        return self._tip_place.copy(), self._jacobian @ self._data.qvel

    def _speed(self) -> float:
        velocity, all_of_them = self._jacobian @ self._data.qvel, self._data.qvel
        return float(velocity @ velocity + 0.0 * (all_of_them @ all_of_them))

    def truth(self) -> OpenTruth:
        self._check_ready("has a truth")
        position, velocity = self._motion()
        return OpenTruth(
            self._count * self._period, position, velocity, -self._felt[:3], self._peak,
            self._fault, self._layout,
        )  # fmt: skip

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(y, x) m: how high it is at these places, without what moves the tip; nan where nothing
        is. For pictures."""
        model, top = copy.copy(self._model), self._tip
        while model.body_weldid[model.body_parentid[top]]:
            top = model.body_parentid[top]
        model.geom_group[:] = _bodies_on(model, top)[model.geom_bodyid]
        # All rays begin in one point, so high above that they are parallel.
        low = model.stat.center[2]
        above = np.array([np.mean(x), np.mean(y), low + FAR * model.stat.extent])
        rays = np.array([(one, other, low) for other in y for one in x]) - above
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        far, met, group = np.zeros(len(rays)), np.zeros(len(rays), np.int32), np.zeros(6, np.uint8)
        group[0] = 1
        mujoco.mj_multiRay(
            model, self._data, above, rays.ravel(), group, True, -1, met, far, None, len(rays),
            mujoco.mjMAXVAL,
        )  # fmt: skip
        found = np.where(far < 0, np.nan, above[2] + far * rays[:, 2])
        return found.reshape(len(y), len(x)).astype(np.float32)


def _bodies_on(model: mujoco.MjModel, body: int) -> np.ndarray:
    """(bodies,) bool: it, and all that it carries."""
    found = np.zeros(model.nbody, bool)
    found[body] = True
    for number in range(body + 1, model.nbody):
        found[number] |= found[model.body_parentid[number]]
    return found
