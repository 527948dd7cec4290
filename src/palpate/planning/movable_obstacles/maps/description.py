"""Robot, objects, start and goals as JSON or YAML says them: our own maps and side-car files.

A map file holds everything; a side-car `NAME.movables.json` (or .yaml) adds what a drawing or an
occupancy grid cannot say. Every other key than these is refused:

    a map of our own    format, robot, start, bounds, cell_size; maybe name, movables, goals,
                        margin, walls
    beside a grid       robot, start; maybe movables, goals, margin, cell_size
    beside a drawing    movables, and of them only hints: {name: {hints: {...}}}

    robot:     {radius} or {footprint: [[x, y], ...]}; maybe drive, reach,
               push_only
    movables:  {name: [[x, y], ...]} or {name: {polygon: [[x, y], ...]}}, maybe with pose, hints
    start, each of goals, pose:  [x, y, theta]
    bounds:    [left, bottom, right, top]
    walls:     [[[x, y], ...], ...], each an outline or {outline, holes}

A polygon is in the world; one with a `pose` is in body coordinates, whose origin is put at x, y and
which are turned by theta, wherever the centroid is.
"""

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from palpate.errors import PalpateError, list_names, quote
from palpate.numerics.polygons import (
    centre_polygon,
    check_polygon,
    check_pose,
    circumscribed_radius,
    corners_of,
    place_points,
)
from palpate.planning.movable_obstacles.maps.map import Map, Movable, Pose, Robot, map_of
from palpate.runs.storage import read_json

FORMAT = "palpate map 1"
SIDE_CAR = ".movables"
_LARGEST = 5_000_000  # bytes of YAML
_DEEPEST = 50  # collections in collections
GRID_KEYS = {"robot", "movables", "start", "goals", "cell_size", "margin"}
_MAP_KEYS = GRID_KEYS | {"bounds", "walls", "format", "name"}
_DRAWING_KEYS = {"movables"}
_ROBOT_KEYS = {"radius", "footprint", "drive", "reach", "push_only"}
_OBJECTS = "names with polygons or hints"
_TRUTHS: dict[str, bool] = dict.fromkeys(("yes", "on", "true", "1"), True)
_TRUTHS |= dict.fromkeys(("no", "off", "false", "0"), False)
_CENTRED = 1e-9  # m: a centroid nearer to the body's origin is there


def read_described(path: str | Path) -> Map:
    """A map of our own format; raises `PalpateError` for a file that is none."""
    path = Path(path)
    content = check_keys(read_json(path), str(path), _MAP_KEYS)
    if content.get("format") != FORMAT:
        raise PalpateError(
            f"{path} has the format {quote(content.get('format'))}: expected {FORMAT!r}"
        )
    for key in ("robot", "start", "bounds", "cell_size"):
        if key not in content:
            raise PalpateError(f"{path} lacks {key}")
    walls = list_of(content.get("walls", []), f"walls of {path}", "a list of outlines")
    name = content.get("name", path.stem)
    if not isinstance(name, str):
        raise PalpateError(f"{path} has the name {quote(name)}: expected a text")
    solid = shapely.union_all([_wall(wall, f"wall {k}") for k, wall in enumerate(walls)])
    what = f"bounds of {path}"
    sides = list_of(content["bounds"], what, "[left, bottom, right, top] in m", lengths=(4,))
    bounds = tuple(number(side, what) for side in sides)
    return build_map(name, str(path), content, solid, bounds, content["cell_size"])


def build_map(
    name: str, what: str, content: Mapping[str, Any], walls: BaseGeometry, bounds: Any, cell: Any
) -> Map:
    """The map of these walls and bounds (m), with all else as `content` describes it.

    `cell` (m) is the size of its cells where `content` has none. Raises `PalpateError`.
    """
    return map_of(
        name,
        walls=walls,
        movables=movables_from(content.get("movables", {}), what),
        robot=robot_from(content["robot"], what),
        start=content["start"],
        goals=list_of(content.get("goals", []), f"goals of {what}", "a list of [x, y, theta]"),
        bounds=bounds,
        cell_size=number(content.get("cell_size", cell), f"cell_size of {what}"),
        margin=number(content["margin"], f"margin of {what}") if "margin" in content else None,
    )


def side_car(path: Path, known: set[str]) -> dict[str, Any]:
    """What stands beside a map's file, as `NAME.movables.json` or .yaml; empty if nothing does.

    Raises `PalpateError` for two of them, and for other keys than `known`.
    """
    suffixes = (".json", ".yaml", ".yml")
    every = [path.with_name(path.stem + SIDE_CAR + suffix) for suffix in suffixes]
    found = [beside for beside in every if beside.exists()]
    if len(found) > 1:
        raise PalpateError(f"{found[0]} and {found[1]} are of the same map: expected one of them")
    if not found:
        return {}
    beside = found[0]
    content = read_json(beside) if beside.suffix == ".json" else read_yaml(beside)
    return check_keys(content, str(beside), known)


def with_hints(world: Map, path: Path) -> Map:
    """A drawing's map with what the side-car of its file says of the objects' dynamics.

    Raises `PalpateError` for a side-car that says anything else, and for hints on an object that
    is not on the map.
    """
    what = f"the side-car of {path}"
    given = side_car(path, _DRAWING_KEYS).get("movables", {})
    movables = dict(world.movables)
    for key, item in keys_of(given, f"movables in {what}", _OBJECTS).items():
        name = str(key)
        if name not in movables:
            raise PalpateError(
                f"{what} has hints for {quote(name)}, which is not on the map; there are: "
                + list_names(map(quote, world.movables), 8)
            )
        said = check_keys(item, f"movable {quote(name)} in {what}", {"hints"})
        hints = keys_of(said.get("hints") or {}, f"hints of {quote(name)} in {what}")
        movables[name] = dataclasses.replace(movables[name], hints=hints)
    return dataclasses.replace(world, movables=movables)


def read_yaml(path: Path) -> Any:
    """The plain data of a YAML file; raises `PalpateError` for tags, and for what is no YAML.

    Aliases are refused as well: a few lines of them stand for gigabytes.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent

    content = read_bytes(path, _LARGEST)
    try:
        events = YAML(typ="safe", pure=True).parse(content) if b"*" in content else ()
        depth = 0
        for event in events:  # before the load, which is where they grow
            depth += isinstance(event, CollectionStartEvent)
            depth -= isinstance(event, CollectionEndEvent)
            if depth > _DEEPEST:
                raise PalpateError(f"{path} is nested more than {_DEEPEST} deep")
            if isinstance(event, AliasEvent):
                raise PalpateError(
                    f"{path} has the alias {quote(event.anchor)}: expected what it stands for"
                )
        return YAML(typ="safe", pure=True).load(content)
    except PalpateError:
        raise
    except (YAMLError, ValueError, LookupError, ArithmeticError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise PalpateError(f"{path} is no plain YAML: {reason}") from error


def read_bytes(path: Path, most: int) -> bytes:
    """The content of a file of at most so many bytes; raises `PalpateError` for any other."""
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:  # no path has a null character
        reason = getattr(error, "strerror", None) or error
        raise PalpateError(f"cannot read {path}: {reason}") from error
    if len(content) > most:
        raise PalpateError(f"{path} is of {len(content)} bytes: expected at most {most}")
    return content


# --- parts ------------------------------------------------------------------------------------


def check_keys(content: Any, what: str, known: set[str]) -> dict[str, Any]:
    """A mapping with no other keys; raises `PalpateError` otherwise."""
    content = keys_of(content, what)
    unknown = sorted({str(key) for key in content} - known)
    if unknown:
        raise PalpateError(
            f"{what} has the unknown key {quote(unknown[0])}; there are: "
            + ", ".join(sorted(known))
        )
    return content


def keys_of(content: Any, what: str, meant: str = "keys and values") -> dict[str, Any]:
    """A mapping; raises `PalpateError` for anything else, with what is `meant`."""
    if not isinstance(content, Mapping):
        kind = type(content).__name__
        raise PalpateError(f"{what}: expected {meant}, not {quote(content)} of type {kind}")
    return dict(content)


def list_of(value: Any, what: str, meant: str, lengths: tuple[int, ...] = ()) -> list[Any]:
    """A list, of one of the `lengths` if there are any; raises `PalpateError` for anything else."""
    if not isinstance(value, list) or (lengths and len(value) not in lengths):
        raise PalpateError(f"{what}: expected {meant}, not {quote(value)}")
    return value


def robot_from(content: Any, what: str) -> Robot:
    """The robot that `content` describes; see the head of this file."""
    item = check_keys(content, f"robot of {what}", _ROBOT_KEYS)
    if ("radius" in item) == ("footprint" in item):
        raise PalpateError(f"robot of {what}: expected either a radius or a footprint")
    outline = None
    if "footprint" in item:
        outline = corners_of(check_polygon(item["footprint"], f"the robot's footprint in {what}"))
        radius = circumscribed_radius(outline)
    else:
        radius = number(item["radius"], f"the robot's radius in {what}")
    reach = None if item.get("reach") is None else number(item["reach"], f"reach in {what}")
    push_only = truth(item.get("push_only", False), f"push_only in {what}")
    return Robot(radius, str(item.get("drive", "differential")), reach, outline, push_only)


def movables_from(content: Any, what: str) -> list[Movable]:
    """The objects that `content` describes; see the head of this file."""
    movables = []
    for key, value in keys_of(content, f"movables of {what}", _OBJECTS).items():
        name = str(key)
        called = f"movable {quote(name)} of {what}"
        item: Any = value if isinstance(value, Mapping) else {"polygon": value}
        item = check_keys(item, called, {"polygon", "pose", "hints"})
        if "polygon" not in item:
            raise PalpateError(f"{called} lacks its polygon: expected [[x, y], ...] in m")
        hints = keys_of(item.get("hints") or {}, f"hints of {called}")
        if "pose" in item:
            pose = check_pose(item["pose"], f"the pose of {called}")
            movables.append(_at(name, item["polygon"], pose, hints, called))
        else:
            movables.append(Movable.from_corners(name, item["polygon"], hints))
    return movables


def _at(name: str, corners: Any, pose: Pose, hints: dict[str, Any], what: str) -> Movable:
    """An object from corners in body coordinates, whose origin is put at `pose`."""
    polygon = check_polygon(corners, what)
    outline, centroid = centre_polygon(polygon)
    if np.linalg.norm(centroid) <= _CENTRED:  # the same numbers again
        return Movable(name, corners_of(polygon), pose, hints)
    ((x, y),) = place_points(np.array([centroid]), pose)
    return Movable(name, outline, (float(x), float(y), pose[2]), hints)


def number(value: Any, what: str) -> float:
    """A finite number; raises `PalpateError` for anything else."""
    found = math.nan
    if isinstance(value, int | float) and not isinstance(value, bool):
        with contextlib.suppress(OverflowError):  # an integer of hundreds of digits
            found = float(value)
    if not math.isfinite(found):
        raise PalpateError(f"{what} is {quote(value)}: expected a number")
    return found


def truth(value: Any, what: str) -> bool:
    """0, 1, true or false; also those in a string, and the words that are truths in YAML 1.1."""
    if isinstance(value, str) and value.strip().lower() in _TRUTHS:
        return _TRUTHS[value.strip().lower()]
    if isinstance(value, bool | int) and value in (0, 1):
        return bool(value)
    raise PalpateError(f"{what} is {quote(value)}: expected 0, 1, true or false")


def _wall(value: Any, what: str) -> BaseGeometry:
    item = value if isinstance(value, Mapping) else {"outline": value}
    item = check_keys(item, what, {"outline", "holes"})
    outline = check_polygon(item.get("outline", []), what)
    holes = list_of(item.get("holes", []), f"holes of {what}", "a list of outlines")
    every = [check_polygon(hole, f"a hole of {what}") for hole in holes]
    return outline.difference(shapely.union_all(every)) if every else outline
