"""Which of the parts that are known a hand has moved."""

import dataclasses

import numpy as np

from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.refinement import Estimate, Way, refine, surprise
from palpate.identification.interactive.screws import NOWHERE, screws_of_way
from palpate.identification.interactive.tree import Candidate, PartTree

BESIDE = 0.06  # m from where a hand takes hold: what it may have hold of
SURPRISE = 1.0  # of a hand's way, for the joint that it moves: twice what is usual
SHORT = 0.05  # m that a hand went: a way so short fits many joints
EXPLAINED = 0.015, 0.1  # m, and of the travel: how far a known joint may miss the hand


def moved_part(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part that moved with the hand, which has one way more; -1 if none that is known has."""
    for explain in (_by_way, _by_all_ways, _by_clouds):
        if (part := explain(tree, before, after, handling)) >= 0:
            return part
    return -1


def labels_near(tree: PartTree, look: int, point: np.ndarray) -> list[int]:
    """The labels of what a hand at a point may have hold of, the nearest first.

    Parts that are there, though a camera hardly sees them, come last.
    """
    labels, cloud = tree.labels[look], tree.looks[look]
    chosen = np.array(cloud.tree.query_ball_point(point, BESIDE), int)
    away = np.linalg.norm(cloud.points[chosen] - point, axis=1)
    found = labels[chosen[np.argsort(away)]].tolist()
    for number, part in enumerate(tree.parts):
        pose = tree.pose(number, look)
        if np.linalg.norm(pose.at(part.support[0]) - point, axis=1).min() < BESIDE:
            found.append(number)
    return list(dict.fromkeys(found))


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
        if _follows_hand(tree, part, before, after, handling):
            one.ways.append((before, way))
            return part
    return -1


def _follows_hand(tree: PartTree, part: int, before: int, after: int, handling: Handling) -> bool:
    """Whether a look shows a part where a hand has taken it, and nothing else has moved.

    It is there from now on, or where it was found without the hand.
    """
    screw, one = tree.screw(part, before), tree.parts[part]
    start, alone = handling.points[:3].mean(axis=0), one.positions[after]
    gone = float(screw.position_of(start, handling.points)[-3:].mean())
    tree.find(part, after, around=one.positions[before] + gone)
    missed = abs(one.positions[after] - one.positions[before] - gone)
    arm = float(np.linalg.norm(screw.velocity(start)))
    own, candidate = int(np.sum(tree.labels[before] == part)), Candidate(NOWHERE, before, after)
    if missed * arm < EXPLAINED[0] + 2.0 * EXPLAINED[1] * handling.travel and not any(
        tree.much_is_left(candidate, look, own) for look in (before, after)
    ):
        return True
    one.positions[after] = alone
    return False


def _by_all_ways(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part that the hand was put to, if one joint explains this way and those before.

    Its joint was mistaken then, as of a short way a line and a circle are hardly told apart.
    """
    for part in labels_near(tree, before, handling.push.point):
        if part < 0:
            continue
        one = tree.parts[part]
        ways = [*one.ways, (before, tree.pose(one.parent, before).inverse.at(handling.points))]
        joint = _joint_of(ways, len(tree.looks))
        if joint is None:
            continue
        kept = one.estimate, one.positions
        one.settle(dataclasses.replace(joint, positions=np.array(one.positions_of(joint.screw))))
        if _follows_hand(tree, part, before, after, handling):
            one.ways = ways
            return part
        one.estimate, one.positions = kept
    return -1


def _joint_of(ways: list[Way], looks: int) -> Estimate | None:
    """The joint that all ways of a hand are of; None if they are of no one joint."""
    longest = max(ways, key=lambda way: float(np.linalg.norm(way[1][-1] - way[1][0])))[1]
    found = [
        refine(screw, np.zeros(looks), [None] * looks, ways) for screw in screws_of_way(longest)
    ]
    found = [one for one in found if all(surprise(one, way) < SURPRISE for _, way in ways)]
    return min(found, key=lambda one: one.criterion, default=None)


def _by_clouds(tree: PartTree, before: int, after: int, handling: Handling) -> int:
    """The part that the clouds show to have moved as the hand has.

    It has one way more, if nothing that carries it moved meanwhile.
    """
    start, end = handling.points[:3].mean(axis=0), handling.points[-3:].mean(axis=0)
    misses = [
        float(np.linalg.norm(tree.motion(part, before, after).at(start[None])[0] - end))
        for part in range(len(tree.parts))
    ]
    if not misses or min(misses) > EXPLAINED[0] + EXPLAINED[1] * handling.travel:
        return -1
    part = int(np.argmin(misses))
    if all(
        abs(tree.parts[one].positions[before] - tree.parts[one].positions[after]) < 1e-3
        for one in tree.carriers(part)
    ):
        back = tree.pose(tree.parts[part].parent, before).inverse
        tree.parts[part].ways.append((before, back.at(handling.points)))
    return part
