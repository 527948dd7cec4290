"""Which of the parts that are known a hand has moved."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.labels import (
    FREE,
    LEAST_MOTION,
    evidence,
    evidence_of_looks,
)
from palpate.identification.interactive.part import Candidate, Part
from palpate.identification.interactive.refinement import SURPRISE, Estimate, refine, surprise
from palpate.identification.interactive.screws import NOWHERE, screws_of_way
from palpate.identification.interactive.tree import NOT_MOVED, PartTree
from palpate.identification.interactive.two_joints import Linkage
from palpate.identification.interactive.ways import Way, misfit

BESIDE = 0.06  # m from where a hand takes hold: what it may have hold of
FURTHER = 1.5  # rad or m that a part may have been beyond where it was seen
NEAR = 0.5  # the same, of one that a hand takes
MISFIT = 1.1  # of each of a hand's ways, for the joint that they say is theirs: at most .91 of 85
SHORT = 0.05  # m that a hand went: a way so short fits many joints
TOGETHER = 0.02  # of the travel: how far two joints may miss the hand, beside the metres below
CLEARLY = 0.005  # of evidence, for each point: how much likelier two joints have to be than one
OPEN = -1.0  # of evidence, for each point: what has less is not where it is believed to be
IN_THE_WAY = 0.05  # share of a part's points that cameras look through: hardly any where it is
ELSEWHERE = 0.15  # rad or m that a carrier is at least from where it was believed to be
EXPLAINED = 0.015, 0.1  # m, and of the travel: how far a known joint may miss the hand


def find_moved_part(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part that moved with the hand, which has one way more; -1 if none that is known has."""
    for explain in (_by_known_joints, _by_clouds, _by_all_ways, _by_way_elsewhere):
        if (part := explain(tree, before, after, handling)) >= 0:
            return part
    return -1


def may_have_moved(tree: PartTree, part: int, look: int, way: Float[np.ndarray, "times 3"]) -> bool:
    """Whether a hand has moved a part after a look: began at it, went as its joint allows, and both
    looks show it there.

    It need not be where it was believed to be, if another position is clearly better.
    """
    one, local = tree.parts[part], tree.way_from(tree.parts[part].parent, look, way)
    if surprise(one.estimate, local) > SURPRISE:
        return False
    low, high = one.range
    tried = np.array([one.positions[look], *np.arange(low - FURTHER, high + FURTHER, 0.04)])
    seen = tree.seen_at(part, look, tried)
    seen[0] += NOT_MOVED
    place = float(tried[seen.argmax()])
    points = one.screw.pose(place).at(one.support[0])
    if np.linalg.norm(points - local[0], axis=1).min() > BESIDE:
        return False
    gone = float(one.screw.position_of(local[0], local)[-3:].mean())
    moved, stood = tree.seen_at(part, look + 1, np.array([place + gone, place]))
    return bool(moved > stood)


def labels_near(tree: PartTree, look: int, point: np.ndarray, reach: float = BESIDE) -> list[int]:
    """The labels of what is within reach (m) of a point, as a hand may have hold of, the nearest
    first.

    Parts that are there, though a camera hardly sees them, come last.
    """
    labels, cloud = tree.labels[look], tree.looks[look]
    chosen = np.array(cloud.tree.query_ball_point(point, reach), int)
    away = np.linalg.norm(cloud.points[chosen] - point, axis=1)
    found = labels[chosen[np.argsort(away)]].tolist()
    for number, part in enumerate(tree.parts):
        pose = tree.pose(number, look)
        if np.linalg.norm(pose.at(part.support[0]) - point, axis=1).min() < reach:
            found.append(number)
    return list(dict.fromkeys(found))


def _by_known_joints(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part that the hand moved, by its own joint or together with what carries it: as both
    looks are likelier, where its way fits either, as that of a folded lid may."""
    began = _Belief.of(tree)
    alone = _by_way(tree, before, after, handling)
    by_way, value = _Belief.of(tree), _evidence_of_both(tree, before, after)
    began.restore(tree)
    both = _by_two_joints(tree, before, after, handling)
    if alone >= 0 and (both < 0 or _evidence_of_both(tree, before, after) < value + CLEARLY):
        by_way.restore(tree)
        return alone
    return both


@dataclasses.dataclass(frozen=True)
class _Belief:
    """What an explanation of a pull may change."""

    positions: list[list[float]]
    ways: list[list[Way]]
    labels: list[np.ndarray]

    @classmethod
    def of(cls, tree: PartTree) -> "_Belief":
        """What is believed now."""
        parts = tree.parts
        return cls(
            [list(one.positions) for one in parts],
            [list(one.ways) for one in parts],
            [*tree.labels],
        )

    def restore(self, tree: PartTree) -> None:
        """Believe it again."""
        for part, positions, ways in zip(tree.parts, self.positions, self.ways, strict=True):
            part.positions, part.ways = list(positions), list(ways)
        for look, labels in enumerate(self.labels):
            if tree.labels[look] is not labels:
                tree.put_labels(look, labels)


def _evidence_of_both(tree: PartTree, before: int, after: int) -> float:
    """How likely (logarithm, for each point) what is believed of the parts makes two looks."""
    looks = before, after
    return evidence_of_looks(
        [tree.looks[look] for look in looks],
        range(-1, len(tree.parts)),
        lambda part, one, other: tree.motion(part, looks[one], looks[other]),
    )


def _by_way(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part whose joint is what the hand's way follows, and which is where the hand has gone.

    A short way fits many joints, and is then only that of the part that the hand was put to.
    """
    near = labels_near(tree, before, handling.push.point)
    others = [part for part in range(len(tree.parts)) if part not in near]
    for part in [*near, *others] if handling.travel > SHORT else near[:1]:
        if part < 0:
            continue
        one = tree.parts[part]
        way = tree.pose(one.parent, before).inverse.at(handling.points)
        if surprise(one.estimate, way) > SURPRISE:
            continue
        if joint_of_ways(tree, one, [*one.ways, (before, handling.points)]) is None:
            continue
        if _follows_hand(tree, part, before, after, handling):
            one.ways.append((before, handling.points))
            return part
    return -1


def _follows_hand(tree: PartTree, part: int, before: int, after: int, handling: Handling) -> bool:
    """Whether a look shows a part where a hand has taken it, and nothing else has moved.

    It is there from now on, and was before where both looks show it best. If not, nothing changes.
    """
    screw, one, labels = tree.screw(part, before), tree.parts[part], tree.labels[before]
    start, kept = handling.points[:3].mean(axis=0), (one.positions[before], one.positions[after])
    gone = float(screw.position_of(start, handling.points)[-3:].mean())
    began = _began_at(tree, part, before, gone, start)
    if began != one.positions[before]:
        one.positions[before] = began
        tree.relabel(before)
    tree.find(part, after, began + gone, tree.points_of_others(part, after, before))
    missed = abs(one.positions[after] - began - gone) * np.linalg.norm(screw.velocity(start))
    own, candidate = int(np.sum(tree.labels[before] == part)), Candidate(NOWHERE, before, after)
    if missed < EXPLAINED[0] + 2.0 * EXPLAINED[1] * handling.travel and not any(
        tree.much_is_left(candidate, look, own) for look in (before, after)
    ):
        return True
    one.positions[before], one.positions[after] = kept
    tree.put_labels(before, labels)
    return False


def _began_at(
    tree: PartTree, part: int, before: int, gone: float, hand: Float[np.ndarray, "3"]
) -> float:
    """Where a part was when a hand took it (m) and it went so far (rad or m): where it was believed
    to be, unless it is clearly better seen at the hand before, and so far from there after.

    Of a sheet that slides each look by itself leaves open where it is.
    """
    one = tree.parts[part]
    low, high = one.range
    step = 0.04 if one.screw.joint == "revolute" else 0.01
    tried = np.array([one.positions[before], *np.arange(low - NEAR, high + NEAR, step)])
    pose = tree.pose(one.parent, before)
    points = [(pose @ one.screw.pose(float(place))).at(one.support[0]) for place in tried]
    away = np.array([np.linalg.norm(each - hand, axis=1).min() for each in points])
    seen = tree.seen_at(part, before, tried) + tree.seen_at(part, before + 1, tried + gone)
    believed = seen[0] + NOT_MOVED
    seen[away >= BESIDE] = -np.inf
    seen[0] = believed
    return float(tried[seen.argmax()])


def _by_two_joints(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part that the hand was put to, if it went as the joints of that and of what carries it
    let it go together, and both are there."""
    for part in labels_near(tree, before, handling.push.point):
        if part < 0 or (carrier := tree.parts[part].parent) < 0:
            continue
        both = tree.parts[carrier], tree.parts[part]
        kept = [one.positions[after] for one in both]
        best, found = -np.inf, None
        for ends in possible_ends(tree, part, before, handling):
            _place(both, ends, after)
            if not _are_seen_near(tree, (carrier, part), before, after, handling):
                _place(both, ends, after)
            seen = _seen(tree, (carrier, part), after)
            if min(seen) > OPEN and sum(seen) > best:
                best, found = sum(seen), [one.positions[after] for one in both]
        _place(both, kept if found is None else found, after)
        own, candidate = int(np.sum(tree.labels[before] == part)), Candidate(NOWHERE, before, after)
        if found and not any(tree.much_is_left(candidate, look, own) for look in (before, after)):
            both[1].ways.append((before, handling.points))
            return part
        _place(both, kept, after)
    return -1


def _place(parts: Sequence[Part], positions: Sequence[float], look: int) -> None:
    """Say where parts are in a look (rad or m)."""
    for part, position in zip(parts, positions, strict=True):
        part.positions[look] = position


def _seen(tree: PartTree, parts: tuple[int, int], look: int) -> list[float]:
    """The evidence, for each point, of parts where they are believed to be in a look."""
    return [
        float(tree.seen_at(part, look, np.array([tree.parts[part].positions[look]]))[0])
        for part in parts
    ]


def _are_seen_near(
    tree: PartTree, parts: tuple[int, int], before: int, after: int, handling: Handling
) -> bool:
    """Whether a carrier and a part on it are where no camera looks through them, taken to where
    they are seen, as joints are a little off; and the hand about where the part has gone."""
    for part in parts:
        tree.find(part, after, around=tree.parts[part].positions[after])
    start, end = handling.points[:3].mean(axis=0), handling.points[-3:].mean(axis=0)
    missed = np.linalg.norm(tree.motion(parts[1], before, after).at(start[None])[0] - end)
    near = missed < EXPLAINED[0] + EXPLAINED[1] * handling.travel
    return bool(near) and min(_seen(tree, parts, after)) > OPEN


def possible_ends(
    tree: PartTree, part: int, before: int, handling: Handling
) -> list[tuple[float, float]]:
    """Where the hand may have taken a part's carrier and the part on it (rad or m): nowhere if
    their joints do not let it go its way."""
    carrier, one = tree.parts[tree.parts[part].parent], tree.parts[part]
    start = tree.pose(part, before).inverse.at(handling.points[:3].mean(axis=0)[None])
    most = (EXPLAINED[0] + TOGETHER * handling.travel) * (0.5 if one.provisional else 1.0)
    linkage = Linkage(tree.pose(carrier.parent, before), (carrier.screw, one.screw), start)
    began = carrier.positions[before], one.positions[before]
    return linkage.ends(began, handling.points, most)


def _by_all_ways(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part that the hand was put to, if one joint explains this way and those before.

    Its joint was mistaken then, as of a short way a line and a circle are hardly told apart.
    """
    for part in labels_near(tree, before, handling.push.point):
        if part < 0:
            continue
        one = tree.parts[part]
        ways = [*one.ways, (before, handling.points)]
        joint = joint_of_ways(tree, one, ways)
        # two joints that move at once may do as one, elsewhere
        if joint is None or one.estimate.refutes(joint.screw):
            continue
        if one.edge is not None and joint.screw.joint == "prismatic":
            continue
        kept, labels = (one.estimate, one.positions), tree.labels[before]
        one.settle(dataclasses.replace(joint, positions=np.array(one.positions_of(joint.screw))))
        if _follows_hand(tree, part, before, after, handling) and not _is_in_the_way(
            tree, part, after
        ):
            one.ways = ways
            return part
        one.estimate, one.positions = kept
        tree.put_labels(before, labels)
    return -1


def _is_in_the_way(tree: PartTree, part: int, look: int) -> bool:
    """Whether cameras would have to look through a part where it is believed to be in a look."""
    pose, (points, normals) = tree.pose(part, look), tree.parts[part].support
    seen = evidence(tree.looks[look], pose.at(points), pose.turned(normals))
    return bool(np.mean(seen == FREE) > IN_THE_WAY)


def _by_way_elsewhere(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part that went as its joint lets it on a carrier that was, before and after, where it was
    in another look: what is on a carrier may hide where that is."""
    for part, one in enumerate(tree.parts):
        if one.parent < 0:
            continue
        carrier = tree.parts[one.parent]
        kept = list(carrier.positions), list(one.positions)
        for place in np.unique(np.round(kept[0], 1)):
            if abs(place - kept[0][before]) < ELSEWHERE:
                continue
            carrier.positions, one.positions = list(kept[0]), list(kept[1])
            carrier.positions[before] = carrier.positions[after] = float(place)
            if (
                surprise(one.estimate, tree.way_from(one.parent, before, handling.points))
                > SURPRISE
            ):
                continue
            for look in (before, after):
                tree.find(part, look, beyond=FURTHER)
            if min(_seen(tree, (one.parent, part), before)) > OPEN and _follows_hand(
                tree, part, before, after, handling
            ):
                one.ways.append((before, handling.points))
                return part
        carrier.positions, one.positions = kept
    return -1


def joint_of_ways(tree: PartTree, part: Part, ways: list[Way]) -> Estimate | None:
    """The joint that all of some ways of a hand are of, on what carries a part; None if they are
    of no one joint."""
    looks = len(tree.looks)
    ways = [(look, tree.way_from(part.parent, look, way)) for look, way in ways]
    longest = max(ways, key=lambda way: float(np.linalg.norm(way[1][-1] - way[1][0])))[1]
    found = [
        refine(screw, np.zeros(looks), [None] * looks, ways) for screw in screws_of_way(longest)
    ]
    found = [
        one
        for one in found
        if not one.screw.is_far_from(longest)
        and all(misfit(one.screw, way) < MISFIT for _, way in ways)
    ]
    return min(found, key=lambda one: one.criterion, default=None)


def missed_by(tree: PartTree, before: int, after: int, handling: Handling) -> dict[int, float]:
    """Of each part that has moved by itself from one look to another, how far (m) from where the
    hand ended it has taken what the hand took hold of."""
    start, end = handling.points[:3].mean(axis=0), handling.points[-3:].mean(axis=0)
    return {
        number: float(np.linalg.norm(tree.motion(number, before, after).at(start[None])[0] - end))
        for number, part in enumerate(tree.parts)
        if abs(part.positions[after] - part.positions[before]) > LEAST_MOTION
    }


def _by_clouds(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part that the clouds show to have moved as the hand has, which has one way more.

    Its joint allows that way: else what moved is something on it, or under it, as well.
    """
    misses = missed_by(tree, before, after, handling)
    if not misses or min(misses.values()) > EXPLAINED[0] + EXPLAINED[1] * handling.travel:
        return -1
    part = min(misses, key=lambda number: misses[number])
    one, new = tree.parts[part], (before, handling.points)
    if surprise(one.estimate, tree.way_from(one.parent, *new)) > SURPRISE:
        return -1
    if joint_of_ways(tree, one, [*one.ways, new]) is None:
        return -1
    one.ways.append(new)
    return part
