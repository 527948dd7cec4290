"""To get a tip from a maze's entrance to its goal without ever pushing too hard."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.worlds.gymnasium import WorldTask
from palpate.worlds.maze.layout import Layout
from palpate.worlds.maze.maze import FORCE_LIMIT, TipTruth
from palpate.worlds.maze.mjcf import OpenTruth
from palpate.worlds.maze.scene import REFERENCE_HEIGHT
from palpate.worlds.maze.tip import TipObservation

# Papers print what a reward is made of (progress to the goal, a penalty of force, one for leaving
# by the entrance, a bonus at the goal), but no number of it: these are our own.
HORIZON = 500  # decisions, as printed
PROGRESS = 50.0  # per m of the way to the goal, around walls: the whole way is worth about 35
FORCE_COST = 0.025  # of the force limit, squared: to push the obstacle for 30 decisions costs 0.5
GOAL_BONUS = 25.0
ENTRANCE_COST = 10.0
# Time costs nothing but the discount: where standing still is worse than nothing, a violation,
# which ends it, would be the way out.

POSITION_SCALE = 0.3  # m, half the arena: brings positions to about 1, as the limit does forces

Truth = TipTruth | OpenTruth


class MazeTask(WorldTask):
    """The task of a `BlindMaze`, and of a `MjcfWorld`.

    A policy sees the wrench (6) and the position (3), as they are measured, each divided by what
    makes it about 1, and acts by [dx, dy, stiffness along, stiffness across]. More than
    `force_limit` N of horizontal contact force is a violation and costs no reward: only the rest of
    the episode. A method that wants it to cost more adds that itself. `horizon`: decisions after
    which an episode is cut off (None: the printed number).

    Where there is no map the way is straight, and nobody says how much of it is behind the tip.
    """

    features, actions, horizon = 9, 4, HORIZON

    def __init__(self, force_limit: float = FORCE_LIMIT, horizon: int | None = None):
        if not 0 < force_limit < math.inf:
            raise PalpateError(f"the force limit is positive and finite, in N, not {force_limit}")
        self.force_limit = force_limit
        self._wrench_scale = force_limit * np.array([1.0] * 3 + [REFERENCE_HEIGHT] * 3)
        if horizon is not None:
            self.horizon = horizon

    def observe(self, observation: TipObservation) -> Float[np.ndarray, "worlds 9"]:
        return np.concatenate(
            [observation.wrench / self._wrench_scale, observation.position / POSITION_SCALE], axis=1
        )

    def reward(self, before: Truth, after: Truth, action: np.ndarray) -> float:
        """What the decision brought, by the way to the goal in the world's frame."""
        layout = before.layout
        way = layout.distance(np.stack([before.position, after.position]))
        reward = PROGRESS * (way[0] - way[1])
        reward -= FORCE_COST * (after.peak_force / self.force_limit) ** 2
        ended = self.end(after)
        return float(
            reward + GOAL_BONUS * (ended == "goal") - ENTRANCE_COST * (ended == "entrance")
        )

    def violates(self, truth: Truth) -> bool:
        return truth.peak_force > self.force_limit

    def force(self, truth: Truth) -> float:
        return truth.peak_force

    def progress(self, first: Truth, truth: Truth) -> float:
        if not isinstance(first.layout, Layout):
            return math.nan
        way = first.layout.distance(np.stack([first.position, truth.position]))
        return float(1.0 - way[1] / way[0])

    def end(self, truth: Truth) -> str:
        x, y = float(truth.position[0]), float(truth.position[1])
        goal = truth.layout.goal
        if math.hypot(x - goal[0], y - goal[1]) < truth.layout.goal_radius:
            return "goal"
        return "entrance" if x < truth.layout.entrance else ""
