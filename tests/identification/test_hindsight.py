"""What was done to a door with a flap, explained once more from the last pull to the first."""

import dataclasses

import numpy as np
import pytest

from palpate.identification.interactive import hindsight
from palpate.identification.interactive import twin as beliefs
from palpate.identification.interactive.hindsight import (
    correct_parents,
    drop_needless,
    explain_backwards,
    reconsider,
    take_further,
)
from palpate.identification.interactive.insertion import hang
from palpate.identification.interactive.twin import Twin
from rooms import DOOR, FLAP, Room, pulled

pytestmark = pytest.mark.unchecked  # what test_interactive.py checks, on more scenes

PLACES = (0.0, 0.0), (-0.6, 0.0), (-0.2, 0.7)


@pytest.fixture
def known() -> tuple[Room, Twin]:
    """A door that was pulled open, and its flap."""
    return pulled(PLACES[0], (DOOR, PLACES[1]), (FLAP, PLACES[2]))


@pytest.fixture
def room(known) -> Room:
    return known[0]


@pytest.fixture
def twin(known) -> Twin:
    return known[1]


def test_an_account_backwards_is_of_the_same_looks_and_pulls(room, twin) -> None:
    other = explain_backwards(twin)
    assert other.looks == twin.looks
    assert other.handled == twin.handled
    assert [part.parent for part in other.parts] == [-1, 0]
    assert other.held == twin.held
    for look, labels in enumerate(other.labels):
        np.testing.assert_array_equal(labels, other.probabilities(look).argmax(axis=0) - 1)
    for part in (0, 1):
        turned, aside = room.error(other, part, part)
        assert turned < 4.0
        assert aside < 3.0
        one, same = other.parts[part], twin.parts[part]
        assert one.positions == one.estimate.positions.tolist()
        gone = np.abs(np.diff(one.positions))
        np.testing.assert_allclose(gone, np.abs(np.diff(same.positions)), atol=0.06)
        for (look, way), (number, points) in zip(one.ways, same.ways, strict=True):
            assert look == number
            np.testing.assert_array_equal(way, points)
        for look, own in one.seen.items():
            np.testing.assert_array_equal(own, np.flatnonzero(other.labels[look] == part))


def test_nothing_is_reconsidered_where_all_pulls_are_explained(twin, monkeypatch) -> None:
    assert [part for part, _ in twin.held] == [0, 1]
    assert reconsider(twin) is twin
    monkeypatch.setattr(beliefs, "OF_PART", 0.1)  # many parts, as a cabinet has, are no reason to
    monkeypatch.setattr(hindsight, "explain_backwards", lambda _: pytest.fail("it was tried"))
    assert reconsider(twin) is twin


def test_a_part_hangs_on_what_explains_all_looks(room, twin, monkeypatch) -> None:
    assert correct_parents(twin) is twin
    whole, flap = twin.explained(), twin.parts[1]
    twin.parts[1] = hang(twin, flap, -1, flap.shown)  # as if it had moved by itself each time
    places = np.linspace(-2.0, 2.0, 81)
    for look in range(len(twin.looks)):
        twin.parts[1].positions[look] = float(places[twin.seen_at(1, look, places).argmax()])
    assert twin.explained() < whole - hindsight.HANGS
    kept = [list(part.positions) for part in twin.parts]
    other = correct_parents(twin)
    assert [part.parent for part in other.parts] == [-1, 0]
    assert other.explained() == pytest.approx(whole, abs=hindsight.BETTER)
    assert room.error(other, 1, 1)[0] < 4.0
    assert [part.positions for part in twin.parts] == kept  # it has been left as it was
    assert reconsider(twin).parts[1].parent == 0

    def lose(other: Twin, last: int) -> None:
        other.parts[1].positions = [1.5] * len(other.looks)

    monkeypatch.setattr(Twin, "refit", lose)
    assert correct_parents(twin) is twin  # as its joint is lost there


@pytest.mark.parametrize("held", [-1, 0], ids=["unexplained", "as-if-the-door-was-pulled"])
def test_what_explains_more_is_believed(room, twin, held) -> None:
    whole = twin.explained()
    twin.remove(1, -1)
    assert [part for part, _ in twin.held] == [0, -1]
    twin.held[1] = held, twin.held[1][1]
    assert twin.explained() < whole - hindsight.BETTER
    other = reconsider(twin)
    assert [part.parent for part in other.parts] == [-1, 0]
    assert other.explained() == pytest.approx(whole, abs=hindsight.BETTER)
    assert room.error(other, 1, 1)[0] < 4.0


def test_what_explains_less_is_not_believed(twin, monkeypatch) -> None:
    first = Twin()
    for look in twin.looks:
        first.look(look)
    whole = twin.explained()
    twin.held[0] = -1, twin.held[0][1]
    assert twin.explained() == pytest.approx(whole - 0.5 * beliefs.OF_PULLS, abs=1e-9)
    monkeypatch.setattr(hindsight, "explain_backwards", lambda _: first)
    assert reconsider(twin) is twin
    # a part that explains nothing costs
    alone = twin.explained()
    twin.parts.append(twin.parts[1])
    assert twin.explained() == pytest.approx(alone - beliefs.OF_PART, abs=1e-9)
    other = drop_needless(twin)
    assert len(other.parts) == 2
    assert other.explained() == pytest.approx(alone, abs=1e-9)
    assert drop_needless(other) is other
    monkeypatch.setattr(Twin, "was_felt_by_itself", lambda *_: True)
    assert drop_needless(twin) is twin


@pytest.mark.parametrize("ways", [True, False])
def test_what_a_hand_took_along_with_its_carrier_is_kept_if_it_explains_anything(
    twin, monkeypatch, ways
) -> None:
    for module in (beliefs, hindsight):
        monkeypatch.setattr(module, "OF_PART", 0.5)  # more than the flap explains
    monkeypatch.setattr(hindsight, "LITTLE", 0.4)
    monkeypatch.setattr(Twin, "was_felt_by_itself", lambda _, part: part == 0)
    if not ways:
        twin.parts[1].ways = []
    assert len(drop_needless(twin).parts) == 1 + ways


@pytest.mark.parametrize("carries", [True, False])
def test_what_hung_on_no_part_or_bore_one_is_fitted_to_the_ways_of_hands(carries) -> None:
    # the door was taken for two hinges, both of them wrong: one on which it hangs, or on it
    room, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)), (DOOR, (-0.2, 0.0)), (DOOR, (-0.8, 0.0)))
    (door,) = twin.parts
    wrong = dataclasses.replace(door.screw, axis=np.array([1.0, 0.0, 0.0]))
    nothing = dataclasses.replace(door.estimate, screw=wrong)
    alone = dataclasses.replace(
        door, estimate=nothing, ways=[], seen={}, positions=[0.0] * len(twin.looks)
    )
    door.estimate = nothing
    if carries:
        door.parent = 1
    else:
        alone.parent, alone.ways = 0, [door.ways.pop(1)]
    twin.parts.append(alone)
    assert not twin.was_felt_by_itself(1)
    other = drop_needless(twin)
    assert len(other.parts[0].ways) == 3
    assert [part.parent for part in other.parts] == [-1]
    turned, aside = room.error(other, 0, 0)
    assert turned < 2.0
    assert aside < 2.0
    assert np.ptp(other.parts[0].positions) == pytest.approx(0.8, abs=0.05)


def test_what_was_known_before_is_believed_again(room, twin, monkeypatch) -> None:
    monkeypatch.setattr(hindsight, "explain_backwards", lambda _: pytest.fail("it was tried"))
    monkeypatch.setattr(hindsight, "ENOUGH", -np.inf)
    known = twin.copy()
    room.pull(twin, DOOR, PLACES[2], (-0.7, 0.7))
    assert twin.adds_to(known)
    whole, kept = twin.explained(), [list(part.positions) for part in known.parts]
    screw = known.parts[1].screw
    wrong = dataclasses.replace(screw, axis=np.array([1.0, 0.0, 0.0]))
    twin.parts[1].estimate = dataclasses.replace(twin.parts[1].estimate, screw=wrong)
    for look in range(len(twin.looks)):
        twin.relabel(look)
    assert not twin.adds_to(known)
    assert twin.explained() < whole - hindsight.CLEARER
    other = reconsider(twin)  # before the last pull all was as in `known`
    assert other.explained() == pytest.approx(whole, abs=hindsight.BETTER)
    assert [part for part, _ in other.held] == [0, 1, 0]
    assert len(other.parts[0].ways) == 2
    assert room.error(other, 1, 1)[0] < 4.0
    assert [part.positions for part in known.parts] == kept  # it has been left as it was
    assert take_further(known, twin).looks == twin.looks


def test_what_no_longer_holds_is_kept_as_it_was(room, twin) -> None:
    known = twin.copy()
    assert twin.adds_to(known)
    for change in (
        lambda one: one.remove(1, -1),
        lambda one: setattr(one.parts[1], "parent", -1),
        lambda one: one.parts[1].settle(
            dataclasses.replace(
                one.parts[1].estimate,
                screw=dataclasses.replace(one.parts[1].screw, joint="prismatic"),
            )
        ),
    ):
        other = twin.copy()
        change(other)
        assert not other.adds_to(known)
    assert [len(one.parts) for one in twin.earlier] == [1]  # before the last pull
    room.pull(twin, DOOR, PLACES[2], (-0.7, 0.7))
    assert [len(one.parts) for one in twin.earlier] == [2]  # what was added to is let go
    assert len(twin.earlier[0].held) == 2
    assert not twin.earlier[0].earlier
    twin.remove(1, -1)
    room.pull(twin, DOOR, (-0.7, 0.7), PLACES[2])
    assert len(twin.earlier[0].parts) == 2
    assert len(twin.earlier) == 2


@pytest.mark.parametrize(("turned", "holds"), [(0.5, True), (20.0, False)])
def test_a_joint_that_is_found_a_little_elsewhere_still_holds(twin, turned, holds) -> None:
    known = twin.copy()
    one = twin.parts[1].estimate
    sure = dataclasses.replace(one, covariance=1e-10 * np.eye(4))  # so that any change refutes it
    known.parts[1].estimate = sure
    angle, aside = np.radians(turned), one.screw.across[0]
    axis = np.cos(angle) * one.screw.axis + np.sin(angle) * aside
    screw = dataclasses.replace(one.screw, axis=axis)
    assert sure.refutes(screw)
    twin.parts[1].estimate = dataclasses.replace(one, screw=screw)
    assert twin.adds_to(known) == holds


def test_the_pulls_of_a_part_that_is_dropped_are_of_what_moved(twin, monkeypatch) -> None:
    monkeypatch.setattr(Twin, "was_felt_by_itself", lambda _, number: number < 2)
    twin.parts.append(dataclasses.replace(twin.parts[1], ways=[]))
    twin.held[1] = 2, twin.held[1][1]
    assert [part for part, _ in drop_needless(twin).held] == [0, 1]


def test_a_carrier_that_no_hand_has_felt_is_dropped_where_what_it_carries_goes_as_far(room) -> None:
    _, twin = pulled(PLACES[0], (DOOR, PLACES[1]))
    (door,) = twin.parts
    gone = door.positions
    beside = dataclasses.replace(door.screw, point=door.screw.point + 0.05)
    carrier = dataclasses.replace(
        door,
        estimate=dataclasses.replace(door.estimate, screw=beside),
        positions=[0.4 * place for place in gone],
        ways=[],
    )
    twin.parts = [carrier, hang(twin, door, -1, 0)]
    twin.parts[1] = hang(twin, twin.parts[1], 0, 0)
    twin.held = [(1, look) for _, look in twin.held]
    for look in range(len(twin.looks)):
        twin.find(1, look, beyond=1.0)
        twin.relabel(look)
    twin.parts[1].settle(twin.estimate(twin.parts[1]))
    (left,) = drop_needless(twin).parts
    assert left.parent == -1
    np.testing.assert_allclose(
        np.subtract(left.positions, left.positions[0]), np.subtract(gone, gone[0]), atol=0.05
    )
