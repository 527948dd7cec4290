"""Plans: against exhaustive search, with objects in one another's way, under doubt, and kept."""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from scipy import ndimage

from namo_rooms import IN_DOOR, two_rooms
from palpate.errors import PalpateError
from palpate.numerics.polygons import place_points, polygons
from palpate.planning.movable_obstacles.maps.files import read_map
from palpate.planning.movable_obstacles.maps.map import Movable
from palpate.planning.movable_obstacles.maps.occupancy import Space
from palpate.planning.movable_obstacles.maps.regions import regions_of
from palpate.planning.movable_obstacles.motion.manipulation import PRIMITIVES, Motion, RigidCarry
from palpate.planning.movable_obstacles.search.openings import CARRYING, HANDLING, TURNING
from palpate.planning.movable_obstacles.search.paths import distances
from palpate.planning.movable_obstacles.search.plan import (
    TRANSFER,
    read_plan,
    write_plan,
)
from palpate.planning.movable_obstacles.search.planner import Planner
from palpate.planning.movable_obstacles.search.policy import NoWayError
from palpate.planning.movable_obstacles.search.tree_search import Settings
from palpate.planning.movable_obstacles.search.verification import faults_of

DATA = Path(__file__).parents[3] / "shared" / "data" / "namo_scenarios"


def planned(world, **options):
    """A plan that has passed the exact check."""
    plan = Planner(**options).plan(world)
    assert faults_of(plan, world) == []
    return plan


# --- against exhaustive search ----------------------------------------------------------------


def exhaustive(world, name: str, depth: int) -> float:
    """The least cost to the goal with one transfer of at most `depth` primitives.

    Every grasp, primitive and length of a step of two thirds of a cell; collision by distances of
    polygons, passage by labels of the grid. Infinite when there is none.
    """
    space = Space(world)
    whole = slice(0, space.shape[0]), slice(0, space.shape[1])
    movable, model = world.movables[name], RigidCarry()
    radius = world.robot.radius
    standoff = radius + world.reach
    goal = np.array(world.goals[0][:2])
    reached = distances(space, whole, np.array(world.start), standing=True)
    others = [m.polygon for other, m in world.movables.items() if other != name]
    obstacles = shapely.union_all([world.walls, *others])
    left, bottom, right, top = world.bounds
    frame = shapely.box(left, bottom, right, top)
    best = math.inf
    step = world.cell_size / 1.5

    def free(bodies, robots) -> int:
        places = shapely.points(robots[:, :2])
        bad = shapely.distance(bodies, obstacles) < world.margin - 1e-9
        bad |= shapely.distance(places, obstacles) < world.clearance - 1e-9
        bad |= ~shapely.covers(frame, bodies)
        return int(np.argmax(bad)) if bad.any() else len(bad)

    def beyond(pose, robot) -> float:
        after = space.moved(name, pose)
        labels, _ = ndimage.label(after.free, np.ones((3, 3)))
        if not labels[after.cell_at(goal)]:
            return math.inf
        nearby = {name: standoff}
        return distances(after, whole, robot, nearby=nearby, standing=True).to(goal)

    def grow(pose, robot, spent, left, last) -> None:
        nonlocal best
        for primitive in PRIMITIVES[world.robot.drive]:
            if last is not None and bool(last.turn) == bool(primitive.turn):
                continue
            reach = np.linalg.norm(place_points(movable.outline, pose) - robot[:2], axis=1).max()
            unit = step / reach if primitive.turn else step
            count = math.ceil((math.pi if primitive.turn else 3.0) / unit)
            lengths = unit * np.arange(1, count + 1)
            motion = model.motion(movable, pose, robot, primitive, lengths, 0)
            possible = free(
                polygons(place_points(movable.outline, motion.object_poses)), motion.robot_poses
            )
            price = TURNING * np.linalg.norm(pose[:2] - robot[:2]) if primitive.turn else CARRYING
            for index in range(0, possible, 3):
                cost = spent + price * lengths[index]
                if cost >= best:
                    break
                there, base = motion.object_poses[index], motion.robot_poses[index]
                best = min(best, cost + beyond(there, base))
                if left > 1:
                    grow(there, base, cost, left - 1, primitive)

    for grasp in model.grasps(movable, 0.4):
        robot = grasp.robot_pose(movable.pose, standoff)
        way = reached.to(robot, {name: standoff})
        if way < math.inf:
            grow(np.array(movable.pose), robot, way + HANDLING * radius, depth, None)
    return best


SMALL = {"size": (4.6, 2.4), "wall": (2.2, 2.4), "start": (0.6, 1.2), "goal": (4.1, 1.9)}
DOOR = ((0.8, 1.6),)


@pytest.mark.parametrize("drive", ["differential", "holonomic"])
@pytest.mark.parametrize(
    "boxes",
    [
        {"a": (1.95, 0.85, 2.6, 1.55)},
        {"a": (2.5, 0.75, 2.9, 1.65)},
        {"a": (2.1, 0.85, 2.5, 1.55), "b": (3.0, 0.6, 3.3, 1.0)},
    ],
    ids=["in the door", "behind it", "something beside the way"],
)
def test_given_time_a_small_map_is_solved_as_well_as_by_trying_everything(boxes, drive):
    world = two_rooms(boxes, doors=DOOR, drive=drive, **SMALL)
    best = exhaustive(world, "a", 2)
    assert best < math.inf
    plan = planned(world, settings=Settings(iterations=1000, patience=100))
    # what a transfer costs counts the way on to the goal, and so does the last transit
    spent = sum(segment.cost for segment in plan.segments[:-1])
    assert spent <= 1.05 * best
    at_once = sum(segment.cost for segment in planned(world).segments[:-1])
    assert at_once <= 1.6 * best


def test_what_cannot_be_solved_by_trying_everything_is_not_claimed_to_be():
    """The robot could pass the door and the room beyond is free, but nothing gets by the box."""
    pocket = shapely.box(2.4, 0, 4.0, 0.75).union(shapely.box(2.4, 1.65, 4.0, 2.4))
    plug = shapely.box(0, 0, 1.2, 0.6).union(shapely.box(0, 1.8, 1.2, 2.4))
    start = {**SMALL, "goal": (4.25, 1.2)}
    boxes = {"a": (1.4, 0.5, 2.9, 1.59)}
    world = two_rooms(boxes, doors=DOOR, extra=(pocket, plug), **start)
    world = dataclasses.replace(world, movables={"a": Movable.from_corners("a", L_SHAPE)})
    assert exhaustive(world, "a", 1) == math.inf
    with pytest.raises(NoWayError, match="past 'a'"):
        Planner().plan(world)


# An L whose foot stands in the room before the door and is higher than the door.
L_SHAPE = [[1.6, 0.65], [2.0, 0.65], [2.0, 0.85], [2.7, 0.85], [2.7, 1.55], [2.0, 1.55],
           [2.0, 1.75], [1.6, 1.75]]  # fmt: skip


# --- what has to be moved, and what not -------------------------------------------------------


def test_an_open_way_needs_no_transfer():
    plan = planned(two_rooms({"a": (1.5, 0.3, 2.0, 0.8)}))
    assert plan.transfers == 0
    assert plan.distance == pytest.approx(6.0, rel=0.01)
    assert plan.sizes["evaluations"] == 0


def test_only_the_object_in_the_way_is_simulated():
    boxes = {"a": IN_DOOR, "b": (1.2, 0.3, 1.7, 0.8), "c": (6.0, 2.2, 6.5, 2.7)}
    plan = planned(two_rooms(boxes))
    assert plan.moved == ["a"]
    assert plan.sizes["evaluations"] == 1


def test_objects_one_behind_the_other_are_moved_in_turn():
    plan = planned(two_rooms({"b": (3.2, 1.1, 3.9, 1.9), "a": (4.0, 1.1, 4.8, 1.9)}))
    assert plan.moved == ["b", "a"]


def test_an_object_that_obstructs_another_is_put_aside_first():
    boxes = {"a": (3.3, 1.1, 4.1, 1.9), "b": (4.3, 1.1, 5.1, 1.9), "c": (5.3, 1.1, 6.0, 1.9)}
    plan = planned(two_rooms(boxes, wall=(3.0, 5.0)))
    assert set(plan.moved) == {"a", "b", "c"}
    assert plan.transfers >= 4  # one of them twice


def test_a_robot_that_is_shut_in_gets_out():
    boxes = {"near": (1.2, 0.3, 1.7, 2.7), "far": IN_DOOR}
    plan = planned(two_rooms(boxes, start=(0.6, 1.5)))
    assert plan.moved[0] == "near"


def test_an_object_on_the_goal_is_moved_off_it():
    plan = planned(two_rooms({"a": (6.7, 1.2, 7.3, 1.8)}, doors=((0.5, 2.5),)))
    assert plan.moved == ["a"]
    final = plan.segments[-2].object_poses[-1]
    body = polygons(
        place_points(two_rooms({"a": (6.7, 1.2, 7.3, 1.8)}).movables["a"].outline, final[None])
    )
    assert body[0].distance(shapely.Point(7.0, 1.5)) >= 0.25 - 1e-6


def test_the_nearer_of_two_doors_is_taken_unless_its_object_may_not_be_moved():
    boxes = {"near": (3.7, 1.1, 4.5, 1.9), "far": (3.7, 4.1, 4.5, 4.9)}
    world = two_rooms(boxes, doors=((1.0, 2.0), (4.0, 5.0)), size=(8.0, 6.0))
    assert planned(world).moved == ["near"]
    plan = Planner().plan(world, immovable=["near"])
    assert plan.moved == ["far"]
    with pytest.raises(NoWayError, match=r"walls or what .* \('near', 'far'\) close"):
        Planner().plan(world, immovable=["near", "far"])
    with pytest.raises(PalpateError, match="no movable 'door'"):
        Planner().plan(world, immovable=["door"])


def test_a_door_that_the_cells_miss_is_found_in_smaller_ones():
    boxes = {"a": (3.7, 1.3, 4.5, 1.7)}
    door = 1.16, 1.84  # 8 cm more than the robot and its margins
    world = dataclasses.replace(two_rooms(boxes, doors=(door,)), cell_size=0.1, margin=0.1)
    assert regions_of(Space(dataclasses.replace(world, movables={}))).free == 2
    plan = Planner().plan(world)
    assert plan.moved == ["a"]
    assert not faults_of(plan, world)


@pytest.mark.parametrize("goal", [(7.58, 0.42), (4.5, 2.58)])
def test_a_goal_in_a_corner_that_the_cells_miss_is_reached_in_smaller_ones(goal):
    world = two_rooms({"a": IN_DOOR}, cell=0.2, margin=0.1, goal=goal)
    for one in (world, dataclasses.replace(world, start=(*goal, 0.0), goals=(world.start,))):
        plan = Planner().plan(one)
        assert plan.moved == ["a"]
        assert not faults_of(plan, one)


def test_who_only_pushes_moves_things_straight_ahead_and_nothing_else():
    world = two_rooms({"a": IN_DOOR})
    pusher = dataclasses.replace(world, robot=dataclasses.replace(world.robot, push_only=True))
    plan = planned(pusher)
    assert plan.moved == ["a"]
    assert {name for one in plan.segments for name in one.primitives} == {"push"}


def test_mirrored_maps_cost_the_same():
    """The mirror image of a map has a plan of the same cost."""
    costs = []
    for bottom, top in ((0.9, 1.7), (1.3, 2.1)):  # about the middle, y = 1.5
        world = two_rooms({"a": (3.7, bottom, 4.5, top)}, doors=((0.7, 2.3),))
        plan = planned(world)
        costs.append(sum(segment.cost for segment in plan.segments))
    assert costs[0] == pytest.approx(costs[1], rel=0.1)


@pytest.mark.parametrize("drive", ["differential", "holonomic"])
def test_the_same_seed_gives_the_same_plan(drive):
    world = two_rooms({"a": IN_DOOR}, drive=drive)
    one, other = (Planner(seed=3).plan(world).to_dict() for _ in range(2))
    for plan in (one, other):
        plan["segments"] = [
            {k: np.asarray(v).tolist() if k.endswith("poses") else v for k, v in s.items()}
            for s in plan["segments"]
        ]
    del one["planning_s"], other["planning_s"]
    assert one == other


def test_why_there_is_no_way_is_said():
    with pytest.raises(NoWayError, match="walls close the robot's"):
        Planner().plan(two_rooms({}, doors=()))
    with pytest.raises(NoWayError, match=r"no grasp and motion .* past 'a'"):
        Planner().plan(
            two_rooms({"a": (2.0, 0.11, 2.5, 2.89)}, wall=(2.5, 2.7), doors=((1.0, 2.0),))
        )
    with pytest.raises(PalpateError, match="has no goal"):
        Planner().plan(dataclasses.replace(two_rooms({}), goals=()))
    with pytest.raises(PalpateError, match="nearer to a wall"):
        Planner().plan(two_rooms({}, doors=((1.25, 1.69),), goal=(4.1, 1.47), margin=0.2))


def test_a_planner_that_knows_a_map_is_not_misled_by_another_of_that_name():
    planner = Planner()
    first = planner.plan(two_rooms({"a": IN_DOOR}))
    other = two_rooms({"a": IN_DOOR}, doors=((0.9, 2.1),), wall=(3.9, 4.3))
    plan = planner.plan(other)
    assert faults_of(plan, other) == []
    again = planner.plan(two_rooms({"a": IN_DOOR}))
    assert again.distance == first.distance
    assert planner.plan(other).sizes["evaluations"] == 0  # known


# --- doubt ------------------------------------------------------------------------------------


class Doubtful(RigidCarry):
    """Objects that stay where they are in a share of the draws."""

    draws = 5

    def __init__(self, stuck: dict[str, float]):
        self.stuck = stuck

    def belief(self, name):
        return self.stuck.get(name, 0.0)

    def motion(self, movable, object_pose, robot_pose, primitive, lengths, draw):
        motion = super().motion(movable, object_pose, robot_pose, primitive, lengths, draw)
        if draw < round(self.stuck.get(movable.name, 0.0) * self.draws):
            still = np.zeros(len(lengths))[:, None]
            return Motion(object_pose + still, robot_pose + still, motion.energy)
        return motion


QUICK = Settings(iterations=20)
TWO_DOORS = {"near": (3.7, 1.1, 4.5, 1.9), "far": (3.7, 3.6, 4.5, 4.4)}


def two_doors():
    return two_rooms(TWO_DOORS, doors=((1.0, 2.0), (3.5, 4.5)), size=(8.0, 5.0))


def test_success_probability_is_the_share_of_draws_that_open_the_way():
    plan = Planner(Doubtful({"a": 0.4}), QUICK).plan(two_rooms({"a": IN_DOOR}))
    assert plan.probability == pytest.approx(0.6)
    transfer = next(segment for segment in plan.segments if segment.kind == TRANSFER)
    assert transfer.probability == pytest.approx(0.6)
    assert np.ptp(transfer.object_poses[:, 0]) > 0.3  # what is handed out is a success
    with pytest.raises(NoWayError):
        Planner(Doubtful({"a": 1.0}), QUICK).plan(two_rooms({"a": IN_DOOR}))


def test_a_doubtful_object_is_left_alone_where_a_surer_way_is_not_much_longer():
    assert Planner(Doubtful({}), QUICK).plan(two_doors()).moved == ["near"]
    assert Planner(Doubtful({"near": 0.8}), QUICK).plan(two_doors()).moved == ["far"]
    assert Planner(Doubtful({"near": 0.8, "far": 1.0}), QUICK).plan(two_doors()).moved == ["near"]


# --- what a plan says -------------------------------------------------------------------------


def test_what_overlaps_its_neighbour_is_named():
    with pytest.raises(NoWayError, match="'a' overlap what stands beside"):
        planned(two_rooms({"a": (3.7, 0.9, 4.5, 1.9)}))  # 10 cm in the wall below the door
    with pytest.raises(NoWayError, match="past 'a'") as told:
        planned(two_rooms({"a": (2.0, 0.11, 2.5, 2.89)}, wall=(2.5, 2.7)))  # beside the wall
    assert "overlap" not in str(told.value)


def test_the_exact_check_finds_what_is_wrong():
    world = two_rooms({"a": IN_DOOR, "b": (1.2, 0.3, 1.7, 0.8)})
    plan = planned(world)
    transit, transfer, last = plan.segments
    broken = [
        ((transfer, last), "does not begin"),
        ((transit, transfer), "does not end at the goal"),
        (
            (
                transit,
                transfer,
                dataclasses.replace(last, poses=last.poses + np.array([0, 0, 0.1])),
            ),
            "begin",
        ),
        (
            (
                transit,
                dataclasses.replace(
                    transfer, object_poses=transfer.object_poses + np.array([0.1, 0, 0])
                ),
                last,
            ),
            "not stand where",
        ),
        ((transit, dataclasses.replace(transfer, name="b"), last), "stand where"),
    ]
    for segments, says in broken:
        faults = faults_of(dataclasses.replace(plan, segments=segments), world)
        assert any(says in fault for fault in faults), (says, faults)
    blocked = world.moved({"b": (2.2, 1.5, 0.0)})
    assert any("'b'" in fault for fault in faults_of(plan, blocked))
    wider = dataclasses.replace(world, robot=dataclasses.replace(world.robot, radius=0.3))
    assert faults_of(plan, wider)


def test_a_plan_is_written_and_read_back(tmp_path):
    world = two_rooms({"a": IN_DOOR})
    plan = planned(world)
    write_plan(tmp_path / "plan.json", plan)
    again = read_plan(tmp_path / "plan.json")
    assert again.distance == pytest.approx(plan.distance, abs=1e-4)
    assert again.carried == pytest.approx(plan.carried, abs=1e-4)
    assert (again.transfers, again.moved, again.goal) == (1, ["a"], plan.goal)
    assert faults_of(again, world) == []
    (tmp_path / "plan.json").write_text('{"format": "palpate plan among movable obstacles 1"}')
    with pytest.raises(PalpateError, match="no plan"):
        read_plan(tmp_path / "plan.json")


def test_a_path_is_efficient_by_the_shortest_way():
    plan = planned(two_rooms({}))
    assert plan.path_efficiency(plan.distance) == pytest.approx(1.0)
    assert plan.path_efficiency(plan.distance / 2) == pytest.approx(0.5)
    assert plan.path_efficiency(2 * plan.distance) == 1.0


@pytest.mark.skipif(not DATA.is_dir(), reason="the scenarios are not in this checkout")
@pytest.mark.parametrize("name", ["minimal_stilman_2005", "obstacle_on_goal", "1_robot_2_rooms"])
def test_namosims_scenarios_are_solved(name):
    plan = planned(read_map(DATA / f"{name}.svg"))
    assert plan.transfers == 1
    kinds = [segment.kind for segment in plan.segments]
    assert kinds == list(itertools.islice(itertools.cycle(["transit", "transfer"]), len(kinds)))
