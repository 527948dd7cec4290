"""A world whose decisions reach farther than what can be foreseen in them, and a guard for it."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from palpate.networks.actor import Critic, DeterministicActor, Perceptron
from palpate.networks.guarded import Guard
from palpate.worlds.gymnasium import WorldTask
from palpate.worlds.world import World

PERIODS = 10  # control periods of a decision
EDGE = 0.75


class Seen(NamedTuple):
    time: float
    position: np.ndarray  # (1,)


class Runway(World):
    """A decision runs by its action, at most 1 forwards or back; beyond `EDGE` is a violation."""

    control_period = 0.1  # type: ignore[assignment]

    def reset(self, seed: int, *, start: float | None = None) -> Seen:
        drawn = np.random.default_rng(seed).uniform(-0.5, 0.1)
        self._place, self._time = drawn if start is None else start, 0.0
        return Seen(self._time, np.array([self._place]))

    def step(self, action: np.ndarray) -> Seen:
        self._place += float(np.clip(action[0], -1, 1)) / PERIODS
        self._time += self.control_period
        return Seen(self._time, np.array([self._place]))

    def truth(self) -> float:
        return self._place

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        return np.zeros((height, width, 3), np.uint8)


class Run(WorldTask):
    """Forwards is worth what it is; an episode has three decisions."""

    features, actions, horizon = 1, 1, 3

    def observe(self, observation: Seen) -> np.ndarray:
        return observation.position

    def reward(self, before: float, after: float, action: np.ndarray) -> float:
        return after - before

    def violates(self, truth: float) -> bool:
        return truth > EDGE

    def force(self, truth: float) -> float:
        return 0.0

    def progress(self, first: float, truth: float) -> float:
        return 0.0

    def end(self, truth: float) -> str:
        return ""


def watchful() -> Guard:
    """Warns where place + 0.2 x action is above 0.6, and goes back."""

    def layer(weights: Any, bias: Any) -> Perceptron:
        return Perceptron((jnp.array(weights),), (jnp.array(bias),))

    critic = layer([[[20.0], [4.0]]] * 2, [[-12.0]] * 2)
    return Guard(Critic(critic), DeterministicActor(layer([[0.0]], [-9.0])))
