"""What is wanted in the maze and in the plane, on truths made by hand and in the worlds."""

import math

import numpy as np
import pytest

from palpate.tasks.maze.maze import ENTRANCE_COST, GOAL_BONUS, PROGRESS, MazeTask
from palpate.tasks.maze.navigation import NavigationTask
from palpate.worlds.gymnasium import WorldTask
from palpate.worlds.maze.maze import FORCE_LIMIT, BlindMaze
from palpate.worlds.maze.navigation import NOISE, PERIODS, Navigation
from palpate.worlds.world import side_by_side


@pytest.fixture
def truth():
    world = BlindMaze(sway=0.0, noise=0.0)
    world.reset(0)
    return world.truth()


def at(truth, x, y, force=0.0):
    return truth._replace(position=np.array([x, y, 0.0]), peak_force=force)


def test_the_maze_rewards_the_way_to_the_goal(truth):
    task, action = MazeTask(), np.zeros(4)
    assert isinstance(task, WorldTask)
    before = at(truth, 0.2, 0.1)
    after = at(truth, 0.23, 0.06)  # 5 cm straight towards the goal at (.25, 0), almost
    way = np.hypot(0.05, 0.1) - np.hypot(0.02, 0.06)
    assert task.reward(before, after, action) == pytest.approx(PROGRESS * way, abs=0.1)
    assert task.progress(before, after) == pytest.approx(
        1 - np.hypot(0.02, 0.06) / np.hypot(0.05, 0.1), abs=0.02
    )
    pushed = after._replace(peak_force=FORCE_LIMIT)
    assert task.reward(before, pushed, action) < task.reward(before, after, action)
    arrived = task.reward(after, at(truth, 0.25, 0.01), action)
    assert arrived > GOAL_BONUS
    # The way around the right wall, not through it: stepping back from it is no loss of 10 cm.
    assert task.reward(at(truth, 0.15, -0.2), at(truth, 0.15, -0.1), action) > 0.9


def test_the_maze_ends_at_the_goal_the_entrance_and_a_violation(truth):
    task = MazeTask()
    assert task.end(at(truth, 0.25, 0.029)) == "goal"
    assert task.end(at(truth, 0.25, 0.031)) == ""
    assert task.end(at(truth, -0.301, 0.0)) == "entrance"
    assert task.end(truth) == ""
    back = task.reward(at(truth, -0.29, 0.0), at(truth, -0.301, 0.0), np.zeros(4))
    assert back < -ENTRANCE_COST
    assert not task.violates(at(truth, 0, 0, FORCE_LIMIT))
    assert task.violates(at(truth, 0, 0, FORCE_LIMIT + 0.01))
    assert MazeTask(force_limit=5.0).violates(at(truth, 0, 0, 5.1))
    assert task.force(at(truth, 0, 0, 3.0)) == 3.0


def test_the_maze_shows_wrench_and_position_about_one():
    world = BlindMaze(noise=0.0)
    seen = side_by_side([world.reset(0), world.reset(1)])._replace(
        wrench=np.array([[26.0, 0, 0, 0, 1.3, 0], [0.0] * 6])
    )
    features = MazeTask().observe(seen)
    np.testing.assert_allclose(features[0, :6], [1, 0, 0, 0, 1, 0])
    np.testing.assert_allclose(features[:, 6:], seen.position / 0.3)


def test_ten_periods_make_one_step_of_the_original():
    world, ends = Navigation(), []
    for seed in range(300):
        first = world.reset(seed, start=(-50.0, 0.0))
        for _ in range(PERIODS):
            seen = world.step(np.array([0.5, -2.0]))
        ends.append(seen.position - first.position)
    assert seen.time == pytest.approx(1.0)
    ends = np.array(ends)
    np.testing.assert_allclose(ends.mean(0), [0.5, -1.0], atol=4 * NOISE / math.sqrt(300))
    np.testing.assert_allclose(ends.std(0), NOISE, rtol=0.15)


def test_the_point_stops_in_an_obstacle_and_succeeds_near_the_origin():
    world, task = Navigation(), NavigationTask()
    assert isinstance(task, WorldTask)
    world.reset(0, start=(-50.0, 4.8))
    for _ in range(5):
        world.step(np.array([0.0, 1.0]))
    truth = world.truth()
    assert task.violates(truth)
    place = world.step(np.array([0.0, -1.0])).position
    np.testing.assert_array_equal(place, truth.position)
    for x, y, inside in [(-90, 0, True), (-79, 0, False), (0, -7, True), (0, -11, False)]:
        world.reset(0, start=(float(x), float(y)))
        assert task.violates(world.truth()) == inside
    world.reset(0, start=(3.0, 2.0))
    assert task.end(world.truth()) == "goal"
    assert task.reward(world.truth(), world.truth(), np.zeros(2)) == pytest.approx(
        -math.hypot(3, 2) / 50
    )
    world.reset(0, start=(3.0, 3.0))
    assert task.end(world.truth()) == ""
    still = world.step(np.array([math.nan, 1.0])).position
    assert np.abs(still - (3, 3)).max() < 0.1


def test_scattered_points_begin_beside_the_walls():
    world = Navigation(scattered=True)
    places = np.array([world.reset(seed).position for seed in range(100)])
    assert (np.abs(places[:, 1]) >= 2).all()
    assert (np.abs(places[:, 1]) <= 5).all()
    assert 30 < (places[:, 1] > 0).sum() < 70
    assert np.ptp(places[:, 0]) > 100


def test_a_straight_way_arrives_and_a_wrong_one_does_not():
    world, task = Navigation(), NavigationTask()
    world.reset(3)
    for _ in range(60 * PERIODS):
        world.step(np.array([1.0, 0.0]))
        if task.end(world.truth()):
            break
    assert world.truth().time < 55
    assert not task.violates(world.truth())
