"""Pieces that give way only as their wheels or a fixed point let them, each alone in a doorway."""

import dataclasses
import math

import numpy as np
import pytest
import shapely

from namo_rooms import two_rooms
from palpate.numerics.polygons import place_points, polygons
from palpate.planning.movable_obstacles.maps.map import Map
from palpate.planning.movable_obstacles.maps.occupancy import Space
from palpate.planning.movable_obstacles.motion.constrained import ConstrainedManipulation, Drawn
from palpate.planning.movable_obstacles.motion.primitives import Constraint
from palpate.planning.movable_obstacles.search.openings import OpeningSearch
from palpate.planning.movable_obstacles.search.plan import TRANSFER, Plan
from palpate.planning.movable_obstacles.search.planner import Planner
from palpate.planning.movable_obstacles.search.policy import NoWayError
from palpate.planning.movable_obstacles.search.regrasps import stops_of
from palpate.planning.movable_obstacles.search.situation import whole
from palpate.planning.movable_obstacles.search.transfers import Move
from palpate.planning.movable_obstacles.search.verification import faults_of

ALONG_WALL = math.pi / 2  # the wall between the rooms runs along y, and so does the body's y
NEAR_END = Constraint("pivot", (0.0, -0.5))


def doorway(margin: float = 0.05) -> Map:
    """A piece of 0.5 by 1.1 m that stands in a door of 1.4 m, its long side across."""
    boxes = {"piece": (3.85, 0.95, 4.35, 2.05)}
    return two_rooms(boxes, doors=((0.8, 2.2),), drive="holonomic", margin=margin)


def deep_doorway() -> Map:
    """A piece before a door, and a robot that holds it at arm's length."""
    world = two_rooms(
        {"piece": (3.64, 1.13, 4.18, 2.11)},
        doors=((0.85, 2.35),),
        wall=(3.87, 4.02),
        size=(8.0, 4.0),
        drive="holonomic",
        radius=0.25,
    )
    return dataclasses.replace(world, robot=dataclasses.replace(world.robot, reach=0.15))


def model(*draws: Constraint) -> ConstrainedManipulation:
    return ConstrainedManipulation({"piece": Drawn(draws)}, 60.0)


def planned(world: Map, *draws: Constraint) -> Plan:
    """A plan that has passed the exact check."""
    plan = Planner(model(*draws)).plan(world)
    assert faults_of(plan, world) == []
    return plan


def anchors_of(plan: Plan, constraint: Constraint) -> np.ndarray:
    """Where the fixed point is throughout, (steps, 2)."""
    poses = [s.object_poses for s in plan.segments if s.object_poses is not None]
    return place_points(np.array([constraint.anchor]), np.vstack(poses))[:, 0]


@pytest.mark.parametrize("wheels", [(0.0, -0.45), (0.0, 0.0)])
def test_a_piece_on_wheels_is_held_by_the_face_that_can_be_reached(wheels):
    """The faces across its axis are at the jambs, where no robot fits."""
    plan = planned(doorway(), Constraint("axis", wheels, ALONG_WALL))
    assert plan.moved == ["piece"]
    first = next(segment for segment in plan.segments if segment.kind == TRANSFER)
    assert abs(math.cos(first.grasp.normal - ALONG_WALL)) < 0.1
    for before, after in zip(first.object_poses[:-1], first.object_poses[1:], strict=True):
        middle = 0.5 * (before[2] + after[2]) + ALONG_WALL
        step = np.diff(place_points(np.array([wheels]), np.array([before, after]))[:, 0], axis=0)[0]
        across = step @ np.array([-math.sin(middle), math.cos(middle)])
        assert abs(across) < 1e-6  # no wheel slips


@pytest.mark.parametrize("point", [(0.2, 0.4), (0.2, -0.45)])
def test_what_turns_about_a_point_is_held_elsewhere_where_the_robot_gets_no_farther(point):
    """Held by the face that it first gets to, the robot comes up against the wall too early."""
    world, constraint = deep_doorway(), Constraint("pivot", point)
    plan = planned(world, constraint)
    transfers = [segment for segment in plan.segments if segment.kind == TRANSFER]
    assert [segment.name for segment in transfers] == ["piece", "piece"]
    assert transfers[0].grasp != transfers[1].grasp
    assert np.ptp(anchors_of(plan, constraint), axis=0) == pytest.approx([0, 0], abs=1e-6)
    # what is left of it can be planned for as well
    pose, robot = transfers[0].object_poses[-1].tolist(), transfers[0].poses[-1].tolist()
    halfway = world.moved({"piece": tuple(pose)}, tuple(robot))
    assert planned(halfway, constraint).transfers == 1


def test_an_object_is_held_once_where_that_is_enough():
    assert planned(doorway(), Constraint("pivot", (0.2, -0.45))).transfers == 1


def test_a_gap_counts_that_is_little_wider_than_the_margin():
    """The piece passes the jamb at 3 cm, and steps of half a cell, 5 cm, would ask for more."""
    with pytest.raises(NoWayError, match="past 'piece'"):
        Planner(model(NEAR_END)).plan(doorway(0.05))
    plan = planned(doorway(0.02), NEAR_END)
    assert plan.moved == ["piece"]
    world = doorway()
    poses = np.vstack([s.object_poses for s in plan.segments if s.object_poses is not None])
    gaps = shapely.distance(
        polygons(place_points(world.movables["piece"].outline, poses)), world.walls
    )
    assert 0.02 <= gaps.min() < math.hypot(0.02, 0.025)


def test_stops_are_apart_and_say_how_sure_they_are():
    world = doorway()
    space = Space(world)

    def stops(*draws: Constraint):
        move = Move(0, "piece", world.goals[0][:2], frozenset(), 0.0)
        start = np.array(world.start)
        return stops_of(OpeningSearch(space, model(*draws), start, move, whole(space)))

    found = stops(NEAR_END)
    turned = [stop.object_poses[-1, 2] for stop in found]
    assert min(turned) < -0.2
    assert max(turned) > 0.2
    assert sorted(np.abs(turned), reverse=True) == list(np.abs(turned))
    assert all(stop.probability == 1 and stop.cost > stop.approach for stop in found)
    assert stops(Constraint("static")) == []
    doubted = stops(NEAR_END, Constraint("static"))
    assert doubted
    assert all(stop.probability == 0.5 for stop in doubted)
