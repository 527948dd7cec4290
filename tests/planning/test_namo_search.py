"""The parts of the planner: value iteration, tree search, regions, ways, motions."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from namo_rooms import IN_DOOR, two_rooms
from palpate.numerics.polygons import length_of, place_points, polygons
from palpate.planning.movable_obstacles.maps.occupancy import Footprint, Space, inside
from palpate.planning.movable_obstacles.maps.regions import regions_of
from palpate.planning.movable_obstacles.motion.collisions import Clearance
from palpate.planning.movable_obstacles.motion.manipulation import (
    FORWARD,
    PRIMITIVES,
    TURN_LEFT,
    Motion,
    RigidCarry,
    carry,
    outline_grasps,
)
from palpate.planning.movable_obstacles.search.abstract import Actions, iterate
from palpate.planning.movable_obstacles.search.passages import Passage
from palpate.planning.movable_obstacles.search.paths import distances
from palpate.planning.movable_obstacles.search.situation import whole
from palpate.planning.movable_obstacles.search.transfers import Move
from palpate.planning.movable_obstacles.search.tree_search import Settings, Step, search

# --- value iteration --------------------------------------------------------------------------


def actions(*rows) -> Actions:
    source, target, cost, probability, group = zip(*rows, strict=True)
    return Actions(
        np.array(source), np.array(target), np.array(cost, float),
        np.array(probability, float), np.array(group),
    )  # fmt: skip


def test_certain_actions_give_the_shortest_way():
    values = iterate(
        4,
        actions(
            (0, 1, 1, 1, 0), (0, 2, 4, 1, 1), (1, 2, 2, 1, 2), (1, 3, 9, 1, 3), (2, 3, 3, 1, -1)
        ),
        [3],
        100.0,
    )
    assert values.value == pytest.approx([6, 5, 3, 0])
    assert values.best.tolist() == [0, 2, 4, -1]


def test_a_hand_solved_decision_between_a_doubtful_and_a_certain_way():
    """State 0: object 0 opens the goal for 2 m with p; object 1 does so for 5 m, surely.

    Trying object 0 first costs 2 + (1 - p) 5, as the failed one is not tried again; it is better
    than 5 where p > 0.4. Without the certain way it is 2 + (1 - p) D.
    """
    for p, expected, best in ((0.5, 4.5, 0), (0.39, 5.0, 1), (0.41, 2 + 0.59 * 5, 0)):
        values = iterate(2, actions((0, 1, 2, p, 0), (0, 1, 5, 1, 1)), [1], 100.0)
        assert values.value[0] == pytest.approx(expected)
        assert values.best[0] == best
    alone = iterate(2, actions((0, 1, 2, 0.7, 0)), [1], 50.0)
    assert alone.value[0] == pytest.approx(2 + 0.3 * 50)


def test_the_same_object_over_another_border_is_no_second_chance():
    values = iterate(2, actions((0, 1, 2, 0.5, 0), (0, 1, 3, 0.9, 0)), [1], 20.0)
    assert values.value[0] == pytest.approx(min(2 + 0.5 * 20, 3 + 0.1 * 20))


def test_a_state_without_actions_is_a_dead_end():
    values = iterate(3, actions((0, 1, 2, 1, 0)), [2], 30.0)
    assert values.value == pytest.approx([30, 30, 0])
    assert values.best.tolist() == [-1, -1, -1]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_values_of_random_certain_graphs_are_dijkstras(seed):
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    random = np.random.default_rng(seed)
    states, count = random.integers(2, 9), random.integers(1, 25)
    source, target = random.integers(0, states, (2, count))
    cost = random.uniform(0.1, 3.0, count)
    graph = np.full((states, states), np.inf)
    np.minimum.at(graph, (target, source), cost)
    rows, columns = np.nonzero(np.isfinite(graph))
    expected = dijkstra(
        coo_matrix((graph[rows, columns], (rows, columns)), shape=graph.shape).tocsr(), indices=0
    )
    found = iterate(
        int(states), Actions(source, target, cost, np.ones(count), np.arange(count)), [0], 1000.0
    )
    assert found.value == pytest.approx(np.minimum(expected, 1000.0))


# --- tree search ------------------------------------------------------------------------------


class Bandit:
    """Arms that pay their mean on average: 1 or 0 in each draw."""

    depth, draws = 1, 40

    def __init__(self, means):
        random = np.random.default_rng(5)
        self._paid = {arm: random.random(self.draws) < mean for arm, mean in enumerate(means)}

    def begin(self, draw):
        return draw

    def actions(self, state):
        return list(self._paid)

    def promise(self, state, action):
        return 1.0

    def act(self, state, action):
        return Step(None, float(self._paid[action][state]))


def test_the_better_arm_of_a_bandit_is_found_and_pulled_most():
    found = search(
        Bandit([0.2, 0.75, 0.4]), Settings(iterations=600, patience=600, exploration=1.0), 0
    )
    best = max(found, key=lambda one: one.tried)
    assert best.actions == (1,)
    assert found[0].actions == (1,)
    assert best.tried > 2 * max(one.tried for one in found if one is not best)


class Ladder:
    """Certain: `depth` binary choices; only all ones pay, sooner the more."""

    depth, draws = 6, 1

    def begin(self, draw):
        return ()

    def actions(self, state):
        return [0, 1]

    def promise(self, state, action):
        return 0.0 if action == 0 and len(state) > 3 else 1.0

    def act(self, state, action):
        state = (*state, action)
        if len(state) < self.depth:
            return Step(state)
        return Step(state, 1.0 if all(state) else 0.0)


def test_a_deep_reward_is_found_and_the_search_ends_when_nothing_can_be_better():
    found = search(Ladder(), Settings(iterations=5000), 0)
    assert found[0].actions == (1,) * 6
    assert search(Ladder(), Settings(iterations=5000), 0) == found
    assert found[0].tried == 1


def test_nothing_to_do_finds_nothing():
    ladder = Ladder()
    ladder.actions = lambda state: []
    assert search(ladder, Settings(), 0) == []


# --- cells, regions, ways ---------------------------------------------------------------------


def test_scanned_polygons_are_what_shapely_says():
    ring = shapely.Point(0.13, -0.2).buffer(1.0) - shapely.box(-0.3, -0.4, 0.5, 0.2)
    both = ring.union(shapely.Polygon([(2, 2), (3, 2.2), (2.4, 3.1)]))
    xs, ys = np.linspace(-1.503, 3.5, 71), np.linspace(-1.607, 3.2, 53)  # none on an edge
    expected = shapely.contains_xy(both, *np.meshgrid(xs, ys))
    assert (inside(both, xs, ys) == expected).all()


def test_free_cells_keep_the_clearance_even_halfway_to_their_neighbours():
    world = two_rooms({"a": (2.0, 1.0, 2.7, 1.6)})
    space = Space(world)
    rows, columns = np.nonzero(space.free)
    obstacles = world.walls.union(world.movables["a"].polygon)
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        beside = np.clip(columns + right, 0, space.shape[1] - 1)
        below = np.clip(rows + down, 0, space.shape[0] - 1)
        both = space.free[below, beside]
        ends = np.stack([space.centres(rows, columns), space.centres(below, beside)], axis=1)
        ways = shapely.linestrings(ends[both])
        assert shapely.distance(ways, obstacles).min() >= world.clearance - 1e-9


def test_a_footprint_at_many_poses_is_the_cover_at_each():
    world = two_rooms({"a": (1.8, 1.0, 2.7, 1.6)})
    space = Space(world)
    movable = world.movables["a"]
    footprint = Footprint(movable, space.inflation, space.cell)
    poses = np.array([[2.0, 1.5, 0.0], [2.3, 1.2, 0.9], [1.7, 1.6, -2.5]])
    for pose, mask in zip(poses, footprint.at(poses, space.xs, space.ys), strict=True):
        cover = space.cover_of(movable.moved(pose))
        exact = np.zeros(space.shape, bool)
        exact[cover.window] = cover.mask
        assert (mask != exact).sum() <= 0.03 * exact.sum()


def test_an_object_hits_what_is_nearer_than_the_margin_and_its_robot_what_is_nearer_than_its_own():
    world = two_rooms({"a": (1.6, 1.2, 2.2, 1.6), "b": (2.5, 2.0, 3.0, 2.5)})
    space, step = Space(world), 0.04
    random = np.random.default_rng(0)
    objects, robots = (
        np.column_stack([random.uniform(-0.2, 8.2, 400), random.uniform(-0.2, 3.2, 400), angles])
        for angles in random.uniform(-4.0, 4.0, (2, 400))
    )
    others = shapely.union(world.walls, world.movables["b"].polygon)
    bodies = polygons(place_points(world.movables["a"].outline, objects))
    inside_of = shapely.box(*world.bounds)
    room = inside_of.buffer(-world.robot.radius, join_style="mitre")
    points = shapely.points(robots[:, :2])
    near = shapely.distance(bodies, others) < math.hypot(world.margin, step / 2)
    near |= shapely.distance(points, others) < math.hypot(world.clearance, step / 2)
    expected = near | ~shapely.covers(inside_of, bodies) | ~shapely.covers(room, points)
    clearance = Clearance.at_start(space, "a", step)
    assert 50 < expected.sum() < 350
    np.testing.assert_array_equal(clearance.hits(objects, robots), expected)
    assert clearance.steps(objects, robots) == np.argmax(expected)
    assert not clearance.hits(objects[:0], robots[:0]).size


TO_GOAL = Move(0, "a", (7.0, 1.5), frozenset(), 0.0)


def opened_door() -> tuple[Space, Passage, Motion]:
    """An object that stands in a door, pushed out of it and on."""
    space = Space(two_rooms({"a": IN_DOOR}))
    passage = Passage(space, whole(space), TO_GOAL)
    movable = space.movables["a"]
    robot = np.array([3.3, 1.5, 0.0])
    lengths = 0.05 * np.arange(1, 61)
    motion = RigidCarry().motion(movable, np.array(movable.pose), robot, FORWARD, lengths, 0)
    return space, passage, motion


def test_a_way_is_found_open_at_the_first_step_that_is_allowed_wherever_one_begins_to_look():
    space, passage, motion = opened_door()
    steps = len(motion.energy)
    first = passage.first_open(motion, np.full(steps, np.inf), 0, steps)
    assert first is not None
    assert 3 < first < steps - 4
    for step, is_open in ((first, True), (first - 3, False)):
        after, robot = space.moved("a", motion.object_poses[step]), motion.robot_poses[step]
        ways = distances(after, whole(after), robot, standing=True)
        assert (ways.to(np.array([7.0, 1.5])) < 6.0) == is_open
    limits = np.where(np.arange(steps) <= first, np.inf, -1.0)
    assert [passage.first_open(motion, limits, begin, steps) for begin in range(4)] == [first] * 4
    assert passage.first_open(motion, np.full(steps, -1.0), 0, steps) is None
    near = np.full(steps, 1.0)  # m: when the robot is as near, the object stands on the aim
    assert passage.first_open(motion, near, 0, steps) is None


def test_what_lies_beyond_is_no_longer_than_the_way_and_infinite_outside_of_the_window():
    space = Space(two_rooms({"a": IN_DOOR}))
    part = slice(5, space.shape[0] - 5), slice(20, space.shape[1])
    passage = Passage(space, part, TO_GOAL)
    places = np.array([[1.0, 1.5, 0.0], [5.0, 1.5, 0.0], [9.0, 1.5, 0.0], [5.0, 0.2, 0.0]])
    beyond = passage.beyond(places)
    assert np.isinf(beyond).tolist() == [True, False, True, True]
    assert 1.4 < beyond[1] <= 2.0  # m: a lower bound


def test_moving_an_object_there_and_back_changes_nothing():
    space = Space(two_rooms({"a": IN_DOOR, "b": (1.0, 0.4, 1.6, 0.9)}))
    there = space.moved("a", (2.5, 1.5, 0.4))
    assert (there.count != space.count).any()
    back = there.moved("a", space.movables["a"].pose)
    assert (back.count == space.count).all()
    gone = space.without(["a"])
    assert (gone.free == space.free_without(["a"])).all()
    assert list(gone.movables) == ["b"]


def test_a_blocked_door_is_a_node_between_two_regions():
    space = Space(two_rooms({"a": IN_DOOR}))
    regions = regions_of(space)
    assert regions.free == 2
    door = regions.at(space, np.array([4.1, 1.5]))
    assert regions.objects[door] == {"a"}
    pairs = {(border.source, border.target) for border in regions.borders}
    left, right = (regions.at(space, np.array(p)) for p in ((1.0, 1.5), (7.0, 1.5)))
    assert {(left, door), (door, left), (right, door), (door, right)} <= pairs
    assert (left, right) not in pairs


def test_cells_that_two_objects_cover_are_nodes_of_their_own():
    space = Space(two_rooms({"a": (3.2, 1.1, 3.9, 1.9), "b": (4.0, 1.1, 4.8, 1.9)}))
    regions = regions_of(space)
    assert frozenset("ab") in regions.objects
    rows, columns = np.nonzero(regions.node >= 0)
    covering = [
        {n for n, c in space.covers.items() if _covers(c, r, k)}
        for r, k in zip(rows, columns, strict=True)
    ]
    assert all(
        regions.objects[regions.node[r, k]] == names
        for r, k, names in zip(rows, columns, covering, strict=True)
    )


def _covers(cover, row, column) -> bool:
    row, column = row - cover.window[0].start, column - cover.window[1].start
    inside_rows = 0 <= row < cover.mask.shape[0] and 0 <= column < cover.mask.shape[1]
    return bool(inside_rows and cover.mask[row, column])


def test_ways_are_short_and_keep_clear():
    world = two_rooms({}, doors=((0.2, 1.2),), goal=(7.0, 2.5), start=(1.0, 2.5))
    space = Space(world)
    window = slice(0, space.shape[0]), slice(0, space.shape[1])
    reached = distances(space, window, np.array(world.start))
    way = reached.path_to(np.array(world.goals[0]))
    assert way[0] == pytest.approx(world.start[:2])
    assert way[-1] == pytest.approx(world.goals[0][:2])
    assert world.walls.distance(shapely.LineString(way)) >= world.clearance - 1e-5
    # around two corners of the door, on the arcs of the clearance
    corner = np.array([4.0, 1.2 - world.clearance])
    ideal = 2 * np.linalg.norm(corner - world.start[:2]) + 0.2
    assert length_of(way) == pytest.approx(ideal, rel=0.02)
    assert reached.to(np.array([7.9, 2.9])) == math.inf


def test_a_robot_that_stands_too_near_may_leave_but_a_goal_too_near_an_object_is_not_reached():
    world = two_rooms({"a": (1.23, 1.2, 1.8, 1.8)}, start=(1.0, 1.5))  # 0.03 m beside it
    space = Space(world)
    window = slice(0, space.shape[0]), slice(0, space.shape[1])
    start, away = np.array(world.start), np.array([0.6, 2.5])
    assert distances(space, window, start, standing=True).to(away) < math.inf
    assert distances(space, window, start).to(away) == math.inf
    assert distances(space, window, away).to(start) == math.inf


# --- grasps and motions -----------------------------------------------------------------------


def test_grasps_lie_on_the_outline_and_face_it():
    outline = np.array([[-0.5, -0.3], [0.5, -0.3], [0.6, 0.3], [-0.5, 0.3]])
    shape = shapely.Polygon(outline)
    grasps = outline_grasps(outline, 0.3)
    assert 8 <= len(grasps) <= 24
    for grasp in grasps:
        assert shape.exterior.distance(shapely.Point(grasp.point)) < 1e-9
        pose = (0.3, -0.2, 0.8)
        robot = grasp.robot_pose(pose, 0.25)
        (where,) = place_points(np.array([grasp.point]), np.array(pose))
        assert np.linalg.norm(robot[:2] - where) == pytest.approx(0.25)
        body = polygons(place_points(outline, np.array([pose])))[0]
        assert body.distance(shapely.Point(robot[:2])) == pytest.approx(0.25)
        ahead = robot[:2] + 0.3 * np.array([math.cos(robot[2]), math.sin(robot[2])])
        assert body.contains(shapely.Point(ahead))


def test_a_carried_object_keeps_its_place_in_the_robots_hands():
    world = two_rooms({"a": IN_DOOR})
    movable = world.movables["a"]
    pose, robot = np.array([2.0, 1.0, 0.3]), np.array([1.4, 0.7, 0.5])
    for primitive in PRIMITIVES["holonomic"]:
        lengths = np.array([0.0, 0.1, 0.4, 0.9])
        motion = RigidCarry().motion(movable, pose, robot, primitive, lengths, 0)
        assert motion.object_poses[0] == pytest.approx(pose)
        apart = motion.object_poses - motion.robot_poses
        assert apart[:, 2] == pytest.approx(np.full(4, -0.2))
        turned = np.stack(
            [
                np.cos(motion.robot_poses[:, 2]) * apart[:, 0]
                + np.sin(motion.robot_poses[:, 2]) * apart[:, 1],
                np.cos(motion.robot_poses[:, 2]) * apart[:, 1]
                - np.sin(motion.robot_poses[:, 2]) * apart[:, 0],
            ]
        )
        assert turned == pytest.approx(np.repeat(turned[:, :1], 4, axis=1))
        moved = np.linalg.norm(np.diff(motion.robot_poses[:, :2], axis=0), axis=1)
        assert moved == pytest.approx(np.diff(lengths) * (0 if primitive.turn else 1))
    assert carry(pose, robot, robot[None])[0] == pytest.approx(pose)
    assert (FORWARD.forward, TURN_LEFT.turn) == (1.0, 1.0)
