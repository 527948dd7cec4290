"""Monte-Carlo tree search with progressive widening, over sequences of actions.

UCT (Kocsis and Szepesvari 2006) with double progressive widening (Couetoux et al. 2011): a node of
n visits has at most k n^alpha children, actions as well as outcomes. Outcomes are numbered draws of
a belief, which a sequence of actions meets again; a node's value is the mean of what came of it, or
the most where there is but one draw. An action that at best is no better than what was found is
closed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np


@dataclass(frozen=True)
class Step:
    """What an action led to: another state, or the end with a `reward` in [0, 1]."""

    state: Any
    reward: float | None = None


@runtime_checkable
class Domain(Protocol):
    """What is searched. `draws`: how many worlds a belief holds; `depth`: actions of a sequence."""

    draws: int
    depth: int

    def begin(self, draw: int) -> Any:
        """The state before the first action."""
        ...

    def actions(self, state: Any) -> Sequence[Any]:
        """What may be done, the most promising first; hashable; none ends a sequence with 0."""
        ...

    def promise(self, state: Any, action: Any) -> float:
        """The most reward that can come of it."""
        ...

    def act(self, state: Any, action: Any) -> Step:
        """Do it. The same state and action give the same step."""
        ...


@dataclass(frozen=True)
class Settings:
    """`exploration` is c in Q + c sqrt(ln N / n); `widening` and `exponent` are k and alpha.

    A search ends when `patience` iterations, times the root of the number of draws, have brought
    nothing better.
    """

    iterations: int = 300
    patience: int = 10
    exploration: float = 0.3
    widening: float = 4.0
    exponent: float = 0.5


@dataclass
class _Node:
    visits: int = 0
    total: float = 0.0
    most: float = 0.0
    children: dict[Any, "_Node"] = field(default_factory=dict)
    closed: bool = False


@dataclass
class Found:
    """A sequence of actions: its mean `reward` over the `draws` tried, and how often it ended."""

    actions: tuple[Any, ...]
    reward: float
    tried: int


def search(domain: Domain, settings: Settings, seed: int) -> list[Found]:
    """Sequences that reached a reward, best mean first.

    Ends early when nothing is left that could be better.
    """
    random = np.random.default_rng(seed)
    root = _Node()
    ends: dict[tuple[Any, ...], list[float]] = {}
    worlds = 0  # draws met so far at the root, widened as well
    highest, since = 0.0, 0
    for iteration in range(settings.iterations):
        worlds = min(domain.draws, _width(settings, iteration + 1))
        draw = iteration % worlds
        best = max((sum(rewards) / len(rewards) for rewards in ends.values()), default=0.0)
        if best > highest * 1.001:
            highest, since = best, iteration
        if highest and iteration - since >= settings.patience * math.sqrt(domain.draws):
            break
        bound = best if domain.draws == 1 else 0.0  # a mean of few draws bounds nothing
        _simulate(domain, settings, root, draw, bound, random, ends)
        if root.closed:
            break
    found = [Found(actions, float(np.mean(r)), len(r)) for actions, r in ends.items()]
    return sorted((one for one in found if one.reward > 0), key=lambda one: -one.reward)


def _width(settings: Settings, visits: int) -> int:
    return max(1, math.ceil(settings.widening * visits**settings.exponent))


def _simulate(
    domain: Domain,
    settings: Settings,
    root: _Node,
    draw: int,
    best: float,
    random: np.random.Generator,
    ends: dict[tuple[Any, ...], list[float]],
) -> None:
    state, node = domain.begin(draw), root
    nodes, taken = [root], []
    reward, rolling = None, False
    while reward is None and len(taken) < domain.depth:
        actions = domain.actions(state)
        if rolling:
            choices = [action for action in actions if domain.promise(state, action) > best]
            # the front of the list more often: a domain puts what is promising first
            place = int(len(choices) * random.random() ** 2)
            action = choices[place] if choices else None
        else:
            action = _select(domain, settings, node, state, actions, best)
        if action is None:
            break
        taken.append(action)
        if not rolling:
            child = node.children.setdefault(action, _Node())
            rolling = child.visits == 0
            node = child
            nodes.append(node)
        step = domain.act(state, action)
        state, reward = step.state, step.reward
        if reward is not None and domain.draws == 1 and len(taken) == len(nodes) - 1:
            node.closed = True  # certain: nothing more is to be learnt here
    if reward is None and not rolling:
        node.closed = domain.draws == 1  # nothing may be done here
    if reward is not None:
        ends.setdefault(tuple(taken), []).append(reward)
    for node in nodes:
        node.visits += 1
        node.total += reward or 0.0
        node.most = max(node.most, reward or 0.0)


def _select(
    domain: Domain, settings: Settings, node: _Node, state: Any, actions: Sequence[Any], best: float
) -> Any:
    """The action of the greatest upper confidence bound among those open; None closes the node."""
    width = _width(settings, node.visits + 1)
    explored = settings.exploration * math.sqrt(math.log(node.visits + 1))
    chosen, greatest, considered = None, -math.inf, 0
    for action in actions:
        child = node.children.get(action)
        if child is not None and child.closed:
            continue
        promise = domain.promise(state, action)
        if promise <= best:
            continue
        if child is None or child.visits == 0:
            bound = promise + explored
        else:
            value = child.most if domain.draws == 1 else child.total / child.visits
            bound = min(promise, value) + explored / math.sqrt(child.visits)
        considered += 1
        if bound > greatest:
            chosen, greatest = action, bound
        if considered >= width:
            break
    if chosen is None and domain.draws == 1:
        node.closed = True
    return chosen
