"""Parts that clouds alone show: what has gone otherwise than its carrier, as a flap does.

A hand that pulls at a flap of a door moves both, by no line and no circle. But once the joint of
the door is known, a flat piece of it that is in the open wherever that joint has taken it has moved
by itself, about one of its edges (the mask that shrank: SAGCI, Eqn. 13). Where nothing is known of
the door either, that is found in the same way, as a part of what stood still.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from palpate.identification.interactive.duplicates import merge_same
from palpate.identification.interactive.edges.pieces import STRANGE, Piece, edges_of, pieces_of
from palpate.identification.interactive.explanation import FURTHER
from palpate.identification.interactive.insertion import Discovery, insert
from palpate.identification.interactive.labels import (
    HIDDEN,
    ON,
    TOLERANCE,
    evidence,
    evidence_of_poses,
)
from palpate.identification.interactive.part import UNSURE, Part, is_same_hinge
from palpate.identification.interactive.refinement import NEAR, refine, sighting
from palpate.identification.interactive.screws import NOWHERE, Screw
from palpate.identification.interactive.tree import FEWEST, UNEXPLAINED, PartTree

MOVED = 0.15  # rad or m that a carrier has moved between two looks, or a part on it
MEETS = 0.6  # share of a piece's points that meet a surface where the joint takes it
# the same, of what stood still: its hinge is not quite at its edge, and it may fold
PARTLY_MEETS = 0.25
GAIN = 1.0  # of evidence, for each point: how much better a joint on a carrier explains a piece
TURNS, FINER = np.arange(-2.2, 2.21, 0.1), np.linspace(-0.075, 0.075, 7)  # rad
TRIED = 3  # of the options, the best
LEAST_EVIDENCE = 500.0  # of evidence, of all points and looks
SURE = 5.0, 0.03  # deg and m: 90 % intervals of a joint that is known well enough
LARGEST = 0.5  # of a carrier's points in a look: a piece that is larger is no part on it
GROWN = 2.5  # of a piece's points: a part that takes more there is not what was tried
MOST = 0.75  # share of a carrier's points that a part on it may take


@dataclasses.dataclass
class Option:
    """An edge of a piece that it may have turned about on a carrier, as it was in the piece's look.

    `turns` (rad) says how far it has turned in each look which that explains better than what is
    known, and `gains` by how much (evidence, of all points).
    """

    look: int
    piece: Piece
    carrier: int
    screw: Screw
    turns: dict[int, float] = dataclasses.field(default_factory=dict)
    gains: dict[int, float] = dataclasses.field(default_factory=dict)

    @property
    def gain(self) -> float:
        """Of all looks."""
        return float(sum(self.gains.values()))


Options = dict[tuple[int, int, int], list[Option]]  # by look, piece and carrier


def split(tree: PartTree, looks: list[int]) -> bool:
    """Whether some looks show a part on a known one that is not known yet; it is the last then.

    They are held against all looks in which a known part is elsewhere.
    """
    if not tree.parts:
        return False
    places = np.array([one.positions for one in tree.parts])
    _, distinct = np.unique(np.round(places / MOVED), axis=1, return_index=True)
    pairs = [(one, int(other)) for one in looks for other in distinct if other not in looks]
    found: Options = {}
    for look, other in [*pairs, *(pair[::-1] for pair in pairs)]:
        _add_options(tree, look, other, found)
    return _insert_best(tree, found)


def split_off_base(tree: PartTree, before: int, after: int) -> bool:
    """Whether two looks show that what stood still before has turned about one of its edges; it is
    the last part then. For a pull that told nothing, as at a flap of a door that is not known."""
    found: Options = {}
    for look, other in ((before, after), (after, before)):
        if pieces := pieces_of(tree.looks[look]):
            known = _evidence_of_pieces(tree, look, other, pieces)
            _try_edges(tree, look, other, pieces, known, [-1], found)
    return _insert_best(tree, found)


def _insert_best(tree: PartTree, found: Options) -> bool:
    """Whether one of some hinges is that of a part; it is the last then."""
    options = [one for each in found.values() for one in each if one.gain > LEAST_EVIDENCE]
    options.sort(key=lambda option: -option.gain)
    return any(_insert(tree, option) for option in options[:TRIED])


def _add_options(tree: PartTree, look: int, other: int, found: Options) -> None:
    """Hinges on known parts of what another look does not show where those have gone."""
    moved = [
        number
        for number, part in enumerate(tree.parts)
        if abs(part.positions[look] - part.positions[other]) > MOVED and _is_sure(part)
    ]
    pieces = pieces_of(tree.looks[look]) if moved else []
    if not pieces:
        return
    known = _evidence_of_pieces(tree, look, other, pieces)
    # the carrier has to be seen where it has gone: else it is elsewhere, and what is on it as well
    whose = tree.labels[look]
    carriers = [
        carrier
        for carrier in moved
        if any(
            np.mean(whose[one.members] == carrier) > MEETS
            and np.mean(each[carrier + 1] < UNEXPLAINED) < STRANGE
            and each[0].mean() < each[carrier + 1].mean() - GAIN
            for one, each in zip(pieces, known, strict=True)
        )
    ]
    _try_edges(tree, look, other, pieces, known, carriers, found)


def _try_edges(
    tree: PartTree,
    look: int,
    other: int,
    pieces: list[Piece],
    known: list[Float[np.ndarray, "labels _"]],
    carriers: list[int],
    found: Options,
) -> None:
    """Hold hinges at the edges of pieces, on each of some carriers (-1: what stands still), against
    another look, if that does not show the pieces where something `known` has gone."""
    strange = [
        number
        for number, each in enumerate(known)
        if np.mean(each.max(axis=0) < UNEXPLAINED) > STRANGE
    ]
    if not carriers or not strange:
        return
    others, cloud = _find_explained(tree, other, look), tree.looks[other]
    if -1 in carriers:  # an inner wall that a lid bares is where the lid had turned inwards
        others |= evidence(tree.looks[look], cloud.points, cloud.normals) >= HIDDEN
    for number in strange:
        best = float(known[number].mean(axis=1).max())
        for carrier in carriers:
            options = found.setdefault(
                (look, number, carrier),
                [
                    Option(look, pieces[number], carrier, screw)
                    for screw in edges_of(pieces[number].surface)
                    # about the carrier's own hinge it would be beside the carrier, not on it
                    if carrier < 0 or not is_same_hinge(screw, tree.screw(carrier, look))
                ],
            )
            for option in options:
                _compare(tree, option, other, best, others)


def _is_sure(part: Part) -> bool:
    """Whether a joint is known well enough that what does not follow it has moved by itself."""
    turned, aside = part.estimate.intervals
    return turned < SURE[0] and (aside < SURE[1] or part.screw.joint == "prismatic")


def _evidence_of_pieces(
    tree: PartTree, look: int, other: int, pieces: list[Piece]
) -> list[Float[np.ndarray, "labels _"]]:
    """The evidence of another look for each piece's points, if they went with each label."""
    motions = [tree.motion(part, look, other) for part in range(-1, len(tree.parts))]
    chosen = np.concatenate([one.members for one in pieces])
    ends = np.cumsum([len(one.members) for one in pieces])[:-1]
    points, normals = tree.looks[look].points[chosen], tree.looks[look].normals[chosen]
    each = evidence_of_poses(tree.looks[other], points, normals, motions)
    return np.split(each, ends, axis=1)


def _find_explained(tree: PartTree, look: int, other: int) -> Bool[np.ndarray, " points"]:
    """Which points of a look another one shows where something known has gone."""
    cloud, found = tree.looks[look], np.zeros(len(tree.looks[look].points), bool)
    for part in range(-1, len(tree.parts)):
        pose = tree.motion(part, look, other)
        rest = np.flatnonzero(~found)
        points, normals = cloud.points[rest], cloud.normals[rest]
        found[rest] = evidence(tree.looks[other], pose.at(points), pose.turned(normals)) == ON
    return found


def _compare(
    tree: PartTree,
    option: Option,
    other: int,
    known: float,
    others: Bool[np.ndarray, " points"],
) -> None:
    """Note whether a hinge explains a piece in another look better than what is `known` (evidence).

    Points of that look that are of `others` are not the piece's.
    """
    piece, there = option.piece, tree.looks[other]
    cloud = tree.looks[option.look]
    points, normals = cloud.points[piece.members], cloud.normals[piece.members]
    carried = tree.motion(option.carrier, option.look, other)

    def hold(turns: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " points"]]:
        """The best of some turns, and the evidence of each point for it."""
        poses = [carried @ option.screw.pose(float(turn)) for turn in turns]
        each = evidence_of_poses(there, points, normals, poses, others)
        best = int(each.mean(axis=1).argmax())
        return float(turns[best]), each[best]

    turn, each = hold(hold(TURNS)[0] + FINER)  # far from a hinge a step is eight centimetres
    better, least = float(each.mean()) - known, MEETS if option.carrier >= 0 else PARTLY_MEETS
    if better > GAIN and np.mean(each == ON) > least and abs(turn) > MOVED:
        option.turns[other] = turn
        option.gains[other] = better * len(piece.surface.members)


def _discovery(tree: PartTree, option: Option, first: int, second: int) -> Discovery:
    """A hinge between two looks, one of them the piece's, from the piece and what it meets."""
    look, screw, turn = option.look, option.screw, option.turns[second + first - option.look]
    other = second + first - look
    carried, mine = tree.motion(option.carrier, look, other), option.piece.surface.members
    pose, cloud, there = carried @ screw.pose(turn), tree.looks[look], tree.looks[other]
    reach = NEAR[0] + TOLERANCE * there.error
    distance, index = there.tree.query(pose.at(cloud.points[mine]), distance_upper_bound=reach)
    met = np.unique(index[np.isfinite(distance)])
    masks = {look: mine, other: met}
    if other == first:
        screw, turn = screw.moved(pose), -turn
    back = tree.motion(option.carrier, second, first)
    seen = [
        sighting(tree.looks[at], masks[at], to)
        for at, to in ((first, NOWHERE), (second, back))
    ]  # fmt: skip
    estimate = refine(screw, np.array([0.0, turn]), seen, [])
    return Discovery(option.carrier, estimate, [masks[first], masks[second]])


def _insert(tree: PartTree, option: Option) -> bool:
    """Put a part into the tree, and keep it if it has points of its own and its carrier as well."""
    look, size = option.look, len(option.piece.surface.members)
    on_part = option.carrier >= 0  # of what stands still there may be as little as one likes
    if on_part and size > LARGEST * np.sum(tree.labels[look] == option.carrier):
        return False
    first, second = sorted((look, max(option.gains, key=lambda one: option.gains[one])))
    new = _discovery(tree, option, first, second)
    before = {at: tree.labels[at] == option.carrier for at in (look, *option.turns)}
    count = len(tree.parts)
    insert(tree, first, second, new)
    number = len(tree.parts) - 1
    part = tree.parts[number]
    sign = np.sign(part.screw.axis @ option.screw.moved(tree.pose(part.parent, look).inverse).axis)
    here, turns = part.positions[look], {look: 0.0} | option.turns
    for at in range(len(tree.looks)):
        nearest = min(turns, key=lambda one: abs(one - at))
        part.positions[at] = here + float(sign) * turns[nearest]
        tree.find(number, at, beyond=FURTHER)
    taken = whole = 0
    for at, carrier in before.items():
        tree.relabel(at)
        taken += int(np.sum(tree.labels[at][carrier] == number))
        whole += int(carrier.sum())
    refused = max(len(part.seen[at]) for at in before) < FEWEST
    refused |= on_part and taken > MOST * whole
    estimate = tree.estimate(part)
    refused |= len(part.seen[look]) > GROWN * size or estimate.intervals[0] > UNSURE
    if refused and number == count:  # else it has replaced another
        tree.remove(number, part.parent)
        return False
    part.settle(estimate)
    merge_same(tree)
    return True
