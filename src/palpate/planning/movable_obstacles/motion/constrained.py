"""Planning with a belief of how objects move: the draws of a posterior, each with its constraint.

What comes of a motion of a hand that is driven by velocity and limited in force is, for a piece
that moves slowly, decided by the constraint and by what it takes to overcome friction: the object
follows where its wheels and anchors let it, and else stays where it is. Inertia is left out,
because a hand at a quarter of a metre a second has time to overcome it.
"""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from palpate.numerics.polygons import place_points, rotate
from palpate.planning.movable_obstacles.maps.map import Movable
from palpate.planning.movable_obstacles.motion.manipulation import (
    BACKWARD,
    FORWARD,
    LEFT,
    RIGHT,
    Grasp,
    ManipulationModel,
    Motion,
    Primitive,
    base_poses,
    carry,
    outline_grasps,
)
from palpate.planning.movable_obstacles.motion.primitives import (
    FACING,
    LEVER,
    Constraint,
    Turn,
    grasp_share,
    turns,
    twist,
)

YIELDING = 0.35  # of the hand's way may go against a constraint: the hand gives way that much
SPACING = 0.3  # m between grasps


@dataclass(frozen=True)
class Drawn:
    """What is believed of one object: a constraint for each draw, and the belief's version."""

    constraints: tuple[Constraint, ...]
    version: int = 0


class ConstrainedManipulation(ManipulationModel):
    """Draws of a belief by object name; `force` in N is the most that the hand exerts.

    Every object has as many draws. With one draw each it is a planner that knows, or thinks so.
    """

    def __init__(self, drawn: Mapping[str, Drawn], force: float) -> None:
        self.drawn = dict(drawn)
        self.force = force
        self.draws = len(next(iter(self.drawn.values())).constraints)
        self._turns: dict[tuple[str, int], list[Turn]] = {}

    def belief(self, name: str) -> Hashable:
        """The version of what is believed of it."""
        return self.drawn[name].version

    def grasps(self, movable: Movable, spacing: float) -> Sequence[Grasp]:
        """Points on the outline where any draw would hold it."""
        every = outline_grasps(movable.outline, max(spacing, SPACING))
        shares = [grasp_share(one, every) for one in set(self.drawn[movable.name].constraints)]
        total = np.sum(shares, axis=0)
        return [grasp for grasp, share in zip(every, total, strict=True) if share > 0]

    def primitives(self, movable: Movable, grasp: Grasp, drive: str) -> Sequence[Primitive]:
        """What moves it in any draw: straight if one is free or along an axis, and turns."""
        drawn = self.drawn[movable.name]
        key = movable.name, drawn.version
        if key not in self._turns:
            self._turns[key] = turns(drawn.constraints)
        if any(one.kind == "free" for one in drawn.constraints):
            return [BACKWARD, FORWARD, LEFT, RIGHT, *self._turns[key]]
        straight: list[Primitive] = []
        axes = [one.direction for one in drawn.constraints if one.kind == "axis"]
        across = np.abs(np.cos(grasp.normal - np.array(axes)))
        if (across > FACING).any():
            straight += [BACKWARD, FORWARD]
        if (np.sqrt(1 - across**2) > FACING).any():
            straight += [LEFT, RIGHT]
        turns_of = [t for t in self._turns[key] if math.dist(grasp.point, t.anchor) >= LEVER]
        return [*straight, *turns_of]

    def motion(
        self,
        movable: Movable,
        object_pose: np.ndarray,
        robot_pose: np.ndarray,
        primitive: Primitive,
        lengths: np.ndarray,
        draw: int,
    ) -> Motion:
        """See `ManipulationModel.motion`; the arm keeps its posture, so the base goes with it."""
        constraint = self.drawn[movable.name].constraints[draw]
        if isinstance(primitive, Turn):
            x, y = primitive.anchor
            wanted = primitive.turn * np.array([y, -x, 1.0])
            hand = place_points(np.array([primitive.anchor]), object_pose)[0] - robot_pose[:2]
            lever = float(np.hypot(*hand))
        else:
            step = base_poses(robot_pose, primitive, np.ones(1))[0] - robot_pose
            wanted, lever = np.array([*rotate(step[:2], -object_pose[2]), step[2]]), 0.0
        rate = twist(constraint, wanted, lever, YIELDING)
        if constraint.force > self.force:
            rate = np.zeros(3)
        objects = swept(object_pose, rate, lengths)
        # The robot keeps its place by the object, as the object keeps its place in the hand.
        robots = carry(robot_pose, object_pose, objects)
        return Motion(objects, robots, constraint.force * _way(objects, object_pose))


def swept(pose: np.ndarray, rate: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Poses (steps, 3) after a constant twist (3,) of the body frame for `lengths` (steps,)."""
    angle = rate[2] * lengths
    if rate[2]:
        along, across = np.sin(angle) / rate[2], (1 - np.cos(angle)) / rate[2]
    else:
        along, across = lengths, np.zeros_like(lengths)
    local = np.stack([rate[0] * along - rate[1] * across, rate[0] * across + rate[1] * along], -1)
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    world = local @ np.array([[cosine, sine], [-sine, cosine]])
    return np.concatenate([pose[:2] + world, (pose[2] + angle)[:, None]], axis=1)


def _way(poses: np.ndarray, start: np.ndarray) -> np.ndarray:
    """How far the centroid has gone at each step, m."""
    steps = np.diff(np.vstack([start, poses])[:, :2], axis=0)
    return np.cumsum(np.linalg.norm(steps, axis=1))
