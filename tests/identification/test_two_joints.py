"""A hand on a flap that moves its door as well: what is said of both, of one pull."""

import dataclasses

import numpy as np
import pytest

from palpate.identification.interactive import discovery
from palpate.identification.interactive.discovery import discover, on_moving_carrier
from palpate.identification.interactive.duplicates import drop_explained
from palpate.identification.interactive.explanation import (
    find_moved_part,
    joint_of_ways,
    possible_ends,
)
from palpate.identification.interactive.handling import Handling, Push
from palpate.identification.interactive.insertion import Discovery
from palpate.identification.interactive.labels import distinguishing_looks, weights_of_looks
from palpate.identification.interactive.screws import screws_of_way
from palpate.identification.interactive.twin import Twin
from palpate.identification.interactive.ways import misfit
from rooms import DOOR, FLAP, SCENE, Room, pulled

pytestmark = pytest.mark.unchecked  # what test_interactive.py checks, on more scenes

BEGAN, ENDED = (-0.6, 0.3), (-0.15, 1.0)


class Unsteady(Room):
    """The door and its flap; the hand moves the door first, and then the flap."""

    def way(self, start: tuple[float, float], end: tuple[float, float]) -> np.ndarray:
        """Of a hand on the flap (m)."""
        found = []
        for share in np.linspace(0.0, 1.0, 60):
            late = np.array([share**0.5, share**2])
            self.at(*(np.array(start) + late * np.subtract(end, start)))
            turn = self.data.xmat[FLAP].reshape(3, 3)
            found.append(self.data.xpos[FLAP] + turn @ self.place(FLAP))
        return np.array(found) + 5e-4 * self.random.standard_normal((60, 3))


@pytest.fixture
def known() -> tuple[Unsteady, Twin, Handling]:
    """A twin that knows the door and the flap, and a pull that moves both."""
    pulls = (DOOR, (-0.6, 0.0)), (FLAP, (-0.6, 0.9)), (FLAP, BEGAN)
    room, twin = pulled((0.0, 0.0), *pulls, kind=Unsteady)
    assert [part.parent for part in twin.parts] == [-1, 0]
    way = room.way(BEGAN, ENDED)
    room.at(*ENDED)
    along = (way[-1] - way[0]) / np.linalg.norm(way[-1] - way[0])
    handling = Handling(
        Push(way[0], along), twin.looks[-1], room.look(), np.linspace(0, 2, 60), way, 0.0 * way
    )
    return room, twin, handling


def test_where_both_joints_are_is_told_by_the_hand_alone(known) -> None:
    _, twin, handling = known
    look = len(twin.looks) - 1
    (ends,) = possible_ends(twin, 1, look, handling)
    gone = np.subtract(ends, [part.positions[look] for part in twin.parts])
    signs = np.sign([part.positions[-1] for part in twin.parts])
    assert np.abs(gone) == pytest.approx([0.45, 0.7], abs=0.04)
    assert signs[0] * gone[0] < 0.0 < signs[1] * gone[1]
    # a hand that leaves the plane in which the joints let it go is moved by something else
    aside = np.linspace(0.0, 0.15, 60)[:, None] * np.array([0.0, 0.0, 1.0])
    lifted = Handling(
        handling.push, handling.before, handling.after, handling.times,
        handling.points + aside, handling.forces,
    )  # fmt: skip
    assert not possible_ends(twin, 1, look, lifted)


def test_a_pull_that_moves_a_known_flap_and_its_door_is_of_the_flap(known) -> None:
    _, twin, handling = known
    before = len(twin.looks) - 1
    after = twin.add_look(handling.after)
    for part in twin.parts:  # as where clouds do not show them
        part.positions[after] = part.positions[before]
    ways = [len(part.ways) for part in twin.parts]
    assert find_moved_part(twin, before, after, handling) == 1
    assert [len(part.ways) for part in twin.parts] == [ways[0], ways[1] + 1]
    gone = [abs(part.positions[after] - part.positions[before]) for part in twin.parts]
    assert gone == pytest.approx([0.45, 0.7], abs=0.05)


def test_ways_of_two_joints_are_of_no_one_joint(known) -> None:
    room, twin, _ = known
    door = twin.parts[0]
    look = door.ways[0][0]
    assert joint_of_ways(twin, door, door.ways) is not None
    mixed = room.way((0.0, 0.0), (-0.3, 0.6))
    assert joint_of_ways(twin, door, [*door.ways, (look, mixed)]) is None
    assert misfit(door.screw, door.ways[0][1]) < 1.1 < misfit(door.screw, mixed)


def test_seen_from_a_door_that_went_along_the_hand_goes_round_the_flap_s_hinge() -> None:
    room, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)))
    room.at(-0.4, 0.9)
    before, after = len(twin.looks) - 1, twin.add_look(room.look())
    assert twin.parts[0].positions[after] - twin.parts[0].positions[before] != 0.0
    way = []
    for share in np.linspace(0.0, 1.0, 60):
        room.at(-0.6 + 0.2 * share, 0.9 * share)
        turn = room.data.xmat[FLAP].reshape(3, 3)
        way.append(room.data.xpos[FLAP] + turn @ room.place(FLAP))
    room.at(-0.6, 0.0)
    hinge, place = room.data.xaxis[1].copy(), room.data.xanchor[1].copy()

    def missed(points: np.ndarray) -> tuple[float, float]:
        found = next(one for one in screws_of_way(points) if one.joint == "revolute")
        turned = float(np.degrees(np.arccos(min(abs(found.axis @ hinge), 1.0))))
        return turned, float(np.linalg.norm(np.cross(found.point - place, hinge)))

    turned, aside = missed(on_moving_carrier(twin, before, after, 0, np.array(way)))
    assert turned < 5.0
    assert aside < 0.03
    assert missed(np.array(way))[0] > 10.0


def test_a_door_is_not_found_again_because_its_flap_moved_a_little() -> None:
    room, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)), (DOOR, (-0.1, 0.0)))
    way = []
    for share in np.linspace(0.0, 1.0, 60):
        room.at(-0.1 - 0.6 * share, 0.0)
        turn = room.data.xmat[DOOR].reshape(3, 3)
        way.append(room.data.xpos[DOOR] + turn @ room.place(DOOR))
    points, look = np.array(way), room.look()
    push = Push(points[0], points[-1] - points[0])
    before = len(twin.looks) - 1
    after = twin.add_look(look)
    twin.parts[0].positions[after] = twin.parts[0].positions[before]  # and it was lost
    handling = Handling(push, twin.looks[before], look, np.linspace(0, 2, 60), points, 0 * points)
    assert not discover(twin, before, after, handling)
    assert len(twin.parts) == 1


def test_looks_differ_though_where_a_carrier_was_is_not_quite_known() -> None:
    door = np.array([1.46, 0.0, 1.46, 1.46, 0.7, 1.43])
    flap = np.array([0.0, 0.0, 1.5, 0.3, 0.3, 1.0])
    chosen = distinguishing_looks(np.array([door, flap]), 5)
    # the flap has moved alone between the last look and the third or the first, by and large
    assert {0, 2, 3} & set(chosen)


def test_a_look_is_held_against_more_than_one_in_which_a_part_has_gone_as_far() -> None:
    door = np.array([0.0, 0.0, 0.6, 1.1, 1.8, 0.0, 1.5, 0.65])
    chosen = distinguishing_looks(door[None], 0)
    # and none in which nothing has moved; two that show the same count as one
    assert set(chosen) == {2, 3, 4, 6, 7}
    weights = dict(zip(chosen, weights_of_looks(door[None], chosen), strict=True))
    assert weights == {2: 0.5, 3: 1.0, 4: 1.0, 6: 1.0, 7: 0.5}
    assert distinguishing_looks(np.zeros((1, 3)), 0) == [2]


def test_what_no_hand_has_moved_may_creep_but_does_not_jump() -> None:
    room, twin = pulled((0.0, 0.0), (DOOR, (-0.9, 0.0)))
    sign = np.sign(twin.parts[0].positions[-1])
    for door, still, expected in ((1.0, True, 1.0), (0.05, False, 0.05), (0.05, True, None)):
        seen = twin.copy()
        room.at(-door, 0.0)
        found = sign * seen.parts[0].positions[seen.add_look(room.look(), still=still)]
        if expected is None:  # so far it does not go by itself
            assert found > 0.3
        else:
            assert found == pytest.approx(expected, abs=0.03)


def test_a_flap_that_was_found_twice_is_one_and_a_door_with_a_flap_is_two(known) -> None:
    _, twin, _ = known
    drop_explained(twin)
    assert [part.parent for part in twin.parts] == [-1, 0]
    flap = twin.parts[1]
    # the same again, of which less is known; the flap has lost its points to it in one look
    again = dataclasses.replace(flap, ways=[], seen=dict(flap.seen), positions=[*flap.positions])
    look = flap.shown
    flap.seen[look] = flap.seen[look][:0]
    flap.positions[look] += 0.4
    twin.parts.append(again)
    drop_explained(twin)
    assert len(twin.parts) == 2
    assert twin.parts[1] is flap
    assert flap.positions[look] == pytest.approx(again.positions[look], abs=0.05)


def test_a_joint_of_which_nothing_is_known_goes_when_a_hand_goes_otherwise(known) -> None:
    _, twin, handling = known
    for spread, kept in ((1e-6, True), (4.0, False)):
        seen = twin.copy()
        flap = seen.parts[1]
        flap.estimate = dataclasses.replace(flap.estimate, covariance=spread * np.eye(4))
        assert seen._drop_refuted(len(seen.looks) - 1, handling) == (not kept)
        assert (flap in seen.parts) == kept


def test_a_line_through_two_ends_of_a_way_is_no_slide(known) -> None:
    _, twin, _ = known
    flap = twin.parts[1]
    look, way = flap.ways[0]
    flap.ways = 2 * [(look, way[[0, 0, 0, -1, -1, -1]])]
    flap.seen = {}  # nothing else tells
    twin.refit(1)
    assert flap.screw.joint == "revolute"


def test_nothing_is_hinged_on_a_part_of_which_a_look_shows_nothing(known) -> None:
    _, twin, _ = known
    look = len(twin.looks) - 1
    twin.labels[look][:] = -1
    new = Discovery(-1, twin.parts[1].estimate, [np.zeros(0, int), np.zeros(0, int)])
    assert not discovery._is_hinged_on(twin, 0, look, look, new)


# The door of the room, whole, with a flap before it whose hinge is beside its own.
NARROW = (
    SCENE[: SCENE.index('<geom type="box" size=".02 .08 1" pos="0 -.78 0"/>')]
    + """
      <geom type="box" size=".02 .35 1" pos="0 -.43 0"/>
      <body name="flap" pos="-.03 -.12 -.1">
        <joint axis="0 0 1"/>
        <geom type="box" size=".01 .13 .28" pos="0 -.14 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
)


class NarrowFlap(Room):
    """A door with a flap in it whose hinge is beside the door's, and a hand on either."""

    def __init__(self) -> None:
        super().__init__(NARROW)

    def place(self, body: int) -> np.ndarray:
        return np.array([-0.02, -0.78, 0.0] if body == DOOR else [-0.01, -0.26, 0.0])


def test_a_door_that_goes_nearly_as_its_flap_would_is_no_piece_of_that() -> None:
    room, twin = NarrowFlap(), Twin()
    room.at(-1.2, 0.0)
    twin.look(room.look())
    room.pull(twin, FLAP, (-1.2, 0.0), (-1.2, -1.6))
    room.pull(twin, DOOR, (-1.2, -1.6), (-0.9, -1.6))
    flap, door = twin.parts
    assert [flap.parent, door.parent] == [1, -1]
    assert [part for part, _ in twin.held] == [0, 1]
    assert np.ptp(door.positions) == pytest.approx(0.3, abs=0.05)
