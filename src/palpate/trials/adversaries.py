"""Who asks a controller for the worst: at random, where it touches something, or after a search."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

Actions = Float[np.ndarray, "worlds actions"]
New = Bool[np.ndarray, " worlds"]

CORNERS = 0.5  # share of random numbers that are the greatest or the least
TOUCH = 0.5  # N: a force from which on there is something to press on
WAVES = 2.0, 9.0  # rad a decision, of what it may follow besides what it sees


class RandomAdversary:
    """Asks for anything, holds it for up to `hold` periods, and asks for something else.

    Half of its numbers are the greatest or the least there are. A share `presses` of its motions
    goes against what it touches, so that it stays in contact.
    """

    def __init__(self, actions: int, hold: int, presses: float = 0.0):
        self.actions, self.hold, self.presses = actions, hold, presses

    def begin(self, worlds: int, random: np.random.Generator) -> None:
        """See `Adversary.begin`."""
        self._random, self._left = random, np.zeros(worlds, int)
        self._action = np.zeros((worlds, self.actions))

    def decide(self, observation: Any) -> tuple[Actions, New]:
        """See `Adversary.decide`."""
        new = self._left <= 0
        if new.any():
            count, random = int(new.sum()), self._random
            drawn = random.uniform(-1.0, 1.0, (count, self.actions))
            drawn = np.where(random.uniform(size=drawn.shape) < CORNERS, np.sign(drawn), drawn)
            if self.presses:
                force = np.asarray(observation.wrench)[new, :2]
                size = np.linalg.norm(force, axis=1, keepdims=True)
                presses = (size[:, 0] > TOUCH) & (random.uniform(size=count) < self.presses)
                against = -force / np.maximum(size, TOUCH)
                drawn[:, :2] = np.where(presses[:, None], against, drawn[:, :2])
            self._action[new] = drawn
            self._left[new] = random.integers(1, self.hold + 1, count)
        self._left -= 1
        return self._action.copy(), new


class MisledPolicy:
    """A policy that decides every so many periods, by what it sees or by what it is made to see.

    `act` gives actions of features, `sees` makes these of observations; with `lies` each of them is
    off by up to so much, anew at each decision.
    """

    def __init__(
        self,
        act: Callable[[np.ndarray], np.ndarray],
        sees: Callable[[Any], np.ndarray],
        every: int,
        lies: float = 0.0,
    ):
        self._act, self._sees, self._every, self._lies = act, sees, every, lies

    def begin(self, worlds: int, random: np.random.Generator) -> None:
        """See `Adversary.begin`."""
        self._random, self._count = random, 0

    def decide(self, observation: Any) -> tuple[Actions, New]:
        """See `Adversary.decide`."""
        new = self._count % self._every == 0
        if new:
            seen = np.asarray(self._sees(observation), float)
            seen = seen + self._random.uniform(-self._lies, self._lies, seen.shape)
            self._action = np.asarray(self._act(seen.astype(np.float32)), float)
        self._count += 1
        return self._action.copy(), np.full(len(self._action), new)


class SearchedAdversary:
    """Answers what it sees by weights of its own in each world, in every period.

    It sees what `sees` makes of observations (worlds, numbers of about 1), two waves and a
    constant; the greatest or the least of each number of an action is asked for, as the weighted
    sum is positive or negative. `improve` makes the next generation of weights of those that came
    out worst: the cross-entropy method.
    """

    def __init__(
        self, actions: int, sees: Callable[[Any], np.ndarray], numbers: int, worlds: int, seed: int
    ):
        self._random, self._sees = np.random.default_rng([seed, 11]), sees
        self._mean = np.zeros((actions, numbers + len(WAVES) + 1))
        self._spread = np.ones_like(self._mean)
        self._shape = worlds, *self._mean.shape
        self._draw()

    def _draw(self) -> None:
        drawn = self._random.standard_normal(self._shape)
        self.weights = self._mean + self._spread * drawn

    def begin(self, worlds: int, random: np.random.Generator) -> None:
        """See `Adversary.begin`."""
        self._count = 0

    def decide(self, observation: Any) -> tuple[Actions, New]:
        """See `Adversary.decide`."""
        worlds = len(self.weights)
        waves = np.sin(np.multiply(WAVES, self._count))
        own = np.broadcast_to([*waves, 1.0], (worlds, len(WAVES) + 1))
        seen = np.concatenate([self._sees(observation), own], axis=1)
        self._count += 1
        answer = np.sign((self.weights @ seen[:, :, None])[:, :, 0])
        return np.where(np.isfinite(answer), answer, 0.0), np.ones(worlds, bool)

    def improve(self, badness: Float[np.ndarray, " worlds"]) -> None:
        """A next generation about the quarter of weights of the greatest badness."""
        worst = np.argsort(-badness)[: max(2, len(badness) // 4)]
        self._mean = self.weights[worst].mean(axis=0)
        self._spread = self.weights[worst].std(axis=0) + 0.05
        self._draw()
        self.weights[0] = self._mean
