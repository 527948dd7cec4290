"""All that was done explained once more, from the last to the first, if not all was explained.

Which part a pull is of depends on what is known by then: a pull that moved two joints tells little
before one of them is known. Backwards in time other pulls come first. Both accounts are of the same
looks and ways, so that how well they explain those compares them.
"""

import dataclasses

import numpy as np

from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.labels import scores
from palpate.identification.interactive.twin import Twin

POINTS = 100  # of each look that accounts are compared by, about
# of evidence, for each point: what is hidden where it has gone is nearly as likely as what is seen
# there, as a part that opens hides much and bares more
CONCEALED = 0.6
OF_PART, OF_PULLS = 0.02, 0.1  # the same: what a part costs, and pulls if none is of a part
ENOUGH = 0.78  # the same: less than nearly all is explained
BETTER = 0.03  # the same: how much more the account backwards has to explain


def reconsider(twin: Twin) -> Twin:
    """The twin, or what is believed of the same looks and handlings when they are taken from the
    last to the first, if that explains more of what was seen.

    Nothing is tried where all pulls are explained, and nearly all that was seen.
    """
    known = explained(twin)
    if known > ENOUGH and not _share_unexplained(twin):
        return twin
    other = explain_backwards(twin)
    return other if explained(other) > known + BETTER else twin


def explained(twin: Twin) -> float:
    """How much likelier the likeliest label of a point makes another look (logarithm), the mean of
    points and pairs of looks, less what parts and unexplained pulls cost."""
    found = []
    for look, cloud in enumerate(twin.looks):
        others = [other for other in range(len(twin.looks)) if other != look]
        motions = [
            [twin.motion(part, look, other) for other in others]
            for part in range(-1, len(twin.parts))
        ]
        chosen = slice(None, None, max(1, len(cloud.points) // POINTS))
        seen = [twin.looks[other] for other in others]
        best = scores(cloud, seen, motions, chosen, hidden=CONCEALED).max(axis=0)
        found.append(float(best.mean()) / max(len(others), 1))
    cost = OF_PART * len(twin.parts) + OF_PULLS * _share_unexplained(twin)
    return float(np.mean(found)) - cost


def _share_unexplained(twin: Twin) -> float:
    """The share of the pulls that moved something which are of no part that is known."""
    held = [
        part for handling, (part, _) in zip(twin.handled, twin.held, strict=True) if handling.moved
    ]
    return float(np.mean(np.array(held) < 0)) if held else 0.0


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
    other = _in_order_of(other, twin)
    for look in range(len(other.looks)):
        other.relabel(look)  # those that came first tell of what was found after
    return other


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
