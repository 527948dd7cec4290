"""A compliant tip in a maze that it cannot see, felt through a force-torque sensor alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from palpate.errors import PalpateError
from palpate.worlds.maze.layout import TIP_RADIUS, Layout, find_layout
from palpate.worlds.maze.rollout import STATE, MazeRollout, Springs
from palpate.worlds.maze.scene import (
    BASE_MASS,
    BLOCK,
    FEELER,
    SWAY_AXIS,
    TIME_STEP,
    TIP,
    TIP_MASS,
    contact_solref,
    maze_scene,
)
from palpate.worlds.maze.tip import TipObservation, TipWorld, not_negative, wrench_of
from palpate.worlds.world import Meter, Spring, World

# What the robot may do. With 300 N/m a spring stretched by the displacement limit pulls 9 N, less
# than any obstacle resists; with 1000 N/m 30 N, more than the force limit.
FORCE_LIMIT = 26.0  # N, of the horizontal contact force on the tip; more is a violation
DISPLACEMENT_LIMIT = 0.03  # m from where the tip is to where a decision sends it
STIFFNESS_RANGE = (50.0, 1000.0)  # N/m

OBSTACLE_FRICTION = (13.0, 17.0)  # N, dry: what it takes to move the block
OBSTACLE_MASS = (0.5, 1.5)  # kg
CONTACT_FRICTION = (0.2, 0.4)  # coefficient, of the tip on walls and block
BEFORE_BLOCK = 0.4  # share of scattered episodes that begin there: hardly one would by chance

SWAY = 0.043  # m, amplitude of the base's motion along `SWAY_AXIS`: 4 cm in y, 1.5 cm in x
SWAY_FREQUENCY = (0.9, 1.1)  # Hz
SERVO = 100.0  # rad/s, of the base that follows the sway, critically damped


class TipTruth(NamedTuple):
    """The hidden state and constants, for judges and tests alone. World frame."""

    time: float  # s since reset
    position: np.ndarray  # (3,) m
    velocity: np.ndarray  # (3,) m/s
    force: np.ndarray  # (3,) N, net contact force on the tip, at the end of the control period
    peak_force: float  # N, the greatest horizontal one in the last control period
    sway: float  # m: where the base is on `SWAY_AXIS`
    obstacle: float  # m by which the block has been pushed
    fault: bool  # whether the last command was not finite, and so no force was given
    layout: Layout
    obstacle_friction: float  # N
    obstacle_mass: float  # kg
    contact_friction: float


class BlindMaze(TipWorld):
    """A tip of 1 kg in a maze, driven by a force (3,) N that acts between it and the robot's base.

    The base sways askew like a mobile one on soft tyres, with an amplitude of `sway` m, a
    frequency about 1 Hz and a random phase; position and velocity are seen relative to it. The tip
    keeps its height by itself and gravity is compensated. `layouts` names mazes, one of which is
    drawn at each reset; `scattered` lets episodes begin all along the way to the goal, many of them
    right before the block and half with the block pushed already, so that all can be found out;
    `control_period` is a whole number of milliseconds, in s. All else is as `TipWorld` has it.

    Raises `PalpateError` for an unknown maze, and as `TipWorld`.
    """

    def __init__(
        self,
        layouts: Sequence[str | Layout] = ("home",),
        *,
        sway: float = SWAY,
        noise: float = 1.0,
        scattered: bool = False,
        control_period: float = TIME_STEP,
    ):
        self._layouts = tuple(map(_layout, layouts))
        if not self._layouts:
            raise PalpateError("a maze world needs at least one layout")
        super().__init__(noise, control_period, TIME_STEP)
        self._sway_amplitude, self._scattered = not_negative("sway", sway), scattered
        self._models: dict[Layout, tuple[mujoco.MjModel, mujoco.MjData]] = {}

    @property
    def effective_mass(self) -> float:
        return TIP_MASS

    def reset(
        self,
        seed: int,
        *,
        layout: str | Layout | None = None,
        start: Sequence[float] | np.ndarray | None = None,
        obstacle_friction: float | None = None,
        contact_friction: float | None = None,
    ) -> TipObservation:
        """Put the tip at rest on the base, where episodes begin or at `start` (x, y) m, world.

        What is None is drawn by the seed: the maze among those of the world, the block's dry
        friction (N) and the tip's coefficient of friction; the block's mass is always drawn.
        """
        random = self._begin(seed)
        drawn = self._layouts[random.integers(len(self._layouts))]
        place = random.uniform(-1, 1, 2)
        friction, touch = random.uniform(*OBSTACLE_FRICTION), random.uniform(*CONTACT_FRICTION)
        self._obstacle_mass = random.uniform(*OBSTACLE_MASS)
        self._rate = 2 * math.pi * random.uniform(*SWAY_FREQUENCY)
        self._phase = random.uniform(0, 2 * math.pi)
        if layout is not None:
            drawn = _layout(layout)
        pushed = 0.0
        if start is None and self._scattered:
            pushed = drawn.obstacle.travel * max(0.0, random.uniform(-1, 1))
            before = random.uniform() < BEFORE_BLOCK
            place = (drawn.place_before_block if before else drawn.drawn_place)(random, pushed)
        elif start is None:
            place = drawn.start + place * drawn.start_half_sizes
        else:
            place = np.asarray(start, float)
            if place.shape != (2,) or not drawn.clearance(place) >= TIP_RADIUS:
                raise PalpateError(
                    f"a tip starts at (x, y) in m, at least {TIP_RADIUS} from every wall of maze "
                    f"'{drawn.name}', not at {start}"
                )
        self._layout = drawn
        self._obstacle_friction = not_negative(
            "obstacle's friction", friction if obstacle_friction is None else obstacle_friction
        )
        self._contact_friction = not_negative(
            "contact's friction", touch if contact_friction is None else contact_friction
        )
        self._place(place, pushed)
        return self._start()

    def _place(self, place: np.ndarray, pushed: float) -> None:
        """A maze's engine with the constants of this episode, the tip at rest on its base."""
        if self._layout not in self._models:
            model = self._compile(self._layout)
            self._models[self._layout] = (model, mujoco.MjData(model))
        model, data = self._model, self._data = self._models[self._layout]
        tip, block = model.body(TIP).id, model.body(BLOCK).id
        model.body_mass[block] = self._obstacle_mass
        mujoco.mj_setConst(model, data)
        mujoco.mj_resetData(model, data)
        inverse_mass = model.body_invweight0[tip, 0] + model.body_invweight0[block, 0]
        model.pair_solref[model.pair(BLOCK).id] = contact_solref(inverse_mass)
        model.pair_friction[:, :2] = self._contact_friction
        model.dof_frictionloss[-1] = self._obstacle_friction
        self._position, self._velocity = data.qpos, data.qvel
        self._applied, self._felt = data.qfrc_applied, data.sensor(FEELER).data
        self._constraint, self._tip_place = data.qfrc_constraint, data.xpos[tip]
        if self._rolls_out:
            self._springs = Springs(model)
        offset, data.qvel[0], _ = self._sway(0.0)
        data.qpos[0], data.qpos[-1] = offset, pushed
        self._seat(*(place - np.multiply(offset, SWAY_AXIS)).tolist())
        mujoco.mj_forward(model, data)
        self._work = 0.0

    # --- what another carrier of the tip does in a way of its own -----------------------------

    _carried = TIP_MASS  # kg on the base
    _view = (0.0, 0.0, 0.0), 0.75, 90.0, -80.0

    def _compile(self, layout: Layout) -> mujoco.MjModel:
        return maze_scene(layout).compile()

    def _seat(self, x: float, y: float) -> None:
        """Put the tip at (x, y) m relative to the base, at rest."""
        self._position[1:3] = x, y

    def _advance(self, x: float, y: float, z: float) -> float:
        model, data, constraint = self._model, self._data, self._constraint
        self._applied[1:4] = x, y, z
        peak = 0.0
        for _ in range(self._substeps):
            self._applied[0] = sways = self._swaying_force()
            before = self._velocity.item(0)
            mujoco.mj_step(model, data)
            # By the mean of both velocities, as the engine's step gives it to the kinetic energy.
            self._work += 0.5 * TIME_STEP * sways * (before + self._velocity.item(0))
            peak = max(peak, constraint.item(1) ** 2 + constraint.item(2) ** 2)
        return peak

    def _motion(self) -> tuple[np.ndarray, np.ndarray]:
        return self._position[1:4].copy(), self._velocity[1:4].copy()

    def _force(self) -> np.ndarray:
        """(3,) N: net contact force on the tip, in world axes."""
        return self._constraint[1:4].copy()

    # -------------------------------------------------------------------------------------------

    def _sway(self, time: Any) -> tuple[Any, Any, Any]:
        """Where the base should be, m, how fast, m/s, and its acceleration, m/s^2: at a time in s,
        or at many."""
        xp: Any = math if isinstance(time, float) else np
        amplitude, rate = self._sway_amplitude, self._rate
        angle = rate * time + self._phase
        offset = amplitude * xp.sin(angle)
        return offset, amplitude * rate * xp.cos(angle), -rate * rate * offset

    def _swaying_force(self) -> float:
        """N: what the base's servo gives in the next millisecond."""
        offset, speed, acceleration = self._sway(self._data.time)
        return (BASE_MASS + self._carried) * (
            acceleration
            + 2 * SERVO * (speed - self._velocity.item(0))
            + SERVO * SERVO * (offset - self._position.item(0))
        )

    def _speed(self) -> float:
        return float(self._velocity @ self._velocity)

    # --- how it is held by a spring for many control periods, see `MazeRollout` -----------------

    _rolls_out = True

    def rollout(self, worlds: Sequence[World]) -> MazeRollout | None:
        """See `World.rollout`."""
        mazes = [world for world in worlds if isinstance(world, BlindMaze)]
        able = all(maze._rolls_out and maze._substeps == 1 for maze in mazes)
        return MazeRollout(mazes) if able and len(mazes) == len(worlds) else None

    def engine(self) -> mujoco.MjModel:
        """See `RolledOut`."""
        self._check_ready("has an engine")
        return self._model

    def full_state(self) -> np.ndarray:
        """See `RolledOut`."""
        state = np.empty(mujoco.mj_stateSize(self._model, STATE))
        mujoco.mj_getState(self._model, self._data, state, STATE)
        return state

    def begin_hold(self, spring: Spring, periods: int) -> tuple[np.ndarray, np.ndarray]:
        """See `RolledOut`."""
        noise = self._following_noise(periods)
        seen = np.concatenate([self._shown_noise[None], noise[:-1]])[:, 6:8]
        weight = BASE_MASS + self._carried
        servo = weight * SERVO * SERVO, weight * 2 * SERVO
        self._springs.switch_on(spring.stiffness, spring.damping, servo)
        forces = np.zeros((periods, self._model.nv))
        times = self._data.time + TIME_STEP * np.arange(periods)
        offset, speed, acceleration = self._sway(times)
        forces[:, 0] = weight * acceleration + servo[0] * offset + servo[1] * speed
        forces[:, 1:3] = (spring.target - seen) @ spring.stiffness
        return forces, noise

    def end_hold(self) -> None:
        """See `RolledOut`."""
        self._springs.switch_off()

    def take(
        self, periods: int, before: np.ndarray, state: np.ndarray, felt: np.ndarray, peak: float,
        noise: np.ndarray,
    ) -> TipObservation:  # fmt: skip
        """See `RolledOut`."""
        data = self._data
        mujoco.mj_setState(self._model, data, state, STATE)
        self._felt[:], self._constraint[1:4] = felt, -felt[:3]
        base, x, y, z = before[1:5].tolist()
        self._tip_place[:] = x + base * SWAY_AXIS[0], y + base * SWAY_AXIS[1], z
        self._count, self._peak, self._fault = self._count + periods, peak, False
        self._shown_noise = noise
        wrench, position = wrench_of(self._felt, self._tip_place), self._position[1:4].copy()
        self._place_before = position
        return TipObservation(
            self._count * self._period, wrench + noise[:6], position + noise[6:],
            self._velocity[1:4].copy(), position - before[2:5],
        )  # fmt: skip

    # -------------------------------------------------------------------------------------------

    def meter(self) -> Meter:
        """See `World.meter`: of stepped worlds; outside is the servo that moves the base."""
        self._check_ready("has a meter")
        mujoco.mj_energyPos(self._model, self._data)
        mujoco.mj_energyVel(self._model, self._data)
        return Meter(float(self._data.energy.sum()), self._work)

    def truth(self) -> TipTruth:
        self._check_ready("has a truth")
        sway, obstacle = self._position.item(0), self._position.item(-1)
        position, velocity = self._motion()
        position[:2] += np.multiply(sway, SWAY_AXIS)
        velocity[:2] += np.multiply(self._velocity[0], SWAY_AXIS)
        return TipTruth(
            self._count * self.control_period, position, velocity, self._force(),
            self._peak, sway, obstacle, self._fault,
            self._layout, self._obstacle_friction, self._obstacle_mass, self._contact_friction,
        )  # fmt: skip


def _layout(given: str | Layout) -> Layout:
    return given if isinstance(given, Layout) else find_layout(given)
