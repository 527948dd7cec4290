"""Reading namosim's drawings, and refusing what is none."""

import math
from pathlib import Path

import numpy as np
import pytest
import shapely

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.maps.svg import read_svg
from palpate.planning.movable_obstacles.maps.svg_paths import path_outlines, transform_matrix

DATA = Path(__file__).parents[3] / "shared" / "data" / "namo_scenarios"
CONFIG = """<namo_config cell_size_cm="10"{extra}><agent agent_id="robot_0">
<goal goal_id="goal_0"/><behavior type="stilman_2005_behavior"><parameters {drive}/></behavior>
</agent></namo_config>"""
BODY = """<path id="robot_0" type="shape" d="M 80 80 h 40 v 40 h -40 z"/>
<path id="goal_0" type="shape" d="M 480 80 h 40 v 40 h -40 z"/>
<path id="box" type="movable" d="M 280 60 L 340 60 340 140 H 280 Z"/>
<path id="wall" type="wall" d="M 0 0 H 600 v 10 h -600 z"/>"""


def drawing(
    folder: Path, body=BODY, config=CONFIG, extra="", drive="", head="", attributes=""
) -> Path:
    config = config.format(extra=extra, drive=drive)
    path = folder / "map.svg"
    path.write_text(
        f"{head}<svg xmlns='http://www.w3.org/2000/svg' xmlns:svg='http://www.w3.org/2000/svg' "
        f"viewBox='0 0 600 200' width='4cm' height='none' {attributes}>{config}{body}</svg>"
    )
    return path


def test_units_are_centimetres_of_the_view_box_and_y_points_up(tmp_path):
    world = read_svg(drawing(tmp_path))
    assert world.bounds == (0.0, 0.0, 6.0, 2.0)
    assert world.start == pytest.approx((1.0, 1.0, 0.0))
    assert world.goals[0] == pytest.approx((5.0, 1.0, 0.0))
    assert world.movables["box"].pose == pytest.approx((3.1, 1.0, 0.0))
    assert world.robot.radius == pytest.approx(0.2 * math.sqrt(2))
    assert world.robot.drive == "differential"
    assert (world.cell_size, world.margin) == (0.1, 0.1)
    assert shapely.get_parts(world.walls)[0].bounds == pytest.approx((0.0, 1.9, 6.0, 2.0))
    assert world.movables["box"].polygon.area == pytest.approx(0.6 * 0.8)


def test_margin_drive_and_angle_are_read(tmp_path):
    body = BODY.replace('id="goal_0"', 'id="goal_0" angle="90"')
    path = drawing(
        tmp_path, body, extra=' collision_margin_cm="2.5"', drive='drive_type="holonomic"'
    )
    world = read_svg(path)
    assert world.margin == pytest.approx(0.025)
    assert world.robot.drive == "holonomic"
    assert world.goals[0][2] == pytest.approx(math.pi / 2)


def test_a_margin_of_nothing_is_a_cell_as_namosim_takes_it(tmp_path):
    assert read_svg(drawing(tmp_path, extra=' collision_margin_cm="0"')).margin == 0.1


@pytest.mark.parametrize(("said", "only"), [("true", True), ("1", True), ("False", False)])
def test_who_only_pushes_is_read(tmp_path, said, only):
    assert read_svg(drawing(tmp_path, drive=f'push_only="{said}"')).robot.push_only is only
    with pytest.raises(PalpateError, match=r"push_only .* 'perhaps'"):
        read_svg(drawing(tmp_path, drive='push_only="perhaps"'))


def test_a_layer_is_known_by_its_label_too(tmp_path):
    layer = '<g id="layer3" label="movables_layer"><path id="box"'
    body = BODY.replace('<path id="box" type="movable"', layer)
    world = read_svg(drawing(tmp_path, body.replace('H 280 Z"/>', 'H 280 Z"/></g>')))
    assert list(world.movables) == ["box"]


def test_what_the_configuration_names_is_to_be_a_path(tmp_path):
    body = BODY.replace(
        '<path id="robot_0" type="shape" d="M 80 80 h 40 v 40 h -40 z"/>',
        '<circle id="robot_0" r="20"/>',
    )
    with pytest.raises(PalpateError, match=r"circle 'robot_0' .* make it a path"):
        read_svg(drawing(tmp_path, body))


def test_prefixed_paths_groups_and_transforms_are_understood(tmp_path):
    body = BODY.replace("<path", "<svg:path")
    moved = f'<g transform="translate(100, 20)"><g transform="scale(0.5)">{body}</g></g>'
    world = read_svg(drawing(tmp_path, moved))
    assert world.start == pytest.approx((1.5, 2.0 - 0.2 - 0.5, 0.0))
    assert world.movables["box"].polygon.area == pytest.approx(0.25 * 0.48)


def test_old_groups_of_the_robots_name_hold_its_shape_and_direction(tmp_path):
    body = BODY.replace('<path id="robot_0"', '<g id="robot_0"><path id="shape"', 1)
    body = body.replace(
        'v 40 h -40 z"/>', 'v 40 h -40 z"/><path type="orientation" d="M 100 100 V 40"/></g>', 1
    )
    world = read_svg(drawing(tmp_path, body))
    assert world.start == pytest.approx((1.0, 1.0, math.pi / 2), abs=0.2)


def test_layers_stand_in_for_missing_types(tmp_path):
    body = BODY.replace(' type="movable"', "")
    body = body.replace('<path id="box"', '<g id="movables_layer"><path id="box"')
    body = body.replace('H 280 Z"/>', 'H 280 Z"/></g>')
    assert list(read_svg(drawing(tmp_path, body)).movables) == ["box"]


# Of radius 10; the handles of the second and the fourth quarter mirror those before.
CIRCLE = "M 10 0 C 10 5.5228 5.5228 10 0 10 S -10 5.5228 -10 0 -5.5228 -10 0 -10 10 -5.5228 10 0"


@pytest.mark.parametrize(
    ("d", "area"),
    [
        ("M 0,0 10,0 10,10 0,10 Z", 100.0),
        ("m 0 0 10 0 0 10 -10 0 z", 100.0),
        ("M0 0H10V10H0Z", 100.0),
        ("m0 0h10v10h-10z", 100.0),
        ("M 0 0 L 1e1,0 L 10 10 L 0 10", 100.0),
        (CIRCLE, 100 * math.pi),
        ("M 0 0 Q 5 10 10 0 Z", 100 / 3),
        ("M 0 0 q 5 10 10 0 t 10 0 z", 0.0),
        ("m 10 0 a 10 10 0 0 1 -20 0 10 10 0 0 1 20 0 z", 100 * math.pi),
        ("M 10 0 A 10 10 0 0 0 -10 0 A 10 10 0 0 0 10 0 Z", 100 * math.pi),
        ("M 0 0 h 10 v 10 h -10 z M 20 20 h 1 v 1 z", 100.5),
        ("M 0 0 h 10 v 10 h -10 z m 20 20 h 1 v 1 z h -1 v -1 z", 101.0),
        ("M 3 3 M 0 0 h 10 v 10 h -10 z m 20 20", 100.0),
    ],
)
def test_every_path_command_is_drawn(d, area):
    shoelaces = []
    for points in path_outlines(d, "it"):
        x, y = points.T
        shoelaces.append(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)
    assert sum(shoelaces) == pytest.approx(area, rel=0.02, abs=1e-9)


def test_an_outline_begins_where_the_one_before_was_closed():
    first, second, third = path_outlines("m 1 2 h 4 v 4 z m 10 20 h 1 v 1 z h 5 v 5 z", "it")
    np.testing.assert_array_equal(first, [[1, 2], [5, 2], [5, 6]])
    np.testing.assert_array_equal(second, [[11, 22], [12, 22], [12, 23]])
    np.testing.assert_array_equal(third, [[11, 22], [16, 22], [16, 27]])


@pytest.mark.parametrize(
    ("end", "flags", "degrees"),
    [
        ("0 10", "0 1", 90),
        ("-10 0", "1 1", 180),
        ("0 -10", "1 1", 270),
        (f"{10 * math.cos(0.5)} {10 * math.sin(0.5)}", "0 1", math.degrees(0.5)),
        (f"{10 * math.cos(1e-4)} {10 * math.sin(1e-4)}", "0 1", math.degrees(1e-4)),
    ],
)
def test_an_arc_has_twelve_chords_for_every_quarter_of_a_circle(end, flags, degrees):
    (points,) = path_outlines(f"M 10 0 A 10 10 0 {flags} {end}", "it")
    assert len(points) == 1 + max(1, math.ceil(12 * degrees / 90 - 1e-4))
    middles = np.linalg.norm((points[1:] + points[:-1]) / 2, axis=1)
    assert middles.min() >= 10 * math.cos(math.pi / 48) - 1e-9
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 10, atol=1e-9)


@pytest.mark.parametrize(
    ("compact", "apart"),
    [
        ("A 5 5 0 01-20 20", "A 5 5 0 0 1 -20 20"),
        ("A5,5,0,0120,20 5 5 0 1010-10", "A 5 5 0 0 1 20 20 5 5 0 1 0 10 -10"),
        ("a 5 5 0 0,1.5 7 5 5 0 1.0 0 1 1", "a 5 5 0 0 1 .5 7 5 5 0 1 0 1 1"),
    ],
)
def test_flags_of_arcs_may_stand_without_spaces(compact, apart):
    (points,), (expected,) = (path_outlines(f"M 10 0 {d}", "it") for d in (compact, apart))
    assert points == pytest.approx(expected)


def test_a_small_arc_far_from_the_origin_is_drawn():
    (points,) = path_outlines("M 100000 0 a 0.2 0.2 0 0 1 0.4 0 z", "it")
    assert len(points) == 25


def test_transforms_multiply_in_the_order_written():
    matrix = transform_matrix("translate(10,5) rotate(90) scale(2 3) skewX(0)", "it")
    assert matrix @ [1, 1, 1] == pytest.approx([10 - 3, 5 + 2, 1])
    about = transform_matrix("rotate(180, 5, 5) matrix(1 0 0 1 1 0)", "it")
    assert about @ [0, 0, 1] == pytest.approx([9, 10, 1])


BOMB = """<!DOCTYPE svg [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;">]>"""
OUTSIDE = '<!DOCTYPE svg [<!ENTITY x SYSTEM "file:///etc/passwd">]>'


@pytest.mark.parametrize("head", [BOMB, OUTSIDE])
def test_entities_are_refused(tmp_path, head):
    with pytest.raises(PalpateError, match="entities"):
        read_svg(drawing(tmp_path, BODY + "<title>&c;</title>", head=head))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 L 340 140 340 60 280 140 Z"), "cross"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 L 340 60"), "3 or more"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 L 340 60 400 60 Z"), "area|simple"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 L 1e9 60 340 140 H 280 Z"), "no place"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 R 3"), "commands"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "L 280 60"), "begin with M"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 L 340"), "too few"),
        (('type="movable"', 'type="movable" transform="spin(3)"'), "transform"),
        (('type="movable"', 'type="movable" transform="matrix(1 2)"'), "transform"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 L 1e999 60 340 140 Z"), "number that"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 A 9 9 0 2 0 340 60 Z"), "flags"),
        (('type="movable"', 'type="movable" transform="scale(nan)"'), "transform"),
        (('type="movable"', 'type="movable" transform="scale(1e8) scale(1e8)"'), "transform"),
        (('type="movable"', 'type="movable" transform="rotate(inf)"'), "transform"),
        (('type="movable"', 'type="movable" transform="rotate(9, 1e308, inf)"'), "transform"),
        (('type="movable"', 'type="moveable"'), "type 'moveable': expected wall, movable"),
        (('id="robot_0"', 'id="robot_1"'), "no agent 'robot_0'"),
        (('id="goal_0"', 'id="goal_1"'), "no goal 'goal_0'"),
        (('id="goal_0"', 'id="goal_0" angle="90deg"'), "angle .* is '90deg'"),
        (('id="wall" type="wall"', 'id="box" type="movable"'), "two movables"),
    ],
)
def test_what_is_wrong_with_a_drawing_is_said_in_a_sentence(tmp_path, change, says):
    with pytest.raises(PalpateError, match=says):
        read_svg(drawing(tmp_path, BODY.replace(*change)))


RECT = '<rect id="box_2" {0} x="1" y="1" width="9" height="9"/>'
LAYER = '<g id="{0}">' + RECT.format("") + "</g>"
CLONED = (
    '<g id="layer1"><use id="u" xlink:href="#{0}" xmlns:xlink="http://www.w3.org/1999/xlink"/></g>'
)


@pytest.mark.parametrize(
    "more",
    [
        *(RECT.format(f'type="{kind}"') for kind in ("wall", "movable", "shape", "orientation")),
        '<polygon id="a" type="wall" points="0,0 9,0 9,9"/>',
        '<circle id="a" type="movable" r="3"/>',
        '<g><ellipse id="a" type="wall" rx="3" ry="2"/></g>',
        '<polyline id="a" type="wall" points="0,0 9,0 9,9"/>',
        '<line id="a" type="wall" x2="3"/>',
        '<use id="a" type="wall" href="#wall"/>',
        *(LAYER.format(layer) for layer in ("movables_layer", "goals_layer", "robots_layer")),
        '<g id="movables_layer"><g><a>' + RECT.format("") + "</a></g></g>",
        '<g id="movables_layer"><a><path id="b" d="M 0 0 h 9 v 9 z"/></a></g>',
        '<a><path id="b" type="wall" d="M 0 0 h 9 v 9 z"/></a>',
        '<switch><g id="movables_layer"><path id="b" d="M 0 0 h 9 v 9 z"/></g></switch>',
        '<g type="wall"><path id="b" d="M 0 0 h 9 v 9 z"/></g>',
        CLONED.format("wall"),
        '<g id="movables_layer"><path id="b" d="M 0 0 h 9 v 9 z"/></g>' + CLONED.format("b"),
        '<defs><path id="b" type="wall" d="M 0 0 h 9 v 9 z"/></defs>' + CLONED.format("b"),
    ],
)
def test_what_is_part_of_the_map_but_no_path_is_refused(tmp_path, more):
    with pytest.raises(PalpateError, match=r"only paths in groups are read.*Object to Path"):
        read_svg(drawing(tmp_path, BODY + more))


def test_decoration_is_passed_over(tmp_path):
    more = RECT.format("") + '<g id="layer1"><circle id="c" r="3"/><text>wall</text></g>'
    more += '<defs><g id="d"/><path id="q" type="wall" d="M 0 0 h 9 v 9 z"/></defs>'
    more += '<use href="#c"/><path id="ink" d="M 0 0 L 1e999 R 5 h 3 M 4 4"/>'
    more += '<namedview><grid type="xygrid"/></namedview><g id="movables_layer"><text>a</text></g>'
    world = read_svg(drawing(tmp_path, BODY + more))
    plain = read_svg(drawing(tmp_path))
    assert world.walls.equals(plain.walls)
    assert list(world.movables) == ["box"]


@pytest.mark.parametrize(
    ("d", "area"),
    [
        ("M 0 0 h 100 v 100 h -100 z M 20 20 h 30 v 30 h -30 z", 1.0 - 0.09),  # a hole
        ("M 0 0 h 100 v 100 h -100 z M 20 20 v 30 h 30 v -30 z", 1.0 - 0.09),
        ("M 0 0 h 100 v 100 h -100 z m 20 20 h 30 v 30 h -30 z m 10 10 h 5 v 5 h -5 z", 0.9125),
        ("M 0 0 h 100 v 100 h -100 z M 200 0 h 30 v 30 h -30 z M 300 0 h 10 v 10 h -10 z", 1.1),
        ("M 0 0 h 100 v 100 h -100 z M 20 0 h 30 v 30.00000001 h -30 z", 1.0 - 0.09),
        ("M 0 0 h 100 v 100 h -100 z M 20 -0.00000001 h 30 v 30 h -30 z", 1.0 - 0.09),
    ],
)
def test_all_outlines_of_a_wall_count(tmp_path, d, area):
    body = BODY.replace("M 0 0 H 600 v 10 h -600 z", d)
    walls = read_svg(drawing(tmp_path, body)).walls
    assert walls.area == pytest.approx(area, abs=1e-6)
    assert all(part.area > 1e-3 for part in shapely.get_parts(walls))


SECOND = " M 0 0 h 3 v 3 h -3 z"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("H 280 Z", "H 280 Z" + SECOND, "path 'box' of .* has 2 outlines: expected one"),
        ('id="robot_0" type="shape" d="', f'id="robot_0" type="shape" d="{SECOND}', "robot_0"),
        ('id="goal_0" type="shape" d="', f'id="goal_0" type="shape" d="{SECOND}', "goal_0"),
        ("v 10 h -600 z", "v 10 h -600 z M 50 5 h 9 v 9 h -9 z", "wall 'wall' .* overlap"),
    ],
)
def test_outlines_too_many_are_refused(tmp_path, old, new, says):
    assert old in BODY
    with pytest.raises(PalpateError, match=says):
        read_svg(drawing(tmp_path, BODY.replace(old, new)))


@pytest.mark.parametrize(
    ("d", "degrees"),
    [
        ("M 103 92 V 40", 90),  # beside the middle, as namosim's own are
        ("M 100 100 H 150 L 140 95 H 150 z", 0),
        ("M 100 100 h 0 v 10", -90),
    ],
)
def test_a_direction_is_that_of_its_first_line(tmp_path, d, degrees):
    arrow = f'<path id="way" type="orientation" d="{d}"/></g>'
    body = BODY.replace('<path id="robot_0"', '<g id="robot_0"><path id="shape"', 1)
    body = body.replace('v 40 h -40 z"/>', f'v 40 h -40 z"/>{arrow}', 1)
    assert read_svg(drawing(tmp_path, body)).start[2] == pytest.approx(math.radians(degrees))


def test_a_direction_has_one_outline(tmp_path):
    body = BODY.replace('<path id="robot_0"', '<g id="robot_0"><path id="shape"', 1)
    arrow = '<path id="way" type="orientation" d="M 100 100 V 40 M 0 0 H 9"/></g>'
    with pytest.raises(PalpateError, match=r"path 'way' .* has 2 outlines"):
        read_svg(drawing(tmp_path, body.replace('v 40 h -40 z"/>', f'v 40 h -40 z"/>{arrow}', 1)))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('agent_id="robot_0"', 'agent_id=""'),
        ('agent_id="robot_0"', ""),
        ('goal_id="goal_0"', 'goal_id=""'),
        ('goal_id="goal_0"', ""),
        ("</namo_config>", "<agent/></namo_config>"),
    ],
)
def test_an_empty_id_names_nothing(tmp_path, old, new):
    unnamed = '<g><path type="shape" d="M 80 20 h 40 v 40 h -40 z"/></g>'
    with pytest.raises(PalpateError, match="without an id"):
        read_svg(drawing(tmp_path, BODY + unnamed, CONFIG.replace(old, new)))


def test_a_path_without_an_id_is_not_found_by_the_name_it_gets(tmp_path):
    config = CONFIG.replace('"goal_0"', '"path_4"')
    unnamed = '<path type="shape" d="M 80 20 h 40 v 40 h -40 z"/>'
    with pytest.raises(PalpateError, match="no goal 'path_4'"):
        read_svg(drawing(tmp_path, BODY + unnamed, config))


def test_long_names_are_cut_in_sentences(tmp_path):
    with pytest.raises(PalpateError, match="two movables") as caught:
        read_svg(
            drawing(
                tmp_path, BODY + 2 * f'<path id="{"x" * 999}" type="movable" d="M 0 0 h 9 v 9 z"/>'
            )
        )
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("text", ["1e200", "1e-200", "1e5", "1e-5"])
def test_cells_are_of_a_size_for_a_room(tmp_path, text):
    path = drawing(tmp_path, config=CONFIG.replace('cm="10"', f'cm="{text}"'))
    with pytest.raises(PalpateError, match=r"expected a size of 0\.0001 to 100 m"):
        read_svg(path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no XML"),
        ("not a drawing", "no XML"),
        ("<html/>", "expected <svg>"),
        ("<svg/>", "viewBox"),
        ("<svg viewBox='0 0 nan 3'/>", "number"),
        ("<svg viewBox='0 0 0 3'/>", "above 0"),
        ("<svg viewBox='0 0 3'/>", "width, height"),
        ("<svg viewBox='0 0 9 9'/>", "namo_config"),
        ("<svg viewBox='0 0 9 9'><namo_config/></svg>", "cell_size_cm"),
        ("<svg viewBox='0 0 9 9'><namo_config cell_size_cm='1'/></svg>", "agent"),
        ("<svg viewBox='0 0 9 9'>" + "<g>" * 100 + "</g>" * 100 + "</svg>", "deep"),
    ],
)
def test_a_file_that_is_no_scenario_is_refused(tmp_path, text, says):
    path = tmp_path / "map.svg"
    path.write_text(text)
    with pytest.raises(PalpateError, match=says):
        read_svg(path)


def test_a_huge_drawing_says_which_cell_size_would_do(tmp_path):
    path = drawing(tmp_path)
    path.write_text(path.read_text().replace("0 0 600 200", "0 0 6000000 2000000"))
    with pytest.raises(PalpateError, match=r"cells of .* m or more"):
        read_svg(path)


@pytest.mark.skipif(not DATA.is_dir(), reason="the scenarios are not in this checkout")
@pytest.mark.parametrize(
    ("name", "size", "movables", "radius"),
    [
        ("minimal_stilman_2005", (1.5, 1.5), 1, 0.07),
        ("obstacle_on_goal", (1.5, 1.5), 1, 0.07),
        ("1_robot_2_rooms", (11.9, 7.5), 1, 0.60),
        ("1_robot_2_obstacles", (15.3, 13.5), 2, 0.60),
        ("namoros_demo_map", (15.0, 10.0), 1, 0.20),
    ],
)
def test_namosims_own_scenarios_are_read(name, size, movables, radius):
    world = read_svg(DATA / f"{name}.svg")
    assert world.bounds[2:] == pytest.approx(size, abs=0.05)
    assert len(world.movables) == movables
    assert world.robot.radius == pytest.approx(radius, abs=0.005)
    assert world.margin == world.cell_size
    world.check()
