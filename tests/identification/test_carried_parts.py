"""A door with a flap in it: pulls that move both, one after the other, and sheets that slide."""

import dataclasses
import math
import types

import numpy as np
import pytest

from depth_scenes import depth_of
from palpate.identification.interactive import twin as twin_module
from palpate.identification.interactive.edges import splitting
from palpate.identification.interactive.edges.splitting import split
from palpate.identification.interactive.handling import Handling, Push
from palpate.identification.interactive.labels import prior, scores, smooth_labels
from palpate.identification.interactive.part import Part
from palpate.identification.interactive.refinement import refine
from palpate.identification.interactive.screws import NOWHERE, Screw
from palpate.identification.interactive.tree import PartTree
from palpate.identification.interactive.twin import Twin
from palpate.numerics.pinhole import Pinhole
from palpate.perception.clouds import cloud_of
from rooms import DOOR, FLAP, Room, pulled

pytestmark = pytest.mark.unchecked  # what test_interactive.py checks, on more scenes

# The flap beside the door, on the wall.
APART = """
<mujoco>
  <worldbody>
    <geom type="box" size=".02 1.3 1.1" pos=".15 0 1.1"/>
    <geom type="box" size=".05 .05 1.1" pos="0 .5 1.1"/>
    <body name="door" pos="0 .44 1.1">
      <joint axis="0 0 1"/>
      <geom type="box" size=".02 .43 1" pos="0 -.43 0"/>
    </body>
    <body name="flap" pos="0 -.85 1.29">
      <joint axis="0 1 0"/>
      <geom type="box" size=".02 .26 .28" pos="0 0 -.29"/>
    </body>
  </worldbody>
</mujoco>
"""
# Two doors on one post, which open away from each other.
POST = """
<mujoco>
  <worldbody>
    <geom type="box" size=".02 .9 .9" pos=".4 0 .9"/>
    <body name="left" pos="0 0 .9">
      <joint axis="0 0 1"/>
      <geom type="box" size=".015 .22 .7" pos="0 .23 0"/>
    </body>
    <body name="right" pos="0 0 .9">
      <joint axis="0 0 -1"/>
      <geom type="box" size=".015 .22 .7" pos="0 -.23 0"/>
    </body>
  </worldbody>
</mujoco>
"""
# A cabinet with a door above a drawer.
CABINET = """
<mujoco>
  <worldbody>
    <geom type="box" size=".02 .5 1" pos=".5 0 1"/>
    <geom type="box" size=".25 .02 .4" pos=".25 .32 .9"/>
    <geom type="box" size=".25 .02 .4" pos=".25 -.32 .9"/>
    <geom type="box" size=".25 .32 .02" pos=".25 0 1.3"/>
    <body name="door" pos="0 .3 1.1">
      <joint axis="0 0 1"/>
      <geom type="box" size=".01 .3 .18" pos="0 -.3 0"/>
    </body>
    <body name="drawer" pos="0 0 .7">
      <joint type="slide" axis="-1 0 0"/>
      <geom type="box" size=".01 .29 .19"/>
      <geom type="box" size=".2 .01 .15" pos=".2 .27 0"/>
      <geom type="box" size=".2 .01 .15" pos=".2 -.27 0"/>
    </body>
  </worldbody>
</mujoco>
"""
CAMERA = Pinhole.looking_at((0.0, 0.0, 0.6), (-2.4, 0.0, 0.7), 320, 240, math.radians(58.0))
ON_DOOR, ON_FLAP = np.array([-0.02, -0.4, 0.5]), np.array([-0.02, 0.0, 0.72])
LEFT, RIGHT = 1, 2
DRAWER = 2


class Post(Room):
    """Two doors on one post, and a hand at the edge of one of them."""

    def __init__(self) -> None:
        super().__init__(POST)

    def place(self, body: int) -> np.ndarray:
        return np.array([-0.015, 0.4 if body == LEFT else -0.4, 0.0])


class Cabinet(Room):
    """A door and a drawer below it, and a hand at the edge of the one or in front of the other."""

    def __init__(self) -> None:
        super().__init__(CABINET)

    def place(self, body: int) -> np.ndarray:
        return np.array([-0.01, -0.5, 0.0] if body == DOOR else [-0.01, 0.0, 0.05])


@pytest.fixture
def room() -> Room:
    return Room()


def test_a_way_of_two_unknown_joints_is_no_part_by_itself(room, monkeypatch) -> None:
    monkeypatch.setattr(twin_module, "split_off_base", lambda *_: False)
    monkeypatch.setattr(twin_module, "discover_pair", lambda *_: -1)
    twin = Twin()
    room.at(0.0, 0.0)
    twin.look(room.look())
    room.pull(twin, FLAP, (0.0, 0.0), (-0.5, 0.6))
    assert not twin.parts
    assert twin.held == [(-1, 0)]


def test_a_door_stays_where_it_is_while_another_is_found_that_looks_like_it() -> None:
    room, twin = Post(), Twin()
    room.at(0.9, 0.0)
    twin.look(room.look())
    room.pull(twin, LEFT, (0.9, 0.0), (1.05, 0.0))
    room.pull(twin, RIGHT, (1.05, 0.0), (1.05, 1.6))
    assert [part.parent for part in twin.parts] == [-1, -1]
    assert [part for part, _ in twin.held] == [0, 1]
    np.testing.assert_allclose(np.diff(twin.parts[0].positions)[1:], 0.0, atol=0.02)
    for part in (0, 1):
        turned, aside = room.error(twin, part, part)
        assert turned < 2.0
        assert aside < 2.0


@pytest.mark.parametrize(
    ("bodies", "held", "places", "gone"),
    [
        ((DOOR, FLAP), [0, 1], [(0.0, 0.0), (-0.6, 0.0), (-0.2, 0.7)], [0.4, 0.7]),
        # the first pull is explained by the second, which moves the door alone
        ((FLAP, DOOR), [1, 0], [(0.0, 0.0), (-0.5, 0.7), (-0.1, 0.7)], [0.4, 0.0]),
    ],
)
def test_a_flap_is_found_on_a_door_that_moves_with_it(bodies, held, places, gone) -> None:
    room, twin = pulled(places[0], *zip(bodies, places[1:], strict=True))
    assert [part.parent for part in twin.parts] == [-1, 0]
    assert [part for part, _ in twin.held] == held
    for part in (0, 1):
        degrees, centimetres = room.error(twin, part, part)
        assert degrees < 4.0
        assert centimetres < 3.0
    positions = np.array([one.positions for one in twin.parts])
    assert np.abs(positions[:, -1] - positions[:, 1]) == pytest.approx(gone, abs=0.1)


def test_a_flap_that_swings_along_is_found_though_the_hand_is_on_the_door() -> None:
    room, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)))
    room.pull(twin, DOOR, (-0.6, 0.0), (-0.25, 0.6))
    assert [part.parent for part in twin.parts] == [-1, 0]
    assert [len(part.ways) for part in twin.parts] == [2, 0]
    assert room.error(twin, 0, 0)[0] < 2.0
    assert room.error(twin, 1, 1)[0] < 8.0  # no hand was on it
    positions = twin.parts[1].positions
    assert abs(positions[3] - positions[2]) == pytest.approx(0.6, abs=0.1)
    room.pull(twin, FLAP, (-0.25, 0.6), (-0.25, 0.1))
    assert [part for part, _ in twin.held] == [0, 0, 1]
    assert room.error(twin, 1, 1)[0] < 2.0


@pytest.mark.parametrize(("door", "flap"), [(-0.9, 0.5), (-0.6, 0.6)])
def test_one_pull_at_a_flap_tells_of_both_when_nothing_is_known(room, door, flap) -> None:
    turned = []
    for _ in range(3):  # with other noise
        twin = Twin()
        room.at(0.0, 0.0)
        twin.look(room.look())
        room.pull(twin, FLAP, (0.0, 0.0), (door, flap))
        assert [part.parent for part in twin.parts] == [-1, 0]
        assert twin.held == [(1, 0)]
        turned.append([room.error(twin, part, part)[0] for part in (0, 1)])
        for part, gone in enumerate((door, flap)):
            assert abs(twin.parts[part].positions[1]) == pytest.approx(abs(gone), abs=0.05)
    assert np.all(np.mean(turned, axis=0) < (4.0, 10.0))


@pytest.mark.parametrize(
    "places",
    [
        ((-0.63, 0.72), (-0.13, 0.72), (-0.47, -0.12)),  # what the hand left was taken for its own
        ((-0.56, 0.69), (-0.06, 0.69), (-0.56, 0.27)),  # the way looks like one circle
    ],
)
def test_a_flap_turns_about_its_own_hinge_though_its_door_went_too(room, places) -> None:
    twin = Twin()
    room.at(*places[0])
    twin.look(room.look())
    for body, start, end in zip((DOOR, FLAP), places, places[1:], strict=False):
        room.pull(twin, body, start, end)
    assert [part.parent for part in twin.parts] == [-1, 0]
    assert [part for part, _ in twin.held] == [0, 1]
    for part, gone in enumerate(np.subtract(places[2], places[1])):
        assert room.error(twin, part, part)[0] < 4.0
        last = np.diff(twin.parts[part].positions)[2]
        assert abs(last) == pytest.approx(abs(gone), abs=0.06)


def test_a_door_that_is_elsewhere_than_was_believed_is_no_flap() -> None:
    _, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)))
    twin.parts[0].positions[1] += 0.4
    twin.parts[0].positions[2] += 0.4
    assert not split(twin, [1, 2])
    assert len(twin.parts) == 1


def test_a_joint_that_is_hardly_known_tells_of_no_flap() -> None:
    room, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)))
    room.at(-0.25, 0.6)
    known = twin.parts[0].estimate
    for covariance, found in ((1e-3 * np.eye(4), False), (1e-6 * np.eye(4), True)):
        twin.parts[0].estimate = dataclasses.replace(known, covariance=covariance)
        twin.look(room.look())
        assert split(twin, [len(twin.looks) - 1]) == found


@pytest.mark.parametrize(("left", "right"), [(0.3, 1.0), (0.3, 1.3)])
def test_a_door_beside_one_that_is_known_is_no_part_on_it(left, right) -> None:
    room, twin = pulled((0.0, 0.0), (LEFT, (0.9, 0.0)), kind=Post)
    known = twin.parts[0].estimate
    twin.parts[0].estimate = dataclasses.replace(known, covariance=1e-6 * np.eye(4))
    room.at(left, right)
    twin.look(room.look())
    assert not split(twin, [len(twin.looks) - 1])
    assert len(twin.parts) == 1


@pytest.mark.parametrize("seed", [0, 3])
def test_a_drawer_slides_though_a_door_swings_meanwhile(seed) -> None:
    room, twin = Cabinet(), Twin()
    room.random = np.random.default_rng(seed)
    room.at(0.0, 0.0)
    twin.look(room.look())
    room.pull(twin, DOOR, (0.0, 0.0), (-0.9, 0.0))
    # some hinge on the door joins the ends of the hand's way as well, but a line would be chance
    room.pull(twin, DRAWER, (-0.9, 0.0), (-0.4, 0.2))
    assert [part.screw.joint for part in twin.parts] == ["revolute", "prismatic"]
    assert [part.parent for part in twin.parts] == [-1, -1]


@pytest.mark.parametrize(
    ("limit", "value"), [("LARGEST", 0.05), ("GROWN", 0.5), ("MOST", 0.02), ("UNSURE", 0.01)]
)
def test_a_flap_too_large_or_hardly_known_is_none(monkeypatch, limit, value) -> None:
    room, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)))
    known = twin.parts[0].estimate
    twin.parts[0].estimate = dataclasses.replace(known, covariance=1e-6 * np.eye(4))
    room.at(-0.25, 0.6)
    twin.look(room.look())
    monkeypatch.setattr(splitting, limit, value)
    assert not split(twin, [len(twin.looks) - 1])
    assert len(twin.parts) == 1
    assert max(labels.max() for labels in twin.labels) == 0


def test_a_flap_that_is_known_is_hung_on_the_door_that_takes_it_along(room) -> None:
    twin = Twin()
    room.at(0.0, 0.3)
    twin.look(room.look())
    room.pull(twin, FLAP, (0.0, 0.3), (0.0, 0.9))
    assert [part.parent for part in twin.parts] == [-1]
    room.pull(twin, DOOR, (0.0, 0.9), (-0.7, 0.9))
    door = next(number for number, one in enumerate(twin.parts) if one.parent < 0)
    assert len(twin.parts) == 2
    assert twin.parts[1 - door].parent == door
    assert room.error(twin, 1 - door, 1)[0] < 4.0
    assert room.error(twin, door, 0)[0] < 4.0


def test_a_part_that_has_not_gone_along_is_taken_off_what_it_hung_on() -> None:
    room, twin = Room(APART), Twin()
    room.at(0.0, 0.0)
    twin.look(room.look())
    room.pull(twin, FLAP, (0.0, 0.0), (0.0, 0.6))
    room.pull(twin, DOOR, (0.0, 0.6), (-0.6, 0.6))
    assert [part.parent for part in twin.parts] == [-1, -1]
    twin.parts[0].parent = 1
    room.pull(twin, DOOR, (-0.6, 0.6), (0.0, 0.6))
    assert [part.parent for part in twin.parts] == [-1, -1]
    assert room.error(twin, 0, 1)[0] < 4.0
    assert twin.parts[0].positions[-1] == pytest.approx(twin.parts[0].positions[1], abs=0.05)


def test_a_flap_that_was_guessed_from_two_ends_is_dropped_once_more_is_known() -> None:
    _, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)), (FLAP, (-0.2, 0.7)))
    guess = twin.parts[1]
    assert guess.provisional
    twin.parts.append(dataclasses.replace(guess, provisional=False))
    twin._drop_guesses()
    assert [part.provisional for part in twin.parts] == [False, False]
    assert [part for part, _ in twin.held] == [0, -1]
    twin.parts[1].ways.append((2, twin.parts[1].ways[0][1]))
    twin.parts[1].provisional = True
    twin.parts.append(dataclasses.replace(guess, provisional=False))
    twin._drop_guesses()  # two ways are no guess
    assert len(twin.parts) == 3


def test_a_joint_that_a_short_way_left_open_is_mended_and_not_found_again(room) -> None:
    twin = Twin()
    room.at(0.0, 0.0)
    twin.look(room.look())
    room.pull(twin, DOOR, (0.0, 0.0), (-0.09, 0.0))
    room.pull(twin, DOOR, (-0.09, 0.0), (-0.9, 0.0))
    assert [part.screw.joint for part in twin.parts] == ["revolute"]
    assert len(twin.parts[0].ways) == 2
    assert room.error(twin, 0, 0)[0] < 2.0


def test_a_little_way_at_what_stands_is_none_of_a_door_that_stands_as_well() -> None:
    room, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)))
    wall, out = np.array([0.13, 0.74, 1.1]), np.array([-1.0, 0.0, 0.0])
    way = wall + np.linspace(0.0, 0.012, 40)[:, None] * out
    twin.observe(
        Handling(
            Push(wall, out), twin.looks[-1], room.look(), np.linspace(0, 1, 40), way, 0.0 * way
        )
    )
    assert [part for part, _ in twin.held] == [0, -1]
    assert len(twin.parts[0].ways) == 1


PANELS = """
<mujoco>
  <worldbody>
    <geom type="box" size=".02 .9 .6" pos=".15 0 .6"/>
    <geom type="box" size=".02 .2 .5" pos="0 .5 .6"/>
    <geom type="box" size=".02 .2 .5" pos="0 -.5 .6"/>
    <geom type="box" size=".02 .12 .6" pos="-.3 .38 .6"/>
  </worldbody>
</mujoco>
"""


DOOR_AND_WALL = """
<mujoco>
  <worldbody>
    <geom type="box" size=".02 1.2 .9" pos=".1 0 .9"/>
    <body pos="0 0 .9">
      <joint type="slide" axis="0 1 0"/>
      <geom type="box" size=".02 .4 .8"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_a_door_that_slides_in_its_plane_is_of_one_part_and_the_wall_behind_it_stands() -> None:
    camera = Pinhole.looking_at((0.0, 0.0, 0.9), (-2.4, 0.0, 1.0), 320, 240, math.radians(58.0))
    looks = [cloud_of([depth_of(DOOR_AND_WALL, 0.15 * n, camera, n)]) for n in range(2)]
    slide = Screw("prismatic", np.array([0.0, 1.0, 0.0]), np.zeros(3)).pose(0.15)
    motions = [[NOWHERE], [slide]]
    given = scores(looks[0], looks[1:], motions)
    found = smooth_labels(looks[0], given + prior(looks[0], given, motions)).argmax(axis=0)
    door = looks[0].points[:, 0] < 0.03
    assert found[door].mean() > 0.98
    assert found[~door].mean() < 0.02


OVEN = """
<mujoco>
  <worldbody>
    <geom type="plane" size="4 4 .1"/>
    <geom type="box" size=".25 .34 .15" pos=".25 0 .15"/>
    <geom type="box" size=".25 .02 .2" pos=".25 .32 .46"/>
    <geom type="box" size=".25 .02 .2" pos=".25 -.32 .46"/>
    <geom type="box" size=".25 .34 .02" pos=".25 0 .68"/>
    <body pos="-.02 0 .28">
      <joint axis="0 -1 0"/>
      <geom type="box" size=".02 .3 .2" pos="0 0 .18"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_a_floor_that_goes_on_from_an_open_door_is_not_of_it() -> None:
    camera = Pinhole.looking_at((0.1, 0.0, 0.4), (-1.0, 0.3, 1.1), 320, 240, math.radians(58.0))
    closed, opened = (
        cloud_of([depth_of(OVEN, position, camera, number)])
        for number, position in enumerate((0.0, 0.5 * math.pi))
    )
    door = Screw("revolute", np.array([0.0, -1.0, 0.0]), np.array([-0.02, 0.0, 0.28]))
    motions = [[NOWHERE], [door.pose(-0.5 * math.pi)]]
    given = scores(opened, [closed], motions)
    found = smooth_labels(opened, given + prior(opened, given, motions)).argmax(axis=0)
    flat = opened.normals[:, 2] > 0.9
    x, y, z = opened.points.T
    low = flat & (z < 0.4) & (np.abs(y) < 0.25)
    assert found[low & (x < -0.1)].mean() > 0.95
    assert found[low & (x > 0.1)].mean() < 0.05


def test_what_is_known_to_be_another_part_does_not_show_where_a_part_is() -> None:
    # two equal panels; the first, half hidden behind a post, would be seen better at the other
    tree = PartTree()
    for seed in (0, 1):
        tree.looks.append(cloud_of([depth_of(PANELS, 0.0, CAMERA, seed)]))
        points = tree.looks[-1].points
        tree.labels.append(np.where((points[:, 1] > 0.28) & (points[:, 0] > -0.1), 0, -1))
    y, z = np.meshgrid(np.arange(0.32, 0.7, 0.03), np.arange(0.15, 1.1, 0.03))
    support = np.stack([np.full(y.size, -0.02), y.ravel(), z.ravel()], axis=1)
    normals = np.tile([-1.0, 0.0, 0.0], (y.size, 1))
    slide = Screw("prismatic", np.array([0.0, -1.0, 0.0]), support.mean(axis=0))
    way = np.linspace(support[0], support[0] + slide.axis, 20)
    known = refine(slide, np.zeros(2), [None, None], [(0, way)])
    tree.parts.append(Part(-1, known, [0.0, 0.0], {}, [(0, way)], (support, normals)))
    tree.parts[0].positions[0] = 1.0  # it has been there, so that it is sought there
    tree.find(0, 1, others=tree.points_of_others(0, 1, 0))
    assert tree.parts[0].positions[1] == 0.0
    tree.find(0, 1)
    assert tree.parts[0].positions[1] == pytest.approx(1.0, abs=0.05)


def test_a_part_that_was_found_twice_becomes_one(room) -> None:
    twin = Twin()
    room.at(-0.3, 0.0)
    twin.look(room.look())
    room.pull(twin, FLAP, (-0.3, 0.0), (-0.3, 0.7))
    assert len(twin.parts) == 1
    other = twin.parts[0]
    short = [(look, way[:10]) for look, way in other.ways]
    twin.parts.append(dataclasses.replace(other, positions=list(other.positions), ways=short))
    room.pull(twin, FLAP, (-0.3, 0.7), (-0.3, 0.1))
    assert len(twin.parts) == 1
    assert twin.held[-1][0] == 0
    assert len(twin.parts[0].ways) == 3


def test_a_way_on_a_part_whose_carrier_has_moved_counts_by_its_ends() -> None:
    _, twin = pulled((0.0, 0.0), (DOOR, (-0.6, 0.0)), (FLAP, (-0.2, 0.7)))
    look, way = twin.parts[1].ways[0]
    local = twin.way_from(0, look, way)
    assert local.shape == (6, 3)
    still = Screw("revolute", np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.29]))
    turned = still.position_of(local[0], local[-1:])[0]
    assert abs(turned) == pytest.approx(0.7, abs=0.1)
    assert twin.way_from(-1, look, way) is way


@pytest.mark.parametrize(("radius", "joint"), [(1.0, "revolute"), (4.0, "prismatic")])
def test_a_slide_is_no_hinge_that_is_fitted_metres_away(radius, joint) -> None:
    # a drawer whose points were mistaken, so that a bent way fits it better
    tree, turned = PartTree(), np.linspace(0.0, 0.8 / radius, 40)
    arc = np.stack([np.sin(turned), 1.0 - np.cos(turned), np.zeros(40)], axis=1)
    way = radius * arc
    for _ in range(3):
        tree.looks.append(cloud_of([depth_of(PANELS, 0.0, CAMERA, 0)]))
        tree.labels.append(np.full(len(tree.looks[0].points), -1))
    hinge = Screw("revolute", np.array([0.0, 0.0, 1.0]), np.array([0.0, radius, 0.0]))
    ways, support = [(0, way), (1, way[::-1])], (way, np.tile([-1.0, 0.0, 0.0], (40, 1)))
    known = refine(hinge, np.zeros(3), [None] * 3, ways)
    assert known.screw.radii(way).mean() == pytest.approx(radius, rel=0.05)
    tree.parts.append(Part(-1, known, [0.0, 0.8 / radius, 0.0], {}, ways, support))
    tree.refit(0)
    assert tree.parts[0].screw.joint == joint


@pytest.mark.parametrize(
    ("count", "gain", "believed"),
    [(1, 0.021, False), (1, 0.024, True), (5, 0.006, False), (5, 0.009, True)],
)
def test_of_many_parts_a_new_one_that_a_hand_felt_has_few_points(
    monkeypatch, count, gain, believed
) -> None:
    twin, other = Twin(), Twin()
    for one, parts in ((twin, count), (other, count + 1)):
        one.parts = [None] * parts
        one.handled, one.held = [types.SimpleNamespace(moved=True)], [(0, 0)]
    monkeypatch.setattr(Twin, "_learn", lambda *_, only_new: None)
    monkeypatch.setattr(Twin, "evidence_of_looks", lambda one: gain if one is other else 0.0)
    twin._explain_by_new(other, other.handled[0])
    assert len(twin.parts) == count + believed
