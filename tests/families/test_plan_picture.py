"""Pictures and animations of plans: what is in them, the same each time, and what is refused."""

import io
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image

from namo_rooms import IN_DOOR, two_rooms
from palpate.errors import PalpateError
from palpate.families.furniture.plan_picture import plan_animation, plan_picture, scene_animation
from palpate.planning.movable_obstacles.search.planner import Planner


@pytest.fixture(scope="module")
def planned():
    world = two_rooms({"a": IN_DOOR, "b": (6.0, 0.4, 6.5, 0.9)})
    return world, Planner().plan(world)


def test_a_picture_holds_the_ways_the_objects_and_what_is_believed(planned, tmp_path):
    world, plan = planned
    driven = np.array([[1.0, 1.5], [3.0, 1.6]])
    path = plan_picture(tmp_path / "plan.svg", world, plan, movability={"b": 0.35}, driven=driven)
    drawn = path.read_text()
    for text in ("drives and carries", "start", "goal", "driven", "35%", "x (m)"):
        assert f"<!-- {text} -->" in drawn
    again = plan_picture(tmp_path / "again.svg", world, plan, movability={"b": 0.35}, driven=driven)
    assert again.read_bytes() == path.read_bytes()


def test_a_map_alone_can_be_drawn(planned, tmp_path):
    path = plan_picture(tmp_path / "map.png", planned[0])
    pixels = np.asarray(Image.open(path).convert("RGB"))
    assert pixels.shape[1] > 1000
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 5


def test_an_animation_moves_the_robot_and_then_the_object(planned, tmp_path):
    world, plan = planned
    path = plan_animation(tmp_path / "plan.gif", world, plan, frames=8)
    with Image.open(path) as film:
        assert film.n_frames == 8
        frames = []
        for index in range(8):
            film.seek(index)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
    assert all(np.abs(a - b).sum() > 0 for a, b in pairwise(frames))


def test_poses_of_an_execution_are_shown_with_the_belief_of_each_moment(planned, tmp_path):
    world, _ = planned
    robots = np.array([[1.0, 1.5, 0.0], [1.5, 1.5, 0.3]])
    still = [movable.pose for movable in world.movables.values()]
    objects = np.array([still, [(4.2, 1.5, 0.1), still[1]]])
    path = scene_animation(
        tmp_path / "run.gif", world, (7.0, 1.5, 0.0), robots, objects, [None, "a"],
        movability=[{"a": 0.5}, {"a": 0.9}],
    )  # fmt: skip
    assert Image.open(io.BytesIO(path.read_bytes())).n_frames == 2


@pytest.mark.parametrize(("name", "says"), [("plan.jpg", ".png or .svg"), ("plan", "suffix")])
def test_other_files_are_refused(planned, tmp_path, name, says):
    with pytest.raises(PalpateError, match=says):
        plan_picture(tmp_path / name, *planned)
    with pytest.raises(PalpateError, match=r"\.gif"):
        plan_animation(tmp_path / name, *planned)


def test_a_film_has_at_least_two_pictures(planned, tmp_path):
    with pytest.raises(PalpateError, match="2 or more"):
        plan_animation(tmp_path / "plan.gif", *planned, frames=1)
