"""Parts that are new: what has moved with a hand as nothing does that is known.

Where a hand pulled at a part of something that moved as well, as at the flap of a door, its way is
no line and no circle. If the carrier is known, the way is only known by its ends: seen from the
carrier, the joint is sought that explains what was seen. Else the pull tells nothing yet.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float, Int

from palpate.identification.interactive.carriers import STILLER, TOUCHES, find_beside
from palpate.identification.interactive.explanation import (
    FURTHER,
    OPEN,
    joint_of_ways,
    labels_near,
)
from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.labels import (
    HIDDEN,
    LEAST_MOTION,
    distinguishing_looks,
    evidence,
)
from palpate.identification.interactive.part import UNSURE, Part, is_same_hinge, support_of
from palpate.identification.interactive.refinement import (
    MOMENTS,
    Estimate,
    misfit,
    nearness,
    patches_of,
    refine,
    sighting,
    surprise,
)
from palpate.identification.interactive.screws import NOWHERE, Pose, Screw, screws_of_way
from palpate.identification.interactive.tree import FEWEST, Candidate, PartTree

TELLS = 0.03  # m that a hand has to go to tell of a joint that is not known
WITHIN = 0.6  # share of a part's points that make it a part of another
LITTLE = 0.05  # m that a hand has taken a part: too little was known of it to know it again
STRANGE = 1.5  # of a hand's way, for the line or circle that fits it best (see `surprise`)
AROUND = 0.3  # m from a hand to the points by which a joint on a carrier is sought
TURNS, ARMS = 12, (0.0, 0.03, 0.06, 0.1, 0.15, 0.22, 0.3, 0.45, 0.7)  # directions, and m
TRIED = 3  # of those joints, the best, which are refined
ROUNDS = 4  # of a joint and of what has moved with it, each from the other
SETTLED = 2  # ways of a hand that agree: the joint of a part is what they say


@dataclasses.dataclass(frozen=True)
class Discovery:
    """A joint on a `carrier` where that was in the look before, the points of both looks, and how
    much likelier those are with it than without (logarithm)."""

    carrier: int
    estimate: Estimate
    masks: list[Int[np.ndarray, " _"]]
    gain: float = 0.0


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
        near = labels_near(tree, before, handling.push.point, math.inf)
        options = (_on_carrier(tree, before, after, one, way) for one in near if one >= 0)
        other = next((one for one in options if one is not None), None)
        # a way of two joints may look like a circle
        if found is None or (other is not None and _is_better(tree, before, after, other, found)):
            found = other
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


def _is_better(
    tree: PartTree, before: int, after: int, on_carrier: Discovery, alone: Discovery
) -> bool:
    """Whether a part on a carrier explains more than one alone, beside which that has moved too."""
    part = tree.parts[on_carrier.carrier]
    there = part.positions[after]
    motion = _candidate(alone.estimate, NOWHERE, before, after).motion
    find_beside(tree, on_carrier.carrier, before, after, motion.inverse)
    moved = abs(part.positions[after] - part.positions[before]) > STILLER
    part.positions[after] = there
    return moved and on_carrier.gain > alone.gain


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
            candidate = _candidate(estimate, back, before, after)
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
        candidate = _candidate(estimate, back, before, after)
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
    candidate, gain = _candidate(estimate, back, before, after), 0.0
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


def _candidate(estimate: Estimate, back: Pose, before: int, after: int) -> Candidate:
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
    parent, carried, same = _relatives(tree, before, after, new)
    number = len(tree.parts)
    back = tree.pose(parent, before).inverse
    screw = new.estimate.screw.moved(back)
    positions = [0.0] * len(tree.looks)
    positions[after] = float(new.estimate.positions[1] - new.estimate.positions[0])
    # a carrier that is found by its overlap alone has not moved: the whole way was the part's
    there = tree.pose(parent, after) if new.carrier >= 0 else back.inverse
    poses = back, (there @ screw.pose(positions[after])).inverse
    support = support_of((tree.looks[before], tree.looks[after]), new.masks, poses)
    estimate = dataclasses.replace(new.estimate, screw=screw)
    seen = {before: new.masks[0], after: new.masks[1]}
    ways = [] if way is None else [(before, way)]
    guessed = new.carrier >= 0 and way is not None
    tree.parts.append(Part(parent, estimate, positions, seen, ways, support, guessed))
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
        tree.find(number, look, others=others, beyond=FURTHER if look < before else None)
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


def _relatives(
    tree: PartTree, before: int, after: int, new: Discovery
) -> tuple[int, list[int], list[int]]:
    """What carries a new part, the parts that it carries, and those that are a piece of it."""
    labels, mask = tree.labels[before], np.zeros(len(tree.labels[before]), bool)
    mask[new.masks[0]] = True
    parent, carried, same = new.carrier, [], []
    back = tree.motion(new.carrier, after, before)
    gone = tree.scores(before, _candidate(new.estimate, back, before, after))[-1]
    for number, part in enumerate(tree.parts):
        own = labels == number
        if own.sum() < FEWEST or number == new.carrier:
            continue
        shared = (mask & own).sum()
        little = part.longest_way < LITTLE or shared > WITHIN * mask.sum()
        if shared > WITHIN * own.sum() and little:
            same.append(number)
        elif (
            shared > WITHIN * own.sum()
            and mask.sum() > 1.2 * own.sum()
            and gone[own].mean() > HIDDEN
        ):
            carried.append(number)  # all of it has moved, and more
        elif (
            new.carrier < 0
            and shared > WITHIN * mask.sum()
            and _carries(tree, number, before, after, new.masks[0])
        ):
            parent = number
    return parent, carried, same


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
        for number in {*pieces, *_relatives(tree, before, after, new)[2]}
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
    away = np.linalg.norm(np.cross(cloud.points[own] - screw.point, screw.axis), axis=1)
    if away.min() > TOUCHES:
        return False
    stayed = evidence(tree.looks[after], cloud.points[rest], cloud.normals[rest])
    return bool(np.mean(stayed) > OPEN)


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
