"""The map as a plan leaves it part of the way, and the steps that lead on from there."""

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy import ndimage

from palpate.numerics.polygons import length_of
from palpate.planning.movable_obstacles.maps.map import Pose
from palpate.planning.movable_obstacles.maps.occupancy import Space, Window
from palpate.planning.movable_obstacles.search.paths import allowed_at, distances, links
from palpate.planning.movable_obstacles.search.plan import TRANSFER, TRANSIT, Segment
from palpate.planning.movable_obstacles.search.transfers import Opening


@dataclass
class Progress:
    """The map as it is simulated so far, and the robot on it."""

    space: Space
    robot: np.ndarray
    segments: list[Segment] = field(default_factory=list)


def at_hand(now: Progress) -> set[str]:
    """The objects that the robot can drive up to."""
    space = now.space
    labels, _ = ndimage.label(space.free, np.ones((3, 3), int))
    allowed = allowed_at(space, now.robot, beside(now), standing=True)
    joined = links(space, whole(space), now.robot, space.free, allowed)
    own = {int(labels.ravel()[node]) for node, _ in joined}
    found = set()
    for name, cover in space.covers.items():
        window = tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in cover.window)
        if own & set(np.unique(labels[window]).tolist()):
            found.add(name)
    return found


def beside(now: Progress) -> dict[str, float]:
    """The object that was let go last is as near as the robot held it."""
    last = now.segments[-1].name if now.segments else None
    world = now.space.map
    return {} if last is None else {last: world.robot.radius + world.reach}


def carry_out(ahead: Progress, opening: Opening) -> Progress:
    """The situation after an opening."""
    poses, bodies = opening.robot_poses, opening.object_poses
    way = with_headings(opening.way, ahead.robot[2], poses[0, 2])
    transit = Segment(TRANSIT, way, opening.approach)
    transfer = Segment(
        TRANSFER,
        poses,
        opening.cost - opening.approach,
        opening.name,
        opening.grasp,
        bodies,
        tuple(part.primitive.name for part in opening.parts),
        opening.probability,
        opening.energy,
    )
    space = ahead.space.moved(opening.name, bodies[-1])
    return Progress(space, poses[-1], [*ahead.segments, transit, transfer])


def drive_to(ahead: Progress, goal: Pose) -> Progress | None:
    """The last stretch; None if the goal cannot be got to."""
    point = np.array(goal[:2])
    space = ahead.space
    reached = distances(space, whole(space), ahead.robot, nearby=beside(ahead), standing=True)
    way = reached.path_to(point)
    if way is None:
        return None
    poses = with_headings(way, float(ahead.robot[2]), goal[2])
    segment = Segment(TRANSIT, poses, length_of(way))
    return Progress(space, np.array(goal), [*ahead.segments, segment])


def with_headings(way: np.ndarray, first: float, last: float) -> np.ndarray:
    """Poses (2 points, 3) along a way (points, 2): turned before each straight and at the end."""
    poses = [(way[0, 0], way[0, 1], first)]
    for here, there in pairwise(way):
        if np.linalg.norm(there - here) < 1e-9:
            continue
        angle = math.atan2(there[1] - here[1], there[0] - here[0])
        poses += [(here[0], here[1], angle), (there[0], there[1], angle)]
    poses.append((way[-1, 0], way[-1, 1], last))
    return np.array(poses)


def whole(space: Space) -> Window:
    return slice(0, space.shape[0]), slice(0, space.shape[1])
