"""Two hinges that one pull turned at once: their geometry in closed form, and a lid that folds."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from chests import DEEP, LEAF, LID, Chest, opened
from palpate.identification.interactive.edges import folding, hinge_pairs
from palpate.identification.interactive.edges.folding import Remainder, discover_pair
from palpate.identification.interactive.edges.hinge_pairs import Grip, HingePair
from palpate.identification.interactive.explanation import find_moved_part
from palpate.identification.interactive.labels import ON
from palpate.identification.interactive.refinement import AT_EDGE, FELT_AT_EDGE, refine
from palpate.identification.interactive.screws import Screw
from palpate.identification.interactive.twin import Twin
from rooms import DOOR, FLAP, Notes, Room, pulled

pytestmark = pytest.mark.unchecked  # what test_interactive.py checks, on more scenes

# A lid with its hinge at the back, and a leaf with its hinge along that of the lid, or across it.
BACK = Screw("revolute", np.array([0.0, 1.0, 0.0]), np.array([0.3, 0.0, 0.8]))
ALONG = Screw("revolute", np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 0.8]))
ACROSS = Screw("revolute", np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.2, 0.8]))
UP, HAND = np.array([0.0, 0.0, 1.0]), np.array([-0.25, 0.1, 0.8])


def pair_of(carried: Screw, turn: float, carried_turn: float) -> HingePair:
    """A pair of hinges of a lid that lies flat, and what a hand on it then holds."""
    whole = BACK.pose(turn) @ carried.pose(carried_turn)
    grip = Grip((UP, whole.rotation @ UP), ([], []), (HAND, whole.at(HAND[None])[0]))
    return HingePair(BACK, turn, carried, carried_turn, grip)


def assert_same(pair: HingePair, other: HingePair) -> None:
    assert pair.carried.distance_to(other.carried) == pytest.approx((0.0, 0.0), abs=1e-5)
    for one, same in zip(pair.motions, other.motions, strict=True):
        np.testing.assert_allclose(one.rotation, same.rotation, atol=1e-9)
        np.testing.assert_allclose(one.at(HAND[None]), same.at(HAND[None]), atol=1e-9)


@pytest.mark.parametrize("carried", [ALONG, ACROSS])
@pytest.mark.parametrize(("turn", "carried_turn"), [(0.8, 0.6), (0.8, -0.6), (0.4, 1.9)])
def test_the_hinge_on_a_carrier_follows_from_what_a_hand_held(carried, turn, carried_turn) -> None:
    true = pair_of(carried, turn, carried_turn)
    lid = np.array([[x, y, 0.8] for x in (0.0, 0.15, 0.3) for y in (-0.3, 0.2, 0.3)])
    found = [
        pair
        for pair in hinge_pairs.hinge_pairs([BACK], lid, true.grip, after=False)
        if abs(pair.turn - turn) < 1e-9
    ]
    assert len(found) == 1
    assert_same(found[0], true)
    # the same, of a lid that is seen in the look after
    seen = BACK.pose(turn).at(lid)
    pairs = hinge_pairs.hinge_pairs([BACK], seen, true.grip, after=True)
    assert sum(abs(pair.turn - turn) < 1e-9 for pair in pairs) == 1
    away = lid + np.array([0.0, 0.0, 0.2])
    pairs = hinge_pairs.hinge_pairs([BACK], away, true.grip, after=False)
    assert not [pair for pair in pairs if abs(pair.turn - turn) < 1e-9]


def test_a_hand_that_went_along_a_hinge_was_on_no_such_pair() -> None:
    true = pair_of(ALONG, 0.8, 0.6)
    places = true.grip.places[0], true.grip.places[1] + [0.0, 0.05, 0.0]
    grip = true.grip._replace(places=places)
    assert not list(hinge_pairs.hinge_pairs([BACK], np.zeros((1, 3)), grip, after=False))


def test_pairs_beside_one_take_what_is_held_to_the_same_place() -> None:
    for carried in (ALONG, ACROSS):
        true = pair_of(carried, 0.8, 0.6)
        assert_same(true.with_carrier(true.carrier, true.turn), true)
        near = list(true.near(0.03, 0.01))
        assert near
        for pair in near:
            gone, whole = pair.motions[1], true.motions[1]
            np.testing.assert_allclose(gone.rotation, whole.rotation, atol=1e-9)
    near = list(pair_of(ALONG, 0.8, 0.6).near(0.03, 0.01))
    assert len(near) == 27
    for pair in near:
        gone = pair.motions[1].at(HAND[None])[0]
        np.testing.assert_allclose(gone, pair.grip.places[1], atol=1e-9)
    # what turned with its carrier alone did not turn on it
    assert pair_of(ALONG, 0.8, 0.6).with_carrier(BACK, 1.38) is None


@pytest.mark.parametrize("carried", [ALONG, ACROSS])
@pytest.mark.parametrize("shut", [False, True])
def test_a_pair_follows_its_way_however_both_hinges_turn(carried, shut) -> None:
    turns = (-1.2, -0.4, -0.2, 0.2, 0.4, 1.2)
    random = np.random.default_rng(0)
    for turn, carried_turn in itertools.product(turns, turns):
        pair = pair_of(carried, turn, carried_turn)
        way = np.array([
            (BACK.pose(share * turn) @ carried.pose(share * carried_turn)).at(HAND[None])[0]
            for share in 0.5 - 0.5 * np.cos(np.linspace(0.0, math.pi, 60))
        ])  # fmt: skip
        way += 5e-4 * random.standard_normal((60, 3))
        if shut:  # from where the pair ends to the lid that lies flat
            away, other = BACK.pose(turn), pair.motions[1]
            grip = Grip(pair.grip.normals[::-1], ([], []), pair.grip.places[::-1])
            pair = HingePair(BACK, -turn, carried.moved(away), -carried_turn, grip)
            back = pair.motions[1].rotation @ other.rotation
            np.testing.assert_allclose(back, np.eye(3), atol=1e-9)
            way = way[::-1]
        assert pair.follows(way)


def test_a_pair_follows_its_way_and_no_other() -> None:
    true = pair_of(ALONG, 0.8, 0.6)
    shares = np.linspace(0.0, 1.0, 60)
    way = np.array([
        (BACK.pose(share * 0.8) @ ALONG.pose(share * 0.6)).at(HAND[None])[0] for share in shares
    ])  # fmt: skip
    assert true.follows(way)
    assert not true.follows(way + np.outer(np.sin(math.pi * shares), [0.0, 0.05, 0.0]))
    assert not true._replace(turn=0.4, carried_turn=1.1).follows(way)


def test_of_two_pairs_that_explain_as_much_the_one_that_turns_less_and_ends_counts_more() -> None:
    end = dataclasses.replace(ALONG, point=ALONG.point)
    front = dataclasses.replace(ALONG, point=np.array([-0.3, 0.0, 0.8]))
    true = pair_of(ALONG, 0.8, 0.6)
    ended = true._replace(grip=true.grip._replace(edges=([front, end], [])))
    assert ended.weight == pytest.approx(1.0 - hinge_pairs.COST * 1.4)
    assert true.weight < ended.weight  # nothing is known of where what is held ends
    assert ended._replace(turn=1.2).weight < ended.weight
    assert ended._replace(turn=-0.8).weight == pytest.approx(ended.weight)
    beside = dataclasses.replace(ALONG, point=ALONG.point + np.array([0.1, 0.0, 0.0]))
    expected = ended.weight - 0.1 * hinge_pairs.UNENDED
    assert ended._replace(carried=beside).weight == pytest.approx(expected)


def test_what_is_beyond_a_hinge_is_told_also_of_a_lid_that_is_folded() -> None:
    flat = np.array([[-0.2, 0.0, 0.8], [0.1, 0.0, 0.8]])
    pair = pair_of(ALONG, 0.8, 2.2)
    assert pair.is_beyond(flat, after=False).tolist() == [True, False]
    # as seen from the carrier the leaf is over it then
    folded = ALONG.pose(2.2).at(flat[:1])
    assert folded[0, 0] > 0.0
    assert pair.is_beyond(np.vstack([folded, flat[1:]]), after=True).tolist() == [True, False]


def test_an_edge_stands_for_a_hinge_until_looks_and_hands_say_more() -> None:
    turned = np.array([0.0, AT_EDGE[0], AT_EDGE[1], 0.0])
    alone = refine(ALONG.varied(turned), np.zeros(1), [None], [], ALONG)
    assert alone.screw.distance_to(ALONG) == pytest.approx((0.0, 0.0), abs=1e-3)
    way = np.array([ALONG.pose(0.02 * step).at(HAND[None])[0] for step in range(40)])
    away = dataclasses.replace(ALONG, point=ALONG.point + 2.0 * FELT_AT_EDGE[1] * UP)
    held = refine(ALONG, np.zeros(2), [None, None], [(0, way)], away)
    assert held.screw.distance_to(ALONG)[1] < 0.5 * FELT_AT_EDGE[1]
    assert refine(ALONG, np.zeros(1), [None], []).intervals[0] > alone.intervals[0]


@pytest.mark.parametrize(("start", "end"), [((0.85, -0.03), (1.2, 1.16)), ((0.9, 1.0), (1.3, 0.2))])
def test_a_lid_and_its_leaf_are_found_from_one_pull_that_moved_both(start, end) -> None:
    chest, notes = Chest(DEEP), Notes()
    chest.at(*start)
    notes.look(chest.look())
    true = [
        Screw("revolute", axis / np.linalg.norm(axis), anchor.copy())
        for axis, anchor in zip(chest.data.xaxis, chest.data.xanchor, strict=True)
    ]
    chest.pull(notes, LEAF, start, end)
    (handling,) = notes.handled
    twin = Twin()
    before, after = twin.add_look(handling.before), twin.add_look(handling.after)
    assert discover_pair(twin, before, after, handling) == 1
    assert [part.parent for part in twin.parts] == [-1, 0]
    for number, hinge in enumerate(true):
        degrees, aside = twin.screw(number, before).distance_to(hinge)
        assert degrees < 2.0
        assert aside < 0.06  # a flat look leaves open where a leaf ends
        gone = np.diff(twin.parts[number].positions)[0]
        assert abs(gone) == pytest.approx(abs(end[number] - start[number]), abs=0.2)
    assert [len(part.ways) for part in twin.parts] == [0, 1]


def test_a_door_and_a_flap_across_it_are_found_from_one_pull_that_moved_both() -> None:
    aside = []
    for end in ((-0.5, 0.6), (-0.8, 0.4), (-0.6, -0.5)):
        room, twin = Room(), Twin()
        room.at(0.0, 0.0)
        twin.look(room.look())
        room.pull(twin, FLAP, (0.0, 0.0), end)
        assert [part.parent for part in twin.parts] == [-1, 0]
        assert [held for held, _ in twin.held] == [1]
        errors = [room.error(twin, number, number) for number in (0, 1)]
        assert max(degrees for degrees, _ in errors) < 3.0
        aside.append([centimetres for _, centimetres in errors])
        for part, gone, off in zip(twin.parts, end, aside[-1], strict=True):
            assert np.ptp(part.positions) == pytest.approx(abs(gone), abs=0.06)
            assert off < 100.0 * part.estimate.intervals[1]
    # one place alone is off by up to 1.5 cm, as the noise falls
    assert np.all(np.mean(aside, axis=0) < 1.0)


def test_of_a_way_that_looks_like_a_circle_two_hinges_explain_more() -> None:
    room, twin = Room(), Twin()
    room.random = np.random.default_rng(1)
    room.at(0.0, 0.0)
    twin.look(room.look())
    room.pull(twin, FLAP, (0.0, 0.0), (-0.28, 0.75))
    assert [part.parent for part in twin.parts] == [-1, 0]
    assert max(room.error(twin, number, number)[0] for number in (0, 1)) < 3.0


def test_one_hinge_that_leaves_little_is_no_two(monkeypatch) -> None:
    monkeypatch.setattr(Twin, "_explain_by_two", pytest.fail)
    room, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)))
    room.pull(twin, FLAP, (-0.6, 0.0), (-0.6, 0.7))
    assert [part for part, _ in twin.held] == [0, 1]
    twin.parts[1].positions[3] = twin.parts[1].positions[2]  # as if it had stayed
    assert folding.leaves_much(twin, 2, 3)


def test_where_nothing_moved_or_all_is_explained_no_pair_is_sought(monkeypatch) -> None:
    monkeypatch.setattr(folding, "_best_pair", pytest.fail)
    chest, notes, twin = Chest(LID), Notes(), Twin()
    chest.at(0.3, 0.0)
    notes.look(chest.look())
    chest.pull(notes, LEAF, (0.3, 0.0), (0.3, 0.0))
    (handling,) = notes.handled
    looks = twin.add_look(handling.before), twin.add_look(handling.after)
    assert discover_pair(twin, *looks, handling) == -1
    assert not twin.parts


def test_a_remainder_is_what_is_not_explained_yet_each_point_for_some() -> None:
    chest = Chest(LID)
    looks = []
    for lid in (0.0, 0.5):
        chest.at(lid, 0.0)
        looks.append(chest.look())
    twin = Twin()
    for look in looks:
        twin.add_look(look)
    known = [folding._evidence(twin, *both, [-1]) for both in ((0, 1), (1, 0))]
    rest = Remainder.of((looks[0], looks[1]), known)
    for own, each, weight in zip(rest.chosen, known, rest.weights, strict=True):
        assert (each[own] < each.max()).all()
        assert len(own) * weight == pytest.approx(np.sum(each < each.max()), abs=weight)
    lid = Screw("revolute", np.array([0.0, 1.0, 0.0]), np.array([0.33, 0.0, 0.8]))
    pair = pair_of(ALONG, 0.8, 0.6)._replace(carrier=lid, turn=0.5, carried_turn=0.0)
    still = pair._replace(turn=0.0)
    moved, stood = rest.values([pair, still]) / [pair.weight, still.weight]
    assert stood == 0.0
    assert moved > folding.LEAST_EVIDENCE
    nothing = Remainder.of((looks[0], looks[1]), [np.full_like(each, ON) for each in known])
    assert nothing.values([pair]).tolist() == [0.0]


def test_a_leaf_goes_as_its_joint_lets_it_though_its_lid_was_believed_elsewhere() -> None:
    chest = Chest(LID)
    twin, notes = opened(chest), Notes()
    chest.pull(twin, LEAF, (0.05, 0.0), (0.05, 0.6))
    assert [part.parent for part in twin.parts] == [-1, 0]
    notes.look(twin.looks[-1])
    chest.pull(notes, LEAF, (0.05, 0.6), (0.05, 0.1))
    (handling,) = notes.handled
    before, after = twin.add_look(handling.before), twin.add_look(handling.after)
    lid, leaf = twin.parts
    true = lid.positions[before]
    wrong = min(lid.positions, key=lambda one: -abs(one - true))
    assert abs(wrong - true) > 0.4
    lid.positions[before] = lid.positions[after] = wrong
    assert find_moved_part(twin, before, after, handling) == 1
    assert lid.positions[before] == pytest.approx(true, abs=0.1)
    assert leaf.positions[after] - leaf.positions[before] == pytest.approx(-0.5, abs=0.1)
    assert len(leaf.ways) == 2


def test_a_part_that_a_pull_of_two_joints_was_taken_for_goes_once_both_are_known() -> None:
    chest = Chest(LID)
    twin = opened(chest)
    chest.pull(twin, LEAF, (0.05, 0.0), (0.05, 0.6))
    chest.pull(twin, LEAF, (0.05, 0.6), (0.5, 0.1))
    leaf = twin.parts[1]
    assert [held for held, _ in twin.held] == [0, 0, 1, 1]
    # the last pull but one taken for one of a third part
    before = twin.held[2][1]
    taken = next(way for way in leaf.ways if way[0] == before)
    false = dataclasses.replace(
        leaf, parent=-1, ways=[taken], seen={}, positions=[0.0] * len(twin.looks),
        support=tuple(one[:20] for one in leaf.support),
    )  # fmt: skip
    leaf.ways = [way for way in leaf.ways if way is not taken]
    twin.parts.append(false)
    twin.held[2] = 2, before
    twin._drop_replaced()
    assert [part.parent for part in twin.parts] == [-1, 0]
    assert [held for held, _ in twin.held] == [0, 0, 1, 1]
    assert len(twin.parts[1].ways) == 2
    # one that a hand took elsewhere stays
    far = dataclasses.replace(false, ways=[(before, taken[1] + [0.0, 0.0, 3.0])])
    twin.parts.append(far)
    twin._drop_replaced()
    assert twin.parts[-1] is far


def test_only_what_was_done_with_a_part_is_forgotten_with_it() -> None:
    twin = opened(Chest(LID))
    twin.parts.append(dataclasses.replace(twin.parts[0]))
    # nothing moved between the last two: they were done after the same look
    twin.held = [(0, 0), (1, 2), (0, 2)]
    twin._forget(0)
    assert twin.held == [(-1, 0), (0, 2), (-1, 2)]


def test_a_part_at_an_edge_stays_a_hinge(monkeypatch) -> None:
    twin = opened(Chest(LID))
    lid = twin.parts[0]
    lid.edge = lid.screw
    asked = []
    kept = twin.estimate
    monkeypatch.setattr(twin, "estimate", lambda *one: asked.append(one) or kept(*one))
    twin.refit(0)
    assert [len(one) for one in asked] == [1]
    lid.edge = None
    twin.refit(0)
    assert len(asked) > 2


def test_a_carrier_that_was_put_on_what_it_carries_stands_on_what_is_still(monkeypatch) -> None:
    twin, notes = opened(Chest(LID)), Notes()
    chest = Chest(LID)
    chest.at(0.05, 0.0)
    notes.look(chest.look())
    chest.pull(notes, LEAF, (0.05, 0.0), (0.3, -0.5))
    (pulled,) = notes.handled
    before, after = twin.add_look(pulled.before), twin.add_look(pulled.after)
    (lid,) = twin.parts
    grip = Grip((UP, UP), ([], []), (HAND, HAND))
    pair = HingePair(ALONG, 0.2, twin.screw(0, before), -0.5, grip)
    own = [np.arange(200)] * 2

    def insert(tree, *_, **__) -> None:
        estimate = dataclasses.replace(lid.estimate, screw=ALONG)
        new = dataclasses.replace(lid, parent=0, estimate=estimate, positions=[0.0] * (after + 1))
        tree.parts.append(new)

    for name, other in (
        ("_best_pair", lambda *_: pair),
        ("_own_points", lambda *_: (own, own)),
        ("insert", insert),
    ):
        monkeypatch.setattr(folding, name, other)
    assert discover_pair(twin, before, after, pulled) == 0
    assert [part.parent for part in twin.parts] == [1, -1]


def test_of_two_doors_on_one_line_the_carrier_is_the_one_at_the_hand() -> None:
    _, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)))
    (door,) = twin.parts
    for height in (2.0, -2.0):  # m, along its hinge
        points, normals = door.support
        other = dataclasses.replace(door, support=(points + height * door.screw.axis, normals))
        for parts, expected in ([door, other], 0), ([other, door], 1):
            twin.parts = parts
            hand = twin.pose(expected, 0).at(points)[0]
            assert folding._part_with(twin, 0, door.screw, hand) == expected
            assert folding._part_with(twin, 0, door.screw, hand, but=expected) == 1 - expected
