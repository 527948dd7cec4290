"""Where one object may be put down so as to be held elsewhere and carried on from there.

What turns about a fixed point in a doorway takes the hand that holds it along its circle, until the
robot is up against the wall; held at another face it can go on. Such a stop opens nothing yet, it
is as far as a carry leads.
"""

import math
from collections.abc import Iterator

import numpy as np

from palpate.planning.movable_obstacles.search.openings import OpeningSearch, State
from palpate.planning.movable_obstacles.search.transfers import Opening

_STOPS = 6  # of one object, at most
_SEPARATION = 0.25  # of the object's size between stops


def stops_of(search_of: OpeningSearch) -> list[Opening]:
    """Carries that open nothing, each with one motion as far as it goes; the farthest first.

    Of stops that are close to one another the one that costs least is kept. An `Opening`'s
    `probability` is here the share of draws in which the object ends up about there.
    """
    size, start = search_of.movable.radius, search_of.begin(0)
    distinct: list[tuple[tuple, State]] = []
    for actions, state in sorted(_ends(search_of), key=lambda one: one[1].spent):
        others = [start, *(other for _, other in distinct)]
        if min(_separation(state, other, size) for other in others) > _SEPARATION * size:
            distinct.append((actions, state))
    distinct.sort(key=lambda one: -_separation(one[1], start, size))
    found = [_stop(search_of, *one) for one in distinct[:_STOPS]]
    return [stop for stop in found if stop is not None]


def _ends(search_of: OpeningSearch) -> Iterator[tuple[tuple, State]]:
    """The end of every motion with every grasp in every draw, and the actions that led there."""
    for draw in range(search_of.draws):
        begin = search_of.begin(draw)
        for grasp in search_of.actions(begin):
            held = search_of.act(begin, grasp)
            if held.reward is not None:
                continue
            for motion in dict.fromkeys((p, 1.0) for p, _ in search_of.actions(held.state)):
                step = search_of.act(held.state, motion)
                if step.reward is None:
                    yield (grasp, motion), step.state


def _stop(search_of: OpeningSearch, actions: tuple, state: State) -> Opening | None:
    grasp, motion = actions
    if not search_of.keep_clear(state.parts):
        return None
    alike = 0
    for draw in range(search_of.draws):
        begun = search_of.act(search_of.begin(draw), grasp)
        ended = search_of.act(begun.state, motion)
        near = _separation(ended.state, state, search_of.movable.radius) <= search_of.space.cell
        alike += ended.reward is None and near
    return search_of.opening(state, state.spent, alike / search_of.draws, state.energy)


def _separation(one: State, other: State, size: float) -> float:
    """How far a point of the object at `size` m from its middle is in one from in the other, m."""
    (x, y, theta), (u, v, phi) = one.object_pose, other.object_pose
    turned = math.remainder(theta - phi, math.tau)
    return float(np.hypot(x - u, y - v)) + size * abs(turned)
