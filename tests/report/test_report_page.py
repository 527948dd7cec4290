"""The page is whole in itself, says what there is evidence for, and runs nobody's text."""

import html
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from plotly.graph_objects import Figure

from palpate.errors import PalpateError
from palpate.report import build_report, write_evidence
from synthetic_evidence import (
    chain,
    evaluation,
    figure,
    identification,
    parameter,
    training,
    write_metrics,
    write_run,
)

VOID = {"meta", "br", "img", "input", "link", "base"}
EVERY_SECTION = [
    *("Results", "Motion", "Energy", "Path of the tip", "Error against horizon", "Parameters"),
    *("Learning", "What was run"),
]


class Page(HTMLParser):
    """What a browser would find: nesting checked, links and data collected."""

    def __init__(self, text):
        super().__init__()
        self.kind = None
        self.open, self.headings, self.data, self.loads, self.tags = [], [], [], [], []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == [], f"left open: {self.open}"

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.tags.append(tag)
        self.loads += [
            attributes[a] for a in ("src", "href", "srcset", "action") if a in attributes
        ]
        assert not any(name.startswith("on") for name in attributes)
        if tag not in VOID:
            self.open.append(tag)
        self.kind = attributes.get("type") if tag == "script" else None
        if self.kind:
            self.data.append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        self.kind = None

    def handle_data(self, data):
        if self.kind:
            self.data[-1] += data
        elif "script" not in self.open and "style" not in self.open:
            self.text += data
            if self.open and self.open[-1] == "h2":
                self.headings.append(data)


def page_of(path):
    return Page(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    runs = [
        identification(folder / "identify"),
        training(folder / "train"),
        evaluation(folder / "evaluate"),
    ]
    return build_report(runs, folder / "report.html", "From recording to rest")


def test_the_page_tells_everything_in_order(report):
    page = page_of(report)
    assert page.headings == EVERY_SECTION
    for words in (
        "From recording to rest",
        "2 of 3 bars met",
        "It swings as recorded. Trust it for 5 s.",
        "A long warning",
        "0.0214",
        "✗ not met",
        "0.0704",
        "PD damper 0.51",
        "± 0.002",
        "Without force data only ratios to the mass can be told.",
        "2.2×10⁻⁴ N s/m",
        "controlled stays below 1 % from 0.74 s on",
        "held still does not come to stay below 1 %",
        "root-mean-square distance from what was observed: 0.0576 m (predicted)",
        "0.022 m after 5 s (identified)",
        "palpate train R.npz",
        "0123abc",
    ):
        assert words in page.text, words


def test_the_page_opens_with_sentences_a_picture_and_folded_warnings(report):
    text = report.read_text(encoding="utf-8")
    marks = ('class="lead"', 'class="player"', "A long warning", ">Results<", "Parameters")
    places = [text.index(mark) for mark in marks]
    assert places == sorted(places)
    notes = text.partition('<section class="notes">')[2].partition("</section>")[0]
    assert notes.count('<details class="note"><summary>A long warning') == 4
    assert "<summary>1 more</summary><details" in notes


def test_the_page_loads_nothing(report):
    page = page_of(report)
    assert page.loads == []
    assert {"link", "iframe", "object", "base"}.isdisjoint(page.tags)
    text = report.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    styles = re.findall(r"<style>(.*?)</style>", text, re.DOTALL)
    assert not any("url(" in style or "@import" in style for style in styles)
    assert text.count("plotly.js v") == 1
    assert len(text.encode()) < 6_000_000


def test_every_chart_is_one_that_plotly_accepts_with_units_on_its_axes(report):
    charts = [json.loads(data) for data in page_of(report).data]
    charts = [chart for chart in charts if "layout" in chart]
    assert len(charts) == 8  # three tip paths, horizon, parameters, two learning curves, energy
    for chart in charts:
        plain = re.sub(r'"@[\w:.-]+"', '"black"', json.dumps(chart))
        Figure(json.loads(plain))
        titles = [
            axis["title"]["text"] for key, axis in chart["layout"].items() if "axis" in key[1:]
        ]
        assert all(t in ("", "step") or re.search(r"\((.+)\)$", t) for t in titles), titles


def test_the_same_files_give_the_same_page(report, tmp_path):
    runs = [report.parent / name for name in ("identify", "train", "evaluate")]
    again = build_report(runs, tmp_path / "again.html", "From recording to rest")
    assert again.read_bytes() == report.read_bytes()


TIME, POINTS = chain(points=4, seconds=1.0)
ENERGIES = np.exp(-TIME)[None]


@pytest.mark.parametrize(
    ("arrays", "metrics", "result", "sections"),
    [
        ({}, [], {}, []),
        ({"motion.time": TIME, "motion.x": POINTS}, [], {}, ["Path of the tip"]),
        ({"horizon.time": TIME, "horizon.x": TIME}, [], {}, ["Error against horizon"]),
        ({"energy.time": TIME, "energy.x": ENERGIES}, [], {}, ["Energy"]),
        ({}, [{"step": 0, "loss": 1.0}], {}, ["Learning"]),
        ({}, [{"step": 0, "reward": None}], {}, []),
        ({}, [], {"figures": [figure("a", None, "m", 1.0)]}, ["Results"]),
        ({}, [], {"parameters": [parameter("a", 1.0, "m", "")]}, ["Parameters"]),
        ({}, [], {"parameters": [parameter("a", [-1.0, None], "m", "")]}, ["Parameters"]),
        ({}, [], {"parameters": [parameter("a", [], "m", "")]}, []),
    ],
)
def test_a_section_appears_where_there_is_evidence(tmp_path, arrays, metrics, result, sections):
    run = write_run(tmp_path / "run", "one", **result)
    if arrays:
        write_evidence(run, arrays)
    if metrics:
        write_metrics(run, metrics)
    page = page_of(build_report([run], tmp_path / "page.html", "One"))
    assert page.headings == [*sections, "What was run"]


def test_gaps_and_nothing_but_gaps_are_drawn_as_gaps(tmp_path):
    gaps = POINTS.copy()
    gaps[40:60] = np.nan
    arrays = {"motion.time": TIME, "motion.observed": gaps, "motion.lost": POINTS * np.nan}
    arrays |= {"energy.time": TIME, "energy.x": np.full((2, len(TIME)), np.nan)}
    arrays |= {"horizon.time": TIME, "horizon.x": TIME * np.nan}
    write_evidence(write_run(tmp_path / "run", "one"), arrays)
    page = page_of(build_report([tmp_path / "run"], tmp_path / "page.html", "One"))
    assert not any("NaN" in data for data in page.data)
    tip = next(json.loads(data) for data in page.data if '"z (m)"' in data)
    assert tip["data"][0]["y"][40:60] == [None] * 20
    assert None not in tip["data"][0]["y"][:40]
    assert tip["data"][0]["connectgaps"] is False


EVIL = "</script><script>alert(1)</script><img src='http://x/y' onerror=alert(1)>\"'&<!--body-->"


def test_what_the_data_tell_is_counted_and_what_follows_from_it_is_not(tmp_path):
    uninformed = "not told by the data: the interval is the prior's"
    rows = [
        parameter("mass", [8.0, 9.0], "kg", "") | {"lower": [7.0, 8.5], "upper": [8.5, 9.5]},
        parameter("friction", [0.1], "1", "", lower=[0.0], upper=[0.4], verdict=uninformed),
        parameter("radius", [0.2], "m", "", fixed=True),
        parameter("roll_direction", [3.0], "deg", "", lower=[-1.0], upper=[5.0], derived=True),
    ]
    run = write_run(tmp_path / "identify", "identify", parameters=rows)
    page = page_of(build_report([run], tmp_path / "report.html", "A table"))
    assert "1 of 3 parameters were identified" in page.text
    assert "7 to 8.5; 8.5 to 9.5" in page.text  # a few elements one by one
    assert "derived" in page.text
    assert "0.1 1" not in page.text
    drawn = [row for text in page.data for row in re.findall("roll.direction", text)]
    assert drawn == []  # degrees have no place on a logarithmic axis


def test_nobodys_text_becomes_markup(tmp_path):
    group = EVIL.replace("/", "").replace(".", "")
    arrays = {"motion.time": TIME, f"motion.{EVIL}": POINTS, f"motion/{group}.{EVIL}": POINTS}
    arrays |= {f"motion/{group}.time": TIME, "energy.time": TIME, f"energy.{EVIL}": ENERGIES}
    result = {
        "figures": [figure(EVIL, 1.0, EVIL, 2.0, seed_document=EVIL, rival=EVIL)],
        "parameters": [parameter(EVIL, 1.0, EVIL, EVIL, verdict=EVIL)],
        "settings": {EVIL: EVIL, "summary": [EVIL]},
        "warnings": [EVIL],
    }
    run = write_run(tmp_path / "run", EVIL, **result)
    write_evidence(run, arrays)
    write_metrics(run, [{"step": 0, f"{EVIL}loss": 1.0}])
    plain = build_report([write_run(tmp_path / "b", "b")], tmp_path / "b.html", "b")
    page = page_of(build_report([run], tmp_path / "page.html", EVIL))
    assert "img" not in page.tags
    assert page.loads == []
    assert page.tags.count("script") - len(page.data) == page_of(plain).tags.count("script")
    assert page.text.count(EVIL) > 8
    charts = [json.loads(data) for data in page.data]
    names = [
        trace["name"] for chart in charts for trace in chart.get("data", ()) if "name" in trace
    ]
    assert html.escape(EVIL, quote=False) in names  # Plotly itself reads a little HTML
    assert not any("<" in name for name in names)


def test_a_rendering_is_embedded(tmp_path):
    run = write_run(tmp_path / "run", "one")
    (run / "rendering.webp").write_bytes(b"picture")
    page = page_of(build_report([run], tmp_path / "page.html", "One"))
    assert page.headings == ["What was run"]  # the page opens with it
    assert page.loads == ["data:image/webp;base64,cGljdHVyZQ=="]


def test_a_page_of_many_runs_opens_with_one_picture(tmp_path):
    runs = [write_run(tmp_path / name, name) for name in ("plain", "one", "two", "three")]
    for run in runs[1:]:
        write_evidence(run, {"motion.time": TIME, "motion.observed": POINTS})
    text = build_report(runs, tmp_path / "page.html", "Many").read_text(encoding="utf-8")
    opening, _, rest = text.partition("<h2>Motion</h2>")
    assert opening.count('class="player"') == 1
    assert "<h3>one</h3>" in opening
    motion = rest.partition("<h2>")[0]
    assert re.findall("<h3>(.*?)</h3>", motion) == ["two", "three"]


def test_pictures_of_the_run_that_the_page_is_about_are_embedded(tmp_path):
    runs = [write_run(tmp_path / name, name) for name in ("one", "two")]
    for run in runs:
        (run / "ranks & <more>.png").write_bytes(run.name.encode())
    page = page_of(build_report(runs, tmp_path / "page.html", "One"))
    assert page.headings == ["What was run"]
    assert page.loads == ["data:image/png;base64,b25l"]


@pytest.mark.parametrize(
    ("count", "words"), [(5, "run 0 → run 1 → run 2 → run 3 → run 4"), (7, "run 4 and 2 more")]
)
def test_many_stages_are_counted(tmp_path, count, words):
    runs = [write_run(tmp_path / f"{n}", f"run {n}") for n in range(count)]
    page = page_of(build_report(runs, tmp_path / "page.html", "Many"))
    assert words in page.text
    assert "→ run 5" not in page.text


def test_lines_of_a_summary_are_sentences_on_the_page(tmp_path):
    run = write_run(tmp_path / "run", "one", settings={"summary": ["part 1: a hinge", "It moves."]})
    page = page_of(build_report([run], tmp_path / "page.html", "One"))
    assert "part 1: a hinge. It moves." in page.text
    assert "moves.." not in page.text


def test_no_run_is_refused(tmp_path):
    with pytest.raises(PalpateError, match="at least one run"):
        build_report([], tmp_path / "page.html", "None")


def test_columns_in_which_nothing_stands_are_left_out(tmp_path):
    own = figure("success rate", 0.9, "")
    held = figure("tip error", 0.02, "m", 0.03)
    for name, figures in (("own", [own]), ("held", [own, held])):
        write_run(tmp_path / name, name, figures=figures)
    for name, columns in (("own", ["", "value"]), ("held", ["", "value", "bar", "verdict"])):
        page = tmp_path / f"{name}.html"
        build_report([tmp_path / name], page, "A page")
        table = page.read_text(encoding="utf-8").partition('<table class="results">')[2]
        assert re.findall("<th>(.*?)</th>", table.partition("</thead>")[0]) == columns
