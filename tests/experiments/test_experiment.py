"""What all experiments share: stages that resume, seeds that are noted, figures with intervals."""

import subprocess
import sys

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.experiments.experiment import (
    Experiment,
    decision_figures,
    mean_of,
    ratio,
    share_of,
    suffix,
)
from palpate.runs.run import RESULT, read_metrics
from palpate.runs.storage import read_json
from palpate.trials.trial import resumable


def squares(experiment, cut_off=None):
    """Squares of 0, 1, 2, one after the other; the work is cut off before the item `cut_off`."""
    done, worked = {"square": np.zeros(3)}, []
    with experiment.stage("squares", {"stage": "squares", "seed": experiment.seed}) as stage:
        for item, note in resumable(stage.run, range(3), done, "squaring"):
            if item == cut_off:
                raise KeyboardInterrupt
            done["square"][item] = item**2
            worked.append(item)
            note(square=item**2, who="me")
        stage.content = {"sum": float(done["square"].sum())}
    return done["square"], worked


def test_a_stage_that_was_cut_off_goes_on_and_a_finished_one_is_read(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        squares(Experiment("e", tmp_path, False, 0), cut_off=2)
    assert not (tmp_path / "squares" / RESULT).exists()
    experiment = Experiment("e", tmp_path, False, 0)
    values, worked = squares(experiment)
    assert values.tolist() == [0.0, 1.0, 4.0]
    assert worked == [2]
    again = Experiment("e", tmp_path, False, 0)
    values, worked = squares(again)
    assert values.tolist() == [0.0, 1.0, 4.0]
    assert worked == []
    assert again.seconds == experiment.seconds > 0
    written = read_json(tmp_path / "squares" / RESULT)
    assert (written["name"], written["sum"]) == ("e squares", 5.0)
    metrics = read_metrics(tmp_path / "squares")
    assert [(line["step"], line["square"], line["who"]) for line in metrics] == [
        (1, 0, "me"),
        (2, 1, "me"),
        (3, 4, "me"),
    ]
    with pytest.raises(PalpateError, match="seed was 0, now 1"):
        squares(Experiment("e", tmp_path, False, 1))


def test_what_a_stage_found_is_found_once(tmp_path):
    experiment, calls = Experiment("e", tmp_path, True, 0), []

    def work():
        calls.append(1)
        return {"value": 3.0}

    for _ in range(2):
        assert experiment.found("a/b", {"stage": "a"}, work)["value"] == 3.0
    assert len(calls) == 1


def test_a_result_has_the_seeds_that_were_used_and_the_seconds_that_were_spent(tmp_path, capsys):
    experiment = Experiment("e", tmp_path, True, 2)
    assert experiment.command == "palpate reproduce e --seed 2 --quick"
    assert experiment.uses(0, 3) == 2
    assert experiment.uses(900) == 902
    with experiment.counted():
        sum(range(1000))
    result = experiment.result([], {"a": 1}, "nothing")
    assert result.seeds == [2, 3, 4, 902]
    assert result.settings == {"quick": True, "a": 1}
    assert result.wall_time_s == experiment.seconds > 0
    assert experiment.result([], {}, "", seeds=[7]).seeds == [7]
    experiment.announce({"this": 1, "that": 2})
    assert capsys.readouterr().out == "e: about 3 minutes on two idle cores (this 1, that 2)\n"


def test_figures_say_how_far_to_trust_them():
    share = share_of("s", 99, 100, bar=0.95)
    assert (share.value, share.met, share.better) == (0.99, True, "higher")
    assert share.spread == pytest.approx(0.99 - 0.9455, abs=1e-3)  # Wilson's lower limit
    assert share_of("s", 0, 0).value is None
    mean = mean_of("m", [1.0, 3.0], "cm")
    assert (mean.value, mean.spread) == (2.0, pytest.approx(2.0))
    assert ratio(1.0, None) is None
    assert ratio(1.0, 4.0) == 0.25
    assert suffix("Stabilised, colour only") == "stabilised.colour_only"
    assert [row.name for row in decision_figures({"MPPI 10 ms": (1.0, 2.0)})] == [
        "decision_ms_median.mppi_10_ms",
        "decision_ms_p99.mppi_10_ms",
    ]


def test_work_on_every_core_is_logged_and_its_errors_are_raised(tmp_path):
    experiment = Experiment("e", tmp_path, True, 4)
    experiment.on_every_core(print, [("said", n) for n in range(3)], "saying")
    told = [(tmp_path / f"said-{n}.log").read_text() for n in range(3)]
    assert told == [f"{Experiment('e', tmp_path, True, 4)} said {n}\n" for n in range(3)]
    with pytest.raises(TypeError, match="integer"):
        experiment.on_every_core(int, [("broken",)], "breaking")
    experiment.on_every_core(print, [], "nothing")


KILLED = """
import os, pathlib, sys, time
from palpate.experiments.experiment import Experiment

def work(experiment, seconds):
    os.write(1, b"begun")
    time.sleep(seconds)

if __name__ == "__main__":
    Experiment("e", pathlib.Path(sys.argv[1]), True, 4).on_every_core(work, [(90,)], "sleeping")
"""


def test_workers_end_with_an_experiment_that_is_killed(tmp_path):
    (tmp_path / "script.py").write_text(KILLED)
    command = [sys.executable, tmp_path / "script.py", tmp_path]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout.read(5) == b"begun"
        process.kill()
        process.communicate(timeout=30)  # to the end of what the worker might write
