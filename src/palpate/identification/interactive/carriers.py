"""What carries what: a part hangs on another one if it has gone along."""

import dataclasses

import numpy as np

from palpate.identification.interactive.labels import HIDDEN, evidence
from palpate.identification.interactive.part import Part
from palpate.identification.interactive.screws import Pose
from palpate.identification.interactive.tree import FEWEST, PartTree

SEEN = 0.2  # of evidence, for each point: less is no difference
CARRIED = 0.15  # rad or m that a part has to go to show what it carries
STILLER = 0.05  # rad or m
LOOKS = 6  # looks that tell whether a part has gone along
TOUCHES = 0.03  # m: what is so near a part may carry it
BESIDE = 0.6  # share of a carrier in what is around a part that stands on it


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
        other = _hang(tree, part, tree.parts[carrier].parent if carried else carrier, first)
        # as free to be elsewhere as on the carrier
        before = _evidence_with(tree, number, now, gone)
        gain = _evidence_with(tree, number, other, gone) - before
        beside = (
            not carried
            and _travel(other, look) + STILLER < _travel(part, look)
            and _share_beside(tree, number, carrier, look) > BESIDE
        )
        if gain > SEEN or (gain > -SEEN and beside):
            other.settle(tree.estimate(other))
            for one in gone:
                tree.relabel(one)
        else:
            tree.parts[number] = part


def _hang(tree: PartTree, part: Part, parent: int, look: int) -> Part:
    """A part as it is in a look, on another parent."""
    onto = tree.pose(parent, look).inverse @ tree.pose(part.parent, look)
    return dataclasses.replace(
        part,
        parent=parent,
        positions=list(part.positions),
        estimate=dataclasses.replace(part.estimate, screw=part.screw.moved(onto)),
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
