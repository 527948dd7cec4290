"""Maps of ROS, namosim's drawings over them, and what stands beside a map."""

import json
import math
import zlib
from pathlib import Path

import numpy as np
import pytest
import shapely
from PIL import Image

from namo_grids import AGENT, BESIDE, CORNERS, LAYERS, SQUARE, namosim_map, room, ros_map
from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.maps.files import maps_in, read_map
from palpate.planning.movable_obstacles.maps.ros import walls_of

DATA = Path(__file__).parents[3] / "shared" / "data" / "namo_scenarios"


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
    strict = ros_map(tmp_path, pixels, occupied_thresh=0.1, free_thresh=0.9)
    assert read_map(strict).walls.area == pytest.approx(area + 0.01)
    unknown = read_map(ros_map(tmp_path, pixels, free_thresh=0.19)).walls.area
    assert unknown == pytest.approx(area + 0.01)
    assert read_map(ros_map(tmp_path, pixels, free_thresh=0.25)).walls.area == pytest.approx(area)
    negated = ros_map(tmp_path, 255 - room(), negate=1)
    assert read_map(negated).walls.area == pytest.approx(area)
    raw = np.where(room() == 0, 100, 0).astype(np.uint8)
    raw[5, 5] = 255  # unknown
    assert read_map(ros_map(tmp_path, raw, mode="raw")).walls.area == pytest.approx(area + 0.01)


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("palette", [False, True])
def test_what_is_transparent_is_not_known_to_be_free(tmp_path, mode, palette):
    white = np.zeros if mode == "raw" else lambda shape, dtype: np.full(shape, 255, dtype)
    pixels = white((20, 40, 4), np.uint8)
    pixels[..., 3] = 255
    pixels[2:4, 2:5, 3] = 0
    path = ros_map(tmp_path, pixels, ".png", mode=mode)
    if palette:
        indices = np.where(pixels[..., 3] == 0, 0, 1).astype(np.uint8)
        picture = Image.fromarray(indices, "P")
        picture.putpalette([*pixels[0, 0, :3].tolist()] * 2)
        picture.save(path.with_suffix(".png"), transparency=0)
    assert read_map(path).walls.bounds == pytest.approx((0.2, 1.6, 0.5, 1.8))


@pytest.mark.parametrize("key", ["occupied_thresh", "free_thresh"])
@pytest.mark.parametrize("value", [65, -0.1, 19.6])
def test_thresholds_in_per_cent_are_refused(tmp_path, key, value):
    with pytest.raises(PalpateError, match=f"the {key} .*expected a share, 0 to 1"):
        read_map(ros_map(tmp_path, room(), **{key: value}))


def test_suffixes_may_be_in_capitals(tmp_path):
    path = ros_map(tmp_path, room())
    (tmp_path / "place.movables.json").rename(tmp_path / "PLACE.movables.json")
    assert read_map(path.rename(tmp_path / "PLACE.YAML")).name == "PLACE"


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
        ({"negate": "maybe"}, "negate of .* is 'maybe': expected 0, 1, true or false"),
        ({"negate": 2}, "negate of .* is 2"),
        ({"negate": []}, "negate"),
        ({"origin": [0, 0, 0.3]}, "yaw of 0.3: expected 0"),
        ({"origin": [0, 0, "0 rad"]}, "number"),
        ({"image": "\0"}, "no picture"),
    ],
)
def test_a_map_server_file_that_makes_no_sense_is_refused(tmp_path, keys, says):
    with pytest.raises(PalpateError, match=says):
        read_map(ros_map(tmp_path, room(), **keys))


@pytest.mark.parametrize(
    ("text", "negated"),
    [
        *((word, False) for word in ("0", "false", "False", "no", "No", "off", "'no'", "FALSE")),
        *((word, True) for word in ("1", "true", "True", "yes", "YES", "on", "'On'")),
    ],
)
def test_negate_is_a_truth_in_any_yaml(tmp_path, text, negated):
    area = read_map(ros_map(tmp_path, room())).walls.area
    path = ros_map(tmp_path, 255 - room() if negated else room())
    path.write_text(f"{path.read_text()}\nnegate: {text}\n")
    assert read_map(path).walls.area == pytest.approx(area)


def test_a_yaw_of_rounding_is_none(tmp_path):
    assert read_map(ros_map(tmp_path, room(), origin=[0, 0, -1e-4])).bounds[0] == 0


def test_a_picture_too_large_says_so(tmp_path):
    path = ros_map(tmp_path, np.zeros((2001, 2001), np.uint8), ".png")
    with pytest.raises(PalpateError, match="2001 x 2001 pixels: expected at most 4,000,000"):
        read_map(path)
    for side in (10_000, 60_000):  # Pillow warns of the one and refuses the other
        (tmp_path / "place.png").write_bytes(f"P5 {side} {side} 255\n".encode())
        with pytest.raises(PalpateError, match=r"pixels: expected|no picture"):
            read_map(path)


def test_a_broken_picture_is_refused(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (90, 90), np.uint8)
    path = ros_map(tmp_path, noise, ".png")
    picture = tmp_path / "place.png"
    whole = picture.read_bytes()
    begin, half = whole.index(b"IDAT"), 2000
    some = whole[begin + 4 : begin + 4 + half]
    chunk = half.to_bytes(4, "big") + b"IDAT" + some + zlib.crc32(b"IDAT" + some).to_bytes(4, "big")
    no_chunk = whole[: begin - 4] + chunk + b"\0\0\0\4\xff\xff\xff\xff" + bytes(8)
    for bad in (whole[: len(whole) // 2], whole[:begin], no_chunk, b"P5 3 3 255 a", b""):
        picture.write_bytes(bad)
        with pytest.raises(PalpateError, match="no picture that can be read"):
            read_map(path)


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
        (BESIDE | {"walls": []}, "unknown key 'walls'; there are: cell_size, goals"),
        (BESIDE | {"bounds": [0, 0, 1, 1]}, "unknown key 'bounds'"),
        (BESIDE | {"movables": {"a": {"hints": {}}}}, "movable 'a' .* lacks its polygon"),
        (
            BESIDE | {"movables": {"a": {"polygon": CORNERS, "hints": 3}}},
            "hints of .*: expected keys and values, not 3",
        ),
        (BESIDE | {"start": [10**400, 1]}, "start is"),
        (BESIDE | {"robot": {"radius": 10**400}}, "radius .* number"),
        (BESIDE | {"cell_size": 10**400}, "cell_size .* number"),
        (BESIDE | {"movables": {"a": [[0, 0], [10**400, 0], [0, 1]]}}, "no list of corners"),
        (BESIDE | {"cell_size": 1e200}, "expected a size of"),
        (BESIDE | {"cell_size": 1e-200}, "expected a size of"),
        (BESIDE | {"margin": 1e200}, "margin"),
    ],
)
def test_a_side_car_that_makes_no_sense_is_refused(tmp_path, beside, says):
    with pytest.raises(PalpateError, match=says):
        read_map(ros_map(tmp_path, room(), beside=beside))


def test_a_map_has_one_side_car(tmp_path):
    path = ros_map(tmp_path, room())
    (tmp_path / "place.movables.yaml").write_text("start: [1, 1]")
    with pytest.raises(PalpateError, match="expected one of them"):
        read_map(path)


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
    turned = math.cos(0.3), math.sin(0.3)
    x, y = 0.8 / 3, 0.2 / 3  # its centroid, from the corner that is at the pose
    centre = (2 + turned[0] * x - turned[1] * y, 1 + turned[1] * x + turned[0] * y, 0.3)
    assert world.movables["cart"].pose == pytest.approx(centre)
    corners = [[2, 1], [2 + 0.4 * turned[0], 1 + 0.4 * turned[1]]]
    for corner in corners:
        assert world.movables["cart"].polygon.distance(shapely.Point(corner)) < 1e-9
    assert world.movables["cart"].hints == {"wheels": 2}
    assert world.goals == ()
    with pytest.raises(PalpateError, match="has no goal"):
        world.check()


# --- drawings ---------------------------------------------------------------------------------


def test_a_drawing_lies_on_the_picture_wherever_its_origin_is(tmp_path):
    world = read_map(namosim_map(tmp_path))
    assert world.bounds == pytest.approx((-1.0, 2.0, 3.0, 4.0))
    assert world.movables["box"].pose == pytest.approx((1.2, 3.4, 0.0))
    assert world.goals == (pytest.approx((2.2, 2.8, 0.0)),)
    assert world.start == pytest.approx((0.0, 3.0, math.pi / 2))
    assert world.check() == world.goals[0]


def test_goals_are_those_of_the_robot(tmp_path):
    goals = "".join(
        f'<path id="g{k}" {whose} angle="90" d="{SQUARE.format(4 + 6 * k, 10)}"/>'
        for k, whose in enumerate(('agent_id="a"', 'agent_id="b"', ""))
    )
    world = read_map(namosim_map(tmp_path, f'<g id="goals_layer">{goals}</g>'))
    assert [goal[0] for goal in world.goals] == pytest.approx([-0.4, 0.8])
    assert world.goals[0][2] == pytest.approx(math.pi / 2)


def test_other_agents_and_drawn_walls_stand_in_the_way(tmp_path):
    other = AGENT | {"id": "b", "initial_pose": [2.0, 3.0]}
    drawn = f'<path id="w" type="wall" d="{SQUARE.format(30, 10)}"/>'
    world = read_map(namosim_map(tmp_path, drawn, agents=[AGENT, other]))
    assert world.walls.distance(shapely.Point(2.0, 3.0)) == 0
    assert world.walls.distance(shapely.Point(2.2, 2.8)) == 0


@pytest.mark.parametrize(
    ("keys", "margin"),
    [
        ({"collision_margin_cm": 20}, 0.2),
        ({"collision_margin_cm": 0}, 0.1),  # namosim takes 0 as not given
        ({"collision_margin_cm": None}, 0.1),
        ({"collision_margin": 0.25}, 0.25),
        ({"collision_margin": 0}, 0.0),
        ({}, 0.1),
    ],
)
def test_the_margin_is_the_files_or_a_cell(tmp_path, keys, margin):
    assert read_map(namosim_map(tmp_path, **keys)).margin == pytest.approx(margin)


def test_an_agent_may_be_drawn_instead_of_having_a_pose(tmp_path):
    drawn = f'<path id="r" agent_id="a" angle="90" d="{SQUARE.format(8, 8)}"/>'
    other = f'<path id="q" agent_id="b" d="{SQUARE.format(2, 2)}"/>'
    layers = f'{LAYERS}<g id="robots_layer">{other}{drawn}</g>'
    world = read_map(namosim_map(tmp_path, layers, agents=[{"id": "a", "radius": 0.2}]))
    assert world.start == pytest.approx((0.0, 3.0, math.pi / 2))
    side = np.ptp(world.robot.outline, axis=0)
    assert world.robot.radius == pytest.approx(np.hypot(*side) / 2)  # as namosim: what is drawn


@pytest.mark.parametrize("where", [{}, {"behavior": {"parameters": {"push_only": True}}}])
def test_an_agent_may_only_push(tmp_path, where):
    agent = AGENT | (where or {"push_only": True})
    assert read_map(namosim_map(tmp_path, agents=[agent])).robot.push_only
    assert not read_map(namosim_map(tmp_path)).robot.push_only


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"agents": [AGENT | {"initial_pose": 3}]}, "initial_pose .*: expected .* not 3"),
        ({"agents": [AGENT | {"initial_pose": [1]}]}, "initial_pose .*: expected"),
        ({"agents": [AGENT | {"initial_pose": [1, 2, 3, 4]}]}, "initial_pose .*: expected"),
        ({"agents": [AGENT | {"initial_pose": [1, 1e30]}]}, "initial_pose"),
        ({"agents": [AGENT | {"behavior": "stilman"}]}, "behavior .*: expected .* not 'stilman'"),
        ({"agents": [AGENT | {"behavior": {"parameters": 3}}]}, "parameters .*: expected .* not 3"),
        ({"agents": [{"id": "a", "radius": 1}]}, "'a' without an initial_pose: .* robots_layer"),
        ({"agents": [{"id": "a", "initial_pose": [0, 3]}]}, "an agent without radius"),
        ({"agents": [AGENT, 3]}, "an agent in .*: expected .* not 3"),
        ({"agents": [AGENT | {"push_only": "maybe"}]}, "push_only .* is 'maybe'"),
        ({"collision_margin_cm": "oops"}, "collision_margin_cm .* is 'oops'"),
        ({"agents": {}}, "no agents"),
        ({"layers": LAYERS.replace("agent_id", 'angle="90deg" agent_id')}, "angle .* '90deg'"),
        ({"layers": LAYERS.replace("<path", "<rect")}, "Object to Path"),
        ({"layers": LAYERS.replace("z", "z m 1 1 h 1 v 1 z", 1)}, "2 outlines"),
    ],
)
def test_a_namosim_yaml_that_makes_no_sense_is_refused(tmp_path, keys, says):
    with pytest.raises(PalpateError, match=says):
        read_map(namosim_map(tmp_path, **keys))


SCENARIO = """<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 400 200'>
<namo_config cell_size_cm="10"><agent agent_id="a"/></namo_config>
<path id="a" type="shape" d="M 80 80 h 40 v 40 h -40 z"/>
<path id="box" type="movable" d="M 200 80 h 40 v 40 h -40 z"/></svg>"""


@pytest.mark.parametrize("kind", ["svg", "namosim"])
@pytest.mark.parametrize(
    ("beside", "says"),
    [
        ({"movables": {"box": {"hints": {"wheels": 2}}}}, None),
        ({}, None),
        ({"movables": {"box": {}}}, None),
        ({"movables": []}, "movables in the side-car of .* of type list"),
        ({"movables": {"box": {"hints": 3}}}, "hints of 'box' .*: expected .* not 3"),
        ({"movables": {"box": 3}}, "movable 'box' .*: expected .* not 3"),
        (
            {"movables": {"desk": {"hints": {}}}},
            "'desk', which is not on the map; there are: 'box'",
        ),
        ({"movables": {"box": {"polygon": CORNERS}}}, "unknown key 'polygon'; there are: hints"),
        ({"robot": {"radius": 1}}, "unknown key 'robot'; there are: movables"),
        ({"start": [1, 1]}, "unknown key 'start'"),
    ],
)
def test_a_side_car_of_a_drawing_gives_hints_and_nothing_else(tmp_path, kind, beside, says):
    path = namosim_map(tmp_path, beside=beside)
    if kind == "svg":
        path = tmp_path / "drawn.svg"
        path.write_text(SCENARIO)
        (tmp_path / "drawn.movables.json").write_text(json.dumps(beside))
    if says is None:
        hints = beside.get("movables", {}).get("box", {}).get("hints", {})
        assert dict(read_map(path).movables["box"].hints) == hints
    else:
        with pytest.raises(PalpateError, match=says):
            read_map(path)


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
