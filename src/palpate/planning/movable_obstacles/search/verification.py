"""An independent, exact look at a plan: swept polygons against walls and objects, no grid.

It shares with the search only outlines, the walls' edges and where a grasp is. What is handed out,
or counts as reached in an experiment, has passed it.
"""

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from palpate.numerics.polygons import place_points, polygons
from palpate.planning.movable_obstacles.maps.map import Map
from palpate.planning.movable_obstacles.search.plan import TRANSFER, TRANSIT, Plan, Segment

_TOLERANCE = 1e-4  # m: of a clearance that is kept
_SAGITTA = 5e-5  # m: between an arc and the chords that stand for it
_BETWEEN = 128  # poses between two steps, which lie half a cell apart
_JOINED = 1e-5  # m and rad: between where one segment ends and the next begins


def faults_of(plan: Plan, world: Map) -> list[str]:
    """What is wrong with a plan on a map, a sentence each; none if it can be carried out.

    The robot's disc keeps the margin, a carried object as well; what is nearer where a segment
    begins (for the robot: or ends) may stay as near as that. Segments join, an object is taken up
    where it stands and held at the map's reach, a differential base drives where it looks, and the
    last pose is the goal.
    """
    return list(_faults(plan, world))


def _faults(plan: Plan, world: Map) -> Iterator[str]:
    standing = {
        name: _turn(movable.outline, movable.pose) for name, movable in world.movables.items()
    }
    robot = np.array(world.start)
    released: str | None = None
    for index, segment in enumerate(plan.segments):
        what = f"segment {index} ({segment.kind})"
        moved = np.abs(segment.poses[0] - robot)[:2].max() > _JOINED
        if moved or _differ(segment.poses[0, 2], robot[2]):
            yield f"{what} does not begin where the robot is"
        robot = segment.poses[-1]
        if world.robot.drive == "differential":
            yield from (f"{what}: {fault}" for fault in _sideways(segment))
        ahead = plan.segments[index + 1 : index + 2]
        near = {name for name in (released, *(s.name for s in ahead)) if name is not None}
        if segment.kind == TRANSIT:
            yield from (f"{what}: {f}" for f in _disc(segment, world, standing, near))
            released = None
            continue
        name = str(segment.name)
        if name not in standing or segment.object_poses is None or segment.grasp is None:
            yield f"{what}: holds nothing that is on the map"
            continue
        body = _turn(world.movables[name].outline, segment.object_poses[0])
        if body.symmetric_difference(standing[name]).area > 1e-6 + 1e-6 * body.area:
            yield f"{what}: '{name}' does not stand where it is taken up"
        hold = segment.grasp.robot_pose(segment.object_poses[0], world.robot.radius + world.reach)
        if np.abs(hold[:2] - segment.poses[0, :2]).max() > 1e-4:
            yield f"{what}: the robot does not stand at the grasp"
        others = {other: shape for other, shape in standing.items() if other != name}
        yield from (f"{what}: {fault}" for fault in _disc(segment, world, others, set()))
        yield from (f"{what}: {fault}" for fault in _body(segment, world, others, body))
        standing[name] = _turn(world.movables[name].outline, segment.object_poses[-1])
        released = name
    if np.abs(robot[:2] - np.array(plan.goal[:2])).max() > _JOINED:
        yield "the plan does not end at the goal"
    elif _differ(robot[2], plan.goal[2]):
        yield "the plan does not end in the goal's direction"


def _turn(outline: np.ndarray, pose: np.ndarray | tuple[float, ...]) -> Polygon:
    turned = affinity.rotate(Polygon(outline), float(pose[2]), origin=(0, 0), use_radians=True)
    return affinity.translate(turned, float(pose[0]), float(pose[1]))


def _differ(one: float, other: float) -> bool:
    return abs(math.remainder(one - other, 2 * math.pi)) > _JOINED


def _sideways(segment: Segment) -> Iterator[str]:
    """Steps across the direction that a differential base looks in, or turning while it drives."""
    step = np.diff(segment.poses, axis=0)
    heading = segment.poses[:-1, 2]
    across = np.abs(np.cos(heading) * step[:, 1] - np.sin(heading) * step[:, 0])
    along = np.linalg.norm(step[:, :2], axis=1)
    turned = np.abs(step[:, 2]) > 1e-6
    if (across[~turned] > 1e-5).any() or (along[turned] > 1e-5).any():
        yield "a differential base would slide sideways"


def _disc(
    segment: Segment, world: Map, others: dict[str, Polygon], near: set[str]
) -> Iterator[str]:
    places = segment.poses[:, :2]
    moves = np.linalg.norm(np.diff(places, axis=0), axis=1) > 1e-12
    kept = places[np.concatenate([[True], moves])]
    way = LineString(kept) if len(kept) > 1 else Point(kept[0])
    radius, clearance = world.robot.radius, world.clearance
    left, bottom, right, top = world.bounds
    inside = shapely.box(left + radius, bottom + radius, right - radius, top - radius)
    if not inside.buffer(_TOLERANCE).covers(way):
        yield "the robot leaves the map"
    ends = [Point(places[0]), Point(places[-1])]
    for edge in world.wall_edges:
        gap = way.distance(edge)
        if gap < clearance - _TOLERANCE:
            own = min(end.distance(edge) for end in ends)
            if gap < min(clearance, own) - _TOLERANCE or gap < radius - _TOLERANCE:
                yield f"the robot comes within {gap:.3g} m of a wall"
                break
    if shapely.contains(world.walls, ends[0]):
        yield "the robot is in a wall"
    for name, shape in others.items():
        gap = way.distance(shape)
        least = clearance
        if name in near:
            least = min(least, radius + world.reach)
        if segment.kind == TRANSIT:
            least = min(least, ends[0].distance(shape))
        if gap < max(least, radius) - _TOLERANCE and gap < clearance - _TOLERANCE:
            yield f"the robot comes within {gap:.3g} m of '{name}'"


def _body(segment: Segment, world: Map, others: dict[str, Polygon], body: Polygon) -> Iterator[str]:
    assert segment.kind == TRANSFER
    assert segment.object_poses is not None
    outline = world.movables[str(segment.name)].outline
    swept = _swept(outline, segment.object_poses)
    left, bottom, right, top = world.bounds
    if not shapely.box(left, bottom, right, top).buffer(_TOLERANCE).covers(swept):
        yield f"'{segment.name}' leaves the map"
    obstacles = [("a wall", edge) for edge in world.wall_edges]
    obstacles += [(f"'{name}'", shape) for name, shape in others.items()]
    for name, shape in obstacles:
        gap = swept.distance(shape)
        if gap >= world.margin - _TOLERANCE:
            continue
        least = min(world.margin, body.distance(shape))
        if gap < least - _TOLERANCE:  # the swept area is a little too large where it turns
            gap = _nearest(outline, segment.object_poses, shape)
        if least > 1e-3:
            bad = gap < least - _TOLERANCE
        else:  # touches already: it may slide along, but not enter
            bad = swept.buffer(-5e-3).intersects(shape) and not body.buffer(-5e-3).intersects(shape)
        if bad:
            yield f"'{segment.name}' comes within {gap:.3g} m of {name}"
            return


def _nearest(outline: np.ndarray, poses: np.ndarray, shape: BaseGeometry) -> float:
    """The least distance to `shape` on the way through poses (steps, 3), from many in between."""
    shares = np.arange(_BETWEEN)[:, None] / _BETWEEN
    between = (poses[:-1, None] + shares * (poses[1:] - poses[:-1])[:, None]).reshape(-1, 3)
    bodies = polygons(place_points(outline, np.vstack([between, poses[-1:]])))
    return float(shapely.distance(bodies, shape).min())


def _swept(outline: np.ndarray, poses: np.ndarray) -> BaseGeometry:
    """The area that an outline passes over, at most `_SAGITTA` too small."""
    radius = float(np.linalg.norm(outline, axis=1).max())
    finest = 2 * math.acos(max(0.0, 1 - _SAGITTA / radius))
    parts = []
    for here, there in pairwise(poses):
        pieces = max(1, math.ceil(abs(there[2] - here[2]) / finest))
        shares = np.linspace(0, 1, pieces + 1)[:, None]
        between = here + shares * (there - here)
        corners = np.stack([np.asarray(_turn(outline, pose).exterior.coords) for pose in between])
        first, second = corners[:-1], corners[1:]
        quads = np.stack([first[:, :-1], first[:, 1:], second[:, 1:], second[:, :-1]], axis=2)
        hulls = shapely.convex_hull(polygons(quads.reshape(-1, 4, 2)))
        parts.append(shapely.union_all([*hulls.tolist(), Polygon(corners[0])]))
    parts.append(_turn(outline, poses[-1]))
    return shapely.union_all(parts)
