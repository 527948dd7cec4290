"""What is believed of a surface after pulls at it, against what the geometry says."""

import dataclasses

import numpy as np
import pytest

from palpate.learning.movable import HEAVY, Pull, moves, posterior, prior
from palpate.perception.surfaces import Surface

OUT, IN, LEFT = np.array([1.0, 0, 0]), np.array([-1.0, 0, 0]), np.array([0, 1.0, 0])
# A front of 0.6 x 0.4 m that faces along x: its sides are y and z.
FRONT = Surface(
    np.arange(3), OUT, np.zeros(3), np.eye(3)[1:], np.array([-0.3, -0.2]), np.array([0.3, 0.2]),
    0.24, -1, np.zeros((0, 3)),
)  # fmt: skip
RIGHT_EDGE, LEFT_EDGE = np.array([0, -0.28, 0.0]), np.array([0, 0.28, 0.0])


def chance(belief, point, direction):
    return float(moves(belief, FRONT, point[None], direction[None])[0])


def certain(hypothesis):
    """A belief in one hypothesis alone."""
    belief = prior(0.4, FRONT)
    return belief._replace(chances=np.eye(len(belief.chances))[hypothesis])


def test_a_prior_is_a_distribution():
    belief = prior(0.4, FRONT).chances
    assert belief.sum() == pytest.approx(1.0)
    assert belief.min() >= 0.0
    assert 1.0 - belief[0] == pytest.approx(0.4)


def test_a_hinge_is_likely_where_a_handle_has_a_long_lever():
    handled = dataclasses.replace(FRONT, handles=LEFT_EDGE[None])
    belief, plain = (prior(0.4, one).chances[1:] for one in (handled, FRONT))
    of_edge = belief[:12].reshape(4, 3).sum(axis=1)  # right, lower, left, upper
    assert of_edge[0] > 2.0 * of_edge[1] == pytest.approx(2.0 * of_edge[3])
    assert of_edge[2] < 0.4 * of_edge[1]
    assert belief.sum() == pytest.approx(plain.sum())
    assert belief[12:21] == pytest.approx(plain[12:21])  # slides


def test_a_hinge_goes_where_the_lever_is_long():
    # the first hypotheses are of the hinge at the lower end of the first side: the right edge
    assert chance(certain(1), LEFT_EDGE, OUT) > 0.9 > 0.1 > chance(certain(1), RIGHT_EDGE, OUT)
    assert chance(certain(0), LEFT_EDGE, OUT) == 0.0
    # pulled inwards it goes if it goes both ways, not if it only opens
    assert chance(certain(1), LEFT_EDGE, IN) > 0.9
    assert chance(certain(2), LEFT_EDGE, IN) == 0.0


def test_a_slide_goes_along_itself_alone():
    assert [chance(certain(one), np.zeros(3), LEFT) for one in (13, 14, 15)] == [0.0] * 3
    along_side = [chance(certain(one), np.zeros(3), LEFT) for one in (16, 17, 18)]
    assert along_side[:2] == pytest.approx([1.0 - HEAVY] * 2)
    assert along_side[2] == 0.0


def test_a_pull_that_failed_at_one_edge_leaves_the_other():
    belief = posterior(prior(0.5, FRONT), FRONT, [Pull(RIGHT_EDGE, OUT, False, 0.0, True)])
    assert chance(belief, LEFT_EDGE, OUT) > 2.0 * chance(belief, RIGHT_EDGE, OUT)
    assert belief.chances[0] > 0.5
    assert belief.chances.sum() == pytest.approx(1.0)


def test_a_pull_that_failed_on_one_half_hardly_tells_of_the_other():
    """Two doors beside each other are one surface; each turns about its outer edge."""
    left, right = np.array([0, 0.07, 0.0]), np.array([0, -0.07, 0.0])
    belief = posterior(prior(0.9, FRONT), FRONT, [Pull(right, OUT, False, 0.0, True)] * 3)
    assert belief.chances[0] < 0.6
    assert chance(belief, left, OUT) > 3.0 * chance(belief, right, OUT)


def test_where_pieces_meet_a_pull_tells_less_of_either():
    """Of the half whose hinge is at the right edge: where the other begins, before it and on it."""
    half = certain(1 + 3 * 7 + 1)  # the first hinge of the piece after the whole, opening outwards
    assert chance(half, np.array([0, -0.02, 0.0]), OUT) == pytest.approx(0.5 * (1.0 - HEAVY), 0.1)
    assert chance(half, np.array([0, -0.05, 0.0]), OUT) == pytest.approx(1.0 - HEAVY, 0.1)
    assert chance(half, np.array([0, 0.05, 0.0]), OUT) == 0.0


def test_what_withstood_a_pull_moves_only_under_a_stronger_one():
    """Given that it is a hinge, the same pull again is in vain, and twice the lever is not."""
    middle = Pull(np.array([0.0, -0.12, 0.0]), OUT, False, 0.0, True)
    belief = posterior(certain(1), FRONT, [middle])
    assert chance(belief, middle.point, OUT) == 0.0
    assert chance(belief, LEFT_EDGE, OUT) > 0.9
    again = posterior(belief, FRONT, [middle])
    assert again.withstood == pytest.approx(belief.withstood)
    assert again.chances == pytest.approx(belief.chances)


def test_what_gives_a_little_moves_rather_than_what_does_not():
    pulls = [Pull(np.zeros(3), OUT, False, travel, True) for travel in (0.004, 0.0)]
    gave, still = (posterior(prior(0.2, FRONT), FRONT, [pull]).chances[0] for pull in pulls)
    assert gave < 0.5 < 0.8 < still


def test_what_gives_a_little_and_withstands_every_pull_outwards_goes_back():
    """A drawer at the soft stop of its open end, which was pulled at all of its edges."""
    edges = LEFT_EDGE, RIGHT_EDGE, np.array([0.0, 0.0, 0.19]), np.array([0.0, 0.0, -0.19])
    pulls = [Pull(edge, OUT, False, 0.004, True) for edge in edges]
    belief = posterior(prior(0.8, FRONT), FRONT, pulls)
    assert belief.chances[0] < 0.1
    assert chance(belief, np.zeros(3), IN) > 0.4
    assert all(chance(belief, edge, OUT) < 0.1 for edge in edges)


def test_what_stopped_early_rather_goes_back():
    ended = posterior(prior(0.3, FRONT), FRONT, [Pull(LEFT_EDGE, OUT, True, 0.2, True)])
    further = posterior(prior(0.3, FRONT), FRONT, [Pull(LEFT_EDGE, OUT, True, 0.3, False)])
    assert ended.chances[0] < 0.2
    back = chance(ended, LEFT_EDGE, IN)
    assert back > chance(further, LEFT_EDGE, IN) > chance(ended, LEFT_EDGE, OUT)
    assert chance(further, LEFT_EDGE, OUT) > 0.6 > chance(ended, LEFT_EDGE, OUT)


def test_what_stopped_at_once_is_held_rather_than_at_its_end():
    """A lid that a latch held after a centimetre goes where the lever is longer."""
    middle = np.array([0.0, 0.05, 0.0])
    soon, late = (
        posterior(prior(0.9, FRONT), FRONT, [Pull(middle, OUT, True, travel, True)])
        for travel in (0.01, 0.2)
    )
    assert chance(soon, LEFT_EDGE, OUT) > 3.0 * chance(late, LEFT_EDGE, OUT)
    assert chance(soon, middle, IN) < chance(late, middle, IN)
    assert chance(soon, middle, OUT) < 0.05  # it has withstood that


def test_what_takes_half_of_a_force_moves_half_as_easily_and_withstands_half():
    """Of a surface on a part that goes at a half of the hand's force."""
    half = moves(certain(1), FRONT, LEFT_EDGE[None], OUT[None], np.array([0.5]))[0]
    assert half == pytest.approx(chance(certain(1), np.array([0.0, -0.01, 0.0]), OUT), abs=0.02)
    assert half < chance(certain(1), LEFT_EDGE, OUT)
    whole = posterior(certain(1), FRONT, [Pull(LEFT_EDGE, OUT, False, 0.0, True)])
    carried = posterior(certain(1), FRONT, [Pull(LEFT_EDGE, OUT, False, 0.0, True, 0.5)])
    assert chance(whole, LEFT_EDGE, OUT) == 0.0 < chance(carried, LEFT_EDGE, OUT)


def test_where_all_corners_stand_still_a_leaf_between_posts_is_tried():
    corners = [np.array([0.0, y, z]) for y in (-0.29, 0.29) for z in (-0.19, 0.19)]
    pulls = [Pull(corner, OUT, moved=False, travel=0.0, ended=False) for corner in corners]
    after = posterior(prior(0.9, FRONT), FRONT, pulls)
    inner, outer = np.array([0.0, 0.17, 0.0]), np.array([0.0, 0.29, 0.0])
    assert chance(after, inner, OUT) > 0.1 > chance(after, outer, OUT)
