"""To bring a point between two obstacles to the origin."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from palpate.worlds.gymnasium import WorldTask
from palpate.worlds.maze.navigation import PointObservation, PointTruth

HORIZON = 100  # decisions
GOAL_RADIUS = 4.0  # of the origin: nearer is success
REWARD_SCALE = 50.0  # the printed reward is -distance: about 50 at the start
FEATURE_SCALE = np.array([50.0, 10.0])


class NavigationTask(WorldTask):
    """The task of `palpate.worlds.maze.navigation.Navigation`.

    The first navigation task of Thananjeyan et al. 2021 (Recovery RL, arXiv 2010.15920). A policy
    sees the position and decides on the motion of the next ten control periods. The reward is the
    printed one, minus the distance to the goal, divided by 50. To be inside an obstacle at any
    control period is a violation.
    """

    features, actions, horizon = 2, 2, HORIZON

    def observe(self, observation: PointObservation) -> Float[np.ndarray, "worlds 2"]:
        return observation.position / FEATURE_SCALE

    def reward(self, before: PointTruth, after: PointTruth, action: np.ndarray) -> float:
        return -math.hypot(*after.position) / REWARD_SCALE

    def violates(self, truth: PointTruth) -> bool:
        return truth.inside

    def force(self, truth: PointTruth) -> float:
        return 0.0

    def progress(self, first: PointTruth, truth: PointTruth) -> float:
        return 1.0 - math.hypot(*truth.position) / math.hypot(*first.position)

    def end(self, truth: PointTruth) -> str:
        return "goal" if math.hypot(*truth.position) < GOAL_RADIUS else ""
