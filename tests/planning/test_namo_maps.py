"""Maps of our own, maps in folders, and what is refused of any map."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely import affinity
from shapely.geometry import Polygon

from namo_grids import CORNERS, OWN, room, ros_map
from namo_rooms import IN_DOOR, two_rooms, write_map
from palpate.errors import PalpateError, quote
from palpate.numerics.polygons import check_polygon, check_pose
from palpate.planning.movable_obstacles.maps.files import maps_in, read_map
from palpate.planning.movable_obstacles.maps.map import Map, Movable, Robot


def own_map(folder: Path, **keys) -> Path:
    """A map of our own with other keys."""
    path = folder / "own.json"
    path.write_text(json.dumps(OWN | keys))
    return path


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: [1", "no plain YAML"),
        ("!!python/object:os.system {}", "no plain YAML"),
        ("- 1\n- 2", "expected keys and values"),
        ("\x00", "no plain YAML"),
        ("a: 1\n---\nb: 2", "no plain YAML"),
        ("a: &a [*a]\nimage: 3", "alias"),
        ("a: &a {b: 1}\nc: {<<: *a}", "alias"),
        ("image: 3\nresolution: 0x" + 9999 * "1" + "\norigin: [0, 0]", "resolution .* number"),
        ("image: 3\nresolution: [" + 999 * "1," + "1]\norigin: [0, 0]", "resolution .* number"),
        ('map_yaml: "\\0"', "cannot read"),
    ],
)
def test_yaml_that_is_no_plain_map_is_refused(tmp_path, text, says):
    path = tmp_path / "map.yaml"
    path.write_text(text)
    with pytest.raises(PalpateError, match=says) as caught:
        read_map(path)
    assert len(str(caught.value)) < 400


def test_aliases_do_not_expand(tmp_path):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join(9 * [f'*a{k - 1}'])}]" for k in range(1, 12)]
    path = ros_map(tmp_path, room(), beside=None)
    (tmp_path / "place.movables.yaml").write_text("\n".join([*lines, "start: *a11"]))
    with pytest.raises(PalpateError, match="has the alias 'a0'"):
        read_map(path)


def test_what_a_sentence_shows_is_short():
    for value in ("x" * 999, [1] * 999, {str(k): k for k in range(999)}, 10**400, 10**9999):
        assert len(quote(value)) < 100
    assert quote("box") == "'box'"


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


@pytest.mark.parametrize(
    ("corners", "pose"),
    [
        ([[0, 0], [0.6, 0], [0.6, 0.2], [0, 0.2]], [2.0, 1.0, 0.0]),
        ([[0.1, -0.1], [0.5, -0.1], [0.5, 0.3]], [1.5, 0.7, 2.0]),
    ],
)
def test_a_polygon_with_a_pose_is_put_there_by_its_own_origin(tmp_path, corners, pose):
    world = read_map(own_map(tmp_path, movables={"a": {"polygon": corners, "pose": pose}}))
    turned = affinity.rotate(shapely.Polygon(corners), pose[2], origin=(0, 0), use_radians=True)
    expected = affinity.translate(turned, *pose[:2])
    movable = world.movables["a"]
    assert movable.polygon.symmetric_difference(expected).area < 1e-12
    assert movable.pose[:2] == pytest.approx(expected.centroid.coords[0])
    assert Polygon(movable.outline).centroid.coords[0] == pytest.approx((0, 0))


def test_what_is_written_is_read_back_exactly(tmp_path):
    generator = np.random.default_rng(5)
    movables = {}
    for k in range(30):
        corners = shapely.MultiPoint(generator.uniform(0, 3, (8, 2))).convex_hull.exterior.coords
        movable = Movable.from_corners(f"m{k}", corners[:-1])
        movables[f"m{k}"] = movable.moved(generator.uniform(0, 3, 3))
    world = Map(**{**vars(two_rooms({}, size=(9.0, 9.0))), "movables": movables})
    write_map(tmp_path / "map.json", world)
    again = read_map(tmp_path / "map.json")
    for name, movable in movables.items():
        assert again.movables[name].pose == movable.pose
        np.testing.assert_array_equal(again.movables[name].outline, movable.outline)


def test_slivers_of_walls_do_not_keep_a_map_from_being_read_back(tmp_path):
    speck = shapely.box(1, 1, 1.0005, 1.0005)
    pierced = shapely.box(2, 1, 3, 2) - shapely.box(2.5, 1.5, 2.5005, 1.5005)
    world = two_rooms({}, extra=(speck, pierced))
    write_map(tmp_path / "map.json", world)
    again = read_map(tmp_path / "map.json").walls
    assert again.symmetric_difference(world.walls).area < 1e-6


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"walls": [{"outline": CORNERS, "holes": 3}]}, "holes of wall 0: expected a list"),
        ({"walls": 3}, "walls of .*: expected a list of outlines"),
        ({"walls": [[[0, 0], [1e-4, 0], [0, 1e-4]]]}, "area of 5e-09 .* 1 square mm"),
        ({"movables": {"a": {"hints": {}}}}, "lacks its polygon"),
        ({"movables": []}, "movables of .* of type list"),
        ({"movables": {"a": {"polygon": CORNERS, "pose": [10**400, 0]}}}, "pose"),
        ({"bounds": [0, 0, 10**400, 1]}, "number"),
        ({"bounds": [0, 0, 1e9, 1e9]}, "within 100 km"),
        ({"name": 3}, "name 3"),
        ({"robot": {"radius": 1, "drive": "x" * 9999}}, "drive"),
        ({"x" * 9999: 1}, "unknown key"),
    ],
)
def test_a_map_of_our_own_that_makes_no_sense_is_refused(tmp_path, keys, says):
    assert read_map(own_map(tmp_path)).start == (1.0, 1.0, 0.0)
    with pytest.raises(PalpateError, match=says) as caught:
        read_map(own_map(tmp_path, **keys))
    assert len(str(caught.value)) < 400


def test_a_movable_larger_than_the_map_is_refused(tmp_path):
    in_mm = [[1000, 800], [1400, 800], [1400, 1200], [1000, 1200]]
    with pytest.raises(PalpateError, match=r"'a' takes 400 m x 400 m .* corners in m"):
        read_map(own_map(tmp_path, movables={"a": in_mm}))
    with pytest.raises(PalpateError, match="movable 'a' takes"):
        read_map(own_map(tmp_path, movables={"a": [[1, -1], [1.2, -1], [1.2, 1.5], [1, 1.5]]}))
    along = {"polygon": [[-0.1, -1.5], [0.1, -1.5], [0.1, 1.5], [-0.1, 1.5]], "pose": [2, 1, 1.57]}
    assert "a" in read_map(own_map(tmp_path, movables={"a": along})).movables


def test_an_outline_is_closed_only_by_the_same_corner():
    far = np.array([[0, 0], [1, 0], [1, 1], [0, 0.5]]) + 9e4
    assert len(check_polygon(far, "it").exterior.coords) == 5
    near = [[0, 0], [1, 0], [1, 1], [1e-10, 0]]
    assert len(check_polygon(near, "it").exterior.coords) == 4


@pytest.mark.parametrize("pose", [[10**400, 1], "here", [1], None, {"x": 1}, "x" * 9999])
def test_what_is_no_pose_is_refused(pose):
    with pytest.raises(PalpateError, match=r"it is .*: expected x and y") as caught:
        check_pose(pose, "it")
    assert len(str(caught.value)) < 200


def test_a_file_that_cannot_be_read_is_left_to_its_own_trial(tmp_path):
    write_map(tmp_path / "own.json", two_rooms({}))
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "two.yaml").write_text("a: 1\n---\nb: 2")
    (tmp_path / "tagged.yaml").write_text("!!python/object:os.system {}")
    (tmp_path / "large.yml").write_bytes(b" " * 5_000_001)
    (tmp_path / "gone.svg").symlink_to(tmp_path / "absent.svg")
    names = [path.name for path in maps_in(tmp_path)]
    assert names == ["large.yml", "own.json", "tagged.yaml", "two.yaml"]
    for name in set(names) - {"own.json"}:
        with pytest.raises(PalpateError):
            read_map(tmp_path / name)


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
        ({"cell": 1e-5}, "cells of"),
        ({"cell": 1e200}, "cells of"),
        ({"cell": 1e-3}, "at most 4,000,000"),
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
    with pytest.raises(PalpateError, match="no movable 'b'; there are: 'a'"):
        world.moved({"b": (1.0, 1.0, 0.0)})
    moved = world.moved({"a": (1.0, 1.0, 0.5)}, start=(2.0, 2.0, 0.0))
    assert moved.movables["a"].pose == (1.0, 1.0, 0.5)
    assert moved.start == (2.0, 2.0, 0.0)
    assert Robot(0.2).reach is None
