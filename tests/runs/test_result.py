"""Figures say truly whether they meet their bar, and `result.json` is checked when it is read."""

import dataclasses
import importlib.metadata
import json
import math
import subprocess
import sys

import pytest

from palpate.errors import PalpateError
from palpate.runs import Figure, Result
from palpate.runs import result as module
from palpate.runs.result import commit, machine, read_result, versions
from palpate.runs.storage import write_json

SCHEMA = "name figures settings seeds split wall_time_s machine versions commit".split()  # noqa: SIM905
FIGURE = "name value unit bar better met seed_document rival spread".split()  # noqa: SIM905


def example() -> Result:
    return Result(
        name="toy",
        figures=[
            Figure("tip_rmse", 0.02134, "m", bar=0.03, seed_document=0.0704, rival="DER 5 cm"),
            Figure("success_rate", 0.97, "", bar=0.99, better="higher", spread=0.004),
            Figure("time", None, "s"),
        ],
        settings={"steps": 10, "rate": 50.0},
        seeds=[0, 1],
        split={"fitted": [0, 1], "evaluated": [2]},
        wall_time_s=12.5,
    )


@pytest.mark.parametrize(
    ("value", "bar", "better", "met"),
    [
        (1.0, None, "lower", None),
        (1.0, 1.0, "lower", True),
        (1.1, 1.0, "lower", False),
        (1.0, 1.0, "higher", True),
        (0.9, 1.0, "higher", False),
        (1.1, 1.0, "higher", True),
        (None, 1.0, "lower", False),
        (None, None, "lower", None),
    ],
)
def test_met(value, bar, better, met):
    assert Figure("x", value, "m", bar=bar, better=better).met is met


def test_figures_that_mean_nothing_are_refused():
    with pytest.raises(PalpateError, match="figure 'x' has value nan: expected a finite number"):
        Figure("x", float("nan"), "m")
    with pytest.raises(PalpateError, match="figure 'x' has bar inf"):
        Figure("x", 1.0, "m", bar=float("inf"))
    with pytest.raises(PalpateError, match="'toy' has the figure 'x' twice"):
        Result("toy", [Figure("x", 1, "m")] * 2, {}, [], None, 1.0)


def test_lines_stand_in_columns():
    assert example().lines() == [
        "tip_rmse     | 0.02134 m     | bar <= 0.03 | met     | seed 0.0704      | rival DER 5 cm",
        "success_rate | 0.97 +- 0.004 | bar >= 0.99 | NOT met | seed not printed | rival none",
        "time         | none          | no bar      | -       | seed not printed | rival none",
    ]
    assert Result("empty", [], {}, [], None, 0.0).lines() == []


def test_the_document_has_the_agreed_schema_and_comes_back(tmp_path):
    document = example().to_dict()
    assert list(document) == SCHEMA
    assert [list(figure) for figure in document["figures"]] == [FIGURE] * 3
    assert [figure["met"] for figure in document["figures"]] == [True, False, None]
    assert document["machine"] == machine()
    write_json(tmp_path / "result.json", document)
    read = read_result(tmp_path / "result.json")
    assert read == example()
    assert read.lines() == example().lines()


def test_an_identification_adds_its_parameters_and_warnings(tmp_path):
    rows = [{"name": "mass", "value": 1.0, "lower": None}]
    found = dataclasses.replace(example(), parameters=rows, warnings=["Weigh it."])
    assert list(found.to_dict()) == [*SCHEMA, "parameters", "warnings"]
    write_json(tmp_path / "result.json", found.to_dict())
    assert read_result(tmp_path / "result.json") == found


def test_nan_in_the_settings_is_refused_by_name():
    with pytest.raises(PalpateError, match=r"toy\.settings\.rate is nan"):
        Result("toy", [], {"rate": float("nan")}, [], None, 1.0).to_dict()


def changed(**changes):
    document = example().to_dict()
    return document | changes


def figure_changed(**changes):
    document = example().to_dict()
    document["figures"][1] |= changes
    return document


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([], "the result is a list: expected a JSON object"),
        ({}, "the result lacks commit, figures, machine, name"),
        (changed(extra=1), "the result has the unknown key extra"),
        (changed(wall_time_s="long"), "has wall_time_s 'long': expected int or float"),
        (changed(wall_time_s=True), "has wall_time_s True: expected int or float"),
        (changed(warnings="none"), "has warnings 'none': expected list"),
        (changed(commit=1), "has commit 1: expected str or null"),
        (figure_changed(value="0.97"), r"figures\[1\] has value '0.97': expected int or float or"),
        (figure_changed(better="more"), "better='more': expected 'lower' or 'higher'"),
        (figure_changed(met=True), r"figures\[1\].met is True, but value 0.97 against bar 0.99"),
        (figure_changed(name="time"), "the figure 'time' twice"),
    ],
)
def test_a_file_that_is_no_result_is_refused(tmp_path, document, message):
    path = tmp_path / "result.json"
    path.write_text(json.dumps(document))
    with pytest.raises(PalpateError, match=message) as caught:
        read_result(path)
    assert str(caught.value).count("result.json") == 1


def test_missing_and_damaged_files_are_named(tmp_path):
    with pytest.raises(PalpateError, match="there is no file"):
        read_result(tmp_path / "result.json")
    (tmp_path / "result.json").write_text('{"name": NaN}')
    with pytest.raises(PalpateError, match=r"result\.json is not valid JSON: JSON has no NaN"):
        read_result(tmp_path / "result.json")


def test_two_standard_errors_are_of_the_deviation_of_a_sample():
    assert module.two_standard_errors([1.0, 2.0, 3.0, 6.0]) == pytest.approx(math.sqrt(14 / 3))
    assert module.two_standard_errors(iter([1.0, 3.0])) == pytest.approx(2.0)
    assert module.two_standard_errors([1.0]) is None  # not zero


def test_the_machine_is_described_without_naming_it():
    import platform

    described = machine()
    assert list(described) == ["cpu", "cores", "platform", "device"]
    assert described["cpu"]
    assert described["cores"] >= 1
    if len(platform.node()) > 3:
        assert platform.node() not in json.dumps(described)


def test_reading_a_result_does_not_load_jax():
    code = "import sys, palpate.runs.result as r; r.machine(); assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_versions_are_those_of_installed_dependencies(monkeypatch):
    def requires(name):
        assert name == "palpate"
        return [
            "numpy>=2.4",
            "jax[cpu]>=0.10; python_version >= '3.11'",
            'nowhere-to-be-found>=1; extra == "rl"',
            'safetensors>=0.8; extra == "io"',
            'pytest>=9; extra == "test"',
        ]

    monkeypatch.setattr(importlib.metadata, "requires", requires)
    monkeypatch.setattr(importlib.metadata, "version", real_version_or_own)
    found = versions()
    assert list(found) == ["python", "palpate", "numpy", "jax", "safetensors"]
    assert found["numpy"] == real_version("numpy")


real_version = importlib.metadata.version


def real_version_or_own(name):
    return "0.1" if name == "palpate" else real_version(name)


def git(folder, *arguments):
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_the_commit_is_that_of_the_source_and_says_when_it_differs(tmp_path, monkeypatch):
    source = tmp_path / "src" / "palpate" / "runs"
    source.mkdir(parents=True)
    file = source / "result.py"
    file.write_text("a = 1\n")
    monkeypatch.setattr(module, "__file__", str(file))
    assert commit() is None  # no checkout
    git(tmp_path, "init", "-q")
    assert commit() is None  # nothing committed
    (tmp_path / "results.json").write_text("")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    head = git(tmp_path, "rev-parse", "HEAD")
    (tmp_path / "results.json").write_text("{}")
    assert commit() == head  # a new result does not make the source another
    file.write_text("a = 2\n")
    assert commit() == head + "-dirty"
