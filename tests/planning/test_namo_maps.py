"""Maps of ROS and of our own, their side-cars, and what is refused."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from PIL import Image

from namo_rooms import IN_DOOR, two_rooms
from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.map import Map, Movable, Robot
from palpate.planning.movable_obstacles.map_description import write_map
from palpate.planning.movable_obstacles.map_files import maps_in, read_map
from palpate.planning.movable_obstacles.map_ros import walls_of

DATA = Path(__file__).parents[3] / "shared" / "data" / "namo_scenarios"
BESIDE = {
    "robot": {"radius": 0.2},
    "start": [1.0, 1.0],
    "goals": [[3.0, 1.0, 1.5]],
    "movables": {"crate": [[1.8, 0.8], [2.2, 0.8], [2.2, 1.2], [1.8, 1.2]]},
}


def ros_map(folder: Path, pixels: np.ndarray, suffix=".pgm", beside=BESIDE, **keys) -> Path:
    """A map_server YAML of `pixels` (rows from the top) and its side-car."""
    Image.fromarray(pixels).save(folder / f"place{suffix}")
    said = {"image": f"place{suffix}", "resolution": 0.1, "origin": [0, 0, 0]} | keys
    path = folder / "place.yaml"
    path.write_text("\n".join(f"{key}: {json.dumps(value)}" for key, value in said.items()))
    if beside is not None:
        (folder / "place.movables.json").write_text(json.dumps(beside))
    return path


def room(height=20, width=40) -> np.ndarray:
    """White, with a black border of one pixel and, from the lower left, a block of 3 x 2 pixels."""
    pixels = np.full((height, width), 254, np.uint8)
    pixels[[0, -1]] = pixels[:, [0, -1]] = 0
    pixels[-5:-3, 4:7] = 0
    return pixels


@pytest.mark.parametrize("suffix", [".pgm", ".png"])
def test_occupied_pixels_are_walls_with_the_origin_at_the_lower_left(tmp_path, suffix):
    world = read_map(
        ros_map(
            tmp_path, room(), suffix, origin=[-1.0, 2.0, 0.0], beside=BESIDE | {"start": [0, 3]}
        )
    )
    assert world.bounds == pytest.approx((-1.0, 2.0, 3.0, 4.0))
    assert world.cell_size == world.margin == 0.1
    block = shapely.box(-0.6, 2.3, -0.3, 2.5)
    assert world.walls.contains(block)
    border = 4.0 * 2.0 - 3.8 * 1.8
    assert world.walls.area == pytest.approx(border + block.area)
    assert world.movables["crate"].pose == pytest.approx((2.0, 1.0, 0.0))
    assert world.goals == ((3.0, 1.0, 1.5),)


def test_thresholds_negation_and_modes(tmp_path):
    pixels = room()
    pixels[5, 5] = 205  # 20 % occupied: what map_saver writes for unknown
    area = read_map(ros_map(tmp_path, room())).walls.area
    unknown = read_map(ros_map(tmp_path, pixels, free_thresh=0.19)).walls.area
    assert unknown == pytest.approx(area + 0.01)
    assert read_map(ros_map(tmp_path, pixels, free_thresh=0.25)).walls.area == pytest.approx(area)
    negated = ros_map(tmp_path, 255 - room(), negate=1)
    assert read_map(negated).walls.area == pytest.approx(area)
    raw = np.where(room() == 0, 100, 0).astype(np.uint8)
    raw[5, 5] = 255  # unknown
    assert read_map(ros_map(tmp_path, raw, mode="raw")).walls.area == pytest.approx(area + 0.01)


def test_colours_are_averaged_and_sixteen_bits_understood(tmp_path):
    coloured = np.repeat(room()[..., None], 3, axis=2)
    area = read_map(ros_map(tmp_path, room())).walls.area
    assert read_map(ros_map(tmp_path, coloured, ".png")).walls.area == pytest.approx(area)
    deep = room().astype(np.uint16) * 257
    assert read_map(ros_map(tmp_path, deep, ".png")).walls.area == pytest.approx(area)


def test_runs_of_pixels_make_the_polygons_that_the_pixels_make():
    blocked = np.random.default_rng(3).random((13, 17)) < 0.4
    rows, columns = np.nonzero(blocked)
    cells = shapely.box(columns * 0.5 - 1, rows * 0.5, columns * 0.5 - 0.5, rows * 0.5 + 0.5)
    walls = walls_of(blocked, -1.0, 0.0, 0.5)
    assert walls.symmetric_difference(shapely.union_all(cells)).area == pytest.approx(0, abs=1e-9)
    assert walls_of(np.zeros((3, 3), bool), 0.0, 0.0, 1.0).is_empty


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"image": "absent.pgm"}, "no file"),
        ({"image": "place.yaml"}, "no picture"),
        ({"resolution": "0.1 m"}, "number"),
        ({"resolution": 0}, "m per pixel"),
        ({"origin": [1]}, "origin"),
        ({"origin": ["a", 2]}, "number"),
        ({"mode": "fuzzy"}, "mode"),
        ({"free_thresh": "low"}, "number"),
    ],
)
def test_a_map_server_file_that_makes_no_sense_is_refused(tmp_path, keys, says):
    with pytest.raises(PalpateError, match=says):
        read_map(ros_map(tmp_path, room(), **keys))


@pytest.mark.parametrize(
    ("beside", "says"),
    [
        (None, "says nothing of the robot"),
        ({"robot": {"radius": 0.2}}, "says nothing of the start"),
        (BESIDE | {"robots": 3}, "unknown key 'robots'"),
        (BESIDE | {"robot": {}}, "radius or a footprint"),
        (BESIDE | {"robot": {"radius": "wide"}}, "number"),
        (BESIDE | {"robot": {"radius": -1}}, "above 0"),
        (BESIDE | {"robot": {"radius": 1, "drive": "legs"}}, "differential, holonomic"),
        (BESIDE | {"movables": [1]}, "names with polygons"),
        (BESIDE | {"movables": {"a": [[0, 0], [1, 1]]}}, "3 or more"),
        (BESIDE | {"movables": {"a": {"shape": 3}}}, "unknown key 'shape'"),
        (BESIDE | {"movables": {"a": {"polygon": [[0, 0], [1, 0], [0, 1]], "pose": [1]}}}, "pose"),
        (BESIDE | {"goals": 3}, "list of"),
        (BESIDE | {"goals": [["x", 1]]}, "goal"),
        (BESIDE | {"start": [1, float("inf")]}, "JSON|start"),
    ],
)
def test_a_side_car_that_makes_no_sense_is_refused(tmp_path, beside, says):
    with pytest.raises(PalpateError, match=says):
        read_map(ros_map(tmp_path, room(), beside=beside))


def test_a_side_car_may_be_yaml_and_give_a_footprint(tmp_path):
    path = ros_map(tmp_path, room(), beside=None)
    (tmp_path / "place.movables.yaml").write_text(
        "robot:\n  footprint: [[-0.3, -0.1], [0.3, -0.1], [0.3, 0.1], [-0.3, 0.1]]\n"
        "  drive: holonomic\n"
        "start: [1, 1, 0.5]\nmovables:\n  cart:\n    polygon: [[0, 0], [0.4, 0], [0.4, 0.2]]\n"
        "    pose: [2, 1, 0.3]\n    hints: {wheels: 2}\n"
    )
    world = read_map(path)
    assert world.robot.radius == pytest.approx(math.hypot(0.3, 0.1))
    assert world.robot.drive == "holonomic"
    assert world.movables["cart"].pose == (2.0, 1.0, 0.3)
    assert world.movables["cart"].hints == {"wheels": 2}
    assert world.goals == ()
    with pytest.raises(PalpateError, match="has no goal"):
        world.check()


@pytest.mark.parametrize(
    "text", ["a: [1", "!!python/object:os.system {}", "- 1\n- 2", "\x00", "a: &a [*a]\nimage: 3"]
)
def test_yaml_that_is_no_plain_map_is_refused(tmp_path, text):
    path = tmp_path / "map.yaml"
    path.write_text(text)
    with pytest.raises(PalpateError):
        read_map(path)


def test_a_map_is_written_and_read_back(tmp_path):
    world = two_rooms({"a": IN_DOOR}, drive="holonomic")
    movable = Movable("b", world.movables["a"].outline, (1.0, 2.0, 0.7), {"wheels": [1, 2]})
    world = Map(**{**vars(world), "movables": {**world.movables, "b": movable}})
    write_map(tmp_path / "map.json", world)
    again = read_map(tmp_path / "map.json")
    for name in ("name", "start", "goals", "bounds", "cell_size", "margin"):
        assert getattr(again, name) == getattr(world, name)
    assert (again.robot.radius, again.robot.drive) == (world.robot.radius, world.robot.drive)
    assert again.walls.symmetric_difference(world.walls).area == pytest.approx(0, abs=1e-12)
    for name, movable in world.movables.items():
        same = again.movables[name]
        assert same.polygon.symmetric_difference(movable.polygon).area < 1e-9
        assert dict(same.hints) == dict(movable.hints)


def test_a_folder_gives_maps_but_not_their_parts(tmp_path):
    write_map(tmp_path / "own.json", two_rooms({}))
    (tmp_path / "grid").mkdir()
    path = ros_map(tmp_path / "grid", room())
    assert maps_in(tmp_path) == [path, tmp_path / "own.json"]
    with pytest.raises(PalpateError, match="no folder"):
        maps_in(tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    with pytest.raises(PalpateError, match="no map"):
        maps_in(tmp_path / "empty")


@pytest.mark.parametrize(
    ("name", "says"), [("a.txt", "suffix"), ("b.svg", "no file"), (".", "folder")]
)
def test_a_file_of_another_kind_is_refused(tmp_path, name, says):
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(PalpateError, match=says):
        read_map(tmp_path / name)


@pytest.mark.skipif(not DATA.is_dir(), reason="the scenarios are not in this checkout")
def test_namosims_ros_map_with_its_layered_drawing_is_read():
    paths = maps_in(DATA)
    assert [path.name for path in paths if path.parent.name == "citi_ing"] == ["namo.yaml"]
    world = read_map(DATA / "citi_ing" / "namo.yaml")
    assert world.bounds == pytest.approx((0, 0, 10.75, 12.1))
    assert sorted(world.movables) == ["box_0", "box_0-6"]
    assert world.movables["box_0"].pose[:2] == pytest.approx((6.3, 5.95), abs=0.05)
    assert len(world.goals) == 1
    world.check()


# --- impossible places ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"start": (4.1, 0.5)}, "start .* in a wall"),
        ({"goal": (4.1, 0.5)}, "goal .* in a wall"),
        ({"start": (-1.0, 0.5)}, "inside map"),
        ({"goal": (7.95, 1.0)}, "inside map"),
        ({"start": (3.6, 1.5)}, "collides with 'a'"),
        ({"goal": (math.nan, 1.0)}, "goal"),
    ],
)
def test_impossible_places_are_said(changes, says):
    with pytest.raises(PalpateError, match=says):
        two_rooms({"a": IN_DOOR}, **changes).check()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"cell": 0.0}, "cells of"),
        ({"cell": math.nan}, "cells of"),
        ({"cell": 1e-5}, "at most 4,000,000"),
        ({"margin": -0.1}, "margin"),
        ({"size": (0.0, 3.0)}, "bounds"),
        ({"radius": math.inf}, "radius"),
    ],
)
def test_sizes_that_are_none_are_refused(changes, says):
    with pytest.raises(PalpateError, match=says):
        two_rooms({}, **changes)


def test_only_what_is_there_can_be_moved():
    world = two_rooms({"a": IN_DOOR})
    with pytest.raises(PalpateError, match="no movable 'b'; there are: a"):
        world.moved({"b": (1.0, 1.0, 0.0)})
    moved = world.moved({"a": (1.0, 1.0, 0.5)}, start=(2.0, 2.0, 0.0))
    assert moved.movables["a"].pose == (1.0, 1.0, 0.5)
    assert moved.start == (2.0, 2.0, 0.0)
    assert Robot(0.2).reach is None
