"""Maps from ROS map_server's YAML and picture, with polygons for what can be moved beside it.

p = (255 - v) / 255 is how occupied a pixel is, p = v / 255 where `negate` is set; above
`occupied_thresh` it is a wall, below `free_thresh` it is free, and what lies between is unknown: as
a wall to a planner, as is what a picture leaves transparent. The origin is the lower left corner;
its yaw has to be 0. Robot, objects, start and goals come from a side-car file (`map_description`).
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from palpate.errors import PalpateError, quote
from palpate.planning.movable_obstacles.maps.description import (
    GRID_KEYS,
    build_map,
    keys_of,
    list_of,
    number,
    read_yaml,
    side_car,
    truth,
)
from palpate.planning.movable_obstacles.maps.map import MOST_CELLS, Map

MODES = ("trinary", "scale", "raw")
_BROKEN = (OSError, ValueError, SyntaxError)  # what Pillow raises for the middle of a picture
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.25}
_OPAQUE = 255
_LEAST_YAW = 1e-3  # rad: less turns a map of 10 m by a centimetre
Bounds = tuple[float, float, float, float]


def read_ros(path: str | Path) -> Map:
    """A map_server YAML as a map.

    Raises `PalpateError` for keys that are missing, a picture that cannot be read, and a map that
    nothing says the robot of.
    """
    path = Path(path)
    content = read_map_yaml(path)
    walls, bounds, resolution = read_grid(path, content)
    beside = side_car(path, GRID_KEYS)
    for key in ("robot", "start"):
        if key not in beside:
            raise PalpateError(
                f"{path} says nothing of the {key}: expected a file {path.stem}.movables.json "
                "beside it with robot, start, goals and movables"
            )
    if beside.get("margin", 0) is None:  # as if it were left out
        del beside["margin"]
    return build_map(path.stem, str(path), beside, walls, bounds, resolution)


def read_map_yaml(path: Path) -> dict[str, Any]:
    """The keys and values of a YAML; raises `PalpateError` for a file that holds none."""
    return keys_of(read_yaml(path), f"{path} is no map")


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
    origin = list_of(content["origin"], f"origin of {path}", "[x, y, yaw]", lengths=(2, 3))
    left, bottom, *yaw = (number(value, f"origin of {path}") for value in origin)
    if yaw and abs(yaw[0]) > _LEAST_YAW:
        raise PalpateError(
            f"{path} has an origin with a yaw of {yaw[0]:g}: expected 0, and a picture that is "
            "turned instead"
        )
    mode = content.get("mode", "trinary")
    if mode not in MODES:
        raise PalpateError(f"{path} has the mode {quote(mode)}: expected one of {', '.join(MODES)}")
    negate = truth(content.get("negate", 0), f"negate of {path}")
    occupied, free = (
        number(content.get(key, default), f"{key} of {path}")
        for key, default in _THRESHOLDS.items()
    )
    for key, share in zip(_THRESHOLDS, (occupied, free), strict=True):
        if not 0 <= share <= 1:  # in per cent every wall would be free
            raise PalpateError(f"{path} has the {key} {share:g}: expected a share, 0 to 1")
    value, opaque = _picture(path.parent / str(content["image"]))
    if mode == "raw":
        share = value / 100  # 0 to 100, and 255 for unknown
        blocked = (share > free) | (share >= occupied) | ~opaque
    else:
        share = value / 255 if negate else (255 - value) / 255
        blocked = (share >= occupied) | ~(share < free) | ~opaque
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


def _picture(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Grey values (rows from the top, columns), 0 to 255, colours averaged, and what is opaque."""
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
            opaque = np.ones((height, width), bool)
            if picture.has_transparency_data:
                opaque = np.asarray(picture.convert("RGBA"))[..., 3] == _OPAQUE
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
    return values / 257 if deep else values, opaque
