"""Whole episodes in environments side by side: collected to learn from, or to judge a policy."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from gymnasium.vector import VectorEnv

from palpate.errors import PalpateError
from palpate.learning.off_policy.agent import Agent
from palpate.learning.off_policy.buffer import Motion, Transition
from palpate.learning.off_policy.environments import (
    REPORTED,
    advance,
    begin_episodes,
    check,
    motions_of,
)
from palpate.runs.progress import Watch, without_progress

# From observations (environments, features), whether each has just begun, and a generator:
# actions (environments, actions) in [-1, 1].
Script = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]


# What is told of an episode so far, and of its next step, as one.
JOINED: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "force": np.fmax,
    "progress": lambda _, now: now,
    "drawn": lambda before, now: np.nan_to_num(before) + now,
    "flow": np.fmax,
    "level": np.fmin,
}


def collect(
    environments: VectorEnv,
    script: Script,
    steps: int,
    seed: int,
    watch: Watch = without_progress,
) -> Transition:
    """The transitions (steps, ...) of a scripted policy, to learn from before a training.

    They stand in the order of time, those of all environments beside each other. What is proposed
    is what is executed. Where decisions can be interrupted, their pieces are given (`Motion`) in
    place of the steps, and more of them. Raises `PalpateError` as `train_off_policy`, and for fewer
    than one step.
    """
    check(environments)
    if steps < 1:
        raise PalpateError(f"{steps} steps were asked for: expected at least one")
    random, count = np.random.default_rng((seed, 1)), environments.num_envs
    observation, fresh = begin_episodes(environments, seed, 0), np.ones(count, bool)
    seen = []
    for _ in watch(range(-(-steps // count))):
        action = np.asarray(script(observation, fresh, random), np.float32)
        lived, observation, info = advance(environments, observation, action, action)
        fresh = info["ended"]
        if "motions" in info:
            motions, pieces = motions_of(info)
            lived = jax.tree.map(lambda leaf, pieces=pieces: leaf[:pieces], motions)
        seen.append(lived)
    most = None if isinstance(seen[0], Motion) else steps
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:most], *seen)


def at_its_best(agent: Agent) -> Callable[[Any, np.ndarray], jax.Array]:
    """What the agent of a state executes when it does not explore, compiled: `act(state, seen)`."""
    return jax.jit(lambda state, seen: agent.guard(state, seen, agent.propose(state, seen, None)))


def evaluate(
    environments: VectorEnv,
    act: Callable[[np.ndarray], np.ndarray],
    episodes: int,
    seed: int,
    watch: Watch = without_progress,
) -> dict[str, np.ndarray]:
    """What exactly `episodes` episodes gave, each array (episodes,).

    "return", "cost" (sums), "length" (decisions), "end" (how, "" if the environments do not say),
    "force" (the greatest of the episode), "progress" (in the end), "drawn" (J, the sum), "flow" (W,
    the most) and "level" (J, the least), all NaN if they do not say. `act` gives actions
    (environments, actions) in [-1, 1] for observations (environments, features).

    Which environment plays how many is settled beforehand, in turns: were the first to end the ones
    that count, short episodes would count too often. The first starts follow from the seed, later
    ones from the environments' own generators, seeded by it.

    Raises `PalpateError` as `train_off_policy`, and for fewer than one episode.
    """
    check(environments)
    if episodes < 1:
        raise PalpateError(f"{episodes} episodes were asked for: expected at least one")
    count = environments.num_envs
    found = {name: np.zeros(episodes) for name in ("return", "cost", "length")}
    found |= {name: np.full(episodes, np.nan) for name in REPORTED}
    found["end"] = np.full(episodes, "", object)
    playing = np.arange(count)  # the number of the episode that each environment plays
    observation, due = begin_episodes(environments, seed, 0), iter(watch(range(episodes)))
    while np.any(playing < episodes):
        action = np.asarray(act(observation), np.float32)
        lived, observation, info = advance(environments, observation, action, action)
        counts = playing < episodes
        those = playing[counts]
        found["return"][those] += np.asarray(lived.reward)[counts]
        found["cost"][those] += np.asarray(lived.cost)[counts]
        found["length"][those] += 1
        for name, joined in JOINED.items():
            found[name][those] = joined(found[name][those], info[name][counts])
        over = counts & info["ended"]
        found["end"][playing[over]] = info["end"][over]
        playing[over] += count
        for _ in range(int(over.sum())):
            next(due, None)
    next(due, None)  # whoever watches sees the last one done
    return found
