"""Every map in a folder: what counts as reached, and what is held against whom."""

import dataclasses
import json

import numpy as np
import pytest

from namo_rooms import IN_DOOR, two_rooms, write_map
from palpate.errors import PalpateError
from palpate.experiments.furniture import namo_scenarios as study
from palpate.planning.movable_obstacles.search.planner import Planner


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch):
    monkeypatch.setattr(study, "plan_picture", lambda *a: None)
    monkeypatch.setattr(study, "plan_animation", lambda *a: None)


def named(result):
    return {figure.name: figure for figure in result.figures}


def test_maps_without_a_rival_are_planned_and_their_figures_given(tmp_path):
    write_map(tmp_path / "maps" / "blocked.json", two_rooms({"a": IN_DOOR}))
    shut = dataclasses.replace(two_rooms({}, doors=()), name="shut")
    write_map(tmp_path / "maps" / "below" / "shut.json", shut)
    result = study.reproduce(tmp_path / "out", quick=True, maps=tmp_path / "maps")
    rows = named(result)
    assert rows["reached_rate"].value == 0.5
    assert rows["reached_rate"].met is False
    assert rows["shut.reached"].value == 0.0
    assert rows["two rooms.transfers"].value == 1
    assert rows["two rooms.distance"].rival is None
    assert rows["speedup_min"].bar is None
    assert rows["planning_s_max"].value > 0
    plan = json.loads((tmp_path / "out" / "two rooms" / "plan.json").read_text())
    assert plan["transfers"] == 1
    assert json.dumps(result.to_dict())


def test_a_map_of_namosims_stands_beside_its_figures(tmp_path):
    world = dataclasses.replace(two_rooms({"a": IN_DOOR}), name="obstacle_on_goal")
    write_map(tmp_path / "obstacle_on_goal.json", world)
    trial = study.plan_map(tmp_path / "obstacle_on_goal.json", tmp_path / "out", 2, 0)
    assert trial.reached
    rows = {figure.name: figure for figure in study.figures([trial])}
    known = study.NAMOSIM["obstacle_on_goal"]
    assert rows["speedup_min"].value == pytest.approx(known.planning_s / trial.planning_s)
    (plan,) = trial.plans
    expected = max(plan.distance / known.distance, plan.carried / known.carried)
    assert rows["distance_ratio_max"].value == pytest.approx(expected)
    assert rows["distance_ratio_max"].bar == 1.1
    assert rows["obstacle_on_goal.carried"].rival == known.carried
    assert "reached" in trial.line()


def test_goals_are_visited_one_after_the_other_on_the_map_as_it_is_left(tmp_path):
    goals = ((7.0, 1.5, 0.0), (1.0, 0.5, 0.0), (6.0, 2.5, 0.0), (4.1, 0.3, 0.0))
    world = dataclasses.replace(two_rooms({"a": IN_DOOR}), goals=goals)
    write_map(tmp_path / "tour.json", world)
    trial = study.plan_map(tmp_path / "tour.json", tmp_path / "out", 1, 0)
    assert (trial.goals, len(trial.plans)) == (4, 3)  # the last one is in a wall
    assert trial.transfers == 1  # the door stays open
    assert trial.reached == 0.75
    assert "in a wall" in trial.line()
    assert trial.plans[1].segments[0].poses[0, :2] == pytest.approx(goals[0][:2])
    assert trial.total("distance") == pytest.approx(sum(plan.distance for plan in trial.plans))
    assert (tmp_path / "out" / "two rooms" / "plan-003.json").exists()


def test_a_plan_that_fails_the_exact_check_is_not_reached(tmp_path, monkeypatch):
    write_map(tmp_path / "a.json", two_rooms({"a": IN_DOOR}))
    monkeypatch.setattr(study, "faults_of", lambda plan, world: ["the robot flies"])
    trial = study.plan_map(tmp_path / "a.json", tmp_path / "out", 1, 0)
    assert not trial.reached
    assert "the robot flies" in trial.line()


def test_a_file_that_is_no_map_is_told_and_not_reached(tmp_path):
    (tmp_path / "bad.svg").write_text("<svg/>")
    trial = study.plan_map(tmp_path / "bad.svg", tmp_path / "out", 1, 0)
    assert not trial.reached
    assert "viewBox" in trial.line()


def test_the_direct_way_is_that_without_movables():
    world = two_rooms({"a": IN_DOOR})
    plan = Planner().plan(world)
    direct = study.direct_distance(world, plan)
    assert direct == pytest.approx(6.0, rel=0.02)
    assert 0 < plan.path_efficiency(direct) < 1
    nowhere = dataclasses.replace(plan, goal=(-50.0, 0.0, 0.0))
    assert study.direct_distance(world, nowhere) is None


def test_the_direct_way_is_no_longer_than_straight_where_that_is_free():
    world = dataclasses.replace(two_rooms({}), start=(0.5, 0.5, 0.0))
    plan = dataclasses.replace(Planner().plan(world), goal=(2.5, 1.3, 0.0))
    assert study.direct_distance(world, plan) == pytest.approx(np.hypot(2.0, 0.8), rel=1e-3)


def test_maps_of_one_name_and_names_that_are_no_folders_are_kept_apart(tmp_path):
    for site, name in (("a", "map"), ("b", "map"), ("c", "../../up")):
        world = dataclasses.replace(two_rooms({}), name=name)
        write_map(tmp_path / "maps" / site / "map.json", world)
    (tmp_path / "maps" / "d").mkdir()
    (tmp_path / "maps" / "d" / "map.svg").write_text("<svg/>")
    result = study.reproduce(tmp_path / "out", quick=True, maps=tmp_path / "maps")
    reached = {name for name in named(result) if name.endswith(".reached")}
    assert len(reached) == 4
    assert len(list((tmp_path / "out").rglob("plan.json"))) == 3
    assert not list(tmp_path.glob("up*"))


def test_a_map_of_namosims_that_is_not_reached_leaves_the_bars_standing(tmp_path):
    world = dataclasses.replace(two_rooms({}, doors=()), name="obstacle_on_goal")
    write_map(tmp_path / "obstacle_on_goal.json", world)
    trial = study.plan_map(tmp_path / "obstacle_on_goal.json", tmp_path / "out", 1, 0)
    rows = {figure.name: figure for figure in study.figures([trial])}
    assert rows["speedup_min"].met is False
    assert rows["distance_ratio_max"].met is False


def test_without_a_folder_it_is_said_what_to_give(tmp_path):
    with pytest.raises(PalpateError, match="--maps"):
        study.reproduce(tmp_path)
