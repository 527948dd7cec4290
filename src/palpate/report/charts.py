"""The charts of a report as Plotly figures in plain dicts: {"data", "layout"}.

Colours are names of the page's palette ("@series-1", "@ink:0.2" with an opacity), which the page
replaces by those of a light or a dark screen. A function that may have nothing to draw returns None. NaN becomes null, which Plotly leaves out as a gap.
"""

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from palpate.report.evidence import Curves, Motion, Parameter
from palpate.report.style import STYLES

Chart = dict[str, Any]
_MOST_POINTS = 1500  # of one line: more than a screen has columns
_MANY = 200  # steps from which on a learning curve is smoothed
_BAND = 0.16  # opacity


# --- the object -------------------------------------------------------------------------------


def tip(motion: Motion, looks: Mapping[str, int], height: int) -> Chart:
    """Each coordinate of a motion's last point over time, one panel an axis; metres, seconds."""
    data, layout = [], _layout(height)
    for row, axis in enumerate("xyz"):
        for label, chain in motion.chains.items():
            line = _line(label, looks, motion.time, chain[:, -1, row], "%{y:.3f} m")
            data.append(line | _panel(row) | {"showlegend": row == 0})
        top = 1.0 - row * 0.345
        layout[f"yaxis{row + 1 if row else ''}"] = _axis(f"{axis} (m)") | {
            "domain": [top - 0.31, top]
        }
    layout["xaxis"] = _axis("time (s)") | {"anchor": "y3"}
    return {"data": data, "layout": layout}


def horizon(curves: Curves, looks: Mapping[str, int]) -> Chart:
    """Prediction error in metres against seconds since the prediction began, with quantiles."""
    data: list[dict[str, Any]] = []
    for label, values in curves.values.items():
        if label in curves.bands:
            data += _band(label, looks, curves.time, *curves.bands[label])
        data.append(_line(label, looks, curves.time, values, "%{y:.4f} m"))
    layout = _layout(340)
    layout["xaxis"] = _axis("time since the prediction began (s)")
    layout["yaxis"] = _axis("RMSE (m)") | {"rangemode": "tozero"}
    return {"data": data, "layout": layout}


def energy(curves: Curves, looks: Mapping[str, int]) -> Chart:
    """Median energy over the episodes and their 5-95 % band on a log scale, the 1 % line marked."""
    data: list[dict[str, Any]] = []
    largest = 1.0
    for label, values in curves.values.items():
        # what has come to rest may lie a rounding below zero, where a logarithm has no place
        low, median, high = _quantiles(np.maximum(values, 1e-9), (0.05, 0.5, 0.95))
        largest = max(largest, float(np.nanmax(high, initial=1.0)))
        if len(values) > 1:
            data += _band(label, looks, curves.time, low, high)
        data.append(_line(label, looks, curves.time, median, "%{y:.2%}"))
    layout = _layout(380)
    layout["xaxis"] = _axis("time (s)")
    decades = range(-4, math.ceil(math.log10(largest)) + 1)
    layout["yaxis"] = _axis("energy relative to the start (%)") | {
        "type": "log",
        "range": [-4.2, math.log10(largest) + 0.15],
        "tickvals": [10.0**decade for decade in decades],
        "ticktext": [f"{10.0 ** (decade + 2):g} %" for decade in decades],
    }
    line = {"color": "@ink", "width": 1.2, "dash": "4px,4px"}
    layout["shapes"] = [
        {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": 0.01, "y1": 0.01, "line": line}
    ]
    layout["annotations"] = [
        _note("1 %: at rest", xref="paper", x=1, xanchor="right", y=-2, yanchor="bottom")
    ]
    return {"data": data, "layout": layout}


# --- parameters -------------------------------------------------------------------------------

_REACH = 10.0  # an interval that goes on beyond this factor is drawn to there with an arrow


def parameters(rows: Sequence[Parameter]) -> Chart | None:
    """Dots with 90 % whiskers relative to each parameter's median on a log axis; no unit.

    A parameter of several elements has a dot for each, one under the other. Filled is what was
    identified, hollow what was fixed, crossed what the data cannot tell. Parameters that are not
    positive have no place on the axis and are left to the table.
    """
    drawn = [row for row in rows if row.value.size and np.all(row.value > 0)]
    if not drawn:
        return None
    relative = np.concatenate([row.value / np.median(row.value) for row in drawn])
    least, most = relative.min() / _REACH, relative.max() * _REACH
    marks: dict[str, dict[str, list[Any]]] = {}
    ticks, height, limits = [], 0.0, [0.8, 1.25]
    whiskers: dict[str, list[Any]] = {"x": [], "y": []}
    for row in drawn:
        middle = float(np.median(row.value))
        pitch = min(5.0, 110.0 / row.value.size)  # pixels between the elements
        height += 15.0
        ticks.append(height + pitch * (row.value.size - 1) / 2)
        for index, value in enumerate(row.value):
            y = -(height + pitch * index)
            lower, upper = row.lower[index], row.upper[index]
            kind = _FIXED if row.fixed else _SURE if math.isfinite(upper - lower) else _UNSURE
            mark = marks.setdefault(kind, {"x": [], "y": [], "text": []})
            mark["x"].append(value / middle)
            mark["y"].append(y)
            element = f"[{index}]" if row.value.size > 1 else ""
            mark["text"].append(_text(f"{row.name}{element} = {interval(value, lower, upper)}"))
            limits.append(value / middle)
            if kind != _SURE:
                continue
            ends = [lower / middle, upper / middle]
            limits += ends
            shown = [min(max(end, least), most) for end in ends]
            whiskers["x"] += [*shown, None]
            whiskers["y"] += [y, y, None]
            for end, edge, symbol in zip(ends, shown, _ARROWS, strict=True):
                if end != edge:
                    beyond = marks.setdefault(symbol, {"x": [], "y": [], "text": []})
                    beyond["x"].append(edge)
                    beyond["y"].append(y)
                    beyond["text"].append("the interval goes on")
        height += pitch * (row.value.size - 1) + 15.0
    data: list[dict[str, Any]] = [
        whiskers
        | {"type": "scatter", "mode": "lines", "hoverinfo": "skip", "showlegend": False}
        | {"name": "90 % interval", "line": {"color": "@series-1", "width": 2}}
    ]
    for kind, mark in marks.items():
        look = {"symbol": _SYMBOLS.get(kind, kind), "size": 8, "color": "@series-1"}
        look["line"] = {"color": "@series-1", "width": 1.5}
        data.append(
            {"type": "scatter", "mode": "markers", "marker": look, "name": kind}
            | {"hovertemplate": "%{text}<extra></extra>", "showlegend": kind in _SYMBOLS}
            | {"cliponaxis": False}
            | mark
        )
    layout = _layout(round(height) + 110) | {"hovermode": "closest"}
    edges = [max(min(limits), least) / 1.15, min(max(limits), most) * 1.15]
    ticks_along = _TICKS if edges[1] / edges[0] < 5 else _TICKS_OF_DECADES
    layout["xaxis"] = _axis("value relative to the parameter's median (no unit)") | {
        "type": "log",
        "range": [math.log10(edge) for edge in edges],
        "tickvals": ticks_along,
        "ticktext": [f"{tick:g}×" for tick in ticks_along],
        "tickangle": 0,
    }
    layout["yaxis"] = _axis("") | {
        "tickvals": [-tick for tick in ticks],
        "ticktext": [_text(row.name.replace("_", " ")) for row in drawn],
        "range": [-height, 0],
        "automargin": True,
        "showgrid": False,
    }
    layout["margin"]["l"] = 10
    return {"data": data, "layout": layout}


_SURE, _FIXED, _UNSURE = "identified, 90 % interval", "fixed", "no interval"
_SYMBOLS = {_SURE: "circle", _FIXED: "circle-open", _UNSURE: "x-thin-open"}
_TICKS = [0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0]
_TICKS_OF_DECADES = [0.001, 0.01, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 100.0, 1000.0]
_ARROWS = "triangle-left", "triangle-right"


def interval(value: float, lower: float, upper: float) -> str:
    """A number and its interval to three figures: "0.0123 (0.011 to 0.0135)"."""
    if math.isnan(lower) or math.isnan(upper):
        return number(value)
    return f"{number(value)} ({number(lower)} to {number(upper)})"


def number(value: float) -> str:
    """To three figures, or the digits before the point: "1430", "0.0123", "2.2×10⁻⁴"."""
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        digits = max(3, math.floor(math.log10(abs(value) or 1)) + 1)
        text = np.format_float_positional(value, precision=digits, fractional=False, trim="-")
    else:
        mantissa, exponent = f"{value:.2e}".split("e")
        text = f"{float(mantissa):g}×10{str(int(exponent)).translate(_RAISED)}"
    return text.replace("-", "−")


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


# --- learning ---------------------------------------------------------------------------------

_LOSS_PANEL, _PANELS = "loss", {"horizon": "horizon (steps)", "amplitude": "amplitude (1)"}


def learning(metrics: Sequence[Mapping[str, Any]]) -> Chart | None:
    """Loss against step, the curriculum's changes of horizon marked, its course in panels below.

    The top panel shows every metric whose name ends in "loss"; None where no line has one. The
    loss has the unit of what was minimised.
    """
    losses = [name for name in _numeric(metrics) if name.endswith(_LOSS_PANEL)]
    panels = [name for name in _PANELS if name in _numeric(metrics)]
    if not losses:
        return None
    steps = _column(metrics, "step")
    every = max(1, math.ceil(len(steps) / _MOST_POINTS))
    data: list[dict[str, Any]] = []
    positive = True
    for index, name in enumerate(losses, start=1):
        values = _column(metrics, name)
        positive &= not (values <= 0).any()
        looks = {name: index}
        smooth = _smooth(values, _column(metrics, "horizon"))
        if len(values) >= _MANY:
            raw = _line(name, looks, steps[::every], values[::every], "%{y:.4g}")
            raw |= {"line": {"color": f"@series-{index}:0.35", "width": 1}, "hoverinfo": "skip"}
            del raw["hovertemplate"]
            data.append(raw | {"showlegend": False})
        line = _line(name, looks, steps[::every], smooth[::every], "%{y:.4g}")
        data.append(line | {"line": line["line"] | {"dash": "solid"}} if index == 1 else line)
    layout = _layout(300 + 110 * len(panels))
    bottom = 1.0 - 190 / (220 + 110 * len(panels)) if panels else 0.0
    layout["yaxis"] = _axis("loss (as minimised)") | {
        "type": "log" if positive else "linear",
        "exponentformat": "power",
        "tickfont": {"size": 11},
        "domain": [bottom, 1.0],
        "dtick": 1 if positive else None,
    }
    share = bottom / len(panels) if panels else 0.0
    for row, name in enumerate(panels, start=1):
        line = _line(name, {name: 3 + row}, steps, _column(metrics, name), "%{y:.4g}")
        line["line"] |= {"shape": "hv", "dash": "solid"}
        data.append(line | _panel(row) | {"showlegend": False})
        top = bottom - (row - 1) * share
        layout[f"yaxis{row + 1}"] = _axis(_PANELS[name]) | {
            "domain": [top - share, top - 0.3 * share],
            "rangemode": "tozero",
            "nticks": 4,
        }
    last = f"y{len(panels) + 1}" if panels else "y"
    layout["xaxis"] = _axis("step") | {"anchor": last}
    if "horizon" in panels:
        changes = steps[1:][np.diff(_column(metrics, "horizon")) != 0]
        edge = {"type": "line", "yref": "paper", "y0": 0, "y1": 1, "layer": "below"}
        edge["line"] = {"color": "@ink:0.35", "width": 1, "dash": "2px,3px"}
        layout["shapes"] = [edge | {"x0": x, "x1": x} for x in _numbers(changes)]
    return {"data": data, "layout": layout}


def _numeric(metrics: Sequence[Mapping[str, Any]]) -> list[str]:
    """The metrics that are a number in some line, in order of appearance."""
    names = dict.fromkeys(name for line in metrics for name in line)
    return [name for name in names if np.isfinite(_column(metrics, name)).any()]


def _column(metrics: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    values = [line.get(name) for line in metrics]
    return np.array([v if isinstance(v, int | float) else math.nan for v in values], dtype=float)


def _smooth(values: np.ndarray, horizon: np.ndarray) -> np.ndarray:
    """The running median of a long column, begun anew where the horizon changes."""
    half = len(values) // 60 if len(values) >= _MANY else 0
    stages = np.split(values, 1 + np.flatnonzero(np.diff(np.nan_to_num(horizon))))
    smooth = []
    for stage in stages:
        padded = np.pad(stage, half, constant_values=math.nan)
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
        smooth.append(_quantiles(windows.T, (0.5,))[0])
    return np.concatenate(smooth)


# --- parts of every chart ---------------------------------------------------------------------


def _line(
    label: str, looks: Mapping[str, int], x: np.ndarray, y: np.ndarray, value: str
) -> dict[str, Any]:
    style = STYLES[looks[label]]
    colour = f"@series-{looks[label]}"
    dash = ",".join(f"{length}px" for length in style.dash) or "solid"
    every = max(1, math.ceil(len(x) / _MOST_POINTS))
    return {
        "type": "scatter",
        "mode": "lines",
        "name": _text(label),
        "legendgroup": _text(label),
        "x": _numbers(x[::every]),
        "y": _numbers(y[::every]),
        "line": {"color": colour, "width": min(style.width, 3.5), "dash": dash},
        "hovertemplate": value,
        "connectgaps": False,
    }


def _band(
    label: str, looks: Mapping[str, int], x: np.ndarray, low: np.ndarray, high: np.ndarray
) -> list[dict[str, Any]]:
    """A filled polygon for each stretch without a gap, because a fill would bridge gaps."""
    polygons = []
    known = np.isfinite(low) & np.isfinite(high)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        every = max(1, math.ceil((end - begin) / _MOST_POINTS))
        part = slice(begin, end, every)
        polygons.append(
            {
                "type": "scatter",
                "mode": "lines",
                "fill": "toself",
                "x": _numbers(np.concatenate([x[part], x[part][::-1]])),
                "y": _numbers(np.concatenate([low[part], high[part][::-1]])),
                "fillcolor": f"@series-{looks[label]}:{_BAND}",
                "line": {"width": 0},
                "hoverinfo": "skip",
                "showlegend": False,
                "legendgroup": _text(label),
            }
        )
    return polygons


def _layout(height: int) -> dict[str, Any]:
    return {
        "height": height,
        "margin": {"l": 64, "r": 12, "t": 34, "b": 48},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": "@ink"},
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom", "yref": "paper"},
        "hovermode": "x unified",
        "hoverlabel": {"bgcolor": "@page", "bordercolor": "@rule", "font": {"color": "@ink"}},
        "dragmode": False,
    }


def _axis(title: str) -> dict[str, Any]:
    return {
        "title": {"text": title, "standoff": 8, "font": {"size": 13}},
        "gridcolor": "@rule",
        "linecolor": "@rule",
        "zeroline": False,
        "ticks": "",
        "fixedrange": True,
    }


def _panel(row: int) -> dict[str, str]:
    return {"xaxis": "x", "yaxis": f"y{row + 1}" if row else "y"}


def _note(text: str, **place: Any) -> dict[str, Any]:
    return {"text": text, "showarrow": False, "font": {"size": 12, "color": "@ink"}} | place


def _text(label: str) -> str:
    """A label that Plotly, which reads a little HTML, shows as it stands."""
    return html.escape(label, quote=False)


def _numbers(values: np.ndarray) -> list[float | None]:
    """Six figures of each value, None for a gap: JSON has no NaN."""
    return [float(f"{v:.6g}") if math.isfinite(v) else None for v in np.asarray(values, float)]


def _quantiles(values: np.ndarray, levels: Sequence[float]) -> np.ndarray:
    """Quantiles over the first axis, gaps apart; NaN where everything is a gap."""
    known = np.isfinite(values).any(axis=0)
    found = np.full((len(levels), values.shape[1]), math.nan)
    found[:, known] = np.nanquantile(values[:, known], levels, axis=0)
    return found
