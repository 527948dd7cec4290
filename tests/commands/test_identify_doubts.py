"""What is wrong with a recording of a rope ends as a result that nobody takes for a good one."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from numpy_rope import PERIOD, chain
from palpate.cli import main
from palpate.commands import folders
from palpate.commands.identification.fit import shareable
from palpate.commands.identify import run
from palpate.errors import DoubtfulResultError
from palpate.families.rope.options import IdentifyRope
from palpate.models.files import load_model
from palpate.models.rope import Rope
from palpate.runs.result import read_result


@pytest.fixture(scope="module")
def markers():
    return chain(1.5)[None].repeat(2, axis=0)


@pytest.fixture
def identify(tmp_path, monkeypatch, one_horizon):
    monkeypatch.chdir(tmp_path)

    def identify(markers, *more):
        np.savez("mine.npz", positions=markers.astype(np.float32))
        given = ["mine.npz", "--rate", str(1 / PERIOD), "--substeps", "5", "--out", "run"]
        return main(["identify", "rope", *given, "--iterations", "1", *more])

    return identify


def test_markers_out_of_order_are_said_at_once_and_at_the_end(identify, markers, capsys):
    assert identify(markers[:, :, [0, 2, 1, 3, 4, 5]]) == DoubtfulResultError.status
    shown = capsys.readouterr()
    assert shown.out.startswith("warning: order of the markers: ")
    assert "run/model.json is not to be trusted: order of the markers: " in shown.err
    (doubt,) = read_result(Path("run/result.json")).settings[folders.DOUBTS]
    _, about = load_model(Path("run/model.json"))
    assert about[folders.DOUBTS] == [doubt]
    options = IdentifyRope(
        recordings=(Path("mine.npz"),),
        rate=1 / PERIOD,
        substeps=5,
        iterations=(1,),
        out=Path("run"),
    )
    with pytest.raises(DoubtfulResultError, match="order of the markers"):
        run(options)  # which is finished
    assert main(["train", "rope-stabilization", "--model", "run", "--iterations", "0"]) == 2
    assert "run/model.json is not to be trusted: order" in capsys.readouterr().out


def test_a_good_recording_leaves_no_doubt(identify, markers, capsys):
    assert identify(markers) == 0
    assert "trusted" not in capsys.readouterr().err
    _, about = load_model(Path("run/model.json"))
    assert about[folders.DOUBTS] == []


def row(name, value, lower, upper, **said):
    return {"name": name, "value": value, "lower": lower, "upper": upper,
            "fixed": False, "shared": False, "verdict": None} | said  # fmt: skip


def test_elements_that_may_have_one_value_are_named_with_what_it_gains():
    alike = row("stiffness", [1.0, 1.2, 0.9, 1.1], [0.5] * 4, [2.0] * 4)
    assert shareable([alike]) == (
        "one value may do for all elements of stiffness: with --shared stiffness intervals are up "
        "to 2 times narrower"
    )
    apart = row("mass", [1.0, 2.0, 4.0], [0.9, 1.9, 3.9], [1.1, 2.1, 4.1])
    few = row("drag", [1.0, 1.0], [0.5, 0.5], [2.0, 2.0])
    prior = alike | {"verdict": "not told by the data: the interval is the prior's"}
    assert shareable([apart, few, prior, alike | {"shared": True}, alike | {"fixed": True}]) == ""


def test_a_rope_on_the_limit_of_its_time_step_is_named():
    options = IdentifyRope(recordings=())
    stiff = Rope.uniform(0.5, 0.05, 6, control_period=0.02, substeps=4)
    stiff = dataclasses.replace(stiff, stretch_stiffness=1e6 * stiff.stretch_stiffness).constrain()
    (said,) = options.bounds(stiff)
    assert "the stretch stiffness is as great as 4 steps in 20 ms" in said
    assert "--substeps 8 allows four times as much" in said
    soft = dataclasses.replace(stiff, stretch_stiffness=0.1 * stiff.stretch_stiffness)
    assert options.bounds(soft) == []
    damped = dataclasses.replace(soft, stretch_damping=1e6 * soft.stretch_damping).constrain()
    (said,) = options.bounds(damped)
    assert "the stretch damping is as great as" in said
    assert "--substeps 8 allows twice as much" in said
