"""Reading namosim's drawings, and refusing what is none."""

import math
from pathlib import Path

import numpy as np
import pytest
import shapely

from palpate.errors import PalpateError
from palpate.planning.movable_obstacles.map_svg import read_svg
from palpate.planning.movable_obstacles.map_svg_paths import path_points, transform_matrix

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
        ("M 0 0 h 10 v 10 h -10 z M 20 20 h 1 v 1 z", 100.0),
    ],
)
def test_every_path_command_is_drawn(d, area):
    points = path_points(d, "it")
    x, y = points.T
    shoelace = abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2
    assert shoelace == pytest.approx(area, rel=0.02, abs=1e-9)


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
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 L 340 60 400 60 Z"), "no area|simple"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 L 1e99 60 340 140 H 280 Z"), "no place"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 R 3"), "commands"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "L 280 60"), "begin with M"),
        (("M 280 60 L 340 60 340 140 H 280 Z", "M 280 60 L 340"), "too few"),
        (('type="movable"', 'type="movable" transform="spin(3)"'), "transform"),
        (('type="movable"', 'type="movable" transform="matrix(1 2)"'), "transform"),
        (('id="robot_0"', 'id="robot_1"'), "no agent 'robot_0'"),
        (('id="goal_0"', 'id="goal_1"'), "no goal 'goal_0'"),
        (('id="wall" type="wall"', 'id="box" type="movable"'), "two movables"),
    ],
)
def test_what_is_wrong_with_a_drawing_is_said_in_a_sentence(tmp_path, change, says):
    with pytest.raises(PalpateError, match=says):
        read_svg(drawing(tmp_path, BODY.replace(*change)))


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
