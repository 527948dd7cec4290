"""What `reproduce maze-passive` counts; trainings and episodes are stood in for."""

import numpy as np
import pytest

from palpate.experiments.contact import maze_passive, other_robots

# Of each row: goals among ten episodes, energy drawn in each, the tank's least level, the rise.
FOUND = {
    "agnostic": (10, 2.0, -0.4, 0.0),
    "filtered": (9, 1.5, 0.2, 0.0),
    "aware": (10, 1.0, 0.3, 0.0),
    "ensured": (8, 0.9, 0.2, 2e-4),  # a rise: a filter that does not hold
    "arm": (9, 1.0, 0.3, 0.0),
    "arm.filtered": (8, 1.0, 0.2, 0.0),
}


def test_rows_are_held_against_agnostic_episode_by_episode(tmp_path, monkeypatch):
    trained, asked = [], []

    def tried(folder, which, world, episodes, seed):
        row = next(
            row
            for row, (training, filtered, on) in maze_passive.ROWS.items()
            if (filtered, on) == (which, world) and folder.name.startswith(f"maze-{training}-3")
        )
        asked.append((row, episodes, seed))
        goals, drawn, level, rise = FOUND.get(row, (5, 3.0, None, 0.0))
        ends = ["goal"] * goals + ["violation"] * (10 - goals)
        energy = [drawn] * goals + [100.0] * (10 - goals)  # of failures nothing is compared
        return {"end": ends, "drawn": energy, "flow": [2.0] * 10, "length": [50] * 10,
                "level": [level] * 10, "rise": [rise] + [0.0] * 9}  # fmt: skip

    def run(options):
        trained.append((options.method, options.costs, options.seed))
        return options.out

    monkeypatch.setattr(maze_passive.train, "run", run)
    monkeypatch.setattr(maze_passive, "evaluate_policy", tried)
    monkeypatch.setattr(other_robots, "CALLS", 50)
    ropes = {"bare": {"success": 1.0, "time": 2.0}, "filtered": {"success": 0.97, "time": 2.02}}
    monkeypatch.setattr(other_robots, "of_ropes", lambda count: ropes | {"least": 0.3})
    rooms = []

    def of_room(seed):
        rooms.append(seed)
        reached = {"bare": True, "filtered": seed % 10 > 0}  # one in ten is lost
        return reached | {"drawn": 80.0, "least": 5.0 + seed % 2}

    monkeypatch.setattr(other_robots, "of_room", of_room)
    monkeypatch.setattr(maze_passive.Experiment, "on_every_core", lambda *_: None)
    result = maze_passive.reproduce(tmp_path)
    figures = {figure.name: figure for figure in result.figures}
    assert figures["filtered.violations"].value == 0
    assert figures["ensured.violations"].value == 3  # one of each seed
    assert not figures["ensured.violations"].met
    assert figures["agnostic.violations"].value == 30
    assert figures["aware.violations"].value == 0
    assert figures["filtered.success_ratio"].value == pytest.approx(0.9)
    assert figures["ensured.success_rate"].value == pytest.approx(0.8)
    assert figures["aware.energy_ratio"].value == pytest.approx(0.5)
    assert figures["ensured.energy_ratio"].value == pytest.approx(0.45)
    assert figures["aware.success_difference"].value == pytest.approx(0.0)
    assert figures["eb.success_difference"].value == pytest.approx(-0.5)
    assert figures["arm.success_difference"].value == pytest.approx(-0.1)
    assert not figures["arm.success_difference"].met
    assert figures["detail.kinetic-barrier.violations"].value == 0  # no tank, and no rise
    assert figures["filter_p99_ms"].value > 0.0
    assert figures["rope.success_difference"].value == pytest.approx(-0.03)
    assert not figures["rope.success_difference"].met
    assert figures["rope.time_ratio"].value == pytest.approx(1.01)
    assert figures["base.success_difference"].value == pytest.approx(-0.1)
    assert not figures["base.success_difference"].met
    assert figures["detail.base.least_tank_level_J"].value == 5.0
    assert sorted(rooms) == [*range(other_robots.ROOM_SEED, other_robots.ROOM_SEED + 40)]
    assert len(trained) == 12
    assert {costs for method, costs, _ in trained if method == "passive"} == {
        ("eb",), ("ef",), ("eb", "ef"),
    }  # fmt: skip
    assert {row for row, *_ in asked} == set(maze_passive.ROWS)
    assert {episodes for row, episodes, _ in asked if row == "aware"} == {300}
    assert len({seed for *_, seed in asked}) == 1
    assert np.isfinite(result.wall_time_s)
