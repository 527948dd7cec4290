"""All that was done explained once more, from the last to the first, if a pull was not explained.

Which part a pull is of depends on what is known by then: a pull that moved two joints tells little
before one of them is known. Backwards in time other pulls come first. Both accounts are of the same
looks and ways, so that how well they explain those compares them.
"""

import dataclasses

import numpy as np

from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.labels import scores
from palpate.identification.interactive.screws import NOWHERE
from palpate.identification.interactive.twin import Twin

POINTS = 200  # of each look that accounts are compared by, about
OF_PART = 0.02  # of evidence, for each point: what a part has to explain at least
BETTER = 0.03  # the same: how much more the account backwards has to explain


def reconsider(twin: Twin) -> Twin:
    """The twin, or what is believed of the same looks and handlings when they are taken from the
    last to the first, if that explains more of what was seen.

    Nothing is tried where all pulls are explained.
    """
    unexplained = any(
        handling.moved and part < 0
        for handling, (part, _) in zip(twin.handled, twin.held, strict=True)
    )
    if not unexplained:
        return twin
    other = explain_backwards(twin)
    return other if explained(other) > explained(twin) + BETTER else twin


def explained(twin: Twin) -> float:
    """How much likelier the likeliest label of a point makes another look (logarithm), the mean of
    points and pairs of looks, less what the parts cost."""
    count, found = len(twin.looks), []
    for look, cloud in enumerate(twin.looks):
        others = [one for one in range(count) if one != look]
        motions = [
            [twin.motion(part, look, one) for one in others] for part in range(len(twin.parts))
        ]
        chosen = slice(None, None, max(1, len(cloud.points) // POINTS))
        clouds = [twin.looks[one] for one in others]
        given = scores(cloud, clouds, [[NOWHERE] * len(others), *motions], chosen)
        found.append(float(given.max(axis=0).mean()) / max(len(others), 1))
    return float(np.mean(found)) - OF_PART * len(twin.parts)


def explain_backwards(twin: Twin) -> Twin:
    """A twin of the same looks and handlings, to which they came from the last to the first.

    Its looks and handlings are in the order in which they came.
    """
    ends = {id(one.after): one for one in twin.handled}
    other = Twin()
    for look in reversed(twin.looks):
        if not other.looks:
            other.look(look)
        if (handling := ends.get(id(look))) is None:
            other.look(look)
        else:
            other.observe(_backwards(handling))
    return _in_order_of(other, twin)


def _backwards(handling: Handling) -> Handling:
    """A handling as if time ran backwards: the hand goes from where it ended to where it began."""
    push = handling.push
    if handling.held:
        push = dataclasses.replace(push, point=handling.points[-1], direction=-push.direction)
    return dataclasses.replace(
        handling, push=push, before=handling.after, after=handling.before,
        points=handling.points[::-1], forces=handling.forces[::-1],
    )  # fmt: skip


def _in_order_of(other: Twin, twin: Twin) -> Twin:
    """The other twin, with the looks and handlings in the order of this one."""
    number = {id(look): at for at, look in enumerate(twin.looks)}
    order = [number[id(look)] for look in other.looks]  # of each look of the other
    back = np.argsort(order)
    for part in other.parts:
        part.positions = [part.positions[at] for at in back]
        part.seen = {order[at]: own for at, own in part.seen.items()}
        # a way is kept with the look before it: that was after it
        part.ways = [(order[at + 1], way[::-1]) for at, way in part.ways]
        part.estimate = dataclasses.replace(part.estimate, positions=part.estimate.positions[back])
    other.labels = [other.labels[at] for at in back]
    held = [part for part, _ in reversed(other.held)]
    other.held = [(part, before) for part, (_, before) in zip(held, twin.held, strict=True)]
    other.looks, other.handled = list(twin.looks), list(twin.handled)
    return other
