"""Maps from ROS map_server's YAML and picture, with polygons for what can be moved beside it.

p = (255 - v) / 255 is how occupied a pixel is, p = v / 255 where `negate` is set; above
`occupied_thresh` it is a wall, below `free_thresh` it is free, and what lies between is unknown: as
a wall to a planner. The origin is the lower left corner; its yaw is passed over, as most readers
do. Robot, objects, start and goals come from a side-car file (`map_description`), or from
namosim's `namo.yaml` and the layers of the drawing it names.
"""

from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.map import MOST_CELLS, Map, Robot, map_of
from palpate.planning.movable_obstacles.map_description import (
    goals_from,
    movables_from,
    number,
    read_yaml,
    robot_from,
    side_car,
)
from palpate.planning.movable_obstacles.map_svg import goals_of, movables_of, read_drawing

MODES = ("trinary", "scale", "raw")
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.25}
Bounds = tuple[float, float, float, float]


def read_ros(path: str | Path) -> Map:
    """A map_server YAML or a namosim `namo.yaml` as a map.

    Raises `PalpateError` for keys that are missing, a picture that cannot be read, and a map that
    nothing says the robot of.
    """
    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise PalpateError(f"{path} is no map: expected keys and values")
    if "map_yaml" in content:
        return _namosim(path, content)
    walls, bounds, resolution = read_grid(path, content)
    beside = side_car(path)
    for key in ("robot", "start"):
        if key not in beside:
            raise PalpateError(
                f"{path} says nothing of the {key}: expected a file {path.stem}.movables.json "
                "beside it with robot, start, goals and movables"
            )
    margin = beside.get("margin")
    return map_of(
        path.stem,
        walls=walls,
        movables=movables_from(beside.get("movables", {}), str(path)),
        robot=robot_from(beside["robot"], str(path)),
        start=beside["start"],
        goals=goals_from(beside.get("goals", []), str(path)),
        bounds=bounds,
        cell_size=number(beside.get("cell_size", resolution), f"cell_size of {path}"),
        margin=None if margin is None else number(margin, f"margin of {path}"),
    )


def read_grid(path: Path, content: dict[str, Any]) -> tuple[BaseGeometry, Bounds, float]:
    """Walls, bounds (left, bottom, right, top; m) and resolution (m) of a map_server YAML.

    Raises `PalpateError` for keys that are missing or of no sense, and for the picture.
    """
    for key in ("image", "resolution", "origin"):
        if key not in content:
            raise PalpateError(f"{path} lacks {key}: expected a map_server YAML")
    resolution = number(content["resolution"], f"resolution of {path}")
    if not 1e-4 <= resolution <= 100:
        raise PalpateError(f"{path} has the resolution {resolution}: expected m per pixel")
    origin = content["origin"]
    if not isinstance(origin, list) or len(origin) not in (2, 3):
        raise PalpateError(f"{path} has the origin {origin!r}: expected [x, y, yaw]")
    left, bottom = (number(value, f"origin of {path}") for value in origin[:2])
    mode = content.get("mode", "trinary")
    if mode not in MODES:
        raise PalpateError(f"{path} has the mode {mode!r}: expected one of {', '.join(MODES)}")
    occupied, free = (
        number(content.get(key, default), f"{key} of {path}")
        for key, default in _THRESHOLDS.items()
    )
    value = _picture(path.parent / str(content["image"]))
    if mode == "raw":
        share = value / 100  # 0 to 100, and 255 for unknown
        blocked = (share > free) | (share >= occupied)
    else:
        share = value / 255 if content.get("negate", 0) else (255 - value) / 255
        blocked = ~(share < free)
    height, width = blocked.shape
    bounds = (left, bottom, left + width * resolution, bottom + height * resolution)
    return walls_of(blocked[::-1], left, bottom, resolution), bounds, resolution


def walls_of(blocked: np.ndarray, left: float, bottom: float, resolution: float) -> BaseGeometry:
    """The polygons that blocked pixels (rows from the bottom, columns) make up."""
    change = np.diff(np.pad(blocked, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, begins = np.nonzero(change == 1)
    _, ends = np.nonzero(change == -1)
    # runs of the same columns in rows that follow one another make one box
    order = np.lexsort((rows, ends, begins))
    rows, begins, ends = rows[order], begins[order], ends[order]
    new = np.ones(len(rows), bool)
    new[1:] = (np.diff(rows) != 1) | (np.diff(begins) != 0) | (np.diff(ends) != 0)
    first = np.flatnonzero(new)
    last = np.append(first[1:], len(rows)) - 1 if len(rows) else first
    boxes = shapely.box(
        left + begins[first] * resolution,
        bottom + rows[first] * resolution,
        left + ends[first] * resolution,
        bottom + (rows[last] + 1) * resolution,
    )
    return shapely.union_all(boxes)


def _picture(path: Path) -> np.ndarray:
    """Grey values (rows from the top, columns), 0 to 255, colours averaged."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            width, height = picture.size
            if width * height > MOST_CELLS:
                raise PalpateError(
                    f"{path} has {width} x {height} pixels: expected at most {MOST_CELLS:,}"
                )
            deep = picture.mode.startswith("I")
            values = np.asarray(picture if deep or picture.mode == "L" else picture.convert("RGB"))
    except FileNotFoundError as error:
        raise PalpateError(f"there is no file {path}, which a map names as its image") from error
    except (UnidentifiedImageError, OSError, ValueError, Image.DecompressionBombError) as error:
        raise PalpateError(f"{path} is no picture that can be read: expected PGM or PNG") from error
    values = values.astype(float)
    if values.ndim == 3:
        values = values.mean(axis=2)
    return values / 257 if deep else values


def _namosim(path: Path, content: dict[str, Any]) -> Map:
    """namosim's own YAML: a map, a drawing over it in pixels, agents."""
    grid = path.parent / str(content["map_yaml"])
    described = read_yaml(grid)
    if not isinstance(described, dict):
        raise PalpateError(f"{grid} is no map: expected keys and values")
    walls, bounds, resolution = read_grid(grid, described)
    agents = content.get("agents")
    if not isinstance(agents, list) or not agents or not isinstance(agents[0], dict):
        raise PalpateError(f"{path} has no agents: expected one with an id and a radius")
    agent = agents[0]
    if "initial_pose" not in agent or "radius" not in agent:
        raise PalpateError(f"{path} has an agent without initial_pose and radius")
    movables, goals = [], []
    if "svg_file" in content:
        drawing = read_drawing(path.parent / str(content["svg_file"]), resolution)
        movables, goals = movables_of(drawing), goals_of(drawing)
    behaviour = agent.get("behavior") or {}
    drive = (behaviour.get("parameters") or {}).get("drive_type", "differential")
    x, y, *degrees = (number(value, f"initial_pose in {path}") for value in agent["initial_pose"])
    margin = content.get("collision_margin")
    return map_of(
        grid.stem,
        walls=walls,
        movables=movables,
        robot=Robot(number(agent["radius"], f"radius in {path}"), str(drive)),
        start=(x, y, np.radians(degrees[0]) if degrees else 0.0),
        goals=goals,
        bounds=bounds,
        cell_size=resolution,
        margin=None if margin is None else number(margin, f"collision_margin in {path}"),
    )
