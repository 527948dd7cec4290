"""What an object does when it is held and the base moves: the interface, and the rigid carry.

A grasp is a point on the object's outline; the robot stands before it, looking at it. A primitive
is a motion of the base in its own directions. A model of manipulation says what comes of it, once
for each draw of a belief: a search meets the same draws again, and a rollout can be repeated.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from palpate.numerics.polygons import place_points, rotate
from palpate.planning.movable_obstacles.maps.map import Movable, Pose

_SHORTEST_FACE = 0.5  # of the least distance between grasps
_MOST_GRASPS = 24


@dataclass(frozen=True)
class Grasp:
    """`point` (x, y) on the outline in the body frame, m, and the outward direction there, rad."""

    point: tuple[float, float]
    normal: float

    def robot_pose(self, pose: Pose | np.ndarray, standoff: float) -> np.ndarray:
        """The base's pose (3,) when the object is at `pose`; `standoff` from its centre, m."""
        (x, y), angle = (
            place_points(np.array([self.point]), np.asarray(pose))[0],
            self.normal + pose[2],
        )
        cos, sin = math.cos(angle), math.sin(angle)
        return np.array([x + standoff * cos, y + standoff * sin, math.atan2(-sin, -cos)])


@dataclass(frozen=True)
class Primitive:
    """A base motion: `forward` and `left` in m per m of its length, or `turn`, rad per rad."""

    name: str
    forward: float = 0.0
    left: float = 0.0
    turn: float = 0.0


FORWARD, BACKWARD = Primitive("push", forward=1.0), Primitive("pull", forward=-1.0)
TURN_LEFT, TURN_RIGHT = Primitive("turn left", turn=1.0), Primitive("turn right", turn=-1.0)
LEFT, RIGHT = Primitive("left", left=1.0), Primitive("right", left=-1.0)
PRIMITIVES = {
    "differential": (FORWARD, BACKWARD, TURN_LEFT, TURN_RIGHT),
    "holonomic": (FORWARD, BACKWARD, LEFT, RIGHT, TURN_LEFT, TURN_RIGHT),
}


@dataclass(frozen=True)
class Motion:
    """Poses (steps, 3) of object and robot at given lengths of a primitive; energy (steps,), J.

    Where the object holds the robot back, both stay where they are from then on.
    """

    object_poses: np.ndarray
    robot_poses: np.ndarray
    energy: np.ndarray


class ManipulationModel(ABC):
    """What a planner needs to know of objects' dynamics.

    `draws`: how many draws of the belief there are; one if it is certain. Draw k is the same world
    each time it is asked for, and objects' draws of one k belong together.
    """

    draws: int = 1

    def belief(self, name: str) -> Hashable:
        """Changes when what is believed of that object does: what was found out is then void."""
        return None

    def grasps(self, movable: Movable, spacing: float) -> Sequence[Grasp]:
        """Where it may be held, about `spacing` m apart."""
        return outline_grasps(movable.outline, spacing)

    @abstractmethod
    def primitives(self, movable: Movable, grasp: Grasp, drive: str) -> Sequence[Primitive]:
        """What is worth trying with that grasp on a "differential" or "holonomic" base."""

    @abstractmethod
    def motion(
        self,
        movable: Movable,
        object_pose: np.ndarray,
        robot_pose: np.ndarray,
        primitive: Primitive,
        lengths: np.ndarray,
        draw: int,
    ) -> Motion:
        """What happens from those poses (3,) on, at the ascending `lengths` (steps,), m or rad."""


class RigidCarry(ManipulationModel):
    """The object moves with the base as one body: namosim's assumption. Energy is not known: 0."""

    def primitives(self, movable: Movable, grasp: Grasp, drive: str) -> Sequence[Primitive]:
        """All that the base can do."""
        return PRIMITIVES[drive]

    def motion(
        self,
        movable: Movable,
        object_pose: np.ndarray,
        robot_pose: np.ndarray,
        primitive: Primitive,
        lengths: np.ndarray,
        draw: int,
    ) -> Motion:
        robot = base_poses(robot_pose, primitive, lengths)
        return Motion(carry(object_pose, robot_pose, robot), robot, np.zeros(len(lengths)))


def base_poses(pose: np.ndarray, primitive: Primitive, lengths: np.ndarray) -> np.ndarray:
    """Poses (steps, 3) of a base that starts at `pose` (3,) and follows a primitive."""
    step = [*rotate((primitive.forward, primitive.left), pose[2]), primitive.turn]
    return pose + lengths[:, None] * np.array(step)


def carry(object_pose: np.ndarray, robot_pose: np.ndarray, robot_poses: np.ndarray) -> np.ndarray:
    """The object's poses (steps, 3) if it keeps its place (3,) relative to the robot's (3,)."""
    relative = rotate(object_pose[:2] - robot_pose[:2], -robot_pose[2])[None]
    angles = object_pose[2] + robot_poses[:, 2:] - robot_pose[2]
    return np.concatenate([place_points(relative, robot_poses)[:, 0], angles], axis=1)


def outline_grasps(outline: np.ndarray, spacing: float) -> tuple[Grasp, ...]:
    """Points on the faces of an outline (points, 2), the middles of faces first.

    Faces shorter than half of `spacing` (m) are passed over unless there is no longer one.
    """
    ends = np.roll(outline, -1, axis=0)
    along = ends - outline
    lengths = np.linalg.norm(along, axis=1)
    faces = np.flatnonzero(lengths >= min(_SHORTEST_FACE * spacing, lengths.max()))
    found: list[tuple[float, Grasp]] = []
    for face in faces:
        normal = math.atan2(-along[face, 0], along[face, 1])  # outward: the outline runs leftwards
        count = max(1, 2 * round(lengths[face] / spacing / 2) - 1)
        for index in range(count):
            share = (index + 1) / (count + 1)
            x, y = outline[face] + share * along[face]
            found.append((abs(share - 0.5), Grasp((float(x), float(y)), normal)))
    found.sort(key=lambda item: item[0])
    return tuple(grasp for _, grasp in found[:_MOST_GRASPS])
