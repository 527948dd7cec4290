"""What `reproduce velocity-yardstick` counts; trainings and episodes are stood in for."""

import pytest

from palpate.experiments import velocity_yardstick
from palpate.families.gymnasium.options import EvaluateGymnasium, TrainGymnasium
from palpate.runs import Figure, Result
from palpate.runs.storage import write_json

REWARDS = {"halfcheetah": 2800.0, "ant": 900.0}


def test_seeds_are_averaged_and_the_cheetah_is_held_against_the_bars(tmp_path, monkeypatch):
    asked = []

    def done(options):
        robot, seed = options.out.name.split("-")[:2]
        trying = isinstance(options, EvaluateGymnasium)
        values = {"training.violations": 5e3}
        if trying:
            values = {"reward": REWARDS[robot] + 30 * int(seed), "cost": 10.0 * int(seed)}
        figures = [Figure(name, value, "") for name, value in values.items()]
        options.out.mkdir()
        result = Result("x", figures, {}, [options.seed], "x", 60.0)
        write_json(options.out / "result.json", result.to_dict())
        asked.append(options)
        return options.out

    monkeypatch.setattr(velocity_yardstick.train, "run", done)
    monkeypatch.setattr(velocity_yardstick.evaluate, "run", done)
    result = velocity_yardstick.reproduce(tmp_path)
    figures = {figure.name: figure for figure in result.figures}
    assert figures["halfcheetah.reward"].value == pytest.approx(2860)
    assert figures["halfcheetah.reward"].met
    assert figures["halfcheetah.cost"].value == pytest.approx(20)
    assert figures["halfcheetah.cost"].met
    assert figures["ant.reward"].met is None
    assert figures["ant.reward"].rival == "OmniSafe 1897 ± 1214"
    assert figures["detail.halfcheetah.cost_3"].value == 30
    assert result.wall_time_s == 12 * 60
    trained = [options for options in asked if isinstance(options, TrainGymnasium)]
    assert {options.steps for options in trained} == {1_000_000}
    assert {options.method for options in trained} == {"lagrangian"}
    assert [options.seed for options in trained] == [1, 2, 3, 1, 2, 3]
    tried = [options for options in asked if isinstance(options, EvaluateGymnasium)]
    assert all(options.episodes >= 10 for options in tried)
    assert not {options.seed for options in tried} & set(range(1000))  # no training's
