"""Where a part belongs in the tree: on what, with what on it, and in place of what.

A part hangs on another one if it has gone along.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from palpate.identification.interactive.explanation import FURTHER, joint_of_ways
from palpate.identification.interactive.labels import (
    HIDDEN,
    LEAST_MOTION,
    distinguishing_looks,
    evidence,
)
from palpate.identification.interactive.part import Candidate, Part, support_of
from palpate.identification.interactive.refinement import Estimate
from palpate.identification.interactive.screws import Pose, Screw
from palpate.identification.interactive.tree import FEWEST, THICK, PartTree

WITHIN = 0.6  # share of a part's points that make it a part of another
SEEN = 0.2  # of evidence, for each point: less is no difference
CARRIED = 0.15  # rad or m that a part has to go to show what it carries
STILLER = 0.05  # rad or m
LOOKS = 6  # looks that tell whether a part has gone along
TOUCHES = 0.03  # m: what is so near a part may carry it
BESIDE = 0.6  # share of a carrier in what is around a part that stands on it
LITTLE = 0.05  # m that a hand has taken a part: too little was known of it to know it again


@dataclasses.dataclass(frozen=True)
class Discovery:
    """A joint on a `carrier` where that was in the look before, the points of both looks, and how
    much likelier those are with it than without (logarithm)."""

    carrier: int
    estimate: Estimate
    masks: list[Int[np.ndarray, " _"]]
    gain: float = 0.0
    edge: Screw | None = None


def candidate_of(estimate: Estimate, back: Pose, before: int, after: int) -> Candidate:
    """A part with a joint, on what has come `back` so from the look after to the one before."""
    gone = float(estimate.positions[1] - estimate.positions[0])
    return Candidate(back.inverse @ estimate.screw.pose(gone), before, after)


def insert(
    tree: PartTree,
    before: int,
    after: int,
    new: Discovery,
    way: Float[np.ndarray, "times 3"] | None = None,
) -> None:
    """Put a new part where it belongs in the tree, with the way of the hand that took it."""
    parent, carried, same = relatives(tree, before, after, new, way)
    number = len(tree.parts)
    back = tree.pose(parent, before).inverse
    screw = new.estimate.screw.moved(back)
    positions = [0.0] * len(tree.looks)
    positions[after] = float(new.estimate.positions[1] - new.estimate.positions[0])
    # a carrier that is found by its overlap alone has not moved: the whole way was the part's
    there = tree.pose(parent, after) if new.carrier >= 0 else back.inverse
    poses = back, (there @ screw.pose(positions[after])).inverse
    masks = _own_masks(tree, before, after, new, carried)
    support = support_of((tree.looks[before], tree.looks[after]), masks, poses)
    estimate = dataclasses.replace(new.estimate, screw=screw)
    seen = {before: masks[0], after: masks[1]}
    ways = [] if way is None else [(before, way)]
    guessed = new.carrier >= 0 and way is not None
    edge = None if new.edge is None else new.edge.moved(back)
    tree.parts.append(Part(parent, estimate, positions, seen, ways, support, guessed, edge))
    for look, mask in seen.items():
        tree.labels[look] = np.where(np.isin(tree.labels[look], same), number, tree.labels[look])
        tree.labels[look][mask] = number
    related = {*tree.carriers(number), *carried, *same}
    strange = [other for other in range(number) if other not in related]
    for look in (*reversed(range(before)), *range(after + 1, len(tree.looks))):
        known, step = (before, 1) if look < before else (after, -1)
        others = np.isin(tree.labels[look], strange) | tree.points_of_others(number, look, known)
        tree.parts[number].positions[look] = tree.parts[number].positions[look + step]
        # a pull that told nothing may have moved it, and far
        beyond = FURTHER if look < before and new.edge is None else None
        tree.find(number, look, others=others, beyond=beyond, new=True)
    for child in carried:
        if tree.parts[child].parent == parent:
            tree.parts[child].parent = number
            tree.parts[child].positions[after] = tree.parts[child].positions[before]
    # what carries the carrier stays: a part cannot hang on what hangs on it
    above = tree.carriers(number)
    for old in sorted(set(same).difference(above), reverse=True):
        tree.parts[number].ways += tree.parts[old].ways
        if tree.parts[old].parent == parent:
            again = np.array(tree.parts[old].positions_of(estimate.screw))
            tree.parts[number].positions[:before] = (again[:before] - again[before]).tolist()
        tree.remove(old, number)
        number -= 1


def _own_masks(
    tree: PartTree, before: int, after: int, new: Discovery, carried: list[int]
) -> list[Int[np.ndarray, " _"]]:
    """The points of both looks that went with a new part, less those of parts that it carries, if
    any are left."""
    motion = candidate_of(new.estimate, tree.motion(new.carrier, after, before), before, after)
    seen, found = tree.looks[before], []
    for look, mask in zip((before, after), new.masks, strict=True):
        points = tree.looks[look].points[mask]
        there = points if look == before else motion.motion.inverse.at(points)
        away, nearest = seen.tree.query(there)
        own = (away > THICK) | ~np.isin(tree.labels[before][nearest], carried)
        found.append(mask[own])
    return found if max(map(len, found)) >= FEWEST else new.masks


def relatives(
    tree: PartTree,
    before: int,
    after: int,
    new: Discovery,
    way: Float[np.ndarray, "times 3"] | None = None,
) -> tuple[int, list[int], list[int]]:
    """What carries a new part, the parts that it carries, and those that are a piece of it, if
    their ways and its own `way` may be of one joint."""
    labels, mask = tree.labels[before], np.zeros(len(tree.labels[before]), bool)
    mask[new.masks[0]] = True
    parent, carried, same = new.carrier, [], []
    back = tree.motion(new.carrier, after, before)
    given = tree.scores(before, candidate_of(new.estimate, back, before, after))
    for number, part in enumerate(tree.parts):
        own = labels == number
        if own.sum() < FEWEST or number == new.carrier:
            continue
        shared = (mask & own).sum()
        little = part.longest_way < LITTLE or shared > WITHIN * mask.sum()
        if shared > WITHIN * own.sum() and little and _may_be_one(tree, part, before, way):
            same.append(number)
        elif (
            shared > WITHIN * own.sum()
            and mask.sum() > 1.2 * own.sum()
            and given[-1][own].mean() > min(HIDDEN, given[0][own].mean())
        ):
            carried.append(number)  # all of it has moved, and more
        elif (
            new.carrier < 0
            and shared > WITHIN * mask.sum()
            and _carries(tree, number, before, after, new.masks[0])
        ):
            parent = number
    return parent, carried, same


def _may_be_one(
    tree: PartTree, part: Part, before: int, way: Float[np.ndarray, "times 3"] | None
) -> bool:
    """Whether a hand's way after a look may be of the joint of a part, as all others of that."""
    ways = part.ways
    return way is None or not ways or joint_of_ways(tree, part, [*ways, (before, way)]) is not None


def _carries(
    tree: PartTree, part: int, before: int, after: int, mask: Int[np.ndarray, " _"]
) -> bool:
    """Whether these points of a look went where a part went, rather than stood still.

    Where no look tells, what was taken for a piece of the part is.
    """
    cloud, places = tree.looks[before], np.array([one.positions for one in tree.parts])
    points, normals = cloud.points[mask], cloud.normals[mask]
    gain = 0.0
    for look in distinguishing_looks(places, before):
        pose = tree.motion(part, before, look)
        if look != after and abs(places[part, look] - places[part, before]) > LEAST_MOTION:
            gone = evidence(tree.looks[look], pose.at(points), pose.turned(normals))
            gain += float(np.sum(gone - evidence(tree.looks[look], points, normals)))
    return gain >= 0.0


def reparent(tree: PartTree, carrier: int, look: int, new: int = -1) -> None:
    """Hang on a part what it carries, which has gone along since a look; take off what has not.

    So it is if the part was seen where the carrier has taken it, and not where it was. Where both
    explain what was seen, as of doors above each other on one hinge, it has to stand on the carrier
    and to have moved less by itself. A `new` part is sought in all looks.
    """
    places = tree.parts[carrier].positions
    for number, part in enumerate(tree.parts):
        if number in (carrier, *tree.carriers(carrier)) or new not in (-1, number):
            continue
        first = part.shown
        shown = {other for other, chosen in part.seen.items() if len(chosen) >= FEWEST}
        shown.add(look + 1)  # it may be taken for the carrier there
        gone = [
            other
            for other in (range(len(tree.looks)) if number == new else sorted(shown))
            if abs(places[other] - places[first]) > CARRIED
        ]
        gone = gone[:: max(1, len(gone) // LOOKS)]
        if not gone:
            continue
        carried = part.parent == carrier
        now = dataclasses.replace(part, positions=list(part.positions))
        other = hang(tree, part, tree.parts[carrier].parent if carried else carrier, first)
        # as free to be elsewhere as on the carrier
        before = _evidence_with(tree, number, now, gone)
        gain = _evidence_with(tree, number, other, gone) - before
        beside = (
            not carried
            and _travel(other, look) + STILLER < _travel(part, look)
            and _share_beside(tree, number, carrier, look) > BESIDE
        )
        # on what it hung it only seemed to undo what that did
        stood = carried and _travel(other, look) + STILLER < _travel(part, look)
        if gain > SEEN or (gain > -SEEN and (beside or stood)):
            other.settle(tree.estimate(other))
            for one in gone:
                tree.relabel(one)
        else:
            tree.parts[number] = part


def hang(tree: PartTree, part: Part, parent: int, look: int) -> Part:
    """A part as it is in a look, on another parent; it is not put into the tree."""
    onto = tree.pose(parent, look).inverse @ tree.pose(part.parent, look)
    return dataclasses.replace(
        part,
        parent=parent,
        positions=list(part.positions),
        estimate=dataclasses.replace(part.estimate, screw=part.screw.moved(onto)),
        edge=None if part.edge is None else part.edge.moved(onto),
        support=(onto.at(part.support[0]), onto.turned(part.support[1])),
    )


def _evidence_with(tree: PartTree, number: int, part: Part, looks: list[int]) -> float:
    """Put a part in the place of another; the evidence of looks for it, wherever it may be."""
    tree.parts[number] = part
    return float(np.mean([tree.find(number, look) for look in looks]))


def _travel(part: Part, look: int) -> float:
    """How far a part has moved by itself from a look to the next, rad or m."""
    return abs(part.positions[look + 1] - part.positions[look])


def _share_beside(tree: PartTree, part: int, carrier: int, look: int) -> float:
    """The share of a carrier in what is around the points of a part in a look."""
    labels, cloud = tree.labels[look], tree.looks[look]
    around = cloud.tree.query_ball_point(cloud.points[labels == part], TOUCHES)
    near = np.unique(np.concatenate([np.array(one, int) for one in [[], *around]]))
    beside = labels[near][labels[near] != part]
    return float(np.mean(beside == carrier)) if len(beside) else 0.0


def find_beside(tree: PartTree, part: int, before: int, after: int, back: Pose) -> None:
    """Say where a part is in the look after, if something else has gone there as well, which comes
    `back` so: where it was before, unless that is in the open or it is seen elsewhere by itself.

    It may only have been taken for moved as it is like the other where that has gone: points that
    the other may have there are none of the part's.
    """
    one, cloud = tree.parts[part], tree.looks[after]
    if tree.seen_at(part, after, np.array([one.positions[before]]))[0] < HIDDEN:
        return
    other = evidence(tree.looks[before], back.at(cloud.points), back.turned(cloud.normals))
    one.positions[after] = one.positions[before]
    tree.find(part, after, others=other >= HIDDEN)
