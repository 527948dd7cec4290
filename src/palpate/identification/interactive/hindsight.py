"""All that was done explained once more: on what each part hangs, and from the last to the first.

A part on a wrong one seems to move when that one does, though no hand holds it. On what it hangs is
told best by all looks together.

Which part a pull is of depends on what is known by then: a pull that moved two joints tells little
before one of them is known. Backwards in time other pulls come first. Both accounts are of the same
looks and ways, so that how well they explain those compares them.
"""

import dataclasses

import numpy as np

from palpate.identification.interactive.explanation import FURTHER
from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.insertion import CARRIED, STILLER, hang
from palpate.identification.interactive.labels import scores
from palpate.identification.interactive.twin import Twin

POINTS = 100  # of each look that accounts are compared by, about
# of evidence, for each point: what is hidden where it has gone is nearly as likely as what is seen
# there, as a part that opens hides much and bares more
CONCEALED = 0.6
OF_PART, OF_PULLS = 0.02, 0.1  # the same: what a part costs, and pulls if none is of a part
ENOUGH = 0.82  # the same, whatever parts cost: less than nearly all is explained
AS_GOOD, HANGS = 0.003, 0.008  # the same: what hanging a part lower may cost, and on another gain
NEARLY = 0.02  # of evidence, for each of a part's points: to be seen less is not to be seen as well
BETTER = 0.03  # the same: how much more the account backwards has to explain


def reconsider(twin: Twin) -> Twin:
    """The twin with each part on what it hangs on, or what is believed of the same looks and
    handlings when they are taken from the last to the first, if that explains more of what was
    seen.

    The latter is not tried where all pulls are explained, and nearly all that was seen.
    """
    twin = correct_parents(twin)
    if _evidence_of_looks(twin) > ENOUGH and not _share_unexplained(twin):
        return twin
    other = correct_parents(explain_backwards(twin))
    return other if explained(other) > explained(twin) + BETTER else twin


def correct_parents(twin: Twin) -> Twin:
    """The twin, with each part on what makes all looks likeliest; of two doors above each other on
    one hinge, which may as well hang on each other, both on what stands still."""
    known, tried = explained(twin), set()
    while options := [one for one in _other_parents(twin) if one not in tried]:
        part, parent = options[0]
        tried.add(options[0])
        if (other := _with_parent(twin, part, parent)) is None:
            continue
        least = known + (-AS_GOOD if parent in (-1, *twin.carriers(part)) else HANGS)
        if explained(other) < least:
            continue
        for look in range(len(other.looks)):
            other.relabel(look)
        other.refit(-1)
        if (settled := explained(other)) > least:  # its joint may have been lost meanwhile
            twin, known = other, settled
    return twin


def _other_parents(twin: Twin) -> list[tuple[int, int]]:
    """Parts that moved when another one did, though no hand held them, and that one: or if it is
    what they hang on, what that hangs on."""
    found: dict[tuple[int, int], None] = {}
    places = np.array([part.positions for part in twin.parts]).reshape(-1, len(twin.looks))
    held = {before: part for part, before in twin.held}
    for look, gone in enumerate(np.abs(np.diff(places, axis=1)).T):
        for part in np.flatnonzero(gone > STILLER).tolist():
            if held.get(look) == part:
                continue
            for other in np.flatnonzero(gone > CARRIED).tolist():
                if other == twin.parts[part].parent:
                    found[part, twin.parts[other].parent] = None
                elif other != part and part not in twin.carriers(other):
                    found[part, other] = None
    return list(found)


def _with_parent(twin: Twin, number: int, parent: int) -> Twin | None:
    """A twin with a part on another one, where its joint takes it nearest to what was seen; None if
    that is not as near as it was."""
    other, part = twin.copy(), twin.parts[number]
    other.parts[number] = hang(other, part, parent, part.shown)
    there, here = 0.0, 0.0
    for look in range(len(other.looks)):
        there += other.find(number, look, beyond=FURTHER)
        here += float(twin.seen_at(number, look, np.array([part.positions[look]]))[0])
    return other if there - here > -NEARLY * len(other.looks) else None


def explained(twin: Twin) -> float:
    """The evidence of all looks, less what parts and unexplained pulls cost."""
    cost = OF_PART * len(twin.parts) + OF_PULLS * _share_unexplained(twin)
    return _evidence_of_looks(twin) - cost


def _evidence_of_looks(twin: Twin) -> float:
    """How much likelier the likeliest label of a point makes another look (logarithm), the mean of
    points and pairs of looks."""
    found = []
    for look, cloud in enumerate(twin.looks):
        others = [other for other in range(len(twin.looks)) if other != look]
        motions = [
            [twin.motion(part, look, other) for other in others]
            for part in range(-1, len(twin.parts))
        ]
        step = max(1, len(cloud.points) // POINTS)
        seen = [twin.looks[other] for other in others]
        best = scores(cloud, seen, motions, step, hidden=CONCEALED).max(axis=0)
        found.append(float(best.mean()) / max(len(others), 1))
    return float(np.mean(found))


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
