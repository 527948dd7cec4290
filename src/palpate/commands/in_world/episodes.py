"""Whole episodes of a controller in environments side by side."""

from collections.abc import Callable

import jax
import numpy as np
from gymnasium.vector import VectorEnv

from palpate.learning.off_policy import evaluate
from palpate.networks.guarded import ActorPolicy

SIDE_BY_SIDE = 20

Acting = Callable[[np.ndarray], np.ndarray]


def at_its_best(policy: ActorPolicy) -> Acting:
    """What a controller without a memory does, compiled: actions (worlds, ...) of observations."""
    act = jax.jit(lambda observation: policy(None, observation)[1])
    return lambda observation: np.asarray(act(observation))


def play_episodes(
    make: Callable[[int], VectorEnv], act: Acting, episodes: int, seed: int
) -> dict[str, np.ndarray]:
    """What so many episodes gave, as `palpate.learning.off_policy.evaluate` does."""
    environments = make(min(SIDE_BY_SIDE, episodes))
    try:
        return evaluate(environments, act, episodes, seed)
    finally:
        environments.close()
