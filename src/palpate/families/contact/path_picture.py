"""One episode in a maze, to look at: way, stiffness and force along it, as picture and film."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.patches import Circle, Ellipse, Rectangle
from matplotlib.transforms import Affine2D

from palpate.networks.guarded import ActorPolicy, GuardedPolicy
from palpate.report.picture import canvas_of, image_of, save_animation, save_picture
from palpate.worlds.gymnasium import GymnasiumWorlds
from palpate.worlds.maze.layout import ARENA, TIP_RADIUS, Layout
from palpate.worlds.maze.mjcf import OpenLayout
from palpate.worlds.world import innermost

PICTURE, FILM = "path.png", "rendering.webp"
LEAST_RISK = 1e-5  # that is drawn
_INK, _WALL, _BLOCK, _WAY, _FORCE = "#1c2127", "#8a94a0", "#e8a33d", "#0062a8", "#c04d00"
_GOAL = "#007a59"
_STIFFEST = 0.022  # m: how long an ellipse's half axis is drawn at the greatest stiffness
_NEWTON = 0.0025  # m of an arrow for each N
_EVERY = 4  # decisions from one ellipse to the next
_PIXELS = 160  # of each side of a picture from above
_WHOLE = {"shrinkA": 0, "shrinkB": 0}
_SETTINGS: Any = {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}


@dataclass(frozen=True)
class Episode:
    """What happened in one, at each of its decisions; positions in the world."""

    layout: Layout | OpenLayout
    period: float  # s, of a decision
    force_limit: float  # N
    end: str
    position: np.ndarray  # (decisions, 2) m, at the decision
    # (decisions,) m by which the obstacle has been pushed, or (decisions, y, x) m: heights.
    scene: np.ndarray
    stiffness: np.ndarray  # (decisions, 2, 2) N/m
    force: np.ndarray  # (decisions, 2) N, at the decision
    greatest: np.ndarray  # (decisions,) N, within it
    risk: np.ndarray | None  # (decisions,) of what the policy proposed
    threshold: float = 1.0  # of the risk, above which the guard acts


def run_episode(policy: ActorPolicy, environment: GymnasiumWorlds, seed: int) -> Episode:
    """The episode that the seed begins, of an environment with one world."""
    observation, _ = environment.reset(seed=seed)
    inside: Any = environment.lockstep
    (world,), task, law = inside.worlds, inside.task, inside.law
    impedance = innermost(law)
    layout, end, rows = world.truth().layout, "", []

    @jax.jit
    def decide(observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        risk = jnp.full(1, jnp.nan)
        if isinstance(policy, GuardedPolicy):
            risk = policy.risk(observation, policy.propose(observation))
        return risk, policy(None, observation)[1]

    while not end:
        truth = world.truth()
        scene = _scene_of(world, truth)
        risk, action = (np.asarray(one) for one in decide(jnp.asarray(observation)))
        observation, _, _, _, infos = environment.step(action)
        end = infos["end"][0]
        felt = infos["force"][0]
        before = truth.position[:2], scene, truth.force[:2]
        rows.append((*before, impedance.stiffness[0].copy(), felt, float(risk[0])))
    position, scene, force, stiffness, greatest, risk = map(np.array, zip(*rows, strict=True))
    period = inside.every * world.control_period
    seen = layout, period, task.force_limit, end, position, scene, stiffness, force, greatest
    if isinstance(policy, GuardedPolicy):
        return Episode(*seen, risk, policy.threshold)
    return Episode(*seen, None)


def show_path(folder: Path, policy: ActorPolicy, environment: GymnasiumWorlds, seed: int) -> None:
    """Draw the first episode of the seed, which was not chosen, into the run's folder."""
    episode = run_episode(policy, environment, seed)
    environment.close()
    path_picture(folder / PICTURE, episode)
    film(folder / FILM, episode)


def path_picture(out: Path, episode: Episode) -> None:
    """The way with ellipses of stiffness and arrows of force; beside it force and risk."""
    time = episode.period * np.arange(len(episode.position))
    with matplotlib.rc_context(_SETTINGS):
        canvas = canvas_of(9.0, 3.9)
        panels = canvas.subplot_mosaic([["way", "force"], ["way", "last"]], width_ratios=[1.35, 1])
        _draw_place(panels["way"], episode.layout, episode.scene[-1])
        _draw_way(panels["way"], episode, len(time))
        force, last = panels["force"], panels["last"]
        force.plot(time, episode.greatest, color=_FORCE, lw=1)
        force.axhline(episode.force_limit, color=_INK, lw=1, ls=(0, (4, 3)))
        force.annotate(
            f"limit {episode.force_limit:g} N", (time[-1], episode.force_limit), ha="right",
            va="bottom", color=_INK,
        )  # fmt: skip
        force.set(ylabel="greatest force (N)", ylim=(0, 1.2 * episode.force_limit))
        if episode.risk is None:
            along, across = principal(episode)
            last.semilogy(time, along, color=_WAY, lw=1.2, label="stiffer axis")
            last.semilogy(time, across, color=_WAY, lw=1.2, ls=(0, (4, 3)), label="softer axis")
            last.legend(frameon=False, loc="upper left")
            last.set(ylabel="stiffness (N/m)")
        else:
            # Of what matters most is less than a percent.
            last.semilogy(time, np.maximum(episode.risk, LEAST_RISK), color=_WAY, lw=1)
            last.axhline(episode.threshold, color=_INK, lw=1, ls=(0, (4, 3)))
            last.annotate(
                f"recovery above {episode.threshold:g}", (time[-1], episode.threshold), ha="right",
                va="bottom", color=_INK,
            )  # fmt: skip
            last.set(ylabel="risk of what is proposed", ylim=(LEAST_RISK, 1))
        last.set(xlabel="time (s)")
        save_picture(out, canvas)


def film(out: Path, episode: Episode) -> None:
    """The same way as it went, a frame for every second decision, about as fast as it was."""
    pictures = []
    with matplotlib.rc_context(_SETTINGS):
        for count in [*range(1, len(episode.position), 2), len(episode.position)]:
            canvas = canvas_of(5.2, 4.3, dpi=80)
            axis = canvas.subplots()
            _draw_place(axis, episode.layout, episode.scene[count - 1])
            _draw_way(axis, episode, count, last=True)
            pictures.append(image_of(canvas))
    save_animation(out, pictures, round(2000 * episode.period), quality=70)


def principal(episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """The greater and the lesser of each decision's two stiffnesses, N/m."""
    values = np.linalg.eigvalsh(episode.stiffness)
    return values[:, 1], values[:, 0]


def _area(layout: OpenLayout) -> tuple[float, float, float, float]:
    """Least and greatest x, then y: a square with start and goal in its middle."""
    (x, y), half = np.add(layout.start, layout.goal) / 2, math.dist(layout.start, layout.goal)
    return x - 0.8 * half, x + 0.8 * half, y - 0.8 * half, y + 0.8 * half


def _scene_of(world: Any, truth: Any) -> Any:
    if isinstance(truth.layout, Layout):
        return truth.obstacle
    west, east, south, north = _area(truth.layout)
    return world.heights(np.linspace(west, east, _PIXELS), np.linspace(south, north, _PIXELS))


def _draw_place(axis: Any, layout: Layout | OpenLayout, scene: Any) -> None:
    if isinstance(layout, Layout):
        _draw_maze(axis, layout, scene)
    else:
        shade = {"cmap": "Greys", "alpha": 0.6, "interpolation": "nearest"}
        axis.imshow(scene, origin="lower", extent=_area(layout), **shade)
    axis.add_patch(Circle(layout.goal, layout.goal_radius, fc="none", ec=_GOAL, lw=1.5))
    axis.annotate("goal", layout.goal, ha="center", va="center", color=_GOAL)
    axis.set(aspect="equal", xlabel="x (m)", ylabel="y (m)")


def _draw_maze(axis: Any, layout: Layout, pushed: float) -> None:
    boxes = [(wall.position, wall.half_sizes, wall.yaw, _WALL) for wall in layout.walls]
    x, y = layout.obstacle.position
    boxes.append(((x + pushed, y), layout.obstacle.half_sizes, 0.0, _BLOCK))
    for (x, y), (width, height), yaw, colour in boxes:
        box = Rectangle((-width, -height), 2 * width, 2 * height, fc=colour, ec="none")
        box.set_transform(Affine2D().rotate(yaw).translate(x, y) + axis.transData)
        axis.add_patch(box)
    width, height = ARENA
    axis.set(xlim=(-width - 0.02, width + 0.02), ylim=(-height - 0.02, height + 0.02))


def _draw_way(axis: Any, episode: Episode, count: int, last: bool = False) -> None:
    way = episode.position[:count]
    axis.plot(*way.T, color=_WAY, lw=1.2)
    axis.add_patch(Circle(tuple(way[-1]), TIP_RADIUS, fc=_WAY, ec="none", alpha=0.6))
    shown = [count - 1] if last else range(0, count, _EVERY)
    values, axes = np.linalg.eigh(episode.stiffness)
    zoom = float(np.ptp(axis.get_xlim())) / (2 * ARENA[0] + 0.04)  # 1 in the mazes
    scale = zoom * 2 * _STIFFEST / np.sqrt(1000.0)
    for number in shown:
        turn = np.degrees(np.arctan2(axes[number, 1, 1], axes[number, 0, 1]))
        softer, stiffer = scale * np.sqrt(np.maximum(values[number], 0.0))
        axis.add_patch(
            Ellipse(tuple(way[number]), stiffer, softer, angle=turn, fc="none", ec=_INK, lw=0.5)
        )
        force = zoom * _NEWTON * episode.force[number]
        if np.hypot(*force) > zoom * 1e-3:
            axis.annotate(
                "", way[number] + force, way[number],
                arrowprops={"arrowstyle": "-|>", "color": _FORCE, "lw": 0.8} | _WHOLE,
            )  # fmt: skip
