"""Whether the maze asks for what it is meant to: one who sees everything, stiff and soft.

The agent reads the truth: it follows the way to the goal softly, and pushes the block stiffly along
the channel and softly across it, with 20 N at most.
"""

import numpy as np
import pytest

from palpate.families.contact.environments import arm_maze, blind_maze
from palpate.worlds.maze.layout import TIP_RADIUS
from palpate.worlds.maze.maze import DISPLACEMENT_LIMIT, STIFFNESS_RANGE

AROUND = np.linspace(0, 2 * np.pi, 48, endpoint=False)
CIRCLE = 0.013 * np.stack([np.cos(AROUND), np.sin(AROUND)], -1)
SOFT, SOFTEST = -0.83, -1.0
LOW, HIGH = STIFFNESS_RANGE
PUSHING = 2 * (20.0 / DISPLACEMENT_LIMIT - LOW) / (HIGH - LOW) - 1  # as far as it may go


def decision(truth):
    place, layout = truth.position[:2], truth.layout
    block, y = layout.obstacle.position
    face = block + truth.obstacle - layout.obstacle.half_sizes[0]
    abreast, stopped = abs(place[1] - y), truth.obstacle > layout.obstacle.travel - 2e-3
    if abreast < 8e-3 and -0.085 < place[0] < face and not stopped:
        if face - TIP_RADIUS - place[0] < 4e-3:
            return np.array([1.0, 0, PUSHING, SOFTEST], np.float32)
        return np.array([0.35, 0, SOFT, SOFTEST], np.float32)
    if abreast < 0.035 and 0.07 < place[0] < face:
        way = np.array([-0.15, 1.0])  # past the block, where it has come to its end
    else:
        blocked = layout.clearance(place + CIRCLE) < 0.8 * TIP_RADIUS
        way = CIRCLE[np.argmin(layout.distance(place + CIRCLE) + blocked)]
    return np.array([*(0.9 * way / np.linalg.norm(way)), SOFT, SOFTEST], np.float32)


def lived(layout, stiffness=None, most=250, make=blind_maze):
    environment = make(layouts=(layout,), stiffness=stiffness)
    environment.reset(seed=1)
    (world,) = environment.lockstep.worlds
    for _ in range(most):
        action = decision(world.truth())
        if stiffness and action[2] == np.float32(PUSHING):
            action[0] = 1.0  # as far as it may
        *_, terminated, _, info = environment.step(action)
        if terminated:
            break
    return info["end"], world.truth().obstacle


@pytest.mark.parametrize("layout", ["home", "unseen-3"])
def test_who_sees_everything_reaches_the_goal_without_a_violation(layout):
    assert lived(layout)[0] == "goal"


@pytest.mark.parametrize("layout", ["home", "unseen-3"])
def test_who_sees_everything_reaches_it_with_an_arm_too(layout):
    assert lived(layout, make=arm_maze)[0] == "goal"


def test_one_stiffness_for_all_is_stuck_or_breaks_the_limit():
    end, pushed = lived("home", 300.0, most=120)
    assert end == ""
    assert pushed < 5e-3  # of 15 cm, and that by the base's rocking
    assert lived("home", 1000.0)[0] == "violation"
