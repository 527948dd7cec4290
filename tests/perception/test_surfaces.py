"""Flat pieces of clouds of boxes before a wall, whose places are known."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from palpate.numerics.pinhole import DepthImage, Pinhole
from palpate.perception.clouds import Cloud, cloud_of, extent_of
from palpate.perception.surface_features import FEATURES, features_of
from palpate.perception.surfaces import surfaces
from palpate.worlds.depth import DepthSensor, depth_image

# A wall at x = 0, a board that stands off it, and a bar before the board as a handle; all of it
# stands high enough for no floor to be seen.
SCENE = """
<mujoco><worldbody><body>
  <geom type="box" size=".02 .9 .6" pos="-.02 0 1"/>
  <geom type="box" size=".01 .2 .15" pos=".29 .3 1.1"/>
  <geom type="box" size=".01 .07 .012" pos=".34 .3 1.15"/>
</body></worldbody></mujoco>
"""


def looked(scene: str, target: tuple[float, ...], eyes: list[tuple[float, ...]]) -> Cloud:
    model = mujoco.MjModel.from_xml_string(scene)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    random = np.random.default_rng(0)
    images: list[DepthImage] = []
    for eye in eyes:
        camera = Pinhole.looking_at(target, eye, 320, 240, math.radians(58))
        images.append(depth_image(model, data, camera, DepthSensor(), random)[0])
    return cloud_of(images)


@pytest.fixture(scope="module")
def cloud() -> Cloud:
    return looked(SCENE, (0.0, 0.1, 1.0), [(1.6, side, 1.3) for side in (-0.9, 0.9)])


def found_at(cloud: Cloud, x: float):
    every = surfaces(cloud, np.full(len(cloud.points), -1), np.random.default_rng(1))
    facing = [one for one in every if one.normal[0] > 0.95 and abs(one.centre[0] - x) < 0.02]
    return max(facing, key=lambda one: one.area)


def test_a_board_is_found_where_it_is_and_as_large(cloud):
    board = found_at(cloud, 0.3)
    away = (cloud.points[board.members] - board.centre) @ board.normal
    assert np.sqrt(np.mean(away**2)) < 5e-3
    assert board.centre == pytest.approx([0.3, 0.3, 1.1], abs=0.02)
    assert sorted(board.high - board.low) == pytest.approx([0.3, 0.4], abs=0.04)
    assert board.sides @ board.normal == pytest.approx([0.0, 0.0], abs=1e-9)
    assert np.linalg.norm(board.sides, axis=1) == pytest.approx([1.0, 1.0])
    assert board.area == pytest.approx(0.12, rel=0.35)


def test_a_bar_is_a_handle_and_the_board_is_none(cloud):
    board, wall = found_at(cloud, 0.3), found_at(cloud, 0.0)
    assert len(board.handles) == 1
    assert board.handles[0] == pytest.approx([0.34, 0.3, 1.15], abs=0.08)
    assert abs(board.handles[0][0] - 0.34) < 0.02
    # the board stands off the wall further than a handle
    assert not np.all(np.abs(wall.handles - board.centre)[:, 1:] < [0.2, 0.15], axis=1).any()


def test_surfaces_share_no_point_and_keep_to_one_label(cloud):
    labels = np.where(cloud.points[:, 2] > 1.1, 0, -1)
    found = surfaces(cloud, labels, np.random.default_rng(0))
    members = np.concatenate([one.members for one in found])
    assert len(np.unique(members)) == len(members)
    assert {one.part for one in found} == {-1, 0}
    assert all((labels[one.members] == one.part).all() for one in found)


def test_features_tell_a_board_that_stands_free_from_a_wall(cloud):
    every = [found_at(cloud, x) for x in (0.3, 0.0)]
    rows = features_of(cloud, every)
    board, wall = (dict(zip(FEATURES, row, strict=True)) for row in rows)
    assert board["faces the cameras"] > 0.7
    assert board["of the scene before it"] < 0.03 < wall["of the scene before it"]
    assert board["goes on beside it"] < 0.3
    assert board["free behind it"] > wall["free behind it"] == 0.0
    assert board["has a handle"] == 1.0
    assert board["free before it"] > 0.9
    assert board["area"] + wall["area"] == pytest.approx(1.0)
    assert board["area"] < wall["area"]
    assert board["size"] < wall["size"] < 0.0
    assert board["aspect"] == pytest.approx(math.log(4 / 3), abs=0.1)
    assert board["height"] > wall["height"]
    assert board["fills its rectangle"] > 0.7
    assert abs(board["faces up"]) < 0.05
    of_parts = ("on a part", "largest of its part", "of its part", "turned against its part")
    assert all(board[name] == 0.0 for name in (*of_parts, "before its part"))


def test_of_a_part_features_tell_what_is_not_in_line_with_its_largest_surface(cloud):
    board, wall = found_at(cloud, 0.3), found_at(cloud, 0.0)
    cosine, sine = math.cos(0.3), math.sin(0.3)
    ajar = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    every = [
        dataclasses.replace(wall, part=0),
        dataclasses.replace(board, part=0, normal=ajar @ board.normal),
        dataclasses.replace(board, part=1),
    ]
    largest, flap, other = (
        dict(zip(FEATURES, row, strict=True)) for row in features_of(cloud, every)
    )
    assert largest["of its part"] == other["of its part"] == 1.0
    assert largest["turned against its part"] == other["turned against its part"] == 0.0
    assert largest["before its part"] == other["before its part"] == 0.0
    assert flap["of its part"] == pytest.approx(board.area / wall.area)
    assert flap["turned against its part"] == pytest.approx(0.3, abs=0.03)
    away, extent = float((board.centre - wall.centre) @ wall.normal), extent_of(cloud.points)
    assert away == pytest.approx(0.3, abs=0.02)
    assert flap["before its part"] == pytest.approx(away / extent)


def test_what_is_turned_stands_off_the_axes_of_its_scene_wherever_that_is_turned(cloud):
    board, wall = found_at(cloud, 0.3), found_at(cloud, 0.0)
    offs = FEATURES.index("off the scene's axes")
    for turn in (0.0, 0.7):
        cosine, sine = math.cos(turn), math.sin(turn)
        whole = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        open_by = 0.5
        cosine, sine = math.cos(open_by), math.sin(open_by)
        opened = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        every = [
            dataclasses.replace(wall, normal=whole @ wall.normal),
            dataclasses.replace(board, normal=whole @ opened @ board.normal),
        ]
        found = features_of(cloud, every)[:, offs]
        assert found[0] < 0.04
        assert found[1] == pytest.approx(open_by, abs=0.06)


def test_of_no_surface_there_are_no_features(cloud):
    assert features_of(cloud, []).shape == (0, len(FEATURES))


BEADS = "".join(f'<geom size=".018" pos=".14 {0.13 + 0.03 * one:.2f} 1"/>' for one in range(7))
LEVER = f"""
<mujoco><worldbody><body>
  <geom type="box" size=".1 .1 .15" pos="0 0 1"/>{BEADS}
</body></worldbody></mujoco>
"""


def test_a_lever_is_a_piece_of_its_own_though_nothing_of_it_is_flat():
    small = looked(LEVER, (0.0, 0.1, 1.0), [(0.9, side, 1.4) for side in (-0.4, 0.5)])
    every = surfaces(small, np.full(len(small.points), -1), np.random.default_rng(1))
    on_lever = small.points[:, 1] > 0.115
    held = np.zeros(len(small.points), int)
    for number, one in enumerate(every, 1):
        held[one.members] = number
    # most of what stands out is of pieces with nothing of the box
    numbers = np.unique(held[on_lever & (held > 0)])
    assert np.mean(held[on_lever] > 0) > 0.5
    box = np.all(np.abs(small.points - [0, 0, 1.0]) < [0.11, 0.11, 0.16], axis=1)
    assert not np.isin(held[box & (held > 0)], numbers).any()
