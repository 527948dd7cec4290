"""A door with a flap that stands off it by no more than a look is noisy."""

import dataclasses
import math

import numpy as np
import pytest

from depth_scenes import depth_of
from palpate.identification.interactive import duplicates
from palpate.identification.interactive.averaging import average
from palpate.identification.interactive.duplicates import merge_same
from palpate.identification.interactive.labels import height_evidence, scores
from palpate.identification.interactive.part import Part
from palpate.identification.interactive.refinement import Estimate
from palpate.identification.interactive.screws import NOWHERE, Pose, Screw
from palpate.identification.interactive.tree import PartTree
from palpate.numerics.pinhole import Pinhole
from palpate.perception.clouds import Cloud, cloud_of
from palpate.perception.surface_features import FEATURES, features_of
from palpate.perception.surfaces import surfaces

STEP = 0.014  # m, of the flap
SCENE = """
<mujoco><worldbody>
  <geom type="box" size=".02 .9 .7" pos="-.3 0 1"/>
  <body name="door" pos="0 -.3 1">
    <joint axis="0 0 1"/>
    <geom type="box" size=".01 .3 .4" pos="0 .3 0"/>
    <body name="flap" pos=".017 .23 .1">
      <joint axis="0 0 1"/>
      <geom type="box" size=".007 .12 .15" pos="0 .12 0"/>
    </body>
  </body>
</worldbody></mujoco>
"""
FLAP = np.array([0.024, 0.05, 1.1])  # the middle of its face, as all is closed
DOOR = Screw("revolute", np.array([0.0, 0.0, 1.0]), np.array([0.0, -0.3, 0.0]))
HINGE = Screw("revolute", np.array([0.0, 0.0, 1.0]), np.array([0.017, -0.07, 0.0]))
FLAT = Estimate(DOOR, np.zeros(2), 1e-6 * np.eye(4), 0.0, 100.0)  # of the door, before it opens
# Of the door and of the flap, rad; both open as they turn the negative way.
CLOSED = (0.0, 0.0), (0.0, 0.0), (-0.3, 0.0), (0.0, 0.0), (-0.5, 0.0), (0.0, 0.0)
OPENED = (0.0, 0.0), (0.0, -1.0), (-0.4, -1.0), (-0.4, 0.0)


def looks_at(
    places: tuple[tuple[float, float], ...], sides: tuple[float, ...], scene: str = SCENE
) -> list[Cloud]:
    """Of one camera on each side (m)."""
    cameras = [
        Pinhole.looking_at((0.0, 0.0, 1.0), (2.0, side, 1.3), 320, 240, math.radians(58))
        for side in sides
    ]
    return [
        cloud_of(
            [depth_of(scene, place, one, 10 * seed + view) for view, one in enumerate(cameras)]
        )
        for seed, place in enumerate(places)
    ]


@pytest.fixture(scope="module")
def looks() -> list[Cloud]:
    return looks_at(CLOSED, (-1.2,))


def labels_of(cloud: Cloud, turn: float) -> np.ndarray:
    """0 of the door, -1 of the wall behind it."""
    return np.where(DOOR.pose(-turn).at(cloud.points)[:, 0] > -0.15, 0, -1)


def averaged(looks: list[Cloud]) -> Cloud:
    turns = [turn for turn, _ in CLOSED[: len(looks)]]
    labels = [labels_of(one, turn) for one, turn in zip(looks, turns, strict=True)]
    motions: dict[int, list[Pose]] = {
        0: [DOOR.pose(turns[0] - turn) for turn in turns],
        -1: [NOWHERE] * len(turns),
    }
    return average(looks, labels, 0, motions)


def on_flap(cloud: Cloud) -> np.ndarray:
    """Which points of a look at all that is closed are of the flap, well within its edges."""
    away = np.abs(cloud.points - FLAP)
    return (away < [0.05, 0.1, 0.13]).all(axis=1)


def test_a_mean_of_looks_is_less_noisy_wherever_the_door_was(looks):
    own, mean = on_flap(looks[0]), averaged(looks)
    noisy, left = (one.points[own, 0] - 0.01 for one in (looks[0], mean))
    assert noisy.std() > 4e-3
    assert left.std() < 0.35 * noisy.std()
    assert left.mean() == pytest.approx(STEP, abs=1.5e-3)
    assert mean.error < 0.5 * looks[0].error  # it says so
    alone = averaged(looks[:1]).points[own, 0] - 0.01
    assert left.std() < alone.std() < noisy.std()


def test_points_are_moved_along_their_normals_alone(looks):
    mean = averaged(looks)
    moved = mean.points - looks[0].points
    along = np.vecdot(moved, looks[0].normals)
    assert np.isfinite(moved).all()
    assert moved == pytest.approx(along[:, None] * looks[0].normals)
    assert np.abs(along).max() < 5.0 * looks[0].deviation.max()


def test_a_flap_is_one_piece_of_the_mean_and_stands_off_what_is_around_it(looks):
    cloud = averaged(looks)
    every = surfaces(cloud, labels_of(looks[0], 0.0), np.random.default_rng(0))
    steps = features_of(cloud, every)[:, FEATURES.index("stands off what is around it")]
    flap = int(np.linalg.norm([one.centre - FLAP for one in every], axis=1).argmin())
    assert every[flap].centre == pytest.approx(FLAP, abs=0.03)
    assert sorted(every[flap].high - every[flap].low) == pytest.approx([0.24, 0.3], abs=0.05)
    assert steps[flap] > 0.8
    assert np.sort(steps)[-2] < 0.5


def tree_of(looks: list[Cloud], places: tuple[tuple[float, float], ...]) -> PartTree:
    """A door and its flap, whose joints and positions are known."""
    tree = PartTree()
    tree.looks = looks
    tree.labels = [np.full(len(one.points), -1) for one in looks]
    for number, screw in enumerate((DOOR, HINGE)):
        positions = [place[number] for place in places]
        estimate = Estimate(screw, np.array(positions), 1e-6 * np.eye(4), 0.0, 100.0)
        support = FLAP[None], np.array([[1.0, 0.0, 0.0]])
        tree.parts.append(Part(number - 1, estimate, positions, {}, [], support))
    return tree


def test_a_closed_flap_is_told_from_its_door_by_the_height_of_its_face():
    looks = looks_at(OPENED, (-1.2, 1.2))
    tree = tree_of(looks, OPENED)
    own = on_flap(looks[0])
    motions = [
        [NOWHERE] * 3,
        *([tree.motion(part, 0, other) for other in (1, 2, 3)] for part in (0, 1)),
    ]
    given = scores(looks[0], looks[1:], motions)
    # both faces are where points are on a surface: of the door's, that tells nothing more
    assert np.median(given[2, own] - given[1, own]) == 0.0
    found = height_evidence(looks[0], looks[1:], [motions[2], motions[1]], given, 2, 1)
    off_hinge = own & (looks[0].points[:, 1] > 0.0)
    assert np.mean(found[off_hinge] > 0.5) > 0.9
    away = looks[0].points[:, 0] < -0.2
    assert not found[away].any()
    tree.relabel(0)
    assert np.mean(tree.labels[0][own] == 1) > 0.9
    beside = (np.abs(looks[0].points[:, 0] - 0.01) < 0.03) & (looks[0].points[:, 1] > 0.2)
    assert np.mean(tree.labels[0][beside] == 0) > 0.9


def test_two_parts_on_one_hinge_of_a_door_are_the_one_that_is_known_better():
    looks = looks_at(OPENED[:2], (-1.2,))
    tree = tree_of(looks, OPENED[:2])
    known = tree.parts[1]
    axis = np.array([math.sin(0.25), 0.0, math.cos(0.25)])
    doubtful = Estimate(
        Screw("revolute", axis, HINGE.point + 0.02 * HINGE.across[0]),
        known.estimate.positions, 4e-3 * np.eye(4), 0.0, 100.0,
    )  # fmt: skip
    tree.parts.append(Part(0, doubtful, [0.0, -1.0], {}, [], known.support))
    aside = Screw("revolute", HINGE.axis, HINGE.point + 0.24 * HINGE.across[1])
    other = Estimate(aside, np.zeros(2), 1e-6 * np.eye(4), 0.0, 100.0)
    tree.parts.append(Part(0, other, [0.0, 0.0], {}, [], known.support))
    merge_same(tree)
    assert [part.parent for part in tree.parts] == [-1, 0, 0]
    assert tree.parts[1] is known
    assert tree.parts[2].screw.point == pytest.approx(aside.point)


def door_and_other(positions: tuple[float, float], other: Part) -> PartTree:
    """A tree of a door, which was seen closed and not where it has turned to since, at -0.5 rad,
    and of another part on its hinge, which was seen there; their positions in that look (rad)."""
    tree = tree_of(looks_at(((0.0, 0.0), (-0.5, 0.0)), (-1.2,)), ((0.0, 0.0), (-0.5, 0.0)))
    door = tree.parts[0]
    door.support = surface_of_door(0.2)
    door.positions = [0.0, positions[0]]
    places = np.array([0.0, positions[1]])
    estimate = dataclasses.replace(door.estimate, positions=places)
    tree.parts[1] = dataclasses.replace(other, estimate=estimate, positions=places.tolist())
    for look, (part, turn) in enumerate(((0, 0.0), (1, -0.5))):
        closed = DOOR.pose(-turn).at(tree.looks[look].points)
        on_face = (np.abs(closed[:, 0] - 0.01) < 0.02) & (np.abs(closed[:, 1]) < 0.25)
        tree.put_labels(look, np.where(on_face, part, -1))
    return tree


def surface_of_door(above: float) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of what is within .15 m of a height (m, from the middle of the door)."""
    across, up = np.meshgrid(np.linspace(-0.25, 0.25, 12), np.linspace(-0.15, 0.15, 12))
    points = np.stack([np.full(144, 0.01), across.ravel(), 1.0 + above + up.ravel()], axis=1)
    return points, np.tile([1.0, 0.0, 0.0], (144, 1))


def test_doors_above_each_other_on_one_hinge_stay_two():
    above = Part(-1, FLAT, [], {}, [], surface_of_door(-0.2))
    tree = door_and_other((-0.5, -0.5), above)
    merge_same(tree)
    assert len(tree.parts) == 2


def test_doors_on_one_post_stay_two():
    scene = """
    <mujoco><worldbody>
      <geom type="box" size=".02 .9 .7" pos="-.3 0 1"/>
      <body pos="0 0 1">
        <joint axis="0 0 1"/>
        <geom type="box" size=".01 .3 .4" pos="0 .31 0"/>
      </body>
      <body pos="0 0 1">
        <joint axis="0 0 -1"/>
        <geom type="box" size=".01 .3 .4" pos="0 -.31 0"/>
      </body>
    </worldbody></mujoco>
    """
    opened = (0.0, 0.0), (-1.5, 0.0), (-1.5, -1.5)
    tree = PartTree()
    tree.looks = looks_at(opened, (0.0,), scene)
    tree.labels = [np.full(len(look.points), -1) for look in tree.looks]
    for number, (side, turn) in enumerate(((1.0, 1.0), (-1.0, -1.0))):
        hinge = Screw("revolute", np.array([0.0, 0.0, turn]), np.zeros(3))
        points, normals = surface_of_door(0.0)
        points = points + np.array([0.0, 0.3 * side, 0.0])
        positions = [place[number] for place in opened]
        estimate = Estimate(hinge, np.array(positions), 1e-6 * np.eye(4), 0.0, 100.0)
        tree.parts.append(Part(-1, estimate, positions, {}, [], (points, normals)))
    for look in range(3):
        tree.relabel(look)
    merge_same(tree)
    assert len(tree.parts) == 2


def test_a_door_that_was_found_twice_is_one():
    again = Part(-1, FLAT, [], {}, [], surface_of_door(0.2))
    tree = door_and_other((0.0, -0.5), again)  # it turned, and was taken for another one
    merge_same(tree)
    (door,) = tree.parts
    assert door.positions == pytest.approx([0.0, -0.5], abs=0.03)


def test_what_turns_about_the_hinge_of_its_carrier_is_its_carrier():
    on_door = Part(0, FLAT, [], {}, [], surface_of_door(0.2))
    tree = door_and_other((-0.2, -0.3), on_door)
    door = tree.parts[0]
    merge_same(tree)
    assert tree.parts == [door]
    assert door.parent == -1
    assert door.positions == pytest.approx([0.0, -0.5], abs=0.03)


@pytest.mark.parametrize("parent", [-1, 0])
def test_what_does_not_explain_another_on_its_hinge_is_another(parent, monkeypatch):
    tree = door_and_other((0.0, -0.5), Part(parent, FLAT, [], {}, [], surface_of_door(0.2)))
    monkeypatch.setattr(duplicates, "LOSS", -10.0)  # nothing is explained as well by it
    merge_same(tree)
    assert len(tree.parts) == 2
