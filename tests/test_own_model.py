"""A model and a task of somebody's own, files that nothing registers, go through every command."""

import csv
import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from palpate.cli import main
from palpate.commands.parsing import parse
from palpate.errors import PalpateError
from palpate.family import resolve
from palpate.identification.posterior.files import read_models
from palpate.models.files import load_model, save_model
from palpate.models.model import Model, rollout
from palpate.models.python_files import load_class
from palpate.recordings.files import read_recording
from palpate.report import read_evidence
from palpate.runs.result import read_result

EXAMPLES = Path(__file__).parents[1] / "examples"
TRUE = {"inertia": 0.8, "damping": 0.3, "friction": 0.4}
CHANNELS = "--observe angle --act torque"


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """A folder with the examples, a recording of a door, and what was identified from it."""
    folder = tmp_path_factory.mktemp("workshop")
    shutil.copy(EXAMPLES / "door.py", folder)
    shutil.copy(EXAMPLES / "door_task.py", folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        record("R.csv", seed=0)
        record("V.csv", seed=1)
        how = "--method levenberg-marquardt --iterations 10 10 10 --validate V.csv"
        do(f"identify door.py:Door R.csv {CHANNELS} {how} --out model")
        yield folder


def record(name: str, seed: int, scale: float = 1.0, header: str = "angle [rad]") -> None:
    """Four seconds of a pushed door at 50 Hz, with a milliradian of noise, that pass pi."""
    rng = np.random.default_rng(seed)
    door = load_class("door.py:Door", Model)(**TRUE)
    signs = [1, 1, -1, -1, -1, 1, 1, 1, -1, -1]
    torque = np.repeat(signs * rng.uniform(1.0, 3.0, 10), 20)
    start = jnp.array([2.5]), jnp.zeros(1)
    states = rollout(door, start, jnp.asarray(torque[:, None], jnp.float32))
    angle = np.concatenate([[2.5], np.asarray(door.observe(states))[:, 0]])
    angle = (angle + 1e-3 * rng.normal(size=angle.size) + np.pi) % (2 * np.pi) - np.pi
    assert np.ptp(np.abs(np.diff(angle))) > 6.0  # it has passed pi
    with open(name, "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["time", header, "temperature", "torque"])
        rows.writerows(
            (0.02 * i, scale * a, 20.0, t)
            for i, (a, t) in enumerate(zip(angle, [*torque, 0.0], strict=True))
        )


def do(words: str) -> None:
    assert main(words.split()) == 0


def refused(words: str, capsys) -> str:
    assert main(words.split()) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said.removeprefix("palpate: ").strip()


def test_what_is_identified_is_the_door_that_was_recorded(workshop):
    rows = {row["name"]: row for row in read_result("model/result.json").parameters}
    for name, true in TRUE.items():
        assert abs(rows[name]["value"] / true - 1) < 0.02, name
        assert rows[name]["lower"] < rows[name]["value"] < rows[name]["upper"]
    assert rows["inertia"]["unit"] == "kg m^2"
    assert read_result("model/result.json").split == {"fitted": ["R"], "validation": ["V"]}


def test_the_page_shows_what_was_observed_beside_what_is_predicted(workshop):
    curves = read_evidence("model").prediction
    assert curves is not None
    observed, identified = curves.values["observed"], curves.values["identified"]
    assert observed.shape == identified.shape == (199, 1, 1)  # after the two frames of the start
    assert np.abs(np.diff(observed[:, 0, 0])).max() < 0.1  # no jump where the angle passes pi
    assert np.ptp(observed) > 1.0
    assert (
        np.abs(identified - observed).mean()
        < 0.2 * np.abs(curves.values["start model"] - observed).mean()
    )
    page = Path("model/report.html").read_text()
    assert page.index("predicted from its first moment") < page.index("<h2>Results</h2>")
    assert "The data tell 3 of 3 parameters." in page
    assert "angle (rad)" in page


def test_draws_of_it_are_shown_as_a_fan_and_come_back(workshop, capsys):
    drawn = "--method local-global --chains 2 --draws 100 --fixed inertia --init model"
    do(f"identify door.py:Door R.csv {CHANNELS} {drawn} --out drawn")
    assert "inertia" not in capsys.readouterr().out
    curves = read_evidence("drawn").prediction
    assert curves is not None
    draws, observed = curves.values["draws"], curves.values["observed"]
    assert draws.shape == (100, 1, 40)
    assert np.abs(draws - observed).max() < 0.5
    models = read_models("drawn/posterior.npz")
    assert models.damping.shape == (200,)
    spread = np.std(models.friction)
    assert spread < 0.1 * TRUE["friction"]
    assert abs(np.median(models.friction) - TRUE["friction"]) < spread


def test_the_file_says_which_class_of_which_file_it_holds(workshop):
    content = json.loads(Path("model/model.json").read_text())
    assert content["model"] == "door.py:Door"
    assert len(content["sha256"]) == 64
    kind = load_class("door.py:Door", Model)
    model, _ = load_model("model/model.json")  # as it was named in this process
    assert type(model) is kind
    assert type(load_model("model/model.json", kind)[0]) is kind


def test_a_file_is_not_run_because_a_model_says_so(workshop, tmp_path, capsys):
    """Not even where it lies beside the model."""
    (tmp_path / "trap.py").write_text("raise SystemExit('it was run')")
    content = json.loads(Path("model/model.json").read_text()) | {"model": "trap.py:Door"}
    trap = tmp_path / "model.json"
    trap.write_text(json.dumps(content))
    with pytest.raises(PalpateError, match=r"trap.py:Door.*run only when you name it"):
        load_model(trap)
    said = refused(f"identify door.py:Door R.csv {CHANNELS} --init {trap} --out no", capsys)
    assert "`palpate identify trap.py:Door`" in said
    said = refused(f"train rope-stabilization --model {trap} --out no", capsys)
    assert "palpate train trap.py:TASK" in said


def test_a_file_that_has_changed_is_told_of(workshop, tmp_path):
    shutil.copy("door.py", tmp_path / "door.py")
    kind = load_class(f"{tmp_path}/door.py:Door", Model)
    save_model(tmp_path / "model.json", kind(**TRUE))
    load_model(tmp_path / "model.json", kind)
    with open(tmp_path / "door.py", "a", encoding="utf-8") as file:
        file.write("# heavier now\n")
    changed = load_class(f"{tmp_path}/door.py:Door", Model)
    assert changed is not kind
    with pytest.warns(UserWarning, match=r"door.py has changed since .*model.json was written"):
        model, _ = load_model(tmp_path / "model.json")
    assert type(model) is changed


def test_degrees_are_read_as_radians(workshop, tmp_path, capsys):
    record("degrees.csv", seed=0, scale=180 / np.pi, header="angle [deg]")
    how = "--method levenberg-marquardt --iterations 1 1 1"
    do(f"identify door.py:Door degrees.csv {CHANNELS} {how} --out {tmp_path / 'degrees'}")
    assert "was in deg and is in rad" in capsys.readouterr().out
    both = [read_recording(file, columns=("angle",)) for file in ("degrees.csv", "R.csv")]
    ours, read = (recording.trials[0]["angle"] for recording in both)
    np.testing.assert_allclose(ours.values, read.values, atol=1e-9)
    assert ours.unit == read.unit == "rad"
    record("other.csv", seed=0, header="angle [m]")
    said = refused(f"identify door.py:Door other.csv {CHANNELS} --out no", capsys)
    assert said == "'angle' is in m and Door observes rad: expected the same unit"


def test_a_policy_is_trained_through_it_and_exported(workshop, capsys):
    size = "--iterations 4 --batch 4 --starts 8"
    do(f"train door_task.py:CloseDoor --model model {size} --out policy")
    said = capsys.readouterr().out
    assert "success, in the model" in said
    assert "angle, in the model" in said
    pytest.importorskip("onnx")
    do("export policy --onnx door.onnx --out exported")
    contract = json.loads(Path("door.json").read_text())
    assert "torque" in json.dumps(contract)


BROKEN = """
import equinox as eqx, jax.numpy as jnp
from door import Door
class Flat(Door):
    def step(self, state, action):
        angle, rate = state
        return angle + rate * self.inertia, rate + action / self.inertia
class Grown(Door):
    def step(self, state, action):
        return (*state, action)
class Missing(Door):
    def observe(self, state):
        return state.angle
class Needs(Door):
    width: float = eqx.field(kw_only=True)
def helper(): pass
"""

REFUSED = {
    "no.py:Door R.csv": "there is no file no.py: expected the Python file of a class",
    "door.py:Dor R.csv": "unknown model of door.py 'Dor'; did you mean 'Door'? there are: Door",
    "door.py R.csv": "door.py names no class: expected door.py:Door or the like",
    "door_task.py:CloseDoor R.csv": "'CloseDoor' in door_task.py is a class but no Model: expected "
    "a subclass of palpate.models.model.Model; there are: Door",
    "raises.py:Door R.csv": "raises.py cannot be loaded: raises.py, line 2: "
    "ZeroDivisionError: division by zero",
    "ends.py:Door R.csv": "ends.py cannot be loaded: ends.py, line 1: SystemExit: 3",
    "wrong.py:Door R.csv": "wrong.py cannot be loaded: wrong.py, line 1: SyntaxError: invalid "
    "syntax (wrong.py, line 1)",
    "broken.py:Missing R.csv": "Missing.observe fails for one state, float32[1] and float32[1]: "
    "broken.py, line 13: AttributeError: 'tuple' object has no attribute 'angle'",
    "broken.py:Grown R.csv": "Grown.step of one state gives float32[1] and float32[1] and "
    "float32[1] and takes float32[1] and float32[1]: expected the same, as `initial_state` gives "
    "it",
    "broken.py:Flat R.csv": "Flat.step of a batch of 3 states and parameters of 3 models gives "
    "float32[3, 3] and float32[3, 3] and takes float32[3, 1] and float32[3, 1]: expected the same, "
    "as `initial_state` gives it",
    "broken.py:Needs R.csv": "a model Needs cannot be made: broken.py: TypeError: "
    "Needs.__init__() missing 1 required keyword-only argument: 'width'; expected fields "
    "`control_period` and `overrides`, and defaults for all that are no parameters",
    "door.py:Door no.csv": "cannot read no.csv: No such file or directory",
    "door.py:Door headless.csv": "headless.csv: no column is called time, t or timestamp, but "
    "angle, torque: expected one, or the rate (--rate HZ)",
    "door.py:Door word.csv": "word.csv: line 3, column 2: expected a finite number, got 'open'",
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_cannot_be_is_refused_with_a_sentence(words, workshop, capsys):
    Path("broken.py").write_text(BROKEN)
    Path("raises.py").write_text("import os\n1 / 0\n")
    Path("ends.py").write_text("raise SystemExit(3)\n")
    Path("wrong.py").write_text("def f(:\n")
    Path("headless.csv").write_text("angle,torque\n0,1\n")
    Path("word.csv").write_text("time,angle,torque\n0,0,1\n0.02,open,1\n")
    assert refused(f"identify {words} {CHANNELS} --out no", capsys) == REFUSED[words]
    assert not Path("no").exists()


def test_a_channel_that_is_not_there_is_told_with_those_there_are(workshop, capsys):
    said = refused("identify door.py:Door R.csv --observe angel --act torque --out no", capsys)
    assert said.startswith("R.csv: unknown column 'angel'; did you mean 'angle'? there are: angle,")
    said = refused("identify door.py:Door R.csv --observe angle --act angle --out no", capsys)
    assert said.startswith("'angle' cannot be both observed and what acts")


def test_a_task_that_is_none_is_refused(workshop, capsys):
    said = refused("train door.py:Door --model model --out no", capsys)
    assert said == (
        "'Door' in door.py is a class but no Task: expected a subclass of palpate.tasks.task.Task; "
        "there are: none"
    )


def test_a_model_is_printed_with_units(workshop):
    door = load_class("door.py:Door", Model)(**TRUE)
    first, *lines = str(door).splitlines()
    assert first == "Door, every 0.02 s"
    assert lines[0].split()[:3] == ["inertia", "0.8", "kg"]
    assert len(lines) == 3


def test_the_page_of_the_docs_runs(workshop, tmp_path, monkeypatch, capsys):
    page = (EXAMPLES.parent / "docs" / "own-model.md").read_text()
    for name in ("door.py", "door_task.py"):
        shutil.copy(EXAMPLES / name, tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for words in re.findall(r"^\$ palpate (.*)$", page, re.MULTILINE):  # in the workshop, unrun
        name, *rest = words.split()
        if name == "export":
            continue
        options = resolve(f"palpate.families.own.options:{name}_options")(rest[0])
        assert parse(options, f"palpate {name}", rest[1:]) is not None, words
    monkeypatch.chdir(tmp_path)
    known: dict[str, Any] = {}
    for block in re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        exec(compile(block, "own-model.md", "exec"), known)
    for name in ("door", "door_task"):
        sys.modules.pop(name)
    for name, true in TRUE.items():
        assert abs(getattr(known["model"], name) / true - 1) < 0.05
        assert known["found"].lower[name] < true < known["found"].upper[name]
    assert "(fixed)" in str(known["weighed"])
    assert known["drawing"](known["model"], np.zeros((5, 1)))[""].shape == (5, 2, 3)
    assert known["about"] == {"recording": "R.npz"}


def test_the_examples_are_short():
    assert len((EXAMPLES / "door.py").read_text().splitlines()) <= 40
    assert all(len(path.read_text().splitlines()) <= 100 for path in EXAMPLES.glob("*.py"))
