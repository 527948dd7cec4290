"""Maps from namosim's SVG scenarios (github.com/Chroma-CITI/namosim; JOSS 10(113), 8816).

Units of the viewBox are centimetres, whatever width and height say, and y points down. Paths have a
`type` wall, movable or shape; `namo_config` names the paths that are the robot and its goals. Older
files put the robot's shape and a direction into a group of the robot's id; layered ones leave out
the types and put what is movable into the layer `movables_layer`. Only paths are read: another
element that is drawn and would have to be one of these is refused, because a wall that vanishes is
driven through. What has no type and is in no such layer is decoration.
"""

import math
import re
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from palpate.errors import PalpateError, quote
from palpate.numerics.polygons import (
    LEAST_AREA,
    centre_polygon,
    check_polygon,
    circumscribed_radius,
)
from palpate.planning.movable_obstacles.maps.description import read_bytes, truth
from palpate.planning.movable_obstacles.maps.map import Map, Movable, Pose, Robot, map_of
from palpate.planning.movable_obstacles.maps.svg_paths import (
    compose,
    path_outlines,
    transform_matrix,
)

_LARGEST_FILE = 50_000_000
_LAYERS = {"movables_layer": "movable", "goals_layer": "shape", "robots_layer": "shape"}
_DIRECTIONS = {"orientation", "direction"}
_TYPES = {"wall", "movable", "shape"} | _DIRECTIONS
_DRAWN = {"path", "rect", "polygon", "circle", "ellipse", "polyline", "line", "use"}
_NEVER_DRAWN = {"defs", "clipPath", "mask", "symbol", "marker", "pattern", "metadata"}
_DEEPEST = 60
_LEAST_ARROW = 1e-9  # m


@dataclass(frozen=True)
class _Drawn:
    """One path: its `type` ("" where it has none), its groups' ids, and where it is in m.

    Its outlines are worked out when somebody asks: nobody does for decoration.
    """

    name: str
    called: str
    type: str
    groups: tuple[str, ...]
    attributes: dict[str, str]
    matrix: np.ndarray

    @cached_property
    def outlines(self) -> list[np.ndarray]:
        """Each of points (points, 2), m."""
        every, matrix = path_outlines(self.attributes["d"], self.called), self.matrix
        return [points @ matrix[:2, :2].T + matrix[:2, 2] for points in every]

    @property
    def points(self) -> np.ndarray:
        """Of its one outline (points, 2), m; raises `PalpateError` where it has several."""
        if len(self.outlines) > 1:
            raise PalpateError(
                f"{self.called} has {len(self.outlines)} outlines: expected one, because only a "
                "wall may have holes or be in pieces"
            )
        return self.outlines[0]


@dataclass
class Drawing:
    size: tuple[float, float]
    paths: list[_Drawn] = field(default_factory=list)
    config: Any = None

    def shape_of(self, identifier: str | None, what: str) -> tuple[_Drawn, float]:
        """The shape of that id, or the one in the group of that id, and its direction in rad."""
        if not identifier:
            raise PalpateError(f"the namo_config has {what} without an id: expected one of a path")
        own = [path for path in self.paths if path.attributes.get("id") == identifier]
        inside = [path for path in self.paths if identifier in path.groups]
        shapes = own or [path for path in inside if path.type == "shape"] or inside[:1]
        named = f"{what} {quote(identifier)}"
        if not shapes:
            raise PalpateError(
                f"the drawing has no {named}, which its namo_config names: expected a path, or a "
                "group with a path of type 'shape', of that id"
            )
        shape = shapes[0]
        if "angle" in shape.attributes:
            return shape, _angle(shape)
        arrow = next((path for path in inside if path.type in _DIRECTIONS), None)
        return shape, 0.0 if arrow is None else _direction(arrow)


@dataclass(frozen=True)
class _Meant:
    """What says by a type, a layer or its name in the namo_config that it is part of the map.

    `holders` are such elements and layers and all that they are in; `ids` are of them, and of all
    that is in a layer.
    """

    holders: set[Any]
    ids: set[str]

    @staticmethod
    def within(root: Any) -> "_Meant":
        parents = {child: one for one in root.iter() for child in one}
        holders: set[Any] = set()
        inside: set[Any] = set()
        named = {one.get(key) for one in root.iter() for key in ("agent_id", "goal_id")}
        named -= {None, ""}
        for element in root.iter():
            layer = bool(_layers(element))
            if layer and element not in inside:
                inside.update(element.iter())
            typed = element.get("type") in _TYPES or element.get("id") in named
            one = element if layer or typed else None
            while one is not None and one not in holders:
                holders.add(one)
                one = parents.get(one)
        return _Meant(holders, {one.get("id", "") for one in holders | inside} - {""})

    def check(self, element: Any, called: str, layer: str) -> None:
        """Refuse an element that would have to be read and is no path."""
        tag = _local(element.tag)
        refused = element.get("type") in _TYPES  # of a group, whose parts are looked at themselves
        if tag != "g":
            drawn = layer and any(_local(one.tag) in _DRAWN for one in element.iter())
            refused = drawn or element in self.holders
        if tag == "use":  # a copy of what is elsewhere
            source = next((v for k, v in element.attrib.items() if _local(k) == "href"), "")
            refused = refused or source.removeprefix("#") in self.ids
        if refused:
            raise PalpateError(
                f"{called} says by its type or layer, or is said by the namo_config, to be part of "
                "the map, and only paths in groups are read: make it a path, in Inkscape with "
                "'Object to Path'"
            )


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
    shape, heading = drawing.shape_of(agent.get("agent_id"), "agent")
    outline, (x, y) = centre_polygon(check_polygon(shape.points, f"agent {quote(shape.name)}"))
    parameters = [element for element in agent.iter() if _local(element.tag) == "parameters"]
    said = parameters[0].attrib if parameters else {}
    goals = []
    for element in agent:
        if _local(element.tag) == "goal":
            found, angle = drawing.shape_of(element.get("goal_id"), "goal")
            goals.append((*_middle(found), angle))
    others = [drawing.shape_of(other.get("agent_id"), "agent")[0] for other in agents[1:]]
    standing = [check_polygon(one.points, f"agent {quote(one.name)}") for one in others]
    return map_of(
        path.stem,
        walls=shapely.union_all([*walls_of(drawing), *standing]),
        movables=movables_of(drawing),
        robot=Robot(
            circumscribed_radius(outline),
            said.get("drive_type", "differential"),
            outline=outline,
            push_only=truth(said.get("push_only", False), f"push_only in {path}"),
        ),
        start=(x, y, heading),
        goals=goals,
        bounds=(0.0, 0.0, *drawing.size),
        cell_size=cell_size,
        # namosim takes 0 as not given
        margin=None if margin is None else _number(margin, f"margin of {path}") / 100 or None,
    )


def walls_of(drawing: Drawing) -> list[BaseGeometry]:
    """What each path of type wall covers."""
    return [_wall(drawn) for drawn in drawing.paths if drawn.type == "wall"]


def movables_of(drawing: Drawing) -> list[Movable]:
    """Paths of type movable; where no path has a type, those of the layer of movables."""
    movables = [drawn for drawn in drawing.paths if drawn.type == "movable"]
    return [Movable.from_corners(drawn.name, drawn.points) for drawn in movables]


def goals_of(drawing: Drawing, agent: str) -> list[tuple[float, float, float]]:
    """Poses of what lies in the layer of goals, but for what has the `agent_id` of another."""
    goals = []
    for drawn in drawing.paths:
        mine = drawn.attributes.get("agent_id", agent) == agent
        if "goals_layer" in drawn.groups and mine:
            goals.append((*_middle(drawn), _angle(drawn)))
    return goals


def robot_of(drawing: Drawing, agent: str) -> tuple[np.ndarray, Pose] | None:
    """Outline about its middle, and pose, of the path in the layer of robots with that `agent_id`.

    None where there is no such path.
    """
    for drawn in drawing.paths:
        if "robots_layer" in drawn.groups and drawn.attributes.get("agent_id") == agent:
            outline, middle = centre_polygon(
                check_polygon(drawn.points, f"robot {quote(drawn.name)}")
            )
            return outline, (*middle, _angle(drawn))
    return None


def _wall(drawn: _Drawn) -> BaseGeometry:
    """Of one path. An outline within another is a hole (even-odd), whatever its direction."""
    what = f"wall {quote(drawn.name)}"
    pieces = np.array([check_polygon(points, what) for points in drawn.outlines], object)
    if len(pieces) == 1:
        return pieces[0]
    # where two overlap and neither is within the other, even-odd would drive through the wall
    left, right = shapely.STRtree(pieces).query(pieces, predicate="overlaps")
    shared = shapely.area(shapely.intersection(pieces[left], pieces[right]))
    alone = shapely.area(pieces)[[left, right]] - shared
    if (np.minimum(shared, alone.min(axis=0)) > LEAST_AREA).any():
        raise PalpateError(
            f"{what} has outlines that overlap: expected some within others or apart, or a path "
            "for each"
        )
    while len(pieces) > 1:  # in pairs, which is fast for hundreds of pieces
        rest = pieces[len(pieces) // 2 * 2 :]
        pairs = shapely.symmetric_difference(pieces[:-1:2], pieces[1::2])
        pieces = np.concatenate([pairs, rest])
    parts = shapely.get_parts(pieces[0])
    return shapely.union_all(parts[shapely.area(parts) >= LEAST_AREA])  # no slivers of rounding


def _middle(drawn: _Drawn) -> tuple[float, float]:
    return centre_polygon(check_polygon(drawn.points, f"goal {quote(drawn.name)}"))[1]


def _direction(drawn: _Drawn) -> float:
    """Of the first line of an arrow, rad, as namosim reads it."""
    along = drawn.points - drawn.points[0]
    longer = np.linalg.norm(along, axis=1) > _LEAST_ARROW
    if not longer.any():
        raise PalpateError(f"{drawn.called} has no direction: expected a line")
    x, y = along[np.argmax(longer)]
    return math.atan2(y, x)


def _angle(drawn: _Drawn) -> float:
    """What its attribute `angle` says in degrees, in rad."""
    return math.radians(_number(drawn.attributes.get("angle", "0"), f"angle of {drawn.called}"))


def read_drawing(path: Path, scale: float, corner: tuple[float, float] | None = None) -> Drawing:
    """Every path of an SVG in metres, y up; `scale` is metres per unit of the viewBox.

    The upper left corner of the viewBox comes to `corner` (x, y), m; without one the lower left
    comes to the origin. Raises `PalpateError` for a file that is no SVG with a viewBox, and for
    elements other than paths that are drawn and would have to be read.
    """
    from xml.etree.ElementTree import ParseError

    from defusedxml import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    content = read_bytes(path, _LARGEST_FILE)
    try:
        root = fromstring(content, forbid_dtd=False, forbid_entities=True, forbid_external=True)
    except DefusedXmlException as error:
        raise PalpateError(
            f"{path} defines XML entities or refers to other files: expected a drawing without"
        ) from error
    except (ParseError, ValueError, LookupError) as error:
        raise PalpateError(f"{path} is no XML: {error}") from error
    if _local(root.tag) != "svg":
        raise PalpateError(f"{path} has the root {quote(_local(root.tag))}: expected <svg>")
    view = root.get("viewBox")
    if view is None:
        raise PalpateError(f"{path} has no viewBox, which gives its size in cm")
    box = [_number(text, f"viewBox of {path}") for text in re.split(r"[\s,]+", view.strip())]
    if len(box) != 4 or box[2] <= 0 or box[3] <= 0:
        raise PalpateError(f"{path} has the viewBox {box}: expected x, y, width, height above 0")
    width, height = box[2] * scale, box[3] * scale
    left, top = corner or (0.0, height)
    to_metres = np.array(
        [[scale, 0, left - scale * box[0]], [0, -scale, top + scale * box[1]], [0, 0, 1.0]]
    )
    drawing = Drawing((width, height))
    matrix = compose(to_metres, np.eye(3), f"the viewBox of {path}")
    _walk(root, matrix, (), drawing, _Meant.within(root), str(path))
    return drawing


def _walk(
    element: Any,
    matrix: np.ndarray,
    groups: tuple[str, ...],
    drawing: Drawing,
    meant: _Meant,
    what: str,
) -> None:
    if len(groups) > _DEEPEST:
        raise PalpateError(f"{what} has groups more than {_DEEPEST} deep")
    layer = next((_LAYERS[group] for group in groups if group in _LAYERS), "")
    for child in element:
        tag = _local(child.tag)
        name = child.get("id", "")
        called = f"{tag} {quote(name)} of {what}"
        here = matrix
        if child.get("transform") and tag in ("g", "path"):
            here = compose(matrix, transform_matrix(child.get("transform"), called), called)
        if tag == "namo_config":
            drawing.config = child
        elif tag == "path":
            kind = child.get("type") or layer
            if kind and kind not in _TYPES:
                raise PalpateError(
                    f"{called} has the type {quote(kind)}: expected wall, movable, shape or "
                    "orientation, or none"
                )
            if child.get("d"):
                own = name or f"path_{len(drawing.paths)}"
                drawing.paths.append(_Drawn(own, called, kind, groups, dict(child.attrib), here))
        elif tag not in _NEVER_DRAWN:
            meant.check(child, called, layer)
            if tag == "g":
                inner = (*groups, name, *(one for one in _layers(child) if one != name))
                _walk(child, here, inner, drawing, meant, what)


def _layers(element: Any) -> list[str]:
    """Which of namosim's layers an element is, by its id or by the label that Inkscape shows."""
    labels = (value for key, value in element.attrib.items() if _local(key) in ("id", "label"))
    return [label for label in labels if label in _LAYERS]


def _local(tag: object) -> str:
    return str(tag).rpartition("}")[2]


def _number(text: str | None, what: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise PalpateError(f"{what} is {quote(text)}: expected a number")
    return value
