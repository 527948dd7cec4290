"""Small maps among movable obstacles that several tests plan on."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import box

from palpate.numerics.polygons import LEAST_AREA
from palpate.planning.movable_obstacles.maps.description import FORMAT
from palpate.planning.movable_obstacles.maps.map import Map, Movable, Robot, map_of
from palpate.runs.storage import write_json

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


def write_map(path: str | Path, world: Map) -> None:
    """Put a map into a JSON file that `read_described` reads back, without slivers of walls."""
    robot: dict[str, Any] = {"radius": world.robot.radius, "drive": world.robot.drive}
    if world.robot.reach is not None:
        robot["reach"] = world.robot.reach
    if world.robot.push_only:
        robot["push_only"] = True
    walls = [
        {
            "outline": np.asarray(part.exterior.coords)[:-1],
            "holes": [
                np.asarray(hole.coords)[:-1]
                for hole in part.interiors
                if shapely.Polygon(hole).area >= LEAST_AREA
            ],
        }
        for part in shapely.get_parts(world.walls)
        if part.area >= LEAST_AREA
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


IN_DOOR: Box = (3.7, 1.1, 4.5, 1.9)
