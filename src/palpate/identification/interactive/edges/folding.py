"""A pull that turned two hinges at once while at least one was unknown: a lid that folds, a flap.

The way of the hand is no line and no circle then. Of all pairs of hinges that let it go so
(`palpate.identification.interactive.edges.hinge_pairs`) that one is taken which explains most of
what neither stood still nor is of another part. A hinge that is known already stays as it is.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from palpate.identification.interactive.edges.hinge_pairs import HingePair, grips, hinge_pairs
from palpate.identification.interactive.edges.pieces import STRANGE, edges_of, pieces_of
from palpate.identification.interactive.explanation import labels_near
from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.insertion import Discovery, hang, insert
from palpate.identification.interactive.labels import ON, evidence_of_poses
from palpate.identification.interactive.part import is_same_hinge
from palpate.identification.interactive.refinement import Estimate, refine, sighting
from palpate.identification.interactive.screws import NOWHERE, Pose, Screw
from palpate.identification.interactive.tree import FEWEST, UNEXPLAINED, PartTree
from palpate.identification.interactive.ways import Way
from palpate.perception.clouds import Cloud

POINTS = 250  # of each look, by which pairs are held against each other
FOLLOWED, FINER = 60, 5  # of the pairs, the best: those that a hand may have followed, and finer
STEPS = (0.03, 0.012), (0.015, 0.006)  # rad, and m aside, by which a pair is made finer
MUCH = 0.05  # share of what has moved: less may be what was hidden, or noise
LEAST_EVIDENCE = 500.0  # of evidence, of all points of both looks
MOST_UNSURE = 5.0, 0.03  # deg and m by which it may count that a known hinge is not quite known

Masks = list[Int[np.ndarray, " _"]]  # points of the looks before and after


@dataclasses.dataclass(frozen=True)
class Remainder:
    """What nothing else explains of the looks before and after, by some of its points: `chosen` and
    the evidence of each as it is `known`; each stands for `weights` of them."""

    looks: tuple[Cloud, Cloud]
    chosen: list[Int[np.ndarray, " _"]]
    known: list[Float[np.ndarray, " _"]]
    weights: list[float]

    @classmethod
    def of(cls, looks: tuple[Cloud, Cloud], known: list[Float[np.ndarray, " _"]]) -> "Remainder":
        """What is left of two looks, by the evidence of all their points."""
        left = [np.flatnonzero(each < ON) for each in known]
        steps = [max(1, len(each) // POINTS) for each in left]
        chosen = [each[::step] for each, step in zip(left, steps, strict=True)]
        each = [one[own] for one, own in zip(known, chosen, strict=True)]
        return cls(looks, chosen, each, [float(step) for step in steps])

    def values(self, pairs: list[HingePair]) -> Float[np.ndarray, " pairs"]:
        """How much better each of some pairs explains it (evidence, of all points), as far as that
        counts for it."""
        total = np.zeros(len(pairs))
        for look in (0, 1):
            own, cloud = self.chosen[look], self.looks[look]
            poses = [pose.inverse if look else pose for one in pairs for pose in one.motions]
            each = evidence_of_poses(
                self.looks[1 - look], cloud.points[own], cloud.normals[own], poses
            )
            best = each.reshape(len(pairs), 2, len(own)).max(axis=1)
            total += self.weights[look] * np.maximum(best - self.known[look], 0.0).sum(axis=1)
        return total * np.array([one.weight for one in pairs])


def discover_pair(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part that a hand held, if two hinges explain a pull and at least one is new; else -1.

    Both parts are in the tree then.
    """
    held = labels_near(tree, before, handling.push.point)
    others = [
        part for part in range(len(tree.parts)) if not {part, *tree.carriers(part)} & set(held)
    ]
    known = [_evidence(tree, *looks, [-1, *others]) for looks in ((before, after), (after, before))]
    if max(int(np.sum(each < UNEXPLAINED)) for each in known) < 2 * FEWEST:
        return -1
    carriers = [
        ([tree.screw(part, before)], tree.pose(part, before).at(tree.parts[part].support[0]))
        for part in held
        if part >= 0 and tree.parts[part].screw.joint == "revolute"
    ]
    looks = tree.looks[before], tree.looks[after]
    pair = _best_pair(looks, known, handling.points, carriers)
    return -1 if pair is None else _insert(tree, before, after, handling.points, pair, known)


def leaves_much(tree: PartTree, before: int, after: int) -> bool:
    """Whether much of what went elsewhere from one look to the next went as no part has."""
    parts = list(range(-1, len(tree.parts)))
    left, moved = 0, 0
    for looks in ((before, after), (after, before)):
        left += int(np.sum(_evidence(tree, *looks, parts) < UNEXPLAINED))
        moved += int(np.sum(_evidence(tree, *looks, [-1]) < UNEXPLAINED))
    return left > max(MUCH * moved, 2 * FEWEST)


def _evidence(
    tree: PartTree, look: int, other: int, parts: list[int]
) -> Float[np.ndarray, " points"]:
    """The evidence of another look for each point of a look, if it went with one of some parts."""
    cloud, motions = tree.looks[look], [tree.motion(part, look, other) for part in parts]
    return evidence_of_poses(tree.looks[other], cloud.points, cloud.normals, motions).max(axis=0)


def _best_pair(
    looks: tuple[Cloud, Cloud],
    known: list[Float[np.ndarray, " _"]],
    way: Float[np.ndarray, "times 3"],
    carriers: list[tuple[list[Screw], Float[np.ndarray, "_ 3"]]],
) -> HingePair | None:
    """The pair that explains most of what is left of two looks; None if that is hardly anything.

    The carrier is one of those that are given by a hinge and points, or a piece of either look.
    """
    options = [(False, *one) for one in carriers]
    options += [
        (number == 1, edges_of(piece.surface), cloud.points[piece.members])
        for number, (cloud, each) in enumerate(zip(looks, known, strict=True))
        for piece in pieces_of(cloud)
        if np.mean(each[piece.members] < UNEXPLAINED) > STRANGE
    ]
    pairs = [
        pair
        for grip in grips(looks, (way[:3].mean(axis=0), way[-3:].mean(axis=0)))
        for after, hinges, points in options
        for pair in hinge_pairs(hinges, points, grip, after=after)
    ]
    if not pairs:
        return None
    remainder = Remainder.of(looks, known)
    order = np.argsort(-remainder.values(pairs))[:FOLLOWED]
    best = [pairs[one] for one in order if pairs[one].follows(way)][:FINER]
    finer = [_make_finer(remainder, one) for one in best]
    value, pair = max(finer, key=lambda one: one[0], default=(0.0, None))
    return pair if value > LEAST_EVIDENCE else None


def _make_finer(remainder: Remainder, pair: HingePair) -> tuple[float, HingePair]:
    """The best pair near one, and what it is worth."""
    value = float(remainder.values([pair])[0])
    for turn, aside in STEPS:
        if not (options := list(pair.near(turn, aside))):
            break
        values = remainder.values(options)
        if values.max() > value:
            value, pair = float(values.max()), options[int(values.argmax())]
    return value, pair


def _insert(
    tree: PartTree,
    before: int,
    after: int,
    way: Float[np.ndarray, "times 3"],
    pair: HingePair,
    known: list[Float[np.ndarray, " _"]],
) -> int:
    """Put what is not known of a pair into the tree, if it explains points of its own; the number
    of what the hand held, or -1."""
    masks = _own_points(tree, before, after, pair, known)
    carrier = _part_with(tree, before, pair.carrier, way[0])
    carried = _part_with(tree, before, pair.carried, way[0], but=carrier)
    shown = [max(map(len, each)) >= FEWEST for each in masks]
    if (carrier is None and not shown[0]) or (carried is None and not shown[1]):
        return -1
    if carrier is not None and carried in tree.carriers(carrier):
        return -1  # they hang the other way round
    held = None if carried is None else tree.parts[carried]
    if carrier is None:
        if held is not None and held.parent >= 0:
            return -1  # it is on something already
        estimate = _estimate(tree, before, after, pair.carrier, pair.turn, masks[0], NOWHERE)
        insert(tree, before, after, Discovery(-1, estimate, masks[0], edge=pair.carrier))
        carrier = len(tree.parts) - 1
    else:
        turn = _signed(tree.screw(carrier, before), pair.carrier, pair.turn)
        tree.parts[carrier].positions[after] = tree.parts[carrier].positions[before] + turn
    if held in tree.parts:
        number = tree.parts.index(held)
        if number in tree.carriers(carrier):  # it was taken for a part of what it carries
            tree.parts[carrier] = hang(tree, tree.parts[carrier], -1, before)
        turn = _signed(tree.screw(number, before), pair.carried, pair.carried_turn)
        if held.parent != carrier:
            tree.parts[number] = held = hang(tree, held, carrier, before)
            for look in range(len(tree.looks)):
                tree.find(number, look)
        held.positions[after] = held.positions[before] + turn
        held.ways.append((before, way))
        return number
    back = tree.motion(carrier, after, before)
    ends = np.stack([way[:3].mean(axis=0), back.at(way[-3:].mean(axis=0)[None])[0]])
    short = [(0, np.repeat(ends, 3, axis=0))]
    estimate = _estimate(
        tree, before, after, pair.carried, pair.carried_turn, masks[1], back, short
    )
    insert(tree, before, after, Discovery(carrier, estimate, masks[1], edge=pair.carried), way)
    return len(tree.parts) - 1


def _part_with(
    tree: PartTree,
    look: int,
    hinge: Screw,
    hand: Float[np.ndarray, "3"],
    but: int | None = None,
) -> int | None:
    """The part that turns about a hinge, as well as both are known, and the nearest to a hand of
    those: doors above each other have one line; None if none does."""
    found: dict[int, float] = {}
    for number, part in enumerate(tree.parts):
        unsure = np.minimum(part.estimate.intervals, MOST_UNSURE).tolist()
        if number != but and is_same_hinge(hinge, tree.screw(number, look), *unsure):
            points = tree.pose(number, look).at(part.support[0])
            found[number] = float(np.linalg.norm(points - hand, axis=1).min())
    return min(found, key=found.__getitem__, default=None)


def _signed(screw: Screw, other: Screw, turn: float) -> float:
    """How far a joint has turned, by how far the same one with another axis has."""
    return turn if screw.axis @ other.axis > 0.0 else -turn


def _own_points(
    tree: PartTree,
    before: int,
    after: int,
    pair: HingePair,
    known: list[Float[np.ndarray, " _"]],
) -> tuple[Masks, Masks]:
    """The points of both looks that went with the carrier, and with what it carries; where both
    explain a point as well, it is told by the side of the hinge."""
    found: tuple[Masks, Masks] = [], []
    for look, other, already in ((before, after, known[0]), (after, before, known[1])):
        cloud, poses = tree.looks[look], list(pair.motions)
        points = cloud.points
        if look == after:
            poses = [pose.inverse for pose in poses]
            points = poses[0].at(points)
        each = evidence_of_poses(tree.looks[other], cloud.points, cloud.normals, poses)
        held = pair.is_beyond(points, after=look == after)
        held = np.where(each[0] == each[1], held, each[1] > each[0])
        own = each.max(axis=0) > already
        found[0].append(np.flatnonzero(own & ~held))
        found[1].append(np.flatnonzero(own & held))
    return found


def _estimate(
    tree: PartTree,
    before: int,
    after: int,
    screw: Screw,
    turn: float,
    masks: Masks,
    back: Pose,
    ways: list[Way] | None = None,
) -> Estimate:
    """A joint at an edge, from the points of its part in both looks and from ways of a hand, whose
    carrier comes `back` so."""
    seen = [
        sighting(tree.looks[look], mask, pose) if len(mask) >= FEWEST else None
        for look, mask, pose in zip((before, after), masks, (NOWHERE, back), strict=True)
    ]
    return refine(screw, np.array([0.0, turn]), seen, ways or [], screw)
