"""Parts that are none: found twice, on one hinge or where another one explains what was seen as
well, or by so little that their joint may be anywhere."""

import numpy as np
from scipy.spatial import cKDTree

from palpate.identification.interactive.explanation import (
    FURTHER,
    joint_of_ways,
    may_have_moved,
)
from palpate.identification.interactive.part import Part, is_same_hinge
from palpate.identification.interactive.tree import FEWEST, PartTree

NEAR, SHARED = 0.05, 0.3  # m between places of two parts, and share of one's where the other was
LOOKS = 6  # that tell whether another part explains what was seen
ANYWHERE = 45.0, 1.0  # deg and m: 90 % intervals of a joint of which nothing is known
LOSS = 0.5  # of evidence, for each point of a part: less is lost where another one explains it


def merge_same(tree: PartTree) -> None:
    """Of parts that turn about one hinge keep the one that is known best.

    They are one part, which went further than it was sought, or showed its other side; what turns
    about the hinge of its carrier, where that has been, is its carrier.
    """
    for number in reversed(range(len(tree.parts))):
        part = tree.parts[number]
        for other, one in enumerate(tree.parts[:number]):
            if _are_same(tree, number, other):
                known = min(part, one, key=lambda each: each.estimate.intervals[0])
                if part.parent != one.parent:
                    known = one if part.parent == other else part
                known.ways = one.ways + part.ways
                shown = {look for each in (part, one) for look in each.seen}
                tree.remove(*((other, number) if known is part else (number, other)))
                for look in shown:
                    tree.find(tree.parts.index(known), look, beyond=FURTHER)
                    tree.relabel(look)
                known.settle(tree.estimate(known))
                break


def merge_by_ways(tree: PartTree) -> None:
    """Parts whose ways were all those of another one, which was there, are that one."""
    order = sorted(tree.parts, key=lambda one: one.longest_way)
    for least, part in enumerate(order):
        for known in reversed(order[least + 1 :]):
            old, number = tree.parts.index(part), tree.parts.index(known)
            if (
                part.ways
                and old not in tree.carriers(number)
                and all(may_have_moved(tree, number, look, way) for look, way in part.ways)
                and joint_of_ways(tree, known, [*known.ways, *part.ways]) is not None
            ):
                known.ways += part.ways
                for look in range(len(tree.looks)):
                    tree.find(number, look, beyond=FURTHER)
                tree.remove(old, number)
                break


def drop_unknown(tree: PartTree) -> None:
    """Take out parts that no hand has held and whose joint may be anywhere by what was seen."""
    for number in reversed(range(len(tree.parts))):
        part = tree.parts[number]
        turned, aside = part.estimate.intervals
        anywhere = turned > ANYWHERE[0] or (aside > ANYWHERE[1] and part.screw.joint == "revolute")
        if anywhere and not part.ways:
            tree.remove(number, part.parent)


def _are_same(tree: PartTree, number: int, other: int) -> bool:
    """Whether two parts are one: on one carrier or on each other, and about one hinge.

    On one carrier hinges may differ by as much as they are uncertain. On a part that moves that is
    enough. What stands still may have doors on one post or above each other: there, and for a part
    on the other one, they also have to have been at one place, and one of them has to explain what
    was seen of the other.
    """
    part, one = tree.parts[number], tree.parts[other]
    if part.screw.joint != "revolute":
        return False
    if part.parent == one.parent:
        turned, aside = np.add(part.estimate.intervals, one.estimate.intervals)
        same = is_same_hinge(part.screw, one.screw, float(turned), float(aside))
        if part.parent >= 0:
            return same
    else:
        carried = part.parent == other or one.parent == number
        same = carried and is_same_hinge(part.screw, one.screw)
    return (
        same
        and _were_alike(tree, number, other)
        and (_explains(tree, other, number) or _explains(tree, number, other))
    )


def drop_explained(tree: PartTree) -> None:
    """Take out parts of which little is known where others explain what was seen of them as well.

    Another one is where they were, and may only have been sought elsewhere (III-B d). So is what
    carries them: where a hand took both, one of them may be taken for a part on itself.
    """
    for number in reversed(range(len(tree.parts))):
        part = tree.parts[number]
        others = [
            other
            for other, one in enumerate(tree.parts)
            if other != number
            and (other == part.parent or (one.parent == part.parent and _is_less_known(part, one)))
        ]
        if any(one.parent == number for one in tree.parts):
            continue
        for other in others:
            if (
                not (
                    other == part.parent
                    and (part.edge is not None or tree.was_felt_by_itself(number))
                )
                and _were_alike(tree, number, other)
                and _explains(tree, other, number)
            ):
                known = tree.parts[other]
                tree.remove(number, other)
                heir = tree.parts.index(known)
                known.ways += [way for way in part.ways if may_have_moved(tree, heir, *way)]
                for look in part.seen:
                    tree.relabel(look)
                break


def _is_less_known(part: Part, other: Part) -> bool:
    return part.provisional or len(part.ways) < min(2, len(other.ways))


def _were_alike(tree: PartTree, part: int, other: int) -> bool:
    """Whether a part was where another one was, in one look or another."""
    swept = []
    for number in (part, other):
        one = tree.parts[number]
        places = np.unique(np.round(one.positions, 1), return_index=True)[1]
        poses = [tree.pose(number, int(look)) for look in places]
        carried = [tree.pose(tree.parts[part].parent, int(look)).inverse for look in places]
        swept.append(
            np.concatenate(
                [
                    (back @ pose).at(one.support[0])
                    for back, pose in zip(carried, poses, strict=True)
                ]
            )
        )
    distance = cKDTree(swept[1]).query(swept[0], distance_upper_bound=NEAR)[0]
    return bool(np.mean(np.isfinite(distance)) > SHARED)


def _explains(tree: PartTree, other: int, part: int) -> bool:
    """Whether a part explains what was seen of another one; it is then where that was."""
    own, one = tree.parts[part].seen, tree.parts[other]
    shown = sorted(look for look, chosen in own.items() if len(chosen) >= FEWEST)
    looks = shown[:: max(1, -(-len(shown) // LOOKS))]
    kept = list(one.positions)
    for look in looks:
        if len(one.seen.get(look, ())) < FEWEST:
            tree.find(other, look, beyond=FURTHER)
    for look in looks:
        given = tree.scores(look)[:, own[look]]
        if np.mean(given[part + 1] - given[other + 1]) > LOSS:
            one.positions = kept
            return False
    return True
