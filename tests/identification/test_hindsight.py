"""What was done to a door with a flap, explained once more from the last pull to the first."""

import copy

import numpy as np
import pytest

from palpate.identification.interactive import hindsight
from palpate.identification.interactive.hindsight import (
    correct_parents,
    explain_backwards,
    explained,
    reconsider,
)
from palpate.identification.interactive.insertion import hang
from palpate.identification.interactive.twin import Twin
from rooms import DOOR, FLAP, Room

pytestmark = pytest.mark.unchecked  # what test_interactive.py checks, on more scenes

PLACES = (0.0, 0.0), (-0.6, 0.0), (-0.2, 0.7)


@pytest.fixture(scope="module")
def room() -> Room:
    return Room()


@pytest.fixture(scope="module")
def pulled(room) -> Twin:
    """Of a door that was pulled open, and of its flap."""
    twin = Twin()
    room.at(*PLACES[0])
    twin.look(room.look())
    for body, start, end in zip((DOOR, FLAP), PLACES, PLACES[1:], strict=False):
        room.pull(twin, body, start, end)
    return twin


@pytest.fixture
def twin(pulled) -> Twin:
    """The same, for each test."""
    return copy.deepcopy(pulled)


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
    monkeypatch.setattr(hindsight, "OF_PART", 1.0)  # many parts, as a cabinet has, are no reason to
    monkeypatch.setattr(hindsight, "explain_backwards", lambda _: pytest.fail("it was tried"))
    assert reconsider(twin) is twin


def test_a_part_hangs_on_what_explains_all_looks(room, twin, monkeypatch) -> None:
    assert correct_parents(twin) is twin
    whole, flap = explained(twin), twin.parts[1]
    twin.parts[1] = hang(twin, flap, -1, flap.shown)  # as if it had moved by itself each time
    places = np.linspace(-2.0, 2.0, 81)
    for look in range(len(twin.looks)):
        twin.parts[1].positions[look] = float(places[twin.seen_at(1, look, places).argmax()])
    assert explained(twin) < whole - hindsight.HANGS
    kept = [list(part.positions) for part in twin.parts]
    other = correct_parents(twin)
    assert [part.parent for part in other.parts] == [-1, 0]
    assert explained(other) == pytest.approx(whole, abs=hindsight.BETTER)
    assert room.error(other, 1, 1)[0] < 4.0
    assert [part.positions for part in twin.parts] == kept  # it has been left as it was
    assert reconsider(twin).parts[1].parent == 0

    def lose(other: Twin, last: int) -> None:
        other.parts[1].positions = [1.5] * len(other.looks)

    monkeypatch.setattr(Twin, "refit", lose)
    assert correct_parents(twin) is twin  # as its joint is lost there


@pytest.mark.parametrize("held", [-1, 0], ids=["unexplained", "as-if-the-door-was-pulled"])
def test_what_explains_more_is_believed(room, twin, held) -> None:
    whole = explained(twin)
    twin.remove(1, -1)
    assert [part for part, _ in twin.held] == [0, -1]
    twin.held[1] = held, twin.held[1][1]
    assert explained(twin) < whole - hindsight.BETTER
    other = reconsider(twin)
    assert [part.parent for part in other.parts] == [-1, 0]
    assert explained(other) == pytest.approx(whole, abs=hindsight.BETTER)
    assert room.error(other, 1, 1)[0] < 4.0


def test_what_explains_less_is_not_believed(twin, monkeypatch) -> None:
    first = Twin()
    for look in twin.looks:
        first.look(look)
    whole = explained(twin)
    twin.held[0] = -1, twin.held[0][1]
    assert explained(twin) == pytest.approx(whole - 0.5 * hindsight.OF_PULLS, abs=1e-9)
    monkeypatch.setattr(hindsight, "explain_backwards", lambda _: first)
    assert reconsider(twin) is twin
    # a part that explains nothing costs
    alone = explained(twin)
    twin.parts.append(twin.parts[1])
    assert explained(twin) == pytest.approx(alone - hindsight.OF_PART, abs=1e-9)
