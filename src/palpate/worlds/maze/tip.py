"""What every tip that feels its way has in common, whatever carries it and wherever it is."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.signal import lfilter

from palpate.errors import PalpateError
from palpate.worlds.maze.scene import REFERENCE_HEIGHT
from palpate.worlds.world import DivergedError, OffscreenCamera, World

DRIVE_LIMIT = 100.0  # N: the drives give no more, whatever is commanded
FASTEST = 20.0  # m/s: a tip that is faster has left physics

# Ornstein-Uhlenbeck noise: standard deviation and correlation time, s, of each channel.
FORCE_NOISE, TORQUE_NOISE, WRENCH_CORRELATION = 0.3, 0.01, 0.1  # N, N m
POSITION_NOISE, POSITION_CORRELATION = 1e-3, 1.0  # m
BLOCK_OF_NOISE = 1000  # steps that are drawn at once
_NOISE = np.array([FORCE_NOISE] * 3 + [TORQUE_NOISE] * 3 + [POSITION_NOISE] * 3)


class TipObservation(NamedTuple):
    """What the robot's sensors show, in axes parallel to the world's."""

    time: float  # s since reset
    # (6,) N, N m with noise: net contact force on the tip, and its torque about the point
    # `REFERENCE_HEIGHT` above the tip.
    wrench: np.ndarray
    position: np.ndarray  # (3,) m with noise, of the tip relative to the robot's base
    velocity: np.ndarray  # (3,) m/s relative to the robot's base, of encoders: exact
    displacement: np.ndarray  # (3,) m since the observation before, like velocity


class TipWorld(World):
    """A tip that is driven by a force (3,) N, and shows wrench, position and velocity.

    `noise` scales the sensors' Ornstein-Uhlenbeck noise, 0 switches it off; `control_period` is a
    whole number of time steps (`time_step`), all in s.

    A command that is not finite is a fault of who commands: the drives give no force in that
    period. No more than `DRIVE_LIMIT` is ever given.

    Who inherits begins `reset` with `_begin` and ends it with `_start`. Raises `PalpateError` for
    values outside their range, and a malformed command.
    """

    _model: mujoco.MjModel
    _data: mujoco.MjData
    _felt: np.ndarray  # of the contact sensor: force (N), torque (N m) and place (m) of all
    _tip_place: np.ndarray  # (3,) m, world
    # Of the camera: what it looks at (m), how far away it is (m), azimuth and elevation (degrees).
    _view: tuple[tuple[float, float, float], float, float, float]

    def __init__(self, noise: float, control_period: float, time_step: float):
        self._noise_scale = not_negative("noise", noise)
        substeps = control_period / time_step
        if not (0.5 < substeps < 1e4 and abs(substeps - round(substeps)) < 1e-6):
            raise PalpateError(
                f"the control period is a whole number of {time_step:g} s, not {control_period}"
            )
        self._substeps, self._period = round(substeps), round(substeps) * time_step
        self._camera: OffscreenCamera | None = None
        self._ready = False

    @property
    def control_period(self) -> float:
        return self._period

    @property
    @abstractmethod
    def effective_mass(self) -> float | np.ndarray:
        """kg, or (2, 2) kg in x and y: what a force on the tip moves."""

    def _begin(self, seed: int) -> np.random.Generator:
        """What draws an episode."""
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise PalpateError(f"a seed is a whole number, 0 or greater, not {seed!r}")
        self._ready = False
        self._random = np.random.default_rng(seed)
        return self._random

    def _start(self) -> TipObservation:
        """The first observation of an episode, whose tip is in its place."""
        self._noise = self._shown_noise = np.zeros(9)
        self._drawn = BLOCK_OF_NOISE  # none are left
        if self._noise_scale:
            self._noise = self._random.standard_normal(9)
        self._count, self._peak, self._fault = 0, 0.0, False
        self._ready = True
        self._place_before = self._motion()[0]
        return self._observe()

    # --- what a carrier of the tip does in a way of its own -----------------------------------

    @abstractmethod
    def _advance(self, x: float, y: float, z: float) -> float:
        """Drive the tip by a force in N for a control period; the greatest contact force that
        counts, squared."""

    @abstractmethod
    def _motion(self) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) m and velocity (3,) m/s of the tip relative to the base."""

    @abstractmethod
    def _speed(self) -> float:
        """m/s, squared, of what may not be faster than `FASTEST`; nan where something diverged."""

    def _wrench(self) -> np.ndarray:
        """(6,) N, N m, as `TipObservation` has it, without noise."""
        return wrench_of(self._felt, self._tip_place) if self._data.ncon else np.zeros(6)

    # -------------------------------------------------------------------------------------------

    def step(self, action: np.ndarray) -> TipObservation:
        """Drive the tip with the force `action` (3,) N for one control period."""
        self._check_ready("runs")
        try:
            x, y, z = np.asarray(action, float).tolist()
            size = math.sqrt(x * x + y * y + z * z)
        except (TypeError, ValueError) as error:
            raise PalpateError(f"a tip takes a force (x, y, z) in N, not {action}") from error
        self._fault = not size < math.inf
        if self._fault:
            x = y = z = 0.0
        elif size > DRIVE_LIMIT:
            x, y, z = (value * DRIVE_LIMIT / size for value in (x, y, z))
        self._peak = math.sqrt(self._advance(x, y, z))
        self._count += 1
        if not self._speed() < FASTEST**2:
            self._ready = False
            raise DivergedError(
                f"the simulation diverged at {self._data.time:.3f} s; gentler forces would work"
            )
        return self._observe()

    def _check_ready(self, does: str) -> None:
        if not self._ready:
            raise PalpateError(f"a tip's world {does} after reset(seed), not before")

    def _observe(self) -> TipObservation:
        wrench, (position, velocity) = self._wrench(), self._motion()
        displacement = position - self._place_before
        self._place_before = position
        if self._noise_scale:
            noise = self._shown_noise = self._next_noise()
            wrench += noise[:6]
            position = position + noise[6:]
        time = self._count * self._period
        return TipObservation(time, wrench, position, velocity, displacement)

    def _next_noise(self) -> np.ndarray:
        """(9,) of the Ornstein-Uhlenbeck processes, sampled exactly at the control period."""
        if self._drawn == BLOCK_OF_NOISE:
            kicks = self._random.standard_normal((BLOCK_OF_NOISE, 9))
            self._block = np.empty_like(kicks)
            for part, correlation in (
                (slice(0, 6), WRENCH_CORRELATION),
                (slice(6, 9), POSITION_CORRELATION),
            ):
                keep = math.exp(-self._period / correlation)
                self._block[:, part] = lfilter(
                    [math.sqrt(1 - keep**2)], [1, -keep], kicks[:, part], axis=0,
                    zi=keep * self._noise[None, part],
                )[0]  # fmt: skip
            self._noise = self._block[-1].copy()
            self._block *= self._noise_scale * _NOISE
            self._drawn = 0
        self._drawn += 1
        return self._block[self._drawn - 1]

    def _following_noise(self, count: int) -> np.ndarray:
        """(count, 9) that the next observations will have."""
        if not self._noise_scale:
            return np.zeros((count, 9))
        found = np.empty((count, 9))
        done = 0
        while done < count:
            found[done] = self._next_noise()
            some = min(count - done - 1, BLOCK_OF_NOISE - self._drawn)
            found[done + 1 : done + 1 + some] = self._block[self._drawn : self._drawn + some]
            self._drawn += some
            done += 1 + some
        return found

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        self._check_ready("is drawn")
        mujoco.mj_kinematics(self._model, self._data)  # a step leaves the places before it
        mujoco.mj_camlight(self._model, self._data)
        camera = self._camera
        if camera is None or (camera.model, camera.width, camera.height) != (
            self._model, width, height,
        ):  # fmt: skip
            self._camera = camera = OffscreenCamera(self._model, width, height)
        view = mujoco.MjvCamera()
        view.lookat, view.distance, view.azimuth, view.elevation = self._view
        return camera.picture(self._data, view)


def wrench_of(felt: np.ndarray, tip_place: np.ndarray) -> np.ndarray:
    """(6,) N, N m on the tip, about the point `REFERENCE_HEIGHT` above it, `tip_place` (3,) m.

    The sensor `felt` (9,) tells the force, N, and the torque, N m, that the tip gives, and the
    place, m, that all its contacts act at together.
    """
    fx, fy, fz, tx, ty, tz, *point = felt.tolist()
    x, y, z = (a - b for a, b in zip(point, tip_place.tolist(), strict=True))
    z -= REFERENCE_HEIGHT
    return np.array(
        (-fx, -fy, -fz, z * fy - y * fz - tx, x * fz - z * fx - ty, y * fx - x * fy - tz)
    )


def not_negative(what: str, value: float) -> float:
    """The value; raises `PalpateError` for one that is negative or not finite."""
    if not 0 <= value < math.inf:
        raise PalpateError(f"the {what} is 0 or greater and finite, not {value}")
    return float(value)
