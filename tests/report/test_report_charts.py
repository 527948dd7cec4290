"""What a chart shows is what was measured: quantiles, curriculum, intervals, 16-bit motion."""

import base64

import numpy as np
import pytest

from palpate.families.rope.energy import chart as energy_chart
from palpate.report import Curves, Motion
from palpate.report.charts import horizon, learning, quantiles
from palpate.report.evidence import Parameter
from palpate.report.parameter_chart import parameters
from palpate.report.parameter_words import number
from palpate.report.player import scene
from palpate.report.style import STYLES, style_indices

TIME = np.linspace(0.0, 2.0, 201)


def traces(chart, **wanted):
    return [t for t in chart["data"] if all(t.get(key) == v for key, v in wanted.items())]


def test_energy_is_the_median_and_its_band_with_the_one_percent_line():
    values = np.exp(-TIME) * np.linspace(0.5, 1.5, 101)[:, None]
    chart = energy_chart(Curves(TIME, {"controlled": values}), {"controlled": 1})
    band, line = chart["data"]
    np.testing.assert_allclose(line["y"], np.exp(-TIME), rtol=1e-5)
    assert max(band["y"]) == pytest.approx(1.45)
    assert min(band["y"]) == pytest.approx(0.55 * np.exp(-2.0), rel=1e-4)
    assert chart["layout"]["yaxis"]["type"] == "log"
    assert chart["layout"]["shapes"][0]["y0"] == 0.01


def test_energies_that_rounding_left_below_zero_can_be_drawn():
    chart = energy_chart(Curves(TIME, {"x": -np.ones((1, 201))}), {"x": 1})
    assert min(chart["data"][0]["y"]) > 0


def test_a_band_does_not_bridge_a_gap():
    low, high = TIME.copy(), TIME + 1.0
    low[50:60] = np.nan
    curves = Curves(TIME, {"x": TIME}, {"x": (low, high)})
    bands = traces(horizon(curves, {"x": 1}, "m"), fill="toself")
    assert [len(band["x"]) for band in bands] == [100, 282]


def test_the_curriculum_is_marked_where_the_horizon_changes():
    lines = [
        {"step": s, "loss": 1.0 / (s + 1), "horizon": 50 if s < 7 else 100, "amplitude": s / 9}
        for s in range(10)
    ]
    chart = learning(lines)
    assert [shape["x0"] for shape in chart["layout"]["shapes"]] == [7.0]
    assert [trace["name"] for trace in chart["data"]] == ["loss", "horizon", "amplitude"]
    assert chart["layout"]["yaxis"]["type"] == "log"
    assert chart["data"][0]["y"] == pytest.approx([1 / (s + 1) for s in range(10)], rel=1e-5)


def test_a_loss_that_is_not_positive_has_a_linear_axis_and_none_is_a_gap():
    chart = learning([{"step": 0, "loss": -1.0}, {"step": 1, "loss": None}, {"step": 2, "loss": 1}])
    assert chart["layout"]["yaxis"]["type"] == "linear"
    assert chart["data"][0]["y"] == [-1.0, None, 1.0]
    assert "shapes" not in chart["layout"]


def test_six_losses_have_six_looks():
    chart = learning([{"step": step} | {f"{k} loss": 1.0 for k in range(6)} for step in range(3)])
    assert len({line["line"]["color"] for line in chart["data"]}) == 6


def test_a_long_curve_is_smoothed_within_a_stage_and_thinned():
    steps = np.arange(6000)
    noise = np.where(steps % 10 == 0, 100.0, 1.0)
    loss = np.where(steps < 3000, 1.0, 7.0) * noise
    lines = [
        {"step": int(s), "loss": float(v), "horizon": 1 + int(s >= 3000)}
        for s, v in zip(steps, loss, strict=True)
    ]
    raw, smooth, _ = learning(lines)["data"]
    assert len(raw["x"]) == len(smooth["x"]) == 1500
    assert set(smooth["y"]) == {1.0, 7.0}  # spikes gone, and no ramp between the stages
    assert smooth["y"][749] == 1.0
    assert smooth["y"][750] == 7.0


def row(name, value, lower=np.nan, upper=np.nan, fixed=False, verdict=None):
    value = np.atleast_1d(np.asarray(value, float))
    edges = (np.broadcast_to(np.asarray(edge, float), value.shape) for edge in (lower, upper))
    return Parameter(name, value, "N", "", fixed, False, *edges, verdict)


def test_whiskers_are_relative_to_the_median_and_cut_with_an_arrow():
    rows = [
        row("sure", 2.0, 1.0, 3.0),
        row("vague", 2.0, 1.0, 2000.0),
        row("several", [1.0, 2.0, 4.0], [0.5, 1.0, 2.0], [2.0, 4.0, 8.0]),
        row("given", 5.0, fixed=True),
        row("unknown", 5.0),
        row("signed", -1.0, -2.0, 1.0),
        row("prior", 4.0, 2.0, 8.0, verdict="not told by the data: the interval is the prior's"),
    ]
    chart = parameters(rows)
    assert len(chart["layout"]["yaxis"]["ticktext"]) == 6  # the signed one is left to the table
    whiskers = chart["data"][0]["x"]
    assert whiskers[:2] == [0.5, 1.5]
    assert whiskers[3:5] == [0.5, 20.0]  # ten times beyond the largest value shown
    assert whiskers[6:8] == [0.25, 1.0]
    (sure,) = traces(chart, name="identified, 90 % interval")
    assert sure["x"] == [1.0, 1.0, 0.5, 1.0, 2.0]
    (uninformed,) = traces(chart, name="not told by the data")
    assert uninformed["text"] == ["prior = 4 N (2 to 8)"]
    assert whiskers[15:17] == [0.5, 2.0]
    assert traces(chart, name="fixed")[0]["x"] == [1.0]
    assert traces(chart, name="no interval")[0]["x"] == [1.0]
    assert [t["marker"]["symbol"] for t in traces(chart, name="beyond")] == ["triangle-right"]
    assert parameters([row("signed", -1.0)]) is None


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1430.0, "1430"),
        (90000.4, "90000"),
        (0.012345, "0.0123"),
        (2.2e-4, "2.2×10⁻⁴"),
        (-3e7, "−3×10⁷"),
        (0.0, "0"),
        (-0.02, "−0.02"),
        (1.0, "1"),
        (float("nan"), "unknown"),
    ],
)
def test_numbers_have_the_figures_that_mean_something(value, text):
    assert number(value) == text


def test_motion_survives_its_sixteen_bits_and_keeps_gaps():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 2.0, (201, 4, 3))
    points[30, 2] = np.nan
    (group,) = scene([Motion("swing", TIME, {"observed": points})], {"observed": 0})["groups"]
    (drawn,) = group["chains"]
    numbers = np.frombuffer(base64.b64decode(drawn["data"]), "<i2").reshape(-1, 4, 3)
    found = np.where(numbers == -32768, np.nan, group["offset"] + group["step"] * numbers)
    frames = np.round(np.array(group["time"]) / 0.01).astype(int)
    np.testing.assert_allclose(found, points[frames], atol=3e-5)
    assert np.isnan(found).sum() == 3
    assert np.diff(group["time"]).max() <= 0.02 + 1e-9


def test_lines_that_a_gap_ends_have_no_tip_and_those_of_a_fan_are_faint():
    points = np.zeros((201, 4, 3))
    outlines = points.copy()
    outlines[:, -1] = np.nan
    looks = {"observed": 0, "draws": 1}
    (group,) = scene([Motion("", TIME, {"observed": points, "draws": outlines})], looks)["groups"]
    assert [chain["lines"] for chain in group["chains"]] == [False, True]
    assert [chain["faint"] for chain in group["chains"]] == [False, True]
    (group,) = scene([Motion("", TIME, {"observed": outlines, "x": points})], looks | {"x": 2})[
        "groups"
    ]
    assert [chain["lines"] for chain in group["chains"]] == [True, False]
    assert not any(chain["faint"] for chain in group["chains"])


def test_a_long_motion_is_thinned():
    time = np.arange(20_000) / 100
    (group,) = scene([Motion("", time, {"x": np.zeros((20_000, 1, 3))})], {"x": 1})["groups"]
    assert len(group["time"]) == 1000
    assert group["time"][-1] == time[-1]


def test_looks_differ_without_colour_and_references_are_broad():
    assert len({(style.dash, style.width) for style in STYLES}) == len(STYLES)
    assert len({style.symbol for style in STYLES}) == len(STYLES)
    looks = style_indices(["predicted", "observed", "a", "predicted", "b"])
    assert looks == {"observed": 0, "predicted": 1, "a": 2, "b": 3}
    assert style_indices("abcdefg")["g"] == 2
    assert style_indices(["identified", "start model", "a"]) == {
        "identified": 1,
        "start model": 2,
        "a": 3,
    }
    assert style_indices(["true", "controlled", "held still", "swing damper"]) == {
        **{"true": 0, "controlled": 1, "held still": 2, "swing damper": 3}
    }


def test_quantiles_leave_gaps_out():
    values = np.array([[1.0, np.nan], [3.0, np.nan], [np.nan, np.nan]])
    low, middle = quantiles(values, (0.0, 0.5))
    assert (low[0], middle[0]) == (1.0, 2.0)
    assert np.isnan(low[1])
