"""Small maps among movable obstacles that several tests plan on."""

from collections.abc import Mapping

import numpy as np
import shapely
from shapely import box

from palpate.planning.movable_obstacles.maps.map import Map, Movable, Robot, map_of

Box = tuple[float, float, float, float]


def corners(bounds: Box) -> np.ndarray:
    left, bottom, right, top = bounds
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def two_rooms(
    boxes: Mapping[str, Box],
    *,
    start=(1.0, 1.5),
    goal=(7.0, 1.5),
    doors=((1.0, 2.0),),
    wall=(4.0, 4.2),
    size=(8.0, 3.0),
    drive="differential",
    cell=0.1,
    margin=0.05,
    radius=0.2,
    extra=(),
) -> Map:
    """Two rooms beside one another; `doors` are (bottom, top) in the wall between them, m."""
    width, height = size
    solid = [box(0, 0, width, height) - box(0.1, 0.1, width - 0.1, height - 0.1)]
    between = box(wall[0], 0, wall[1], height)
    for bottom, top in doors:
        between = between - box(wall[0], bottom, wall[1], top)
    return map_of(
        "two rooms",
        walls=shapely.union_all([*solid, between, *extra]),
        movables=[Movable.from_corners(name, corners(bounds)) for name, bounds in boxes.items()],
        robot=Robot(radius, drive),
        start=start,
        goals=[goal],
        bounds=(0.0, 0.0, width, height),
        cell_size=cell,
        margin=margin,
    )


IN_DOOR: Box = (3.7, 1.1, 4.5, 1.9)
