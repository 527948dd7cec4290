"""A twin to look at: what was seen, coloured by part, and each joint's axis with its cone."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from palpate.identification.interactive.twin import Twin
from palpate.report.picture import canvas_of, legend_of, save_picture

PICTURE = "twin.png"
POINTS = 6000  # that are drawn
WITHIN = 0.95  # of an axis's direction: the cone that is drawn
_STILL = "#8f99a3"
_COLOURS = ("#0062a8", "#e8a33d", "#007a59", "#c04d00", "#7a4fa0", "#b03060")
_MARKS = ("o", "s", "^", "D", "v", "P")
_SETTINGS: Any = {"font.size": 8}


def show_twin(path: Path, twin: Twin, title: str) -> None:
    """Write the picture of a twin's first look and of its last one."""
    with matplotlib.rc_context(_SETTINGS):
        figure = canvas_of(10.0, 5.0)
        last = len(twin.looks) - 1
        for place, (look, when) in enumerate(((0, "before"), (last, "after the last push"))):
            axes: Any = figure.add_subplot(1, 2, place + 1, projection="3d")
            _draw(axes, twin, look)
            axes.set_title(f"{title}: {when}", fontsize=8)
        legend_of(figure, "lower center", markerscale=4.0)
        save_picture(path, figure)


def _draw(axes: Any, twin: Twin, look: int) -> None:
    cloud, labels = twin.looks[look], twin.labels[look]
    step = max(1, len(cloud.points) // POINTS)
    for number in range(-1, len(twin.parts)):
        chosen = cloud.points[labels == number][::step]
        colour = _COLOURS[number % len(_COLOURS)] if number >= 0 else _STILL
        mark = _MARKS[number % len(_MARKS)] if number >= 0 else "."
        name = "stands still" if number < 0 else f"part {number + 1}"
        axes.scatter(*chosen.T, s=3.0 if number >= 0 else 1.0, c=colour, marker=mark, label=name,
                     linewidths=0)  # fmt: skip
    size = float(np.ptp(cloud.points, axis=0).max())
    for number in range(len(twin.parts)):
        screw = twin.screw(number, look)
        chosen = cloud.points[labels == number]
        middle = chosen.mean(axis=0) if len(chosen) else screw.point
        screw = screw.near(middle)
        ends = screw.point + np.outer([-0.3 * size, 0.3 * size], screw.axis)
        colour = _COLOURS[number % len(_COLOURS)]
        dashes = "-" if screw.joint == "revolute" else "--"
        axes.plot(*ends.T, color=colour, lw=1.5, linestyle=dashes)
        spread = 2.45 * np.sqrt(np.diag(twin.parts[number].estimate.covariance)[:2])
        turn = np.linspace(0.0, 2.0 * np.pi, 25)
        first, second = screw.across
        rim = np.outer(spread[0] * np.cos(turn), first) + np.outer(spread[1] * np.sin(turn), second)
        axes.plot(*(ends[1] + 0.6 * size * rim).T, color=colour, lw=0.8)
    middle, half = cloud.points.mean(axis=0), 0.5 * size
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half),
             zlim=(middle[2] - half, middle[2] + half), xlabel="x (m)", ylabel="y (m)",
             zlabel="z (m)")  # fmt: skip
    axes.set_box_aspect((1, 1, 1), zoom=0.9)
    axes.locator_params(nbins=4)
    axes.view_init(elev=22, azim=_towards(cloud))


def _towards(cloud: Any) -> float:
    """The direction, degrees, from which the first camera looks."""
    away = np.asarray(cloud.images[0].pinhole.position) - cloud.points.mean(axis=0)
    return float(np.degrees(np.arctan2(away[1], away[0])))
