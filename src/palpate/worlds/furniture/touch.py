"""Which body a robot's force sensors have felt, from where things were seen to be."""

from collections.abc import Sequence

import numpy as np
import shapely
from shapely.ops import nearest_points

from palpate.numerics.polygons import place_points
from palpate.worlds.furniture.robot import GRIPPER_RADIUS, RobotObservation

TOUCHING = 0.03  # m between surfaces that may touch
WRIST_THRESHOLD = 3.0  # N: less on an empty gripper is its own inertia and noise
BASE_THRESHOLD = 20.0  # N: less is the noise of the estimate


def felt_wrenches(
    robot: RobotObservation,
    radius: float,
    poses: np.ndarray,
    outlines: Sequence[np.ndarray],
    walls: Sequence[np.ndarray],
) -> np.ndarray:
    """The wrenches (bodies, 3) N, N, N m that the robot exerts, about each body frame's origin.

    The wrist's wrench goes to the body that is held. An empty gripper's force, and the base's,
    go to the nearest body within 3 cm, at its nearest point, unless a wall is nearer still.
    `radius` (m) is the base's; `poses` (bodies, 3) m, m, rad are as seen.
    """
    wrenches = np.zeros_like(poses)
    gripper, base = robot.gripper_pose[:2], robot.base_pose[:2]
    if robot.holding is not None:
        _add(wrenches, poses, robot.holding, gripper, robot.wrist_wrench)
    touches = [(base, radius, robot.base_force, BASE_THRESHOLD)]
    if robot.holding is None:
        touches.append((gripper, GRIPPER_RADIUS, robot.wrist_wrench[:2], WRIST_THRESHOLD))
    for centre, size, force, threshold in touches:
        if np.hypot(*force) > threshold:
            body, point = _nearest(centre, size + TOUCHING, poses, outlines, walls)
            if body is not None:
                _add(wrenches, poses, body, point, np.array([*force, 0.0]))
    return wrenches


def _add(
    wrenches: np.ndarray, poses: np.ndarray, body: int, point: np.ndarray, wrench: np.ndarray
) -> None:
    lever = point - poses[body, :2]
    wrenches[body] += wrench
    wrenches[body, 2] += lever[0] * wrench[1] - lever[1] * wrench[0]


def _nearest(
    centre: np.ndarray,
    reach: float,
    poses: np.ndarray,
    outlines: Sequence[np.ndarray],
    walls: Sequence[np.ndarray],
) -> tuple[int | None, np.ndarray]:
    """The body nearest to `centre`, if nearer than `reach` and any wall, and where."""
    here = shapely.Point(centre)
    shapes = [shapely.Polygon(place_points(o, p)) for o, p in zip(outlines, poses, strict=True)]
    distances = [shape.distance(here) for shape in shapes]
    body = int(np.argmin(distances))
    wall = min((shapely.Polygon(wall).distance(here) for wall in walls), default=np.inf)
    if distances[body] > min(reach, wall):
        return None, centre
    nearest, _ = nearest_points(shapes[body], here)
    return body, shapely.get_coordinates(nearest)[0]
