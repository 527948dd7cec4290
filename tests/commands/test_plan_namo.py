"""`palpate plan namo`: what is written and said."""

import json
import math

import numpy as np
import pytest
from PIL import Image

from namo_rooms import IN_DOOR, two_rooms, write_map
from palpate.commands.plan import run
from palpate.errors import PalpateError
from palpate.families.furniture import planning
from palpate.families.furniture.options import PlanNamo
from palpate.families.furniture.planning import ANIMATION, PICTURE
from palpate.planning.movable_obstacles.search.plan import read_plan
from palpate.planning.movable_obstacles.search.verification import faults_of


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


def test_a_plan_that_does_not_hold_is_not_handed_over(tmp_path, map_file, monkeypatch):
    monkeypatch.setattr(planning, "faults_of", lambda plan, world: ["the robot flies"])
    with pytest.raises(PalpateError, match="the robot flies"):
        run(PlanNamo(map=map_file, out=tmp_path / "out"))
    assert not (tmp_path / "out" / "plan.json").exists()


def test_what_stands_beside_a_map_decides_whether_a_plan_is_another(tmp_path):
    picture = np.full((60, 80), 255, np.uint8)
    picture[[0, -1]] = picture[:, [0, -1]] = 0
    Image.fromarray(picture).save(tmp_path / "room.png")
    (tmp_path / "room.yaml").write_text("image: room.png\nresolution: 0.1\norigin: [0, 0, 0]\n")
    beside = {"robot": {"radius": 0.25}, "start": [1, 1, 0], "goals": [[6, 4, 0]]}
    for box in (3.0, 4.0):
        corners = [[box, 2], [box + 0.5, 2], [box + 0.5, 2.5], [box, 2.5]]
        text = json.dumps(beside | {"movables": {"box": corners}})
        (tmp_path / "room.movables.json").write_text(text)
        if box == 3.0:
            run(PlanNamo(map=tmp_path / "room.yaml", out=tmp_path / "out"))
    with pytest.raises(PalpateError, match="map"):
        run(PlanNamo(map=tmp_path / "room.yaml", out=tmp_path / "out"))


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"goal": (50.0, 50.0, 0.0)}, "would not be inside"),
        ({"goal": (math.nan, 1.0, 0.0)}, "the goal"),
        ({"immovable": ("door",)}, "no movable 'door'"),
        ({"immovable": ("a",)}, "no way to the goal"),
    ],
)
def test_what_was_refused_can_be_asked_again_in_the_same_folder(tmp_path, map_file, wrong, says):
    with pytest.raises(PalpateError, match=says):
        run(PlanNamo(map=map_file, out=tmp_path / "out", **wrong))
    assert not (tmp_path / "out").exists()
    assert read_plan(run(PlanNamo(map=map_file, out=tmp_path / "out"))).transfers == 1


def test_another_goal_and_fixed_objects_are_heard(tmp_path, map_file):
    path = run(PlanNamo(map=map_file, out=tmp_path / "near", goal=(2.0, 2.0, 0.5)))
    assert json.loads(path.read_text())["goal"] == [2.0, 2.0, 0.5]
    assert read_plan(path).transfers == 0
    with pytest.raises(PalpateError, match="walls or what may not be moved"):
        run(PlanNamo(map=map_file, out=tmp_path / "fixed", immovable=("a",)))
    with pytest.raises(PalpateError, match="no file"):
        run(PlanNamo(map=tmp_path / "absent.svg", out=tmp_path / "none"))
