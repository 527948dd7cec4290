"""Maps from namosim's SVG scenarios (github.com/Chroma-CITI/namosim; JOSS 10(113), 8816).

Units of the viewBox are centimetres, whatever width and height say, and y points down. Paths have a
`type` wall, movable or shape; `namo_config` names the paths that are the robot and its goals. Older
files put the robot's shape and a direction into a group of the robot's id; layered ones leave out
the types and put what is movable into the layer `movables_layer`.
"""

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.geometry import (
    centred,
    checked_polygon,
    circumscribed_radius,
)
from palpate.planning.movable_obstacles.map import Map, Movable, Robot, map_of
from palpate.planning.movable_obstacles.map_svg_paths import path_points, transform_matrix

_LARGEST_FILE = 50_000_000
_LAYERS = {"movables_layer": "movable", "goals_layer": "shape", "robots_layer": "shape"}
_DEEPEST = 60


@dataclass(frozen=True)
class _Drawn:
    """One path: its `type` ("" where it has none), points (points, 2) in m, its groups' ids."""

    name: str
    type: str
    points: np.ndarray
    groups: tuple[str, ...]
    attributes: dict[str, str]


@dataclass
class _Drawing:
    size: tuple[float, float]
    paths: list[_Drawn] = field(default_factory=list)
    config: Any = None

    def of(self, identifier: str, what: str) -> tuple[_Drawn, float]:
        """The shape of that id, or the one in the group of that id, and its direction in rad."""
        own = [path for path in self.paths if path.name == identifier]
        inside = [path for path in self.paths if identifier in path.groups]
        shapes = own or [path for path in inside if path.type == "shape"] or inside[:1]
        if not shapes:
            raise PalpateError(
                f"the drawing has no {what} '{identifier}', which its namo_config names: expected "
                "a path, or a group with a path of type 'shape', of that id"
            )
        shape = shapes[0]
        if "angle" in shape.attributes:
            return shape, math.radians(_number(shape.attributes["angle"], f"angle of {what}"))
        for path in inside:
            if path.type in ("orientation", "direction"):
                arrow = path.points - shape.points.mean(axis=0)
                x, y = arrow[np.argmax(np.linalg.norm(arrow, axis=1))]
                return shape, math.atan2(y, x)
        return shape, 0.0


def read_svg(path: str | Path) -> Map:
    """A namosim scenario as a map.

    Raises `PalpateError` for a file that is no such drawing; entities and external references are
    refused, so that no file can expand without end or read another one.
    """
    path = Path(path)
    drawing = read_drawing(path, 0.01)
    config = drawing.config
    if config is None:
        raise PalpateError(
            f"{path} has no namo_config: expected one with cell_size_cm and an agent, or the "
            "YAML file that goes with a layered drawing"
        )
    cell_size = _number(config.get("cell_size_cm"), f"cell_size_cm of {path}") / 100
    margin = config.get("collision_margin_cm")
    agents = [element for element in config if _local(element.tag) in ("agent", "agent_config")]
    if not agents:
        raise PalpateError(f"{path} has no agent in its namo_config: expected one, with its goals")
    agent = agents[0]
    robot_id = agent.get("agent_id", "")
    shape, heading = drawing.of(robot_id, "agent")
    outline, (x, y) = centred(checked_polygon(shape.points, f"agent '{robot_id}'"))
    parameters = [element for element in agent.iter() if _local(element.tag) == "parameters"]
    drive = parameters[0].get("drive_type", "differential") if parameters else "differential"
    goals, goal_paths = [], set()
    for element in agent:
        if _local(element.tag) == "goal":
            found, angle = drawing.of(element.get("goal_id", ""), "goal")
            goal_paths.add(id(found))
            _, (goal_x, goal_y) = centred(checked_polygon(found.points, f"goal '{found.name}'"))
            goals.append((goal_x, goal_y, angle))
    others = [other.get("agent_id", "") for other in agents[1:]]
    walls = [
        checked_polygon(drawn.points, f"wall '{drawn.name}'")
        for drawn in drawing.paths
        if drawn.type == "wall"
    ]
    walls += [checked_polygon(drawing.of(other, "agent")[0].points, other) for other in others]
    return map_of(
        path.stem,
        walls=shapely.union_all(walls),
        movables=movables_of(drawing),
        robot=Robot(circumscribed_radius(outline), drive, outline=outline),
        start=(x, y, heading),
        goals=goals,
        bounds=(0.0, 0.0, *drawing.size),
        cell_size=cell_size,
        margin=None if margin is None else _number(margin, f"margin of {path}") / 100,
    )


def movables_of(drawing: _Drawing) -> list[Movable]:
    """Paths of type movable; where no path has a type, those of the layer of movables."""
    return [
        Movable.from_corners(drawn.name, drawn.points)
        for drawn in drawing.paths
        if drawn.type == "movable"
    ]


def goals_of(drawing: _Drawing) -> list[tuple[float, float, float]]:
    """Poses of what lies in the layer of goals."""
    goals = []
    for drawn in drawing.paths:
        if "goals_layer" in drawn.groups:
            _, (x, y) = centred(checked_polygon(drawn.points, f"goal '{drawn.name}'"))
            goals.append((x, y, math.radians(float(drawn.attributes.get("angle", 0.0)))))
    return goals


def read_drawing(path: Path, scale: float) -> _Drawing:
    """Every path of an SVG in metres, y up; `scale` is metres per unit of the viewBox.

    Raises `PalpateError` for a file that is no SVG with a viewBox.
    """
    from xml.etree.ElementTree import ParseError

    from defusedxml import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    try:
        content = path.read_bytes()
    except OSError as error:
        raise PalpateError(f"cannot read {path}: {error.strerror or error}") from error
    if len(content) > _LARGEST_FILE:
        raise PalpateError(f"{path} is of {len(content)} bytes: expected at most {_LARGEST_FILE}")
    try:
        root = fromstring(content, forbid_dtd=False, forbid_entities=True, forbid_external=True)
    except DefusedXmlException as error:
        raise PalpateError(
            f"{path} defines XML entities or refers to other files: expected a drawing without"
        ) from error
    except (ParseError, ValueError, LookupError) as error:
        raise PalpateError(f"{path} is no XML: {error}") from error
    if _local(root.tag) != "svg":
        raise PalpateError(f"{path} has the root <{_local(root.tag)}>: expected <svg>")
    box = [
        _number(text, f"viewBox of {path}") for text in re.split(r"[\s,]+", _viewbox(root, path))
    ]
    if len(box) != 4 or box[2] <= 0 or box[3] <= 0:
        raise PalpateError(f"{path} has the viewBox {box}: expected x, y, width, height above 0")
    to_metres = np.array(
        [[scale, 0, -scale * box[0]], [0, -scale, scale * (box[1] + box[3])], [0, 0, 1.0]]
    )
    drawing = _Drawing((box[2] * scale, box[3] * scale))
    _walk(root, to_metres, (), drawing, str(path))
    return drawing


def _walk(
    element: Any, matrix: np.ndarray, groups: tuple[str, ...], drawing: _Drawing, what: str
) -> None:
    if len(groups) > _DEEPEST:
        raise PalpateError(f"{what} has groups more than {_DEEPEST} deep")
    for child in element:
        tag = _local(child.tag)
        name = child.get("id", "")
        here = matrix
        if child.get("transform"):
            here = matrix @ transform_matrix(child.get("transform"), f"'{name}' in {what}")
        if tag == "namo_config":
            drawing.config = child
        elif tag == "g":
            _walk(child, here, (*groups, name), drawing, what)
        elif tag == "path" and child.get("d"):
            named = f"path '{name}' of {what}"
            points = path_points(child.get("d"), named)
            layer = next((_LAYERS[group] for group in groups if group in _LAYERS), "")
            drawing.paths.append(
                _Drawn(
                    name or f"path_{len(drawing.paths)}",
                    child.get("type", layer),
                    points @ here[:2, :2].T + here[:2, 2],
                    groups,
                    dict(child.attrib),
                )
            )


def _viewbox(root: Any, path: Path) -> str:
    text = root.get("viewBox")
    if text is None:
        raise PalpateError(f"{path} has no viewBox, which gives its size in cm")
    return text.strip()


def _local(tag: object) -> str:
    return str(tag).rpartition("}")[2]


def _number(text: str | None, what: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise PalpateError(f"{what} is {text!r}: expected a number")
    return value
