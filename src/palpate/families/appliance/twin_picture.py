"""A twin to look at: what was seen, coloured by part, and each joint's axis with its cone; and as a
film the twin beside what it is of, from look to look."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from palpate.identification.interactive.screws import NOWHERE, Pose
from palpate.identification.interactive.twin import Twin
from palpate.models.articulated.description import Description, Geometry
from palpate.perception.clouds import Cloud
from palpate.report.picture import canvas_of, image_of, legend_of, save_animation, save_picture

PICTURE, FILM = "twin.png", "rendering.webp"
MOST_FRAMES, SHOWN_FOR = 16, 800  # looks, and ms of each
MOVED = 0.01  # rad or m of a part, since the frame before
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


def film_twin(path: Path, twin: Twin, description: Description) -> None:
    """Write a film: what was seen, and beside it the twin as it is described, posed alike.

    It shows the looks before which something has moved.
    """
    places = np.array([part.positions for part in twin.parts])
    shown = [0]
    for look in range(1, len(twin.looks)):
        if np.abs(places[:, look] - places[:, shown[-1]]).max() > MOVED:
            shown.append(look)
    frames = np.linspace(0, len(shown) - 1, min(len(shown), MOST_FRAMES)).round().astype(int)
    pictures = []
    with matplotlib.rc_context(_SETTINGS):
        for look in np.array(shown)[frames].tolist():
            figure = canvas_of(8.0, 4.0, dpi=80)
            seen: Any = figure.add_subplot(1, 2, 1, projection="3d")
            cloud = twin.looks[look]
            points = cloud.points[:: max(1, len(cloud.points) // POINTS)]
            seen.scatter(*points.T, s=1.0, c=points[:, 2], cmap="copper", linewidths=0)
            seen.set_title("seen", fontsize=8)
            model: Any = figure.add_subplot(1, 2, 2, projection="3d")
            _draw_links(model, twin, description, look)
            model.set_title("twin", fontsize=8)
            for axes in (seen, model):
                _fit(axes, twin.looks[0])
            pictures.append(image_of(figure))
    save_animation(path, pictures, SHOWN_FOR, quality=70)


def _draw_links(axes: Any, twin: Twin, description: Description, look: int) -> None:
    """The boxes of each link, where it is in a look."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    for number, link in enumerate(description.links, -1):
        pose = NOWHERE
        if number >= 0:
            pose = twin.pose(number, look) @ Pose(np.eye(3), twin.parts[number].screw.point)
        faces = [face for box in link.visuals for face in _faces(box, pose)]
        colour = _COLOURS[number % len(_COLOURS)] if number >= 0 else _STILL
        axes.add_collection3d(Poly3DCollection(faces, facecolors=colour, shade=True))


def _faces(box: Geometry, pose: Pose) -> np.ndarray:
    """The six rectangles of a box (6, 4, 3) m, its link being there."""
    faces = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            corners = np.insert(np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) / 2, axis, side, 1)
            faces.append(corners * box.size)
    return np.array([pose.at(box.place.origin + face @ box.place.rotation.T) for face in faces])


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
    _fit(axes, cloud)


def _fit(axes: Any, cloud: Cloud) -> None:
    """Show a cloud's room, from where its first camera is."""
    size = float(np.ptp(cloud.points, axis=0).max())
    middle, half = cloud.points.mean(axis=0), 0.5 * size
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half),
             zlim=(middle[2] - half, middle[2] + half), xlabel="x (m)", ylabel="y (m)",
             zlabel="z (m)")  # fmt: skip
    axes.set_box_aspect((1, 1, 1), zoom=0.9)
    axes.locator_params(nbins=4)
    axes.view_init(elev=22, azim=_towards(cloud))


def _towards(cloud: Cloud) -> float:
    """The direction, degrees, from which the first camera looks."""
    away = np.asarray(cloud.images[0].pinhole.position) - cloud.points.mean(axis=0)
    return float(np.degrees(np.arctan2(away[1], away[0])))
