"""Furniture on real wheels in a room: a MuJoCo scene that no model in palpate shares physics with.

Pieces of three dimensions stand on casters, fixed wheels, locked casters or feet, roll with dry
and viscous friction, slide by Coulomb's law, hang on hinges, and collide with walls and each
other. See `pieces` for the kinds and `scene` for how they are built.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np
import shapely
from numpy.typing import ArrayLike

from palpate.errors import PalpateError
from palpate.numerics.polygons import place_points
from palpate.worlds.furniture.bodies import Bodies
from palpate.worlds.furniture.pieces import (
    Piece,
    PieceKind,
    PieceParameters,
    draw_parameters,
    draw_swivels,
)
from palpate.worlds.furniture.robot import (
    Robot,
    RobotAction,
    RobotInScene,
    RobotObservation,
    RobotTruth,
    add_robot,
)
from palpate.worlds.furniture.scene import TIME_STEP, convex_parts, furniture_scene
from palpate.worlds.furniture.touch import felt_wrenches
from palpate.worlds.world import DivergedError, Drive, OffscreenCamera, World

CONTROL_PERIOD = 0.02  # s
STEPS_PER_PERIOD = round(CONTROL_PERIOD / TIME_STEP)
MOST_WRENCH = 1e4  # N and N m: more is a mistake
TIPPED = math.radians(20)
OVERLAP = 1e-4  # m^2 by which pieces may overlap at the start
SETTLING = 0.2  # s in which pieces sink into the floor before an episode begins


@dataclass(frozen=True)
class FurnitureSensors:
    """Standard deviations of white noise: of poses, and of a wrench relative and absolute."""

    position_noise: float = 1e-3  # m
    angle_noise: float = 2e-3  # rad
    wrench_noise: float = 0.01  # of each component
    force_noise: float = 0.2  # N
    torque_noise: float = 0.05  # N m

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < math.inf:
                raise PalpateError(f"a sensor's {name} is 0 or greater, not {value}")

    def measured(self, wrench: np.ndarray, relative: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """True wrenches (..., 3) with noise, from standard normal draws of their shape."""
        absolute = np.array([self.force_noise, self.force_noise, self.torque_noise])
        return wrench * (1 + self.wrench_noise * relative) + offset * absolute


@dataclass(frozen=True)
class FurnitureObservation:
    """What a tracker of poses and the handles' force sensors show."""

    time: float  # s since reset
    poses: np.ndarray  # (bodies, 3) m, m, rad, with noise; the angle counts full turns
    # (bodies, 3) N, N, N m: what was applied over the last control period, in world axes about
    # each body frame's origin, with noise; exactly 0 for a body whose handle nobody held. With a
    # robot it is what the robot's sensors felt (`palpate.worlds.furniture.touch`).
    wrench: np.ndarray
    robot: RobotObservation | None = None


@dataclass(frozen=True)
class FurnitureTruth:
    """The hidden state and constants, for experiments and tests alone."""

    time: float  # s since reset
    names: tuple[str, ...]
    kinds: tuple[PieceKind, ...]  # with outlines and the places of wheels
    parameters: tuple[PieceParameters, ...]
    poses: np.ndarray  # (bodies, 3) m, m, rad
    velocities: np.ndarray  # (bodies, 3) m/s, m/s, rad/s of the body frames' origins
    centres: np.ndarray  # (bodies, 2) m, centre of mass of everything, in the body frame
    inertias: np.ndarray  # (bodies,) kg m^2, about the vertical through the centre of mass
    # (bodies,) of (mounts, 2) m: where wheels and feet touch the floor, in the body frame
    wheel_places: tuple[np.ndarray, ...]
    anchors: np.ndarray  # (bodies, 2) m, world: what a hinge holds in place; NaN without one
    energy: float  # J, kinetic, of everything
    robot: RobotTruth | None = None


class _Running(NamedTuple):
    model: mujoco.MjModel
    data: mujoco.MjData
    bodies: Bodies
    robot: RobotInScene | None


class FurnitureWorld(World):
    """Furniture moved by ideal handles at its body frames' origins, or by a robot.

    Without a robot the action is a wrench (bodies, 3) in N, N, N m, in world axes about each body
    frame's origin, held for one control period; with one it is a `RobotAction`.

    Hidden constants that a piece does not bring are drawn by the seed of `reset`. `walls` are
    simple polygons (points, 2) in m. With a `drive` the forces of the servos of the robot's base
    (3,) N, N, N m are what that makes of them.

    Raises `PalpateError` for a scene without pieces, pieces that start inside one another or a
    wall, a malformed wall or action; and `DivergedError`, also when a piece tips over.
    """

    def __init__(
        self,
        pieces: Sequence[Piece],
        walls: Sequence[ArrayLike] = (),
        robot: Robot | None = None,
        sensors: FurnitureSensors | None = None,
        drive: Drive | None = None,
    ):
        if not pieces:
            raise PalpateError("a furniture world needs at least one piece")
        self._pieces = tuple(pieces)
        self._kinds = tuple(piece.made_as for piece in pieces)
        self._walls = [np.asarray(wall, float) for wall in walls]
        for wall in self._walls:
            convex_parts(wall)
        self._robot, self.drive = robot, drive
        self._sensors = sensors or FurnitureSensors()
        self._names = _distinct([kind.name for kind in self._kinds])
        self._camera: OffscreenCamera | None = None
        self._running: _Running | None = None

    @property
    def control_period(self) -> float:
        return CONTROL_PERIOD

    @property
    def names(self) -> tuple[str, ...]:
        """What each body is called: its kind, numbered from the second of a kind on."""
        return self._names

    @property
    def kinds(self) -> tuple[PieceKind, ...]:
        """What each body is like."""
        return self._kinds

    @property
    def starts(self) -> np.ndarray:
        """(bodies, 3) m, m, rad where the pieces stand at first."""
        return np.array([piece.pose for piece in self._pieces], float)

    @property
    def outlines(self) -> dict[str, np.ndarray]:
        """Each body's polygon (points, 2) in its body frame, m."""
        return {n: np.asarray(k.outline) for n, k in zip(self._names, self._kinds, strict=True)}

    @property
    def walls(self) -> tuple[np.ndarray, ...]:
        """Polygons (points, 2) in the world, m."""
        return tuple(self._walls)

    def reset(
        self, seed: int, episode: int = 0, poses: np.ndarray | None = None
    ) -> FurnitureObservation:
        """Put every piece at rest where it starts, casters at random angles.

        Args:
            seed: draws the hidden constants, which are the same in every episode.
            episode: with the seed draws where free casters point, and the noise.
            poses: (bodies, 3) m, m, rad to start from instead of the pieces' own.
        """
        for value, what in ((seed, "a seed"), (episode, "an episode")):
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
                raise PalpateError(f"{what} is a whole number, 0 or greater, not {value!r}")
        start = self.starts if poses is None else np.asarray(poses, float)
        if start.shape != (len(self._pieces), 3) or not np.isfinite(start).all():
            raise PalpateError(
                f"poses to start from are finite and of shape ({len(self._pieces)}, 3), "
                f"not {start.shape}"
            )
        self._refuse_overlaps(start)
        self._running = None  # not to be stepped on if this start fails
        # With the kind's name, or a heavy table would mean a heavy couch in a world of its own.
        self._parameters = tuple(
            piece.parameters
            or draw_parameters(kind, np.random.default_rng([seed, place, *kind.name.encode()]))
            for place, (piece, kind) in enumerate(zip(self._pieces, self._kinds, strict=True))
        )
        self._random = np.random.default_rng([seed, episode + 1])
        swivels = [
            draw_swivels(kind, parameters, self._random)
            for kind, parameters in zip(self._kinds, self._parameters, strict=True)
        ]
        pieces = self._names, self._kinds, self._parameters
        spec = furniture_scene(*pieces, swivels, start, self._walls)
        if self._robot:
            add_robot(spec, self._robot, self._names)
        model = spec.compile()
        data = mujoco.MjData(model)
        bodies = Bodies(model, data, self._names, self._kinds, start[:, 2])
        outlines = list(self.outlines.values())
        robot = self._robot and RobotInScene(model, data, self._robot, bodies, outlines, self.drive)
        mujoco.mj_step(model, data, round(SETTLING / TIME_STEP))
        self._running = _Running(model, data, bodies, robot)
        self._check()
        data.qvel[:] = 0
        data.time = 0.0
        self._step_count = 0
        return self._observe(np.zeros_like(start), None)

    def step(self, action: np.ndarray | RobotAction) -> FurnitureObservation:
        """Act for one control period: wrenches (bodies, 3) in N, N, N m, or the robot."""
        model, data, _, robot = self._now()
        if robot is None:
            wrench = self._wrenches(action)
            data.ctrl[: wrench.size] = wrench.ravel()
            mujoco.mj_step(model, data, STEPS_PER_PERIOD)
            felt = None
        else:
            if not isinstance(action, RobotAction):
                raise PalpateError(
                    f"a furniture world with a robot takes a RobotAction, not {type(action)}"
                )
            felt = robot.advance(action, CONTROL_PERIOD)
            wrench = np.zeros((len(self._pieces), 3))
        self._check()
        self._step_count += 1
        return self._observe(wrench, felt)

    def _wrenches(self, action: Any) -> np.ndarray:
        wrench = np.asarray(action if not isinstance(action, RobotAction) else np.nan, float)
        if wrench.shape != (len(self._pieces), 3) or not (np.abs(wrench) <= MOST_WRENCH).all():
            raise PalpateError(
                "a furniture world without a robot takes wrenches (N, N, N m) of shape "
                f"({len(self._pieces)}, 3), each at most {MOST_WRENCH:g}, not "
                f"{wrench.tolist() if wrench.size < 20 else wrench.shape}"
            )
        return wrench

    def truth(self) -> FurnitureTruth:
        model, data, bodies, robot = self._now()
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_energyVel(model, data)
        return FurnitureTruth(
            time=data.time,
            names=self._names,
            kinds=self._kinds,
            parameters=self._parameters,
            poses=bodies.poses(),
            velocities=bodies.velocities(),
            centres=bodies.centres(),
            inertias=bodies.inertias(),
            wheel_places=bodies.wheel_places(),
            anchors=bodies.anchors(self._parameters),
            energy=float(data.energy[1]),
            robot=robot and robot.truth(),
        )

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        model, data, bodies, _ = self._now()
        camera = self._camera
        if camera is None or (camera.model, camera.width, camera.height) != (model, width, height):
            self._camera = camera = OffscreenCamera(model, width, height)
        mujoco.mj_forward(model, data)
        corners = np.concatenate([*self._walls, bodies.poses()[:, :2]])
        view = mujoco.MjvCamera()
        view.lookat = [*(corners.min(0) + corners.max(0)) / 2, 0.3]
        view.distance = 2.5 + 1.1 * float(np.ptp(corners, axis=0).max())
        view.azimuth, view.elevation = 90, -50
        return camera.picture(data, view)

    def _now(self) -> _Running:
        if self._running is None:
            raise PalpateError("a furniture world runs after reset(seed), not before")
        return self._running

    def _refuse_overlaps(self, poses: np.ndarray) -> None:
        named = [
            (name, shapely.Polygon(place_points(outline, pose)))
            for (name, outline), pose in zip(self.outlines.items(), poses, strict=True)
        ]
        robot = self._robot
        if robot:
            named.append(("robot", shapely.Point(robot.pose[:2]).buffer(robot.radius)))
        movable = len(named)
        named += [(f"wall {i}", shapely.Polygon(wall)) for i, wall in enumerate(self._walls)]
        for number, (name, shape) in enumerate(named[:movable]):
            for other, obstacle in named[number + 1 :]:
                if shape.intersection(obstacle).area > OVERLAP:
                    raise PalpateError(
                        f"the {name} starts inside the {other}; move one of them away"
                    )

    def _check(self) -> None:
        _, data, bodies, _ = self._now()
        warnings = (mujoco.mjtWarning.mjWARN_BADQACC, mujoco.mjtWarning.mjWARN_BADQPOS)
        if any(data.warning[warning].number for warning in warnings):
            self._running = None
            raise DivergedError(
                f"the furniture's simulation diverged at {data.time:.3f} s; gentler actions, or "
                "pieces that start farther from each other, would work"
            )
        tilts = bodies.tilts()
        if tilts.min() < math.cos(TIPPED):
            self._running = None
            raise DivergedError(
                f"the {self._names[int(tilts.argmin())]} tipped over at {data.time:.3f} s; "
                "gentler actions would work"
            )

    def _observe(
        self, wrench: np.ndarray, felt: tuple[np.ndarray, np.ndarray] | None
    ) -> FurnitureObservation:
        sensors, random = self._sensors, self._random
        _, _, bodies, scene = self._now()
        poses, robot = bodies.poses(), None
        pose_noise = (sensors.position_noise, sensors.position_noise, sensors.angle_noise)
        relative, offset, drift = random.standard_normal((3, *wrench.shape))
        poses += drift * pose_noise
        if scene is None or self._robot is None:
            held = wrench.any(-1, keepdims=True)
            wrench = held * sensors.measured(wrench, relative, offset)
        else:
            wrist, base_force = felt or (np.zeros(3), np.zeros(2))
            wrist = sensors.measured(wrist, *random.standard_normal((2, 3)))
            robot = scene.observe(wrist, base_force, random, CONTROL_PERIOD)
            outlines = list(self.outlines.values())
            wrench = felt_wrenches(robot, self._robot.radius, poses, outlines, self._walls)
        time = self._step_count * CONTROL_PERIOD
        return FurnitureObservation(time, poses, wrench, robot)


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    """ "chair", "chair 2", "chair 3"."""
    return tuple(
        name if (count := names[: i + 1].count(name)) == 1 else f"{name} {count}"
        for i, name in enumerate(names)
    )
