"""Parts that are new: what has moved with a hand as nothing does that is known.

Where a hand pulled at a part of something that moved as well, as at the flap of a door, its way is
no line and no circle. If the carrier is known, the way is only known by its ends: seen from the
carrier, the joint is sought that explains what was seen. Else the pull tells nothing yet.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from palpate.identification.interactive.explanation import (
    OPEN,
    joint_of_ways,
    labels_near,
)
from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.insertion import (
    CARRIED,
    TOUCHES,
    WITHIN,
    Discovery,
    candidate_of,
    find_beside,
    insert,
    relatives,
)
from palpate.identification.interactive.labels import (
    LEAST_MOTION,
    evidence,
)
from palpate.identification.interactive.part import UNSURE, Candidate, Part, is_same_hinge
from palpate.identification.interactive.refinement import (
    Estimate,
    nearness,
    patches_of,
    refine,
    sighting,
    surprise,
)
from palpate.identification.interactive.screws import NOWHERE, Pose, Screw, screws_of_way
from palpate.identification.interactive.tree import FEWEST, PartTree
from palpate.identification.interactive.ways import MOMENTS, misfit

TELLS = 0.03  # m that a hand has to go to tell of a joint that is not known
STRANGE = 1.5  # of a hand's way, for the line or circle that fits it best (see `surprise`)
AROUND = 0.3  # m from a hand to the points by which a joint on a carrier is sought
TURNS, ARMS = 12, (0.0, 0.03, 0.06, 0.1, 0.15, 0.22, 0.3, 0.45, 0.7)  # directions, and m
TRIED = 3  # of those joints, the best, which are refined
ROUNDS = 4  # of a joint and of what has moved with it, each from the other
SETTLED = 2  # ways of a hand that agree: the joint of a part is what they say
# How much likelier a joint on what moved as well has to be than one that the whole way follows
# (logarithm): by chance a way of two joints may be an arc, and hardly ever a line.
BY_CHANCE = {"revolute": 8.0, "prismatic": 16.0}


def discover(
    tree: PartTree, before: int, after: int, handling: Handling, *, carried: bool = False
) -> bool:
    """Whether a new part explains what moved with the hand; it is the tree's last one then.

    Parts that turn out to be a piece of it are taken out of the tree. One that has to be `carried`
    is sought on known parts alone.
    """
    way = handling.points
    found = None if carried else _best(tree, before, after, -1, way, screws_of_way(way))
    if found is not None and (known := _find_known(tree, before, found)) is not None:
        if joint_of_ways(tree, known, [*known.ways, (before, way)]) is not None:
            return False  # it went as a known part does, which clouds show elsewhere
        found = None  # what is on it has moved as well
    if found is not None and (others := _parts_that_contradict(tree, before, after, found, way)):
        if len(others) == 1 and _is_hinged_on(tree, others[0], before, after, found):
            tree.parts[others[0]].positions[after] = tree.parts[others[0]].positions[before]
            found = dataclasses.replace(found, carrier=others[0])
        else:
            found = None  # both have moved, and their way looks like a circle
    if found is None or found.carrier < 0:
        # what it is on need not reach to the hand: a flap hangs by its far edge
        near = [one for one in labels_near(tree, before, handling.push.point, math.inf) if one >= 0]
        # a way of two joints may look like a circle: what has moved beside it may carry it
        if found is not None:
            near = [one for one in near if _moves_beside(tree, before, after, one, found)]
        options = (_on_carrier(tree, before, after, one, way) for one in near)
        other = next((one for one in options if one is not None), None)
        if found is None:
            found = other
        elif other is not None:
            chance = BY_CHANCE[found.estimate.screw.joint]
            found = other if other.gain > found.gain + chance else found
    if found is not None:
        insert(tree, before, after, found, way)
    return found is not None


def _on_carrier(
    tree: PartTree, before: int, after: int, carrier: int, way: Float[np.ndarray, "times 3"]
) -> Discovery | None:
    """A part of something that moved as well: what joins the ends of the way, and was seen."""
    motion = tree.motion(carrier, before, after)
    ends = np.stack([way[:3].mean(axis=0), motion.inverse.at(way[-3:].mean(axis=0)[None])[0]])
    places = tree.parts[carrier].positions
    if abs(places[after] - places[before]) < LEAST_MOTION or math.dist(*ends) < TELLS:
        return None
    short = np.repeat(ends, 3, axis=0)
    followed = screws_of_way(on_moving_carrier(tree, before, after, carrier, way))[:1]
    found = _best(tree, before, after, carrier, short, followed)
    cloud = tree.looks[before]
    lost = tree.unexplained(Candidate(NOWHERE, before, after), before)
    lost &= np.linalg.norm(cloud.points - ends[0], axis=1) < AROUND
    if lost.sum() < FEWEST or (found is not None and min(map(len, found.masks)) >= FEWEST):
        return found
    points, normals = cloud.points[lost], cloud.normals[lost]

    def value(screw: Screw) -> float:
        pose = motion @ screw.pose(float(screw.position_of(ends[0], ends[1:])[0]))
        return float(np.sum(evidence(tree.looks[after], pose.at(points), pose.turned(normals))))

    best = sorted(_joining(*ends), key=value, reverse=True)[:TRIED]
    joined = _best(tree, before, after, carrier, short, best)
    if joined is not None and joined.estimate.intervals[0] < UNSURE:
        return joined
    return found


def _moves_beside(tree: PartTree, before: int, after: int, number: int, alone: Discovery) -> bool:
    """Whether a part has moved as well as one that is taken to be on nothing that moved, and
    further than what was let go may creep."""
    part = tree.parts[number]
    there, began = part.positions[after], part.positions[before]
    if abs(there - began) <= CARRIED:
        return False
    motion = candidate_of(alone.estimate, NOWHERE, before, after).motion
    find_beside(tree, number, before, after, motion.inverse)
    moved = abs(part.positions[after] - began) > CARRIED
    part.positions[after] = there
    return moved


def on_moving_carrier(
    tree: PartTree, before: int, after: int, carrier: int, way: Float[np.ndarray, "times 3"]
) -> Float[np.ndarray, "times 3"]:
    """A hand's way as if its carrier had stayed, which went along with it step by step, about."""
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    part, there = tree.parts[carrier], tree.pose(carrier, before)
    base = tree.pose(part.parent, before)
    places = part.positions[before] + gone / gone[-1] * (
        part.positions[after] - part.positions[before]
    )
    found = [
        (there @ (base @ part.screw.pose(float(place))).inverse).at(point[None])[0]
        for place, point in zip(places, way, strict=True)
    ]
    return np.array(found)


def _joining(start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> list[Screw]:
    """Joints that take a point from one place to another: a line, and circles all around it."""
    middle, chord = 0.5 * (start + end), (end - start) / np.linalg.norm(end - start)
    line = Screw("prismatic", chord, middle)
    first, second = line.across
    found = [line]
    for turn in np.arange(TURNS) * math.tau / TURNS:
        axis = math.cos(turn) * first + math.sin(turn) * second
        side = np.cross(axis, chord)
        found += [Screw("revolute", axis, middle + arm * side) for arm in ARMS]
    return found


def _best(
    tree: PartTree,
    before: int,
    after: int,
    carrier: int,
    way: Float[np.ndarray, "times 3"],
    screws: list[Screw],
) -> Discovery | None:
    """The likeliest of some joints, each from all that moved so; None if none explains enough."""
    start, back = way[:3].mean(axis=0), tree.motion(carrier, after, before)
    found: list[Discovery] = []
    for screw in screws:
        gone = float(screw.position_of(start, way)[-3:].mean())
        estimate = Estimate(screw, np.array([0.0, gone]), np.eye(4), 0.0, 0.0)
        masks: list[np.ndarray] = []
        for _ in range(ROUNDS):
            candidate = candidate_of(estimate, back, before, after)
            masks = [
                np.flatnonzero(tree.probabilities(look, candidate).argmax(0) == len(tree.parts) + 1)
                for look in (before, after)
            ]
            if max(map(len, masks)) < FEWEST:
                break
            seen = [
                sighting(tree.looks[look], mask, pose) if len(mask) >= FEWEST else None
                for look, mask, pose in zip((before, after), masks, (NOWHERE, back), strict=True)
            ]
            estimate = refine(estimate.screw, estimate.positions, seen, [(0, way)])
        if max(map(len, masks)) < FEWEST or surprise(estimate, way) > STRANGE:
            continue
        if estimate.screw.is_far_from(way):
            continue  # what goes so slides, and its line is tried, too
        candidate = candidate_of(estimate, back, before, after)
        if not any(
            tree.much_is_left(candidate, look, len(mask))
            for look, mask in zip((before, after), masks, strict=True)
        ):
            gain = _gain(tree, before, after, estimate, back, way)
            found.append(Discovery(carrier, estimate, masks, gain))
    return max(found, key=lambda one: one.gain, default=None)


def _gain(
    tree: PartTree,
    before: int,
    after: int,
    estimate: Estimate,
    back: Pose,
    way: Float[np.ndarray, "times 3"],
) -> float:
    """How much likelier two looks and a hand's way are with a new part than without (logarithm,
    less what its numbers cost by the Bayesian information criterion).

    What is explained as well without it says nothing for it: a wall may slide in its plane.
    """
    candidate, gain = candidate_of(estimate, back, before, after), 0.0
    for look in (before, after):
        given = tree.scores(look, candidate)
        more = given[-1] - given[:-1].max(axis=0)
        other, pose = candidate.between(look)
        fit = nearness(tree.looks[look], tree.looks[other], pose)
        patch = patches_of(tree.looks[look].points)  # errors of neighbours are not independent
        more = np.where(more > 0.0, more + fit, 0.0)
        gain += float(np.sum(np.bincount(patch, more) / np.bincount(patch)))
    numbers = 4.0 if estimate.screw.joint == "revolute" else 2.0
    strays = misfit(estimate.screw, way) * 2.0 * min(len(way), MOMENTS)
    return gain - 0.5 * strays - 0.5 * numbers * math.log(max(estimate.independent, 2.0))


def _parts_that_contradict(
    tree: PartTree,
    before: int,
    after: int,
    new: Discovery,
    way: Float[np.ndarray, "times 3"],
) -> list[int]:
    """Parts that look like a piece of a new one, or that it looks like a piece of, and that are
    known by ways which no joint has that goes the new way as well: a lid and its leaf look like one
    surface."""
    held = labels_near(tree, before, way[0])[:1]
    taken = tree.labels[before][new.masks[0]]
    pieces = [one for one in held if one >= 0 and np.sum(taken == one) >= WITHIN * len(taken)]
    return [
        number
        for number in {*pieces, *relatives(tree, before, after, new)[2]}
        if len(ways := tree.parts[number].ways) >= SETTLED
        and joint_of_ways(tree, tree.parts[number], [*ways, (before, way)]) is None
    ]


def _find_known(tree: PartTree, before: int, new: Discovery) -> Part | None:
    """The known part that a new one is made of points of, and turns about the hinge of."""
    taken, screw = tree.labels[before][new.masks[0]], new.estimate.screw
    for number, part in enumerate(tree.parts):
        own = (taken == number) | np.isin(taken, _carried_by(tree, number))
        if (
            len(part.ways) >= SETTLED
            and screw.joint == "revolute"
            and np.sum(own) > WITHIN * len(taken)
            and is_same_hinge(screw, tree.screw(number, before), *part.estimate.intervals)
        ):
            return part
    return None


def _carried_by(tree: PartTree, part: int) -> list[int]:
    """What a part carries, on other parts or by itself."""
    return [number for number in range(len(tree.parts)) if part in tree.carriers(number)]


def _is_hinged_on(tree: PartTree, part: int, before: int, after: int, new: Discovery) -> bool:
    """Whether a new part turns about a line on another one, the rest of which has stayed."""
    cloud, screw = tree.looks[before], new.estimate.screw
    own = np.flatnonzero(tree.labels[before] == part)
    rest = np.setdiff1d(own, new.masks[0])
    if screw.joint != "revolute" or len(rest) < FEWEST:
        return False
    away = screw.radii(cloud.points[own])
    if away.min() > TOUCHES:
        return False
    stayed = evidence(tree.looks[after], cloud.points[rest], cloud.normals[rest])
    return bool(np.mean(stayed) > OPEN)
