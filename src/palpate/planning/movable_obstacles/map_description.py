"""Robot, objects, start and goals as JSON or YAML says them: our own maps and side-car files.

A map file holds everything; a side-car `NAME.movables.json` (or .yaml) beside a drawing or an
occupancy grid adds what that cannot say. Keys, all but `robot` optional in a side-car:

    robot:     {radius} or {footprint: [[x, y], ...]}, drive, reach
    movables:  {name: [[x, y], ...]} or {name: {polygon: ..., pose: ..., hints: {...}}}
    start, goals, cell_size, margin, bounds
    walls:     [[[x, y], ...], ...], each an outline or {outline, holes}
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.geometry import (
    checked_polygon,
    checked_pose,
    circumscribed_radius,
    corners_of,
)
from palpate.planning.movable_obstacles.map import Map, Movable, Robot, map_of
from palpate.storage import read_json, write_json

FORMAT = "palpate map 1"
SIDE_CAR = ".movables"
_LARGEST = 5_000_000  # bytes of YAML
_KEYS = {"robot", "movables", "start", "goals", "cell_size", "margin", "bounds", "walls"}
_MAP_KEYS = _KEYS | {"format", "name"}


def read_described(path: str | Path) -> Map:
    """A map of our own format; raises `PalpateError` for a file that is none."""
    path = Path(path)
    content = checked_keys(read_json(path), str(path), _MAP_KEYS)
    if content.get("format") != FORMAT:
        raise PalpateError(
            f"{path} has the format {content.get('format')!r}: expected {FORMAT!r}, as "
            "`write_map` writes it"
        )
    for key in ("robot", "start", "bounds", "cell_size"):
        if key not in content:
            raise PalpateError(f"{path} lacks {key}")
    walls = content.get("walls", [])
    if not isinstance(walls, list):
        raise PalpateError(f"{path} has walls that are no list of outlines")
    return map_of(
        str(content.get("name", path.stem)),
        walls=shapely.union_all([_wall(wall, f"wall {k}") for k, wall in enumerate(walls)]),
        movables=movables_from(content.get("movables", {}), str(path)),
        robot=robot_from(content["robot"], str(path)),
        start=content["start"],
        goals=goals_from(content.get("goals", []), str(path)),
        bounds=_bounds(content["bounds"], str(path)),
        cell_size=number(content["cell_size"], f"cell_size of {path}"),
        margin=None if "margin" not in content else number(content["margin"], f"margin of {path}"),
    )


def write_map(path: str | Path, world: Map) -> None:
    """Put a map into a JSON file that `read_described` reads back.

    Objects are written as outlines about their centroids, with their poses.
    """
    robot: dict[str, Any] = {"radius": world.robot.radius, "drive": world.robot.drive}
    if world.robot.reach is not None:
        robot["reach"] = world.robot.reach
    walls = [
        {
            "outline": np.asarray(part.exterior.coords)[:-1],
            "holes": [np.asarray(hole.coords)[:-1] for hole in part.interiors],
        }
        for part in shapely.get_parts(world.walls)
        if not part.is_empty
    ]
    movables = {
        name: {"polygon": movable.outline, "pose": movable.pose, "hints": dict(movable.hints)}
        for name, movable in world.movables.items()
    }
    write_json(
        path,
        {
            "format": FORMAT,
            "name": world.name,
            "bounds": world.bounds,
            "cell_size": world.cell_size,
            "margin": world.margin,
            "robot": robot,
            "start": world.start,
            "goals": world.goals,
            "walls": walls,
            "movables": movables,
        },
    )


def side_car(path: Path) -> dict[str, Any]:
    """What stands beside a map's file, as `NAME.movables.json` or .yaml; empty if nothing does."""
    for suffix in (".json", ".yaml", ".yml"):
        beside = path.with_name(path.stem + SIDE_CAR + suffix)
        if beside.exists():
            content = read_json(beside) if suffix == ".json" else read_yaml(beside)
            return checked_keys(content, str(beside), _KEYS)
    return {}


def read_yaml(path: Path) -> Any:
    """The plain data of a YAML file; raises `PalpateError` for tags, and for what is no YAML."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        content = path.read_bytes()
    except OSError as error:
        raise PalpateError(f"cannot read {path}: {error.strerror or error}") from error
    if len(content) > _LARGEST:
        raise PalpateError(f"{path} is of {len(content)} bytes: expected at most {_LARGEST}")
    try:
        return YAML(typ="safe", pure=True).load(content)
    except (YAMLError, ValueError, RecursionError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise PalpateError(f"{path} is no plain YAML: {reason}") from error


# --- parts ------------------------------------------------------------------------------------


def checked_keys(content: Any, what: str, known: set[str]) -> dict[str, Any]:
    """A mapping with no other keys; raises `PalpateError` otherwise."""
    if not isinstance(content, Mapping):
        raise PalpateError(f"{what} holds a {type(content).__name__}: expected keys and values")
    unknown = sorted({str(key) for key in content} - known)
    if unknown:
        raise PalpateError(
            f"{what} has the unknown key '{unknown[0]}'; there are: {', '.join(sorted(known))}"
        )
    return dict(content)


def robot_from(content: Any, what: str) -> Robot:
    """The robot that `content` describes; see the head of this file."""
    item = checked_keys(content, f"robot of {what}", {"radius", "footprint", "drive", "reach"})
    if ("radius" in item) == ("footprint" in item):
        raise PalpateError(f"robot of {what}: expected either a radius or a footprint")
    outline = None
    if "footprint" in item:
        outline = corners_of(checked_polygon(item["footprint"], f"the robot's footprint in {what}"))
        radius = circumscribed_radius(outline)
    else:
        radius = number(item["radius"], f"the robot's radius in {what}")
    reach = None if item.get("reach") is None else number(item["reach"], f"reach in {what}")
    return Robot(radius, str(item.get("drive", "differential")), reach, outline)


def movables_from(content: Any, what: str) -> list[Movable]:
    """The objects that `content` describes; those without a polygon are left out."""
    if not isinstance(content, Mapping):
        raise PalpateError(f"movables of {what}: expected names with polygons")
    movables = []
    for name, value in content.items():
        item: Mapping[str, Any] = value if isinstance(value, Mapping) else {"polygon": value}
        item = checked_keys(item, f"movable '{name}' of {what}", {"polygon", "pose", "hints"})
        if "polygon" not in item:
            continue
        movable = Movable.from_corners(str(name), item["polygon"], item.get("hints"))
        if "pose" in item:
            pose = checked_pose(item["pose"], f"the pose of movable '{name}'")
            movable = Movable(movable.name, movable.outline, pose, movable.hints)
        movables.append(movable)
    return movables


def hints_from(content: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """What a side-car says of objects that stand in the drawing, by name."""
    return {
        str(name): dict(item["hints"])
        for name, item in content.get("movables", {}).items()
        if isinstance(item, Mapping) and isinstance(item.get("hints"), Mapping)
    }


def goals_from(content: Any, what: str) -> list[Any]:
    """A list of goal poses; raises `PalpateError` for anything else."""
    if not isinstance(content, list):
        raise PalpateError(f"goals of {what}: expected a list of [x, y, theta]")
    return content


def number(value: Any, what: str) -> float:
    """A finite number; raises `PalpateError` for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise PalpateError(f"{what} is {value!r}: expected a number")
    return float(value)


def _bounds(value: Any, what: str) -> tuple[float, float, float, float]:
    if not isinstance(value, list) or len(value) != 4:
        raise PalpateError(f"bounds of {what}: expected [left, bottom, right, top] in m")
    left, bottom, right, top = (number(side, f"bounds of {what}") for side in value)
    return left, bottom, right, top


def _wall(value: Any, what: str) -> BaseGeometry:
    item = value if isinstance(value, Mapping) else {"outline": value}
    item = checked_keys(item, what, {"outline", "holes"})
    outline = checked_polygon(item.get("outline", []), what)
    holes = [checked_polygon(hole, f"a hole of {what}") for hole in item.get("holes", [])]
    return outline.difference(shapely.union_all(holes)) if holes else outline
