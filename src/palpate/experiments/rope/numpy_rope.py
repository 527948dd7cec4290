"""A rope that shares no physics with palpate: point masses on springs, in plain NumPy.

It stands for a user's own rope, which is neither the model that is identified nor the MuJoCo cable
that policies are tried in. With nodes x_i, segments of length h and E I the bending stiffness,

    m x_i'' = m g + stretching + bending + drag
    stretching   k (|e_i| - h) + c e_i' along each edge e_i = x_i+1 - x_i
    bending      of the energy E I / (2 h^3) sum |x_i-1 - 2 x_i + x_i+1|^2, and a dashpot like it
    drag         of the air, linear and quadratic in the speed of a node

Bending and linear drag are linear, and implicit in the step; the rest is symplectic Euler's. The
gripper is a pivot that follows commands within its limits of speed and acceleration, and a lag.
"""

import math
from typing import Any

import numpy as np

from palpate.errors import PalpateError
from palpate.recordings import Channel, Recording, Role, Trial
from palpate.worlds.excitation import excitation, record
from palpate.worlds.rope.configuration import in_step
from palpate.worlds.rope.rope import (
    GRIPPER_START,
    RopeConfiguration,
    RopeObservation,
    RopeTruth,
)
from palpate.worlds.rope.starts import shake_commands, start_tangents
from palpate.worlds.world import DivergedError, World

LAG = 0.01  # s, with which the gripper follows
STRETCHED = 0.005  # of its length, by which the rope's weight stretches the first segment
DAMPED = 0.1  # of critical, a node on the spring of its segment
PHASE = 0.8  # of the fastest spring in a time step, rad
TOO_FAST = 1e3  # m/s

# What ropes are drawn from, and how they are seen.
LENGTH, DENSITY = (0.5, 1.5), (0.05, 0.15)  # m, kg/m
BENDING, BEND_DAMPING, AIR = (3e-5, 3e-4), (3e-5, 1.5e-4), (1.5e-3, 6e-3)  # N m^2; N m^2 s; Pa s
NODES = 32  # of a simulated rope, about
NOISE = 2e-3  # m, of a marker's coordinate
LOST, LONGEST_GAP = 0.01, 8  # of the positions that begin a gap; frames


class NumpyRope(World):
    """See the module; the constants are those of a MuJoCo rope, of as many `bodies` as segments.

    Markers lie on nodes: `bodies` is a multiple of `markers` - 1.
    """

    def __init__(self, configuration: RopeConfiguration):
        self.configuration = configuration
        count, length = configuration.bodies, configuration.length
        self._edge = length / count
        self._every = count // (configuration.markers - 1)
        self._mass = np.full(count + 1, configuration.mass / count)
        self._mass[[0, -1]] /= 2
        self._mass[-1] += configuration.tip_mass
        self._weight = configuration.gravity * self._mass
        self._spring = self._weight.sum() / (STRETCHED * self._edge)
        fastest = 2 * math.sqrt(self._spring / self._mass[1:-1].min())
        self._steps = math.ceil(configuration.control_period * fastest / PHASE)
        self._step = configuration.control_period / self._steps
        self._dashpot = DAMPED * 2 * math.sqrt(self._spring * self._mass[1])
        second = np.diff(np.eye(count + 1), n=2, axis=0)  # x_i-1 - 2 x_i + x_i+1
        curved = second.T @ second
        self._bending = configuration.bending_stiffness / self._edge**3 * curved
        drag, self._quadratic = configuration.sideways_drag()
        damping = configuration.joint_damping / self._edge**2 * curved + drag * np.eye(count + 1)
        implicit = np.diag(self._mass) + self._step * (damping + self._step * self._bending)
        implicit[0] = np.eye(count + 1)[0]  # the gripper's velocity is given
        self._solve = np.linalg.inv(implicit)
        below = np.cumsum(self._weight[::-1])[::-1][1:]
        self._hanging = np.zeros((count + 1, 3))
        self._hanging[1:, 2] = -np.cumsum(self._edge + below / self._spring)
        self._rest = self._potential(self._hanging)
        self._random = np.random.default_rng(0)  # reset brings its own
        self._time = 0.0

    @property
    def control_period(self) -> float:
        return self.configuration.control_period

    def reset(self, seed: int, start: str = "hanging") -> RopeObservation:
        """The gripper at rest, the rope lying as a `RopeWorld` of this start does."""
        self._random = np.random.default_rng(seed)
        azimuth = self._random.uniform(0, 2 * np.pi)
        cosine, sine = math.cos(azimuth), math.sin(azimuth)
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        shaken = start == "shaken"
        self._position = self._hanging.copy()
        if start not in ("hanging", "shaken"):
            edges = self._edge * start_tangents(start, self.configuration.bodies) @ turn.T
            self._position[1:] = np.cumsum(edges, axis=0)
        self._position = self._position + GRIPPER_START
        self._velocity = np.zeros_like(self._position)
        self._command = np.zeros(3)
        if shaken:
            for command in shake_commands(self.control_period) @ turn.T:
                self._advance(command)
            self._velocity[0] = self._command[:] = 0
        self._time = 0.0
        return self._measure()

    def step(self, action: Any) -> RopeObservation:
        """Command the gripper's velocity (3,) m/s for one control period."""
        self._advance(np.asarray(action, float))
        self._time += self.control_period
        return self._measure()

    def truth(self) -> RopeTruth:
        moving = 0.5 * float(self._mass[1:] @ (self._velocity[1:] ** 2).sum(-1))
        energy = moving + self._potential(self._position - self._position[0]) - self._rest
        gripper, velocity = self._position[0].copy(), self._velocity[0].copy()
        return RopeTruth(self._time, self._position.copy(), self._velocity.copy(), energy,
                         gripper, velocity, self.configuration)  # fmt: skip

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        """See `World.render`: there is none, which is said with a `PalpateError`."""
        raise PalpateError("a NumPy rope has no picture: its markers can be drawn")

    def _advance(self, command: np.ndarray) -> None:
        step, limits = self._step, self.configuration
        position, velocity, edge = self._position, self._velocity, self._edge
        command = _shorten(command, limits.speed_limit)
        for _ in range(self._steps):
            change = _shorten(command - self._command, limits.acceleration_limit * step)
            self._command = self._command + change
            along = np.diff(position, axis=0)
            size = np.sqrt((along * along).sum(1))[:, None]
            along /= size
            rate = (np.diff(velocity, axis=0) * along).sum(1)[:, None]
            tension = (self._spring * (size - edge) + self._dashpot * rate) * along
            force = -self._bending @ position
            force[:-1] += tension
            force[1:] -= tension
            force[:, 2] -= self._weight
            speed = np.sqrt((velocity * velocity).sum(1))[:, None]
            force -= self._quadratic * speed * velocity
            momentum = self._mass[:, None] * velocity + step * force
            momentum[0] = velocity[0] + step / LAG * (self._command - velocity[0])
            velocity = self._solve @ momentum
            position = position + step * velocity
        self._position, self._velocity = position, velocity
        if not np.abs(velocity).max() < TOO_FAST:
            raise DivergedError(f"the NumPy rope diverged at {self._time:.3f} s")

    def _potential(self, position: np.ndarray) -> float:
        """Of weight, stretching and bending about the gripper, J; `position` relative to it, m."""
        stretched = np.linalg.norm(np.diff(position, axis=0), axis=1) - self._edge
        bent = 0.5 * np.sum(position * (self._bending @ position))
        return float(
            self._weight @ position[:, 2] + 0.5 * self._spring * stretched @ stretched + bent
        )

    def _measure(self) -> RopeObservation:
        markers = self._position[:: self._every]
        noise = self.configuration.observation_noise * self._random.standard_normal(markers.shape)
        return RopeObservation(
            time=self._time,
            markers=markers + noise,
            gripper_position=self._position[0].copy(),
            gripper_velocity=self._velocity[0].copy(),
            grip_force=np.full(3, np.nan),
        )


def draw_rope(seed: int, markers: int, rate: float) -> RopeConfiguration:
    """A rope as `NumpyRope` takes it, drawn by the seed."""
    random = np.random.default_rng(seed)
    length = float(random.uniform(*LENGTH))
    mass = length * float(random.uniform(*DENSITY))
    bending, damping, air = (
        float(np.exp(random.uniform(*np.log(bounds)))) for bounds in (BENDING, BEND_DAMPING, AIR)
    )
    bodies = (markers - 1) * max(1, round(NODES / (markers - 1)))
    return in_step(
        1 / rate, length=length, mass=mass, bodies=bodies, markers=markers,
        bending_stiffness=bending, joint_damping=damping * bodies / length, air_viscosity=air,
        observation_noise=NOISE,
    )  # fmt: skip


def record_rope(rope: RopeConfiguration, seed: int, trials: int, duration: float) -> Recording:
    """Markers alone, of a rope whose held end is shaken by hand; some are lost for a while."""
    world, random, kept = NumpyRope(rope), np.random.default_rng((seed, 1)), []
    for number in range(trials):
        own = 1000 * seed + number
        limits = rope.speed_limit, rope.acceleration_limit
        motion = excitation(own, duration, rope.control_period, *limits)
        seen = record(world, motion, own)
        markers = seen["markers"]
        for frame, marker in np.argwhere(random.random(markers.shape[:2]) < LOST):
            markers[frame : frame + random.integers(1, LONGEST_GAP), marker] = np.nan
        channel = Channel("markers", Role.OBSERVATION, seen["time"], markers, "m")
        kept.append(Trial(f"motion {number}", {"markers": channel}))
    return Recording(tuple(kept), {"source": f"a NumPy rope, seed {seed}"})


def ranges() -> dict[str, Any]:
    """What is drawn from, for files."""
    return {"length": LENGTH, "density": DENSITY, "bending": BENDING, "air": AIR, "noise": NOISE,
            "bend_damping": BEND_DAMPING, "lost": LOST}  # fmt: skip


def _shorten(vector: np.ndarray, limit: float) -> np.ndarray:
    size = math.sqrt(vector @ vector)
    return vector if size <= limit else vector * (limit / size)
