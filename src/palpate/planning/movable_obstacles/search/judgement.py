"""Of the ways to open that a tree search found, the one that is best over all draws of a belief."""

import numpy as np

from palpate.planning.movable_obstacles.search.openings import OpeningSearch, State
from palpate.planning.movable_obstacles.search.transfers import Opening
from palpate.planning.movable_obstacles.search.tree_search import Found, Settings, search

_JUDGED = 6  # sequences that are tried in every draw


def open_way(search_of: OpeningSearch, settings: Settings, seed: int) -> Opening | None:
    """The best way found, judged over all draws of the belief; None if none succeeded."""
    found = search(search_of, settings, seed)
    judged = [_ends(search_of, candidate) for candidate in found[:_JUDGED]]
    judged = [ends for ends in judged if ends]
    judged.sort(key=lambda ends: _cost(ends) * search_of.draws / len(ends))
    for ends in judged:
        probability = len(ends) / search_of.draws
        energy = float(np.mean([end.energy for end in ends]))
        opening = search_of.opening(ends[0], _cost(ends), probability, energy)
        if opening is not None:  # else there is no way to the grasp
            return opening
    return None


def _cost(ends: list[State]) -> float:
    return float(np.mean([end.spent + end.exit_length for end in ends]))


def _ends(search_of: OpeningSearch, candidate: Found) -> list[State]:
    """Where a sequence leads, in the draws in which it opens the way."""
    ends = []
    for draw in range(search_of.draws):
        state = search_of.begin(draw)
        for action in candidate.actions:
            step = search_of.act(state, action)
            state = step.state
            if step.reward is not None:
                break
        if state.opened:
            ends.append(state)
    return ends
