"""What is believed of a surface after pulls at it, against what the geometry says."""

import numpy as np
import pytest

from palpate.learning.movable import Pull, moves, posterior, prior, probability
from palpate.perception.surfaces import Surface

OUT, IN, LEFT = np.array([1.0, 0, 0]), np.array([-1.0, 0, 0]), np.array([0, 1.0, 0])
# A front of 0.6 x 0.4 m that faces along x: its sides are y and z.
FRONT = Surface(
    np.arange(3), OUT, np.zeros(3), np.eye(3)[1:], np.array([-0.3, -0.2]), np.array([0.3, 0.2]),
    0.24, -1, np.zeros((0, 3)),
)  # fmt: skip
RIGHT_EDGE, LEFT_EDGE = np.array([0, -0.28, 0.0]), np.array([0, 0.28, 0.0])


def test_a_prior_is_a_distribution():
    belief = prior(0.4)
    assert belief.sum() == pytest.approx(1.0)
    assert belief.min() >= 0.0
    assert 1.0 - belief[0] == pytest.approx(0.4)


def test_a_hinge_goes_where_the_lever_is_long():
    chance = moves(FRONT, np.stack([LEFT_EDGE, RIGHT_EDGE]), np.stack([OUT, OUT]))
    # the first hypotheses are of the hinge at the lower end of the first side: the right edge
    assert chance[0, 1] > 0.9 > 0.1 > chance[1, 1]
    assert chance[0, 0] == 0.0
    # pulled inwards it goes if it goes both ways, not if it only opens
    inward = moves(FRONT, LEFT_EDGE[None], IN[None])[0]
    assert inward[1] > 0.9
    assert inward[2] == 0.0


def test_a_slide_goes_along_itself_alone():
    aside = moves(FRONT, np.zeros((1, 3)), LEFT[None])[0]
    along_normal, along_first_side = aside[1 + 12 : 1 + 15], aside[1 + 15 : 1 + 18]
    assert along_normal.max() == 0.0
    assert along_first_side.tolist() == [1.0, 1.0, 0.0]


def test_a_pull_that_failed_at_one_edge_leaves_the_other():
    belief = posterior(prior(0.5), FRONT, [Pull(RIGHT_EDGE, OUT, False, True)])
    chance = moves(FRONT, np.stack([LEFT_EDGE, RIGHT_EDGE]), np.stack([OUT, OUT])) @ belief
    assert chance[0] > 2.0 * chance[1]
    assert belief[0] > 0.5
    assert belief.sum() == pytest.approx(1.0)


def test_what_stopped_early_rather_goes_back():
    ended = posterior(prior(0.3), FRONT, [Pull(LEFT_EDGE, OUT, True, True)])
    further = posterior(prior(0.3), FRONT, [Pull(LEFT_EDGE, OUT, True, False)])
    back, on = (moves(FRONT, LEFT_EDGE[None], way[None])[0] for way in (IN, OUT))
    assert ended[0] < 0.2
    assert back @ ended > back @ further > on @ ended
    assert on @ further > 0.6 > on @ ended


def test_features_move_the_odds_the_way_that_they_should():
    plain = {
        "faces the cameras": 0.5, "free before it": 1.0, "free behind it": 0.0,
        "goes on beside it": 0.5, "of the scene before it": 0.2, "has a handle": 0.0,
    }  # fmt: skip

    def chance(**changed: float) -> float:
        return probability(plain | changed, on_part=False, largest=False)

    assert 0.0 < chance() < 1.0
    assert chance(**{"has a handle": 1.0}) > chance()
    assert chance(**{"free behind it": 1.0}) > chance()
    assert chance(**{"of the scene before it": 0.9}) < chance()
    own = probability(plain, on_part=True, largest=False)
    assert own < chance()
    assert probability(plain, on_part=True, largest=True) < own
