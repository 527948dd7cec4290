"""Maps from ROS map_server's YAML and picture, with polygons for what can be moved beside it.

p = (255 - v) / 255 is how occupied a pixel is, p = v / 255 where `negate` is set; above
`occupied_thresh` it is a wall, below `free_thresh` it is free, and what lies between is unknown: as
a wall to a planner. The origin is the lower left corner; its yaw has to be 0. Robot, objects, start
and goals come from a side-car file (`map_description`), or from namosim's `namo.yaml` and the
layers of the drawing it names, which lies on the picture pixel by pixel.
"""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.geometry import checked_pose, shown
from palpate.planning.movable_obstacles.map import MOST_CELLS, Map, Pose, Robot, map_of
from palpate.planning.movable_obstacles.map_description import (
    GRID_KEYS,
    goals_from,
    movables_from,
    number,
    read_yaml,
    robot_from,
    side_car,
    with_hints,
)
from palpate.planning.movable_obstacles.map_svg import (
    drawn_walls,
    goals_of,
    movables_of,
    read_drawing,
)

MODES = ("trinary", "scale", "raw")
_BROKEN = (OSError, ValueError, SyntaxError)  # what Pillow raises for the middle of a picture
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.25}
_TRUTHS = {"yes": True, "on": True, "true": True, "no": False, "off": False, "false": False}
_LEAST_YAW = 1e-3  # rad: less turns a map of 10 m by a centimetre
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
    beside = side_car(path, GRID_KEYS)
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
        raise PalpateError(f"{path} has the origin {shown(origin)}: expected [x, y, yaw]")
    left, bottom, *yaw = (number(value, f"origin of {path}") for value in origin)
    if yaw and abs(yaw[0]) > _LEAST_YAW:
        raise PalpateError(
            f"{path} has an origin with a yaw of {yaw[0]:g}: expected 0, and a picture that is "
            "turned instead"
        )
    mode = content.get("mode", "trinary")
    if mode not in MODES:
        raise PalpateError(f"{path} has the mode {shown(mode)}: expected one of {', '.join(MODES)}")
    negate = _truth(content.get("negate", 0), f"negate of {path}")
    occupied, free = (
        number(content.get(key, default), f"{key} of {path}")
        for key, default in _THRESHOLDS.items()
    )
    value = _picture(path.parent / str(content["image"]))
    if mode == "raw":
        share = value / 100  # 0 to 100, and 255 for unknown
        blocked = (share > free) | (share >= occupied)
    else:
        share = value / 255 if negate else (255 - value) / 255
        blocked = (share >= occupied) | ~(share < free)
    height, width = blocked.shape
    bounds = (left, bottom, left + width * resolution, bottom + height * resolution)
    return walls_of(blocked[::-1], left, bottom, resolution), bounds, resolution


def _truth(value: Any, what: str) -> bool:
    """0, 1, true or false; also the words that are truths in YAML 1.1 and strings in YAML 1.2."""
    if isinstance(value, str) and value.lower() in _TRUTHS:
        return _TRUTHS[value.lower()]
    if isinstance(value, bool | int) and value in (0, 1):
        return bool(value)
    raise PalpateError(f"{what} is {shown(value)}: expected 0, 1, true or false")


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
        with warnings.catch_warnings():  # what is too large is said below
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            opened = Image.open(path)
        with opened as picture:
            width, height = picture.size
            if width * height > MOST_CELLS:
                raise PalpateError(
                    f"{path} has {width} x {height} pixels: expected at most {MOST_CELLS:,}"
                )
            deep = picture.mode.startswith("I")
            values = np.asarray(picture if deep or picture.mode == "L" else picture.convert("RGB"))
    except PalpateError:
        raise
    except FileNotFoundError as error:
        raise PalpateError(f"there is no file {path}, which a map names as its image") from error
    except (UnidentifiedImageError, *_BROKEN, Image.DecompressionBombError) as error:
        raise PalpateError(f"{path} is no picture that can be read: expected PGM or PNG") from error
    values = values.astype(float)
    if values.ndim == 3:
        values = values.mean(axis=2)
    return values / 257 if deep else values


def _namosim(path: Path, content: dict[str, Any]) -> Map:
    """namosim's own YAML: a map, a drawing over it in pixels, agents; the first is the robot."""
    grid = path.parent / str(content["map_yaml"])
    described = read_yaml(grid)
    if not isinstance(described, dict):
        raise PalpateError(f"{grid} is no map: expected keys and values")
    walls, bounds, resolution = read_grid(grid, described)
    agents = content.get("agents")
    if not isinstance(agents, list) or not agents:
        raise PalpateError(f"{path} has no agents: expected one with an id and a radius")
    (robot, start), *others = (_agent(agent, str(path)) for agent in agents)
    besides = [shapely.Point(pose[:2]).buffer(other.radius) for other, pose in others]
    movables, goals = [], []
    if "svg_file" in content:
        corner = bounds[0], bounds[3]
        drawing = read_drawing(path.parent / str(content["svg_file"]), resolution, corner)
        movables, goals = movables_of(drawing), goals_of(drawing, str(agents[0]["id"]))
        besides = [*besides, *drawn_walls(drawing)]
    margin = content.get("collision_margin")
    world = map_of(
        grid.stem,
        walls=shapely.union_all([walls, *besides]) if besides else walls,
        movables=movables,
        robot=robot,
        start=start,
        goals=goals,
        bounds=bounds,
        cell_size=resolution,
        margin=None if margin is None else number(margin, f"collision_margin in {path}"),
    )
    return with_hints(world, path)


def _agent(content: Any, what: str) -> tuple[Robot, Pose]:
    """An agent of namosim's YAML, and where it stands; its angles are degrees."""
    if not isinstance(content, dict) or not {"id", "initial_pose", "radius"} <= content.keys():
        raise PalpateError(f"{what} has an agent without id, initial_pose and radius")
    behaviour = _keys(content.get("behavior"), f"behavior in {what}")
    parameters = _keys(behaviour.get("parameters"), f"parameters of the behavior in {what}")
    drive = parameters.get("drive_type", "differential")
    pose = content["initial_pose"]
    if not isinstance(pose, list) or len(pose) not in (2, 3):
        raise PalpateError(
            f"{what} has the initial_pose {shown(pose)}: expected [x, y, angle] in m and degrees"
        )
    x, y, *degrees = (number(value, f"initial_pose in {what}") for value in pose)
    theta = math.radians(degrees[0]) if degrees else 0.0
    robot = Robot(number(content["radius"], f"radius in {what}"), str(drive))
    return robot, checked_pose((x, y, theta), f"initial_pose in {what}")


def _keys(content: Any, what: str) -> dict[str, Any]:
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise PalpateError(f"{what} is {shown(content)}: expected keys and values")
    return content
