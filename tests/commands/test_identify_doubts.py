"""What is wrong with a recording of a rope ends as a result that nobody takes for a good one."""

from pathlib import Path

import numpy as np
import pytest

from numpy_rope import PERIOD, chain
from palpate.cli import main
from palpate.commands import folders
from palpate.commands.identify import run
from palpate.errors import DoubtfulResultError
from palpate.families.rope.options import IdentifyRope
from palpate.models.files import load_model
from palpate.runs.result import read_result


@pytest.fixture(scope="module")
def markers():
    return chain(1.5)[None].repeat(2, axis=0)


@pytest.fixture
def identify(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def identify(markers, *more):
        np.savez("mine.npz", positions=markers.astype(np.float32))
        given = ["mine.npz", "--rate", str(1 / PERIOD), "--substeps", "5", "--out", "run"]
        return main(["identify", "rope", *given, "--iterations", "1", "1", "1", *more])

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
        iterations=(1, 1, 1),
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
