"""Maps that namosim puts together: a map_server YAML, a drawing over its picture, and agents.

The drawing lies on the picture pixel by pixel; its layers hold movables, goals and robots. The
first agent is the robot, the others stand in its way. An agent without an `initial_pose` stands
where the layer of robots has a path with its `agent_id`, and has its outline. Angles are degrees.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import shapely

from palpate.errors import PalpateError, quote
from palpate.numerics.polygons import check_pose, circumscribed_radius
from palpate.planning.movable_obstacles.maps.description import (
    keys_of,
    list_of,
    number,
    truth,
    with_hints,
)
from palpate.planning.movable_obstacles.maps.map import Map, Pose, Robot, map_of
from palpate.planning.movable_obstacles.maps.ros import read_grid, read_map_yaml
from palpate.planning.movable_obstacles.maps.svg import (
    Drawing,
    goals_of,
    movables_of,
    read_drawing,
    robot_of,
    walls_of,
)


def read_namosim(path: str | Path) -> Map:
    """namosim's `namo.yaml` as a map.

    Raises `PalpateError` for keys that are missing or of no sense, and as the readers of the grid
    and the drawing do.
    """
    path = Path(path)
    content = read_map_yaml(path)
    grid = path.parent / str(content["map_yaml"])
    walls, bounds, resolution = read_grid(grid, read_map_yaml(grid))
    drawing = None
    if content.get("svg_file") is not None:
        corner = bounds[0], bounds[3]
        drawing = read_drawing(path.parent / str(content["svg_file"]), resolution, corner)
    agents = content.get("agents")
    if not isinstance(agents, list) or not agents:
        raise PalpateError(f"{path} has no agents: expected one with an id and a radius")
    (robot, start), *others = (_agent(agent, drawing, str(path)) for agent in agents)
    besides = [shapely.Point(pose[:2]).buffer(other.radius) for other, pose in others]
    world = map_of(
        grid.stem,
        walls=shapely.union_all([walls, *besides, *(walls_of(drawing) if drawing else [])]),
        movables=movables_of(drawing) if drawing else [],
        robot=robot,
        start=start,
        goals=goals_of(drawing, str(agents[0]["id"])) if drawing else [],
        bounds=bounds,
        cell_size=resolution,
        margin=_margin(content, str(path)),
    )
    return with_hints(world, path)


def _margin(content: dict[str, Any], what: str) -> float | None:
    """In m; None where it is to be a cell, as namosim takes 0 centimetres too."""
    if content.get("collision_margin_cm") is not None:
        centimetres = number(content["collision_margin_cm"], f"collision_margin_cm in {what}")
        return centimetres / 100 or None
    if content.get("collision_margin") is not None:  # older files, in m
        return number(content["collision_margin"], f"collision_margin in {what}")
    return None


def _agent(content: Any, drawing: Drawing | None, what: str) -> tuple[Robot, Pose]:
    """An agent, and where it stands."""
    agent = keys_of(content, f"an agent in {what}")
    for key in ("id", "radius"):
        if key not in agent:
            raise PalpateError(f"{what} has an agent without {key}: expected id and radius")
    behaviour = keys_of(agent.get("behavior") or {}, f"behavior in {what}")
    parameters = behaviour.get("parameters") or {}
    # an older file has what the robot can do beside its radius
    parameters = agent | keys_of(parameters, f"parameters of the behavior in {what}")
    robot = Robot(
        number(agent["radius"], f"radius in {what}"),
        str(parameters.get("drive_type", "differential")),
        push_only=truth(parameters.get("push_only", False), f"push_only in {what}"),
    )
    pose = agent.get("initial_pose")
    if pose is None:
        drawn = None if drawing is None else robot_of(drawing, str(agent["id"]))
        if drawn is None:
            raise PalpateError(
                f"{what} has the agent {quote(agent['id'])} without an initial_pose: expected "
                "one, or in the drawing's robots_layer a path with its agent_id"
            )
        outline, place = drawn
        return replace(robot, radius=circumscribed_radius(outline), outline=outline), place
    called = f"initial_pose in {what}"
    pose = list_of(pose, called, "[x, y, angle] in m and degrees", lengths=(2, 3))
    x, y, *degrees = (number(value, called) for value in pose)
    theta = math.radians(degrees[0]) if degrees else 0.0
    return robot, check_pose((x, y, theta), called)
