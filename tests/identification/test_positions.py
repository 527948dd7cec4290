"""Where parts are in looks: what shows it, what does not, and what a hand says of it."""

import numpy as np
import pytest

from palpate.identification.interactive import explanation
from palpate.identification.interactive import twin as twin_module
from palpate.identification.interactive.edges import folding
from palpate.identification.interactive.explanation import find_moved_part
from palpate.identification.interactive.handling import Handling
from palpate.identification.interactive.twin import Twin
from rooms import DOOR, Notes, Room, pulled

pytestmark = pytest.mark.unchecked  # what test_interactive.py checks, on more scenes


DRAWERS = """
<mujoco>
  <worldbody>
    <geom type="box" size=".02 .9 1.1" pos=".15 0 1.1"/>
    <body name="upper" pos="0 0 1.5">
      <joint type="slide" axis="-1 0 0"/>
      <geom type="box" size=".1 .4 .2"/>
    </body>
    <body name="lower" pos="0 0 .7">
      <joint type="slide" axis="-1 0 0"/>
      <geom type="box" size=".1 .4 .2"/>
    </body>
  </worldbody>
</mujoco>
"""
UPPER = 1


class Drawers(Room):
    """Two drawers, and a hand at the front of one."""

    def __init__(self) -> None:
        super().__init__(DRAWERS)

    def place(self, body: int) -> np.ndarray:
        return np.array([-0.1, 0.2, 0.0])


def known_door() -> tuple[Room, Twin]:
    """A twin that has seen a hand open the door, to -0.5 rad."""
    room, twin = pulled((0.0, 0.0), (DOOR, (-0.5, 0.0)))
    assert len(twin.parts) == 1
    return room, twin


def swung_on() -> tuple[Twin, Handling]:
    """The same, once the door has swung on to -0.75 rad since it was let go, and a hand has taken
    it from there to -0.3, which the twin has seen and not yet explained."""
    (room, twin), notes = known_door(), Notes()
    room.at(-0.75, 0.0)
    twin.look(room.look())
    notes.look(twin.looks[-1])
    room.pull(notes, DOOR, (-0.75, 0.0), (-0.3, 0.0))
    (handling,) = notes.handled
    twin.add_look(handling.after)
    return twin, handling


@pytest.fixture
def room() -> Room:
    return Room()


def test_where_a_known_door_has_gone_no_other_part_is_seen() -> None:
    room, twin = known_door()
    sign = np.sign(twin.parts[0].positions[-1])
    room.at(-0.9, 0.0)
    look = twin.add_look(room.look())
    assert sign * twin.parts[0].positions[look] == pytest.approx(0.9, abs=0.02)
    screw, points = twin.screw(0, look), twin.looks[look].points
    turned = np.arctan2(screw.point[0] - points[:, 0], screw.point[1] - points[:, 1])
    high = (points[:, 2] > 0.4) & (points[:, 2] < 1.8)
    of_door = high & (np.abs(turned - 0.9) < 0.05) & (points[:, 0] < -0.1)
    assert of_door.sum() > 300
    other = len(twin.parts)  # of which no label is
    assert twin.points_of_others(other, look, look - 1)[of_door].mean() < 0.1
    assert twin.has_gone_to(0, look, look - 1)[of_door].mean() > 0.8
    assert twin.points_of_others(0, look, look - 1)[of_door].mean() < 0.1


def test_where_a_known_drawer_has_gone_no_other_part_is_seen() -> None:
    room, twin = Drawers(), Twin()
    room.at(0.0, 0.0)
    twin.look(room.look())
    room.pull(twin, UPPER, (0.0, 0.0), (0.2, 0.0))
    room.at(0.35, 0.0)
    look = twin.add_look(room.look())
    assert twin.parts[0].positions[look] == pytest.approx(0.35, abs=0.01)
    points = twin.looks[look].points
    front = (points[:, 0] < -0.4) & (points[:, 2] > 1.32) & (points[:, 2] < 1.68)
    assert front.sum() > 300
    assert twin.points_of_others(1, look, look - 1)[front].mean() < 0.1
    assert twin.has_gone_to(0, look, look - 1)[front].mean() > 0.8


def test_a_new_part_that_explains_nothing_leaves_all_as_it_was(room, monkeypatch) -> None:
    twin = Twin()
    room.at(0.0, 0.0)
    twin.look(room.look())
    for module in (twin_module, folding):
        monkeypatch.setattr(module, "FEWEST", 10**6)
    room.pull(twin, DOOR, (0.0, 0.0), (-0.5, 0.0))
    assert not twin.parts
    assert twin.held == [(-1, 0)]
    assert all((labels == -1).all() for labels in twin.labels)


def test_a_joint_that_is_refused_leaves_labels_as_they_were(monkeypatch) -> None:
    (room, twin), notes = known_door(), Notes()
    notes.look(twin.looks[-1])
    room.pull(notes, DOOR, (-0.5, 0.0), (-0.1, 0.0))
    (handling,) = notes.handled
    before = len(twin.looks) - 1
    after = twin.add_look(handling.after)
    twin.parts[0].positions[before] *= 0.6
    labels = twin.labels[before].copy()
    positions = list(twin.parts[0].positions)
    monkeypatch.setattr(explanation, "EXPLAINED", (0.015, -1.0))
    assert find_moved_part(twin, before, after, handling) == -1
    assert np.array_equal(twin.labels[before], labels)
    assert np.array_equal(twin.parts[0].seen[before], np.flatnonzero(labels == 0))
    assert twin.parts[0].positions == positions


def test_of_places_that_explain_a_part_as_well_the_one_that_meets_it_is_taken() -> None:
    room, twin = known_door()
    sign = np.sign(twin.parts[0].positions[-1])
    for begun in (0.47, 0.54):
        room.at(-0.5, 0.0)
        look = twin.add_look(room.look())
        twin.parts[0].positions[look] = sign * begun
        twin.find(0, look)
        assert sign * twin.parts[0].positions[look] == pytest.approx(0.5, abs=0.012)


def test_where_a_part_never_was_it_is_only_if_it_is_seen_there(monkeypatch) -> None:
    room, twin = known_door()
    part = twin.parts[0]
    sign = np.sign(part.positions[-1])
    room.at(-0.5, 0.0)
    twin.look(room.look())
    look = len(twin.looks) - 1
    part.positions[look] = 0.0

    def seen_at(part, look, positions, others=None, fewest=None):
        """Hidden behind the wall, badly seen where it is, and in the open elsewhere."""
        there = np.abs(sign * positions - 0.5) < 0.1
        return np.where(sign * positions < -0.6, -0.4, np.where(there, -1.0, -2.9))

    with monkeypatch.context() as patch:
        patch.setattr(twin, "seen_at", seen_at)
        twin.find(0, look, beyond=1.5)
    assert sign * part.positions[look] == pytest.approx(0.5, abs=0.11)
    room.at(-0.9, 0.0)  # it is found further than it ever was
    look = twin.add_look(room.look())
    assert sign * part.positions[look] == pytest.approx(0.9, abs=0.05)


@pytest.mark.parametrize(("there", "place"), [(-0.3, 0.9), (-0.4, 0.5)])
def test_where_a_part_never_was_it_is_if_a_little_is_seen_there_and_it_is_nowhere_else(
    monkeypatch, there, place
) -> None:
    _, twin = known_door()
    part = twin.parts[0]
    sign = np.sign(part.positions[-1])
    look = len(twin.looks) - 1

    def seen_at(part, look, positions, others=None, fewest=None):
        """Edge-on at -0.9, or hidden there, and in the open everywhere else."""
        return np.where(np.abs(sign * positions - 0.9) < 0.1, there, -2.9)

    monkeypatch.setattr(twin, "seen_at", seen_at)
    twin.find(0, look)
    assert sign * part.positions[look] == pytest.approx(place, abs=0.11)


@pytest.mark.parametrize("slope", [-0.1, 0.1])
def test_where_looks_hardly_tell_a_part_is_where_the_hand_took_it(monkeypatch, slope) -> None:
    _, twin = known_door()
    look = len(twin.looks) - 1

    def seen_at(part, look, positions, others=None, fewest=None):
        return 0.8 + slope * positions

    monkeypatch.setattr(twin, "seen_at", seen_at)
    monkeypatch.setattr(twin, "_align", lambda *given: None)
    twin.find(0, look, around=0.2)
    assert twin.parts[0].positions[look] == pytest.approx(0.2)


def test_where_a_part_began_is_told_by_both_looks_and_the_hand_together(monkeypatch) -> None:
    twin, handling = swung_on()
    part, before, after = twin.parts[0], len(twin.looks) - 2, len(twin.looks) - 1
    sign = np.sign(part.positions[1])
    part.positions[before] = part.positions[after] = sign * 0.6

    def seen_at(part, look, positions, others=None, fewest=None):
        """Each look by itself leaves open where it is within half a radian."""
        middle = 0.95 if look == before else 0.1
        return 0.8 - np.maximum(4.0 * (np.abs(sign * positions - middle) - 0.2), 0.0)

    monkeypatch.setattr(twin, "seen_at", seen_at)
    monkeypatch.setattr(twin, "_align", lambda *given: None)
    assert find_moved_part(twin, before, after, handling) == 0
    places = sign * np.array(part.positions)[[before, after]]
    assert places == pytest.approx([0.75, 0.3], abs=0.05)


def test_where_a_hand_takes_a_part_from_corrects_where_it_was_believed_to_be() -> None:
    twin, handling = swung_on()
    part, before, after = twin.parts[0], len(twin.looks) - 2, len(twin.looks) - 1
    sign = np.sign(part.positions[1])
    part.positions[before] = sign * 0.5  # and the look before did not show it
    twin.relabel(before)
    assert find_moved_part(twin, before, after, handling) == 0
    places = sign * np.array(part.positions)[[before, after]]
    assert places == pytest.approx([0.75, 0.3], abs=0.03)
    assert (twin.labels[before] == 0).sum() > 500


def test_a_short_way_along_a_wall_is_not_the_slide_of_the_wall(room) -> None:
    twin = Twin()
    room.at(-1.5, 0.0)
    twin.look(room.look())
    room.pull(twin, DOOR, (-1.5, 0.0), (-1.4, 0.0))
    (part,) = twin.parts
    assert part.screw.joint == "revolute"
    assert room.error(twin, 0, 0)[0] < 5.0
    wall = twin.looks[0].points[:, 0] > 0.1
    assert (twin.labels[0][wall] == 0).mean() < 0.05


def test_a_part_is_described_where_its_joint_says_that_it_was() -> None:
    _, twin = known_door()
    part, shown = twin.parts[0], [0, len(twin.looks) - 1]
    points, normals = part.support
    part.support = points + 0.05 * normals, normals

    def seen() -> list[float]:
        return [
            float(twin.seen_at(0, at, np.array(part.positions[at : at + 1]))[0]) for at in shown
        ]

    assert max(seen()) < 0.0
    twin.refit(-1)
    assert min(seen()) > 0.7


def test_a_part_that_no_look_shows_keeps_its_description() -> None:
    _, twin = known_door()
    part = twin.parts[0]
    kept = part.support
    part.seen = {look: chosen[:5] for look, chosen in part.seen.items()}
    twin.describe(0)
    assert part.support is kept
