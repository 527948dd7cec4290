"""All that was done explained once more, when nothing more is to come.

On what each part hangs is told best by all looks together: on a wrong one it seems to move when
that one does, though no hand holds it. What was believed before some push, and then given up, may
explain more of all looks than what took its place; and a part that no hand has felt may explain no
more than it costs.

Which part a pull is of depends on what is known by then: a pull that moved two joints tells little
before one of them is known. Backwards in time other pulls come first. All accounts are of the same
looks and ways, so that how well they explain those compares them.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np

from palpate.identification.interactive.explanation import (
    EXPLAINED,
    FURTHER,
    joint_of_ways,
    missed_by,
)
from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.insertion import CARRIED, STILLER, hang
from palpate.identification.interactive.part import support_of
from palpate.identification.interactive.refinement import SURPRISE, surprise
from palpate.identification.interactive.tree import FEWEST, ROUGHLY
from palpate.identification.interactive.twin import OF_PART, Twin

ENOUGH = 0.82  # of evidence, for each point, whatever parts cost: less than nearly all is explained
AS_GOOD, HANGS = 0.003, 0.008  # the same: what hanging a part lower may cost, and on another gain
# the same: of a part that no hand took, and of one that a hand took along, less may as well be none
LITTLE, NOTHING = 0.008, 3e-4
SOUGHT = {"revolute": (3.0, 0.05), "prismatic": (1.5, 0.03)}  # rad and m: how far, in which steps
NEARLY = 0.02  # of evidence, for each of a part's points: to be seen less is not to be seen as well
# the same: how much more what was known earlier, or the account backwards, has to explain
CLEARER, BETTER = 0.01, 0.03
FEWER = 1  # parts than are known now: what was known earlier and had less explains less


def reconsider(twin: Twin) -> Twin:
    """The twin with each part on what it hangs on, or what explains more of what was seen.

    That may be what was believed before some push, or what is believed of the same looks and
    handlings when they are taken from the last to the first; the latter is not tried where all
    pulls are explained, and nearly all that was seen.
    """
    twin = drop_needless(_with_what_was_known(correct_parents(twin)))
    if twin.evidence_of_looks() > ENOUGH and not twin.share_unexplained:
        return twin
    other = drop_needless(correct_parents(explain_backwards(twin)))
    return other if other.explained() > twin.explained() + BETTER else twin


def _with_what_was_known(twin: Twin) -> Twin:
    """The twin, or what was believed before something no longer held, if that explains more."""
    others = [
        take_further(known, twin)
        for known in twin.earlier
        if len(known.parts) + FEWER >= len(twin.parts) and not twin.adds_to(known)
    ]
    best = max(others, key=Twin.explained, default=twin)
    return _fitted(best) if best.explained() > twin.explained() + CLEARER else twin


def take_further(known: Twin, twin: Twin) -> Twin:
    """What was known after some of a twin's looks, in all of them: only where parts are is found
    in those that came after."""
    other = known.copy()
    for look in twin.looks[len(other.looks) :]:
        other.add_look(look)
        other.relabel(len(other.looks) - 1)
    for look in range(len(other.looks)):
        other.relabel(look)  # those that came after tell of it, too
    other.handled = list(twin.handled)
    for number in range(len(known.held), len(twin.held)):
        before, handling = twin.held[number][1], twin.handled[number]
        part = _part_that_went(other, before, handling)
        other.held.append((part, before))
        if part >= 0 and handling.moved:
            one, way = other.parts[part], (before, handling.points)
            if surprise(one.estimate, other.way_from(one.parent, *way)) <= SURPRISE:
                one.ways.append(way)
    return other


def _fitted(twin: Twin) -> Twin:
    """The twin with its joints fitted to all looks, if that explains as much."""
    other = twin.copy()
    other.refit(-1)
    for look in range(len(other.looks)):
        other.relabel(look)
    return other if other.explained() >= twin.explained() else twin


def drop_needless(twin: Twin) -> Twin:
    """The twin without parts that explain too little, and that no hand has felt by themselves; one
    that a hand took along with its carrier only if it explains nothing at all."""
    while options := [one for part in range(len(twin.parts)) if (one := _dropped(twin, part))]:
        twin = max(options, key=Twin.explained)
    return twin


def _dropped(twin: Twin, number: int) -> Twin | None:
    """The twin without a part; None if that was felt by itself, or explains too much."""
    if twin.was_felt_by_itself(number):
        return None
    other = max(_without(twin, number), key=Twin.explained)
    held = [part == number for part, _ in twin.held]
    other.held = [
        (_part_that_went(other, before, handling), before) if lost else (part, before)
        for (part, before), lost, handling in zip(other.held, held, other.handled, strict=True)
    ]
    least = NOTHING if twin.parts[number].ways else LITTLE
    return other if other.explained() > twin.explained() + OF_PART - least else None


def _without(twin: Twin, number: int) -> Iterator[Twin]:
    """The twin without a part; what that carried was only seen as if on it, and is fitted again: a
    lid, taken for two hinges at once, from where it is now. Then it is fitted to the ways of hands,
    and so is what carried the part, with the ways of that as well, if a hand has taken it."""
    part, other = twin.parts[number], twin.copy()
    other.remove(number, part.parent)
    carried = [at - (at > number) for at, one in enumerate(twin.parts) if one.parent == number]
    anew = other.copy()
    for look in range(len(other.looks)):
        other.relabel(look)
    if carried:
        other.refit(-1)
        for look in range(len(other.looks)):
            other.relabel(look)
    yield other
    if part.parent >= 0 and twin.parts[part.parent].ways:
        carrier = part.parent - (part.parent > number)
        anew.parts[carrier].ways += part.ways
        carried.append(carrier)
    if fitted := [at for at in carried if _fit_to_ways(anew, at)]:
        anew.refit(-1)
        for look in range(len(anew.looks)):
            for at in fitted:
                anew.find(at, look)
            anew.relabel(look)
        yield anew


def _fit_to_ways(twin: Twin, number: int) -> bool:
    """Give a part the joint that the ways of hands alone say, and seek it in every look; whether
    they are of one joint, and a look says what is to be sought."""
    part = twin.parts[number]
    own = part.seen.get(part.shown, np.zeros(0, int))
    if not part.ways or len(own) < FEWEST:
        return False
    if (found := joint_of_ways(twin, part, part.ways)) is None:
        return False
    part.settle(found)
    back = twin.pose(number, part.shown).inverse
    part.support = support_of([twin.looks[part.shown]], [own], [back])
    beyond, step = SOUGHT[found.screw.joint]
    tried = np.arange(-beyond, beyond, step)
    for look in range(len(twin.looks)):
        if look != part.shown:
            seen = twin.seen_at(number, look, tried, fewest=ROUGHLY)
            part.positions[look] = float(tried[seen.argmax()])
    for look in range(len(twin.looks)):
        twin.relabel(look)
    return True


def _part_that_went(twin: Twin, before: int, handling: Handling) -> int:
    """The part that has gone from one look to the next as the hand has, -1: none; of one that has
    not moved what it was put to."""
    if not handling.moved:
        return twin.part_at(before, handling)
    missed = missed_by(twin, before, before + 1, handling)
    if not missed or min(missed.values()) > EXPLAINED[0] + EXPLAINED[1] * handling.travel:
        return -1
    return min(missed, key=missed.__getitem__)


def correct_parents(twin: Twin) -> Twin:
    """The twin, with each part on what makes all looks likeliest; of two doors above each other on
    one hinge, which may as well hang on each other, both on what stands still."""
    known, tried = twin.explained(), set()
    while options := [one for one in _other_parents(twin) if one not in tried]:
        part, parent = options[0]
        tried.add(options[0])
        if (other := _with_parent(twin, part, parent)) is None:
            continue
        least = known + (-AS_GOOD if parent in (-1, *twin.carriers(part)) else HANGS)
        if other.explained() < least:
            continue
        for look in range(len(other.looks)):
            other.relabel(look)
        other.refit(-1)
        if (settled := other.explained()) > least:  # its joint may have been lost meanwhile
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
    other.earlier = []  # of looks in the other order
    return other
