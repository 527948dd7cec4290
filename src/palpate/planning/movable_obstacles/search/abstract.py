"""Value iteration over abstract actions: which way to open, given what is known of each.

An abstract state is a node of `regions` as it was entered, because how far it is to the next border
depends on where one stands. Scholz, Levihn, Isbell et al. (NAMO-MDP, WAFR 2012) iterate
V(s) <- max_a R + gamma sum P V over free regions; here as costs without discount, and an object
that did not give way once is not tried again: a failure leads to the best action with another.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Actions:
    """What may be done: action k leads from state `source[k]` to `target[k]`.

    `cost` (actions,) in m is paid whether it succeeds or not; `probability` is that of success;
    `group` is the index of the object that fails if it fails, -1 if nothing can.
    """

    source: np.ndarray
    target: np.ndarray
    cost: np.ndarray
    probability: np.ndarray
    group: np.ndarray


@dataclass(frozen=True)
class Values:
    """`value` (states,) is the expected cost to go, m; `best` the action to take, -1 for none."""

    value: np.ndarray
    best: np.ndarray
    sweeps: int


def iterate(
    states: int, actions: Actions, goals: Sequence[int], dead_end: float, tolerance: float = 1e-9
) -> Values:
    """The least expected costs to a goal state; `dead_end` (m) is that of having no way left.

    Q(s, a) = c + p V(s') + (1 - p) F(s, a), where F is the least c' + p' V(s'') + (1 - p') D over
    the actions a' of s with other objects than a's, and D if there are none. Values fall from D,
    so that each sweep gives an upper bound; with p of 0 or 1 this is Bellman's shortest path, and
    at most `states` sweeps are needed.
    """
    value = np.full(states, float(dead_end))
    value[list(goals)] = 0.0
    best = np.full(states, -1)
    if not len(actions.source):
        return Values(value, best, 0)
    source, group = actions.source, actions.group
    sweep, quality = 0, value[source]
    while sweep <= 4 * states:
        sweep += 1
        final = actions.cost + actions.probability * value[actions.target]
        once = final + (1 - actions.probability) * dead_end
        fallback = np.minimum(_best_of_others(states, source, group, once, dead_end), dead_end)
        quality = final + (1 - actions.probability) * fallback
        least = np.full(states, float(dead_end))
        np.minimum.at(least, source, quality)
        least[list(goals)] = 0.0
        change = np.abs(least - value).max()
        value = least
        if change <= tolerance:
            break
    reached = np.flatnonzero(quality <= value[source] + 1e-7)
    for action in reached[::-1]:
        if value[source[action]] < dead_end:
            best[source[action]] = action
    best[list(goals)] = -1
    return Values(value, best, sweep)


def _best_of_others(
    states: int, source: np.ndarray, group: np.ndarray, once: np.ndarray, dead_end: float
) -> np.ndarray:
    """For each action the least `once` of its state's actions that have another object."""
    first = np.full(states, dead_end)
    np.minimum.at(first, source, once)
    leader = np.full(states, -2)
    leads = once <= first[source]
    leader[source[leads]] = group[leads]
    second = np.full(states, dead_end)
    others = group != leader[source]
    np.minimum.at(second, source[others], once[others])
    return np.where((group == leader[source]) & (group >= 0), second[source], first[source])
