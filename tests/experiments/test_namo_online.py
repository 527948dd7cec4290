"""The experiment: ours in one scene, rows that are kept, and the figures made of them."""

import pytest

from palpate.experiments.experiment import Experiment
from palpate.experiments.furniture import namo_online
from palpate.trials.furniture.namo_episode import Learner
from palpate.trials.furniture.rooms import scenes


def row(seed: int, **reached: bool) -> dict:
    counted = dict.fromkeys(namo_online.COUNTED, 2.0)
    return {"seed": seed, "constructions": ["bolted"]} | {
        name: {"reached": yes, "reason": ""} | counted for name, yes in reached.items()
    }


ROWS = [
    row(0, ours=True, told_truth=True, all_movable=False, flag=True),
    row(1, ours=True, told_truth=True, all_movable=True, flag=False),
    row(2, ours=False, told_truth=False, all_movable=False, flag=False),
    row(3, ours=False, told_truth=True, all_movable=False, flag=False),
]


def test_success_counts_among_rooms_that_the_told_planner_solves():
    found = {figure.name: figure for figure in namo_online.figures(ROWS, {})}
    assert found["success_of_solvable"].value == pytest.approx(2 / 3)
    assert found["success_of_solvable"].rival == pytest.approx(1 / 3)
    assert not found["success_of_solvable"].met
    assert found["success_rate_all_movable"].value == 0.25
    assert found["success_rate_all_movable"].met
    assert found["success_rate_told_truth"].value == 0.75
    assert found["success_rate_flag"].value == 0.25
    assert found["ours.time"].value == 2.0


def test_nothing_solvable_meets_no_bar():
    found = {figure.name: figure for figure in namo_online.figures(ROWS[2:3], {})}
    assert found["success_of_solvable"].value is None
    assert found["success_of_solvable"].met is False


def test_rooms_are_taken_up_where_they_were_left(tmp_path, monkeypatch):
    done, cut_off = [], [3]

    def tried(out, room, step):
        if step in cut_off:
            cut_off.clear()
            raise KeyboardInterrupt
        done.append(step)
        return ROWS[step - 1]

    monkeypatch.setattr(namo_online, "room_row", tried)
    monkeypatch.setattr(namo_online, "generated_room", lambda seed: None)
    settings = namo_online.configuration(5, 4)
    experiment = Experiment("namo-online", tmp_path, True, 0)
    with pytest.raises(KeyboardInterrupt):
        namo_online.outcomes(experiment, 5, 4, settings)
    rows = namo_online.outcomes(experiment, 5, 4, settings)
    assert done == [1, 2, 3, 4]
    assert [r["seed"] for r in rows] == [0, 1, 2, 3]
    assert namo_online.outcomes(experiment, 5, 4, settings) == rows
    assert done == [1, 2, 3, 4]


def test_a_locked_caster_is_learnt_by_contact_and_the_way_found(tmp_path):
    room = scenes()["learning by contact"]
    outcome = namo_online.episode(room, Learner(room.world().outlines, 1))
    assert outcome.reached, outcome.reason
    first, last = outcome.beliefs[0][1], outcome.beliefs[-1][1]
    assert last["cabinet"] > first["cabinet"]
    namo_online.show(tmp_path, room, outcome)
    assert (tmp_path / "episode.gif").stat().st_size > 10_000
    assert len(list(tmp_path.glob("plan-*.png"))) == len(outcome.plans)
