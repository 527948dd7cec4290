"""`palpate plan namo`: what is written and said."""

import json

import pytest

from namo_rooms import IN_DOOR, two_rooms
from palpate.errors import PalpateError
from palpate.experiments.namo_options import PlanNamo
from palpate.experiments.plan_namo import ANIMATION, PICTURE, run
from palpate.planning.movable_obstacles.map_description import write_map
from palpate.planning.movable_obstacles.plan import read_plan
from palpate.planning.movable_obstacles.verification import faults_of


@pytest.fixture
def map_file(tmp_path):
    path = tmp_path / "rooms.json"
    write_map(path, two_rooms({"a": IN_DOOR}))
    return path


def test_a_plan_its_picture_and_its_animation_are_written(tmp_path, map_file, capsys):
    out = tmp_path / "out"
    path = run(PlanNamo(map=map_file, out=out))
    assert path == out / "plan.json"
    assert faults_of(read_plan(path), two_rooms({"a": IN_DOOR})) == []
    assert (out / PICTURE).read_bytes().startswith(b"\x89PNG")
    assert (out / ANIMATION).read_bytes().startswith(b"GIF8")
    assert (out / "report.html").exists()
    said = capsys.readouterr().out
    assert "hold 'a' and" in said
    assert "1 transfers" in said
    # asked again it tells the same plan
    written = path.read_text()
    assert run(PlanNamo(map=map_file, out=out)).read_text() == written


def test_another_goal_and_fixed_objects_are_heard(tmp_path, map_file):
    path = run(PlanNamo(map=map_file, out=tmp_path / "near", goal=(2.0, 2.0, 0.5)))
    assert json.loads(path.read_text())["goal"] == [2.0, 2.0, 0.5]
    assert read_plan(path).transfers == 0
    with pytest.raises(PalpateError, match="walls alone"):
        run(PlanNamo(map=map_file, out=tmp_path / "fixed", immovable=("a",)))
    with pytest.raises(PalpateError, match="no file"):
        run(PlanNamo(map=tmp_path / "absent.svg", out=tmp_path / "none"))
