"""Furniture seen from above, drawn without OpenGL."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from palpate.errors import PalpateError
from palpate.worlds.furniture.pieces import placed
from palpate.worlds.furniture.robot import Robot, forward_kinematics
from palpate.worlds.furniture.scene import COLOURS


def draw_top_view(
    axes: Axes,
    outlines: Mapping[str, np.ndarray],
    poses: np.ndarray,
    walls: Sequence[np.ndarray] = (),
    footprints: Sequence[np.ndarray] = (),
) -> None:
    """Draw pieces by name with their forward directions, walls, and the robot, onto `axes` in m.

    Args:
        outlines: per body its polygon (points, 2) in the body frame.
        poses: (bodies, 3) m, m, rad.
        walls: polygons (points, 2), filled.
        footprints: of the robot: polygons or lines (points, 2) in the world.
    """
    if np.shape(poses) != (len(outlines), 3):
        raise PalpateError(
            f"a top view of {len(outlines)} outlines needs poses of shape ({len(outlines)}, 3), "
            f"not {np.shape(poses)}"
        )
    for wall in walls:
        axes.add_patch(Polygon(wall, facecolor="0.6", edgecolor="0.3"))
    for number, (name, outline) in enumerate(outlines.items()):
        pose, colour = poses[number], COLOURS[number % len(COLOURS)]
        axes.add_patch(Polygon(placed(outline, pose), facecolor=(*colour, 0.6), edgecolor="black"))
        forward = np.array([[0.0, 0.0], [0.6 * np.max(np.asarray(outline)[:, 0]), 0.0]])
        axes.plot(*placed(forward, pose).T, color="black", linewidth=1)
        axes.annotate(name, pose[:2], ha="center", va="bottom", fontsize="small")
    for footprint in footprints:
        axes.plot(*np.asarray(footprint).T, color="black", linewidth=2)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xlabel("x in m")
    axes.set_ylabel("y in m")


def robot_footprints(
    robot: Robot, base_pose: np.ndarray, joint_angles: np.ndarray
) -> list[np.ndarray]:
    """The base's circle, its heading and the arm as lines (points, 2) in the world, m."""
    angles = np.linspace(0, 2 * np.pi, 49)
    circle = robot.radius * np.stack([np.cos(angles), np.sin(angles)], -1)
    heading = np.array([[0.5 * robot.radius, 0.0], [robot.radius, 0.0]])
    arm = forward_kinematics(base_pose, joint_angles, robot.links)
    return [placed(circle, base_pose), placed(heading, base_pose), arm]


def top_view(
    outlines: Mapping[str, np.ndarray],
    poses: np.ndarray,
    walls: Sequence[np.ndarray] = (),
    footprints: Sequence[np.ndarray] = (),
    size: tuple[int, int] = (640, 480),
) -> np.ndarray:
    """What `draw_top_view` draws as a picture, uint8 (height, width, 3), of `size` in pixels."""
    width, height = size
    figure = Figure(figsize=(width / 100, height / 100), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    draw_top_view(figure.add_subplot(), outlines, poses, walls, footprints)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
