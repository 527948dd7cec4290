"""A lid that folds: both leaves are one surface, and most pulls move both joints."""

import dataclasses

import numpy as np
import pytest

from chests import CHEST_LID, DEEP, LEAF, LID, Chest, opened
from palpate.identification.interactive import explanation
from palpate.identification.interactive import twin as twin_module
from palpate.identification.interactive.duplicates import ANYWHERE, drop_explained, drop_unknown
from palpate.identification.interactive.edges.splitting import split_off_base
from palpate.identification.interactive.explanation import find_moved_part
from palpate.identification.interactive.part import support_of
from palpate.identification.interactive.tree import PartTree
from palpate.identification.interactive.twin import Twin
from rooms import Notes

pytestmark = pytest.mark.unchecked  # what test_interactive.py checks, on more scenes


@pytest.fixture
def chest() -> Chest:
    return Chest(LID)


@pytest.mark.parametrize("turn", [0.6, 1.0])
def test_a_leaf_is_found_on_its_lid_though_both_look_like_one(chest, turn) -> None:
    twin = opened(chest)
    chest.pull(twin, LEAF, (0.05, 0.0), (0.05, turn))
    assert [part.parent for part in twin.parts] == [-1, 0]
    assert [held for held, _ in twin.held] == [0, 0, 1]
    for part in (0, 1):
        turned, aside = chest.error(twin, part, part)
        assert turned < 3.0
        assert aside < 1.0
    lid, leaf = np.array([part.positions for part in twin.parts])
    np.testing.assert_allclose(lid[2:] - lid[0], [lid[1], 0.05, 0.05, 0.05, 0.05], atol=0.05)
    assert np.diff(leaf)[-2] == pytest.approx(turn, abs=0.05)


@pytest.mark.parametrize(
    ("start", "leaf", "lid", "scene", "seed"),
    [
        (0.0, -0.73, 0.57, LID, 0),
        (0.0, -0.73, 0.57, LID, 1),
        (0.0, -0.73, 0.66, DEEP, 0),
        (0.0, -0.73, 0.66, DEEP, 1),
        (0.0, -0.73, 0.66, DEEP, 3),
        (1.14, -0.34, -0.65, LID, 0),
    ],
)
def test_a_leaf_that_was_found_before_its_lid_hangs_on_it(start, leaf, lid, scene, seed) -> None:
    chest, twin = Chest(scene), Twin()
    chest.random = np.random.default_rng(seed)
    chest.at(start, 0.0)
    twin.look(chest.look())
    chest.pull(twin, LEAF, (start, 0.0), (start, leaf))
    chest.pull(twin, CHEST_LID, (start, leaf), (start + lid, leaf))
    # what went with the leaf as well is none of its points, nor the leaf a piece of the lid
    first, second = twin.ordered()
    assert [twin.parts[part].parent for part in (first, second)] == [-1, first]
    assert [part for part, _ in twin.held] == [second, first]
    gone = np.abs(np.diff(twin.parts[first].positions))
    np.testing.assert_allclose(gone, [0.0, 0.0, abs(lid), 0.0], atol=0.07)
    for joint, part in enumerate((first, second)):
        turned, aside = chest.error(twin, part, joint)
        assert turned < 3.0
        assert aside < 4.0


def test_two_known_joints_that_are_a_little_off_explain_a_pull_of_both(chest) -> None:
    twin = opened(chest)
    chest.pull(twin, LEAF, (0.05, 0.0), (0.05, 0.6))
    lid, leaf = twin.parts
    off = leaf.screw.varied(np.array([0.0, 0.0, 0.03, 0.03]))
    leaf.estimate = dataclasses.replace(leaf.estimate, screw=off)
    chest.pull(twin, LEAF, (0.05, 0.6), (0.5, 0.1))
    assert twin.held[-1][0] == 1
    assert len(leaf.ways) == 2
    assert abs(lid.positions[-1] - lid.positions[0]) == pytest.approx(0.5, abs=0.06)


def test_a_part_of_which_nothing_is_seen_is_kept_if_it_carries_another(chest, monkeypatch) -> None:
    twin = opened(chest)
    chest.pull(twin, LEAF, (0.05, 0.0), (0.05, 0.6))
    twin.parts.reverse()  # the lid was found last
    twin.parts[0].parent, twin.held = 1, [(1, 0), (1, 2), (0, 4)]
    monkeypatch.setattr(twin_module, "FEWEST", 10**6)
    assert twin._keep(True, 4, 5)
    assert len(twin.parts) == 2
    twin.parts[0].parent = -1
    assert not twin._keep(True, 4, 5)
    assert len(twin.parts) == 1


def test_a_leaf_that_a_hand_has_felt_by_itself_is_not_explained_away_by_its_lid(chest) -> None:
    twin = opened(chest)
    whole = twin.parts[0].seen[0]  # of both leaves, before they are told from each other
    chest.pull(twin, LEAF, (0.05, 0.0), (0.05, 0.6))
    assert twin.was_felt_by_itself(1)
    twin.parts[0].support = support_of([twin.looks[0]], [whole], [twin.pose(0, 0).inverse])
    drop_explained(twin)
    assert [part.parent for part in twin.parts] == [-1, 0]
    twin.parts[1].ways = []
    assert not twin.was_felt_by_itself(1)
    drop_explained(twin)
    assert [part.parent for part in twin.parts] == [-1]


def test_a_pull_that_folds_a_known_lid_does_not_mistake_its_joint(chest) -> None:
    twin = opened(chest)
    chest.pull(twin, LEAF, (0.05, 0.0), (0.3, -0.5))
    assert [held for held, _ in twin.held] == [0, 0, 1]
    turned, aside = chest.error(twin, 0, 0)
    assert turned < 2.0
    assert aside < 1.0


def test_a_joint_of_which_nothing_is_known_is_not_kept_unless_a_hand_has_held_it(chest) -> None:
    twin = opened(chest)
    part = twin.parts[0]
    sure = part.estimate.covariance
    for number, limit in ((0, np.radians(ANYWHERE[0])), (2, ANYWHERE[1])):
        covariance = sure.copy()
        covariance[number, number] = (limit / 1.645) ** 2
        for factor, kept in ((0.9, True), (1.2, False)):
            estimate = dataclasses.replace(part.estimate, covariance=factor * covariance)
            for ways in ([], part.ways):  # a hand that held it tells that it is there
                changed = dataclasses.replace(part, estimate=estimate, ways=ways)
                twin.parts = [changed]
                drop_unknown(twin)
                assert bool(twin.parts) == (kept or bool(ways))


@pytest.mark.parametrize(("lid", "leaf"), [(1.2, 0.0), (1.2, 0.2)])
def test_an_inner_wall_that_an_open_lid_bares_is_no_lid_that_turned_inwards(lid, leaf) -> None:
    chest, looks = Chest(DEEP), PartTree()
    for state in ((0.0, 0.0), (lid, leaf)):
        chest.at(*state)
        looks.add_look(chest.look())
    assert not split_off_base(looks, 0, 1)


def test_a_way_that_a_joint_does_not_allow_is_not_explained_by_clouds(chest) -> None:
    twin, notes = opened(chest), Notes()
    notes.look(twin.looks[-1])
    chest.pull(notes, LEAF, (0.05, 0.0), (0.6, 0.0))
    (right,) = notes.handled
    aside = 0.06 * np.sin(np.linspace(0.0, np.pi, len(right.points)))  # m, and back
    strange = dataclasses.replace(right, points=right.points + aside[:, None] * [0.0, 1.0, 0.0])
    looks = twin.add_look(right.before), twin.add_look(right.after)
    assert find_moved_part(twin, *looks, strange) == -1
    assert find_moved_part(twin, *looks, right) == 0


def test_parts_are_split_off_only_after_something_has_moved(chest, monkeypatch) -> None:
    twin, calls = opened(chest), []
    monkeypatch.setattr(twin_module, "split", lambda _, looks: calls.append(looks))
    look = twin.looks[-1]
    moved = twin.handled[-1]
    still = dataclasses.replace(
        moved, before=look, after=look, points=np.repeat(moved.points[:1], 60, axis=0)
    )
    for _ in range(3):
        twin.observe(still)
    assert len(calls) == 1  # what the pull before had moved may show only now


def test_a_pull_that_folds_a_lid_of_which_little_is_known_is_of_both_joints(chest) -> None:
    twin, notes = opened(chest), Notes()
    chest.pull(twin, LEAF, (0.05, 0.0), (0.05, 0.6))
    chest.pull(twin, LEAF, (0.05, 0.6), (0.0, 0.0))
    notes.look(twin.looks[-1])
    chest.pull(notes, LEAF, (0.0, 0.0), (0.46, 0.89))
    (pull,) = notes.handled
    looks = twin.add_look(pull.before), twin.add_look(pull.after)
    lid, leaf = twin.parts
    lid.ways = []  # as if a hand had never held it: its circle may be the hand's then
    assert explanation._by_way(twin.copy(), *looks, pull) == 0
    assert find_moved_part(twin, *looks, pull) == 1
    gone = [part.positions[looks[1]] - part.positions[looks[0]] for part in (lid, leaf)]
    np.testing.assert_allclose(np.abs(gone), [0.46, 0.89], atol=0.08)
