"""The top view shows pieces where they stand."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.furniture.furniture import KINDS, FurnitureWorld, Piece, Robot
from palpate.worlds.furniture.picture import robot_footprints, top_view
from palpate.worlds.furniture.pieces import centroid, placed

OUTLINES = {"box": np.array(KINDS["box"].outline)}


def test_placing_turns_and_moves():
    outline = np.array([(1.0, 0.0), (0.0, 2.0)])
    moved = placed(outline, np.array([3.0, 4.0, np.pi / 2]))
    assert moved == pytest.approx(np.array([(3, 5), (1, 4)]))


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_an_outline_is_centred(kind):
    assert centroid(np.array(kind.outline)) == pytest.approx(0, abs=1e-12)


def test_a_picture_has_its_size_and_changes_with_the_pose():
    wall = [np.array([(-2.0, -2.0), (2, -2), (2, -1.9), (-2, -1.9)])]
    here = top_view(OUTLINES, np.zeros((1, 3)), wall, size=(320, 240))
    there = top_view(OUTLINES, np.array([[0.5, 0.5, 0.4]]), wall, size=(320, 240))
    assert here.shape == there.shape == (240, 320, 3)
    assert here.dtype == np.uint8
    assert (here != there).any()
    coloured = np.ptp(here.astype(int), axis=-1) > 40  # the rest is grey
    # The view is at least as wide as the wall of 4 m, of which the box is half a metre.
    assert 0.2 * 0.5 * 0.4 / 4**2 < coloured.mean() < 0.5 * 0.4 / 4**2 * 2


def test_poses_that_do_not_fit_are_refused():
    with pytest.raises(PalpateError, match=r"shape \(1, 3\), not \(2, 3\)"):
        top_view(OUTLINES, np.zeros((2, 3)))


def test_a_robots_footprints_reach_from_its_base_to_its_gripper():
    robot = Robot()
    circle, heading, arm = robot_footprints(
        robot, np.array([1.0, 2.0, np.pi / 2]), np.array(robot.nominal)
    )
    assert np.linalg.norm(circle - [1, 2], axis=1) == pytest.approx(robot.radius)
    assert heading[-1] == pytest.approx([1, 2 + robot.radius])
    assert arm[0] == pytest.approx([1, 2])
    assert arm[-1] == pytest.approx([1, 2 + 0.7 * np.cos(0.9) + 0.15])


def test_the_world_gives_what_the_picture_needs():
    world = FurnitureWorld([Piece("cart"), Piece("chair", (2, 0, 0))])
    observation = world.reset(0)
    assert top_view(world.outlines, observation.poses, world.walls).any()
