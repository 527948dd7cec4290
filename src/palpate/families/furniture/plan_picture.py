"""A map among movable obstacles, and the plan on it: as a picture, or moving.

Walls are solid, objects numbered by the order in which they are moved; where an object began is
dashed, where it is left is filled. Ways are told apart by line as well as by colour.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Circle, PathPatch, Polygon
from matplotlib.path import Path as Outline
from PIL import Image

from palpate.errors import PalpateError
from palpate.numerics.polygons import place_points
from palpate.planning.movable_obstacles.maps.map import Map
from palpate.planning.movable_obstacles.maps.occupancy import Space
from palpate.planning.movable_obstacles.maps.regions import regions_of
from palpate.planning.movable_obstacles.search.plan import TRANSFER, Plan
from palpate.report.picture import legend_of, save_animation, save_picture

_INK, _QUIET, _WALL = "#1c2127", "#5b6570", "#3d4650"
_OBJECT, _MOVED, _ROBOT, _CARRY = "#f3d9a0", "#e8a33d", "#0062a8", "#c04d00"
_TINTS = ("#e4eef7", "#e6f3ec", "#f6ebf3", "#fbf3df", "#ececf6", "#f0f0ea")
_WIDE = 7.0  # inches of the longer side
_GHOSTS = 6  # poses of an object that are shown on its way
_SUFFIXES = (".png", ".svg")
_STAR: Any = {
    "marker": "*", "ms": 11, "color": _ROBOT, "mec": _INK, "mew": 0.6, "ls": "", "zorder": 9
}  # fmt: skip
_SETTINGS: Any = {"font.size": 8, "svg.hashsalt": "palpate", "axes.edgecolor": "#dfe3e7"}


def plan_picture(
    out: str | Path,
    world: Map,
    plan: Plan | None = None,
    *,
    movability: Mapping[str, float] | None = None,
    driven: np.ndarray | None = None,
) -> Path:
    """Draw a map with its free regions and, if given, a plan; in metres.

    `movability` is the believed probability that an object gives way, by name, written on it;
    `driven` (points, 2 or 3) is a way that was driven in fact, m. `out` is a .png or .svg; the
    same input gives the same bytes.

    Raises `PalpateError` for another suffix.
    """
    out = Path(out)
    if out.suffix not in _SUFFIXES:
        raise PalpateError(f"{out} has the suffix '{out.suffix}': expected .png or .svg")
    with matplotlib.rc_context(_SETTINGS):
        figure, axes = _scene(world)
        _draw_regions(axes, world)
        _draw_walls(axes, world)
        final = (plan.leaves(world) if plan else world).movables
        order = {name: k + 1 for k, name in enumerate(plan.moved)} if plan else {}
        for name, movable in world.movables.items():
            moved = name in order
            _draw_object(axes, place_points(movable.outline, movable.pose), moved=moved)
            if moved:
                _draw_object(axes, place_points(movable.outline, final[name].pose), left=True)
            label = str(order[name]) if moved else ""
            if movability and name in movability:
                label += f"{' ' if label else ''}{movability[name]:.0%}"
            x, y = final[name].pose[:2]
            axes.text(x, y, label, ha="center", va="center", color=_INK, zorder=8)
        if plan is not None:
            _draw_ghosts(axes, world, plan)
            _draw_ways(axes, plan)
        if driven is not None:
            axes.plot(*driven[:, :2].T, color=_INK, lw=0.8, ls=":", label="driven", zorder=6)
        _draw_robot(axes, world, np.array(world.start), "start")
        goal = plan.goal if plan is not None else next(iter(world.goals), None)
        if goal is not None:
            axes.plot(*goal[:2], label="goal", **_STAR)
        legend_of(figure, "upper center", handlelength=2.6)
        save_picture(out, figure)
    return out


def plan_animation(
    out: str | Path, world: Map, plan: Plan, *, frames: int = 60, period: float = 0.08
) -> Path:
    """The plan carried out, as an endless GIF of `frames` pictures that each stand `period` s.

    Raises `PalpateError` for another suffix than .gif and for fewer than two frames.
    """
    out = Path(out)
    if out.suffix != ".gif":
        raise PalpateError(f"{out} has the suffix '{out.suffix}': expected .gif")
    if frames < 2:
        raise PalpateError(f"an animation has {frames} frames: expected 2 or more")
    robots, objects, held = _timeline(world, plan, frames)
    return scene_animation(out, world, plan.goal, robots, objects, held, period)


def scene_animation(
    out: str | Path,
    world: Map,
    goal: Sequence[float],
    robots: np.ndarray,
    objects: np.ndarray,
    held: Sequence[str | None],
    period: float = 0.08,
    movability: Sequence[Mapping[str, float]] | None = None,
) -> Path:
    """A GIF of poses: `robots` (frames, 3), `objects` (frames, movables, 3), and what is held then.

    `movability` is what is believed of the objects in each frame. An execution is shown so as well
    as a plan.
    """
    out = Path(out)
    pictures = []
    with matplotlib.rc_context(_SETTINGS):
        figure, axes = _scene(world, dots=100)
        canvas = FigureCanvasAgg(figure)
        _draw_walls(axes, world)
        canvas.draw()  # with its layout, once: the rest is drawn over it
        figure.set_layout_engine("none")
        background = canvas.copy_from_bbox(figure.bbox)
        for index, robot in enumerate(robots):
            drawn: list[Any] = axes.plot(*goal[:2], **_STAR)
            drawn += axes.plot(*robots[: index + 1, :2].T, color=_ROBOT, lw=1.0, zorder=5)
            for (name, movable), pose in zip(world.movables.items(), objects[index], strict=True):
                corners = place_points(movable.outline, pose)
                drawn += _draw_object(axes, corners, left=name == held[index])
                if movability is not None and name in movability[index]:
                    text = f"{movability[index][name]:.0%}"
                    x, y = pose[:2]
                    drawn.append(axes.text(x, y, text, ha="center", va="center", zorder=8))
            drawn += _draw_robot(axes, world, robot)
            canvas.restore_region(background)
            for artist in sorted(drawn, key=lambda one: one.get_zorder()):
                axes.draw_artist(artist)
                artist.remove()
            picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
            colours = 64, Image.Quantize.FASTOCTREE
            pictures.append(picture.quantize(*colours, dither=Image.Dither.NONE))
    milliseconds = [round(1000 * period)] * (len(pictures) - 1) + [1500]
    save_animation(out, pictures, milliseconds)
    return out


# --- time -------------------------------------------------------------------------------------


def _timeline(
    world: Map, plan: Plan, frames: int
) -> tuple[np.ndarray, np.ndarray, list[str | None]]:
    """Robot, objects and what is held at even steps of the way, a turn counted as the rim's arc."""
    names, standing = list(world.movables), [one.pose for one in world.movables.values()]
    poses, held = [], []
    for segment in plan.segments:
        for index, pose in enumerate(segment.poses):
            if segment.name is not None and segment.object_poses is not None:
                standing[names.index(segment.name)] = segment.object_poses[index]
            poses.append([pose, *standing])
            held.append(segment.name)
    all_poses = np.array(poses, float)
    all_poses[:, 0, 2] = np.unwrap(all_poses[:, 0, 2])
    steps = np.abs(np.diff(all_poses[:, 0], axis=0))
    moved = np.linalg.norm(steps[:, :2], axis=1) + world.robot.radius * steps[:, 2]
    along = np.concatenate([[0.0], np.cumsum(moved)])
    wanted = np.linspace(0, along[-1], frames)
    columns = all_poses.reshape(len(along), -1).T
    between = np.stack([np.interp(wanted, along, column) for column in columns], axis=1)
    between = between.reshape(frames, -1, 3)
    after = np.clip(np.searchsorted(along, wanted, side="right"), 1, len(along) - 1)
    return between[:, 0], between[:, 1:], [held[index] for index in after]


# --- drawing ----------------------------------------------------------------------------------


def _scene(world: Map, dots: int = 200) -> tuple[Figure, Axes]:
    left, bottom, right, top = world.bounds
    scale = _WIDE / max(right - left, top - bottom)
    size = (max(2.5, scale * (right - left)) + 0.6, max(2.0, scale * (top - bottom)) + 0.9)
    figure = Figure(figsize=size, dpi=dots, layout="constrained")
    axes = figure.subplots()
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.tick_params(color=_QUIET, labelcolor=_QUIET)
    return figure, axes


def _draw_regions(axes: Axes, world: Map) -> None:
    """Each free region of the robot's centre in a tint of its own."""
    space = Space(world)
    node = regions_of(space).node
    tints = np.array([to_rgba(tint) for tint in _TINTS])
    image = np.where(space.free[..., None], tints[node % len(tints)], 0.0)
    left, bottom = world.bounds[:2]
    right, top = (np.array([left, bottom]) + np.array(node.shape[::-1]) * space.cell).tolist()
    axes.imshow(
        image, origin="lower", extent=(left, right, bottom, top), zorder=0, interpolation="nearest"
    )


def _draw_walls(axes: Axes, world: Map) -> None:
    for part in shapely.get_parts(world.walls):
        if part.is_empty:
            continue
        rings = [np.asarray(ring.coords) for ring in (part.exterior, *part.interiors)]
        whole = Outline.make_compound_path(*(Outline(ring, closed=True) for ring in rings))
        axes.add_patch(PathPatch(whole, fc=_WALL, ec="none", zorder=2))


def _draw_object(
    axes: Axes, corners: np.ndarray, *, moved: bool = False, left: bool = False
) -> list[Any]:
    look: dict[str, Any] = {"fc": _OBJECT, "ec": _INK, "lw": 0.8, "zorder": 3}
    if moved:
        look |= {"fc": "none", "ls": (0, (3, 2)), "ec": _QUIET}
    if left:
        look |= {"fc": _MOVED, "zorder": 4}
    return [axes.add_patch(Polygon(corners, closed=True, **look))]


def _draw_ghosts(axes: Axes, world: Map, plan: Plan) -> None:
    """Objects on their ways."""
    for segment in plan.segments:
        if segment.name is None or segment.object_poses is None:
            continue
        chosen = np.linspace(0, len(segment.object_poses) - 1, _GHOSTS).round().astype(int)
        for pose in segment.object_poses[chosen[1:-1]]:
            corners = place_points(world.movables[segment.name].outline, pose)
            axes.add_patch(Polygon(corners, fc=_MOVED, alpha=0.12, ec=_CARRY, lw=0.4, zorder=3))


def _draw_robot(axes: Axes, world: Map, pose: np.ndarray, label: str | None = None) -> list[Any]:
    radius = world.robot.radius
    disc = Circle((pose[0], pose[1]), radius, fc="white", ec=_ROBOT, lw=1.4, zorder=7, alpha=0.9)
    tip = pose[:2] + radius * np.array([math.cos(pose[2]), math.sin(pose[2])])
    nose = axes.plot([pose[0], tip[0]], [pose[1], tip[1]], color=_ROBOT, lw=1.4, zorder=8)
    drawn: list[Any] = [axes.add_patch(disc), *nose]
    if label is not None:
        drawn += axes.plot([], [], marker="o", ls="", mfc="white", mec=_ROBOT, label=label)
    return drawn


def _draw_ways(axes: Axes, plan: Plan) -> None:
    looks = {
        False: {"color": _ROBOT, "lw": 1.3, "label": "drives"},
        True: {"color": _CARRY, "lw": 2.2, "ls": (0, (2.5, 1.2)), "label": "drives and carries"},
    }
    for segment in plan.segments:
        look = looks[segment.kind == TRANSFER]
        axes.plot(segment.poses[:, 0], segment.poses[:, 1], zorder=6, **look)
        if segment.kind == TRANSFER:
            axes.plot(*segment.poses[0, :2], marker="o", ms=4, color=_CARRY, zorder=7)
            axes.plot(*segment.poses[-1, :2], marker="s", ms=4, color=_CARRY, zorder=7)
