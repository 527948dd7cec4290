"""What `reproduce maze-reflex` counts; trainings and episodes are stood in for."""

import numpy as np
import pytest

from palpate.experiments.contact import maze_reflex
from palpate.runs import Figure, Result
from palpate.runs.storage import write_json

VIOLATIONS = {"maze": {"srl-vic": 100.0, "bresa": 10.0}, "navigation": {"srl-vic": 0.0, "bresa": 3}}
GOALS = {"srl-vic": 5, "bresa": 6}


@pytest.fixture
def stood_in(monkeypatch):
    asked = []

    def run(options):
        asked.append(options)
        violations = VIOLATIONS[options.task][options.method]
        figures = [
            Figure("training.violations", violations, ""),
            Figure("pretraining.violations", 100.0, ""),
        ]
        result = Result("x", figures, {}, [0], None, 3.0)
        write_json(options.out / "result.json", result.to_dict())
        return options.out

    def played(make, act, episodes, seed):
        asked.append(make.keywords)
        ends = np.full(episodes, "horizon", object)
        ends[: GOALS[act]] = "goal"
        return {"end": ends}

    def load_actor(path):
        method = path.parent.name.rsplit("-", 1)[0].split("-", 1)[1]
        return method, {"command": f"palpate train --method {method}"}

    monkeypatch.setattr(maze_reflex.train, "run", run)
    monkeypatch.setattr(maze_reflex, "play_episodes", played)
    monkeypatch.setattr(maze_reflex, "load_actor", load_actor)
    monkeypatch.setattr(maze_reflex, "at_its_best", lambda policy: policy)
    timed = {"p99_ms": 0.1, "median_ms": 0.05}
    monkeypatch.setattr(maze_reflex, "decision", lambda training: timed)
    # Processes of their own would not see what stands in here.
    monkeypatch.setattr(maze_reflex.Experiment, "on_every_core", lambda *_: None)
    monkeypatch.setattr(maze_reflex, "EPISODES", 10)
    return asked


def test_violations_are_pooled_over_trainings_and_success_is_set_beside(stood_in, tmp_path):
    result = maze_reflex.reproduce(tmp_path)
    figures = {figure.name: figure for figure in result.figures}
    assert figures["maze.violations_ratio"].value == pytest.approx(0.1)
    assert figures["maze.violations_ratio"].met
    assert figures["maze.baseline_violations"].value == 300
    assert figures["maze.baseline_violations"].met
    assert figures["detail.maze.violations_ratio_with_pretraining"].value == pytest.approx(0.55)
    assert figures["maze.success_difference"].value == pytest.approx(0.1)
    assert figures["navigation.violations_ratio"].value is None  # of nothing there is no share
    assert not figures["navigation.baseline_violations"].met
    assert figures["detail.maze.bresa.20_hz.goal_rate"].value == pytest.approx(0.6)
    assert figures["decision_p99_ms"].met
    trained = [one for one in stood_in if hasattr(one, "method")]
    assert [(one.task, one.method, one.seed) for one in trained[:3]] == [
        ("maze", "srl-vic", seed) for seed in (31, 32, 33)
    ]
    assert {one.out.name for one in trained} >= {"maze-srl-vic-31", "navigation-bresa-33"}
    assert result.seeds[1:] == [31, 32, 33]
    again = len(stood_in)
    assert maze_reflex.reproduce(tmp_path).figures == result.figures
    assert len(stood_in) == again  # what was found of the trainings is read again
