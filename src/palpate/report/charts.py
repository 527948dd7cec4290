"""The charts of a report as Plotly figures in plain dicts: {"data", "layout"}.

Colours are names of the page's palette ("@series-1", "@ink:0.2" with an opacity), which the page
replaces by those of a light or a dark screen. NaN becomes null, which Plotly leaves out as a gap.
"""

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from palpate.report.evidence import Curves
from palpate.report.style import STYLES

Chart = dict[str, Any]
_MOST_POINTS = 1500  # of one line: more than a screen has columns
_FEW = 40  # points up to which each is marked; one alone is no line
_MANY = 200  # steps from which on a learning curve is smoothed
_BAND = 0.16  # opacity


# --- the object -------------------------------------------------------------------------------


def horizon(curves: Curves, looks: Mapping[str, int], unit: str) -> Chart:
    """Prediction error in `unit` against seconds since the prediction began, with quantiles."""
    data: list[dict[str, Any]] = []
    for label, values in curves.values.items():
        if label in curves.bands:
            data += quantile_band(label, looks, curves.time, *curves.bands[label])
        data.append(curve_line(label, looks, curves.time, values, f"%{{y:.4g}} {plain_text(unit)}"))
    layout = empty_layout(340)
    layout["xaxis"] = titled_axis("time since the prediction began (s)")
    layout["yaxis"] = titled_axis(f"RMSE ({plain_text(unit) or 1})") | {"rangemode": "tozero"}
    return {"data": data, "layout": layout}


def prediction(curves: Curves, looks: Mapping[str, int], names: Sequence[str]) -> Chart:
    """Predicted numbers over time, a panel for each; several lines of a label are a fan."""
    data, count = [], curves.values[next(iter(curves.values))].shape[1]
    layout = empty_layout(max(300, 100 + 120 * count))
    # A fan beneath what is held against it, which it would hide.
    ordered = sorted(curves.values.items(), key=lambda item: -item[1].shape[2])
    for row in range(count):
        for label, values in ordered:
            line = curve_line(label, looks, curves.time, values[:, row, 0], "%{y:.4g}")
            if values.shape[2] > 1:
                every = max(1, math.ceil(values.shape[0] * values.shape[2] / (4 * _MOST_POINTS)))
                gap = np.full((1, values.shape[2]), math.nan)  # between one line and the next
                y = np.concatenate([values[::every, row], gap]).T.ravel()
                x = np.tile(np.append(curves.time[::every], math.nan), values.shape[2])
                thin = {"color": f"@series-{looks[label]}:0.3", "width": 1}
                line |= {"x": _numbers(x), "y": _numbers(y), "mode": "lines", "line": thin}
                line |= {"hoverinfo": "skip"}
                del line["hovertemplate"]
            data.append(line | _panel(row) | {"showlegend": row == 0})
        _place_panel(layout, row, plain_text(names[row]), 1.0 - row / count, 1.0 / count)
    last = f"y{count}" if count > 1 else "y"
    layout["xaxis"] = titled_axis("time (s)") | {"anchor": last}
    return {"data": data, "layout": layout}


# --- learning ---------------------------------------------------------------------------------

_PANELS = {"horizon": "horizon (steps)", "amplitude": "amplitude (1)"}


def learning(metrics: Sequence[Mapping[str, Any]]) -> Chart | None:
    """Loss against step, the curriculum's changes of horizon marked, its course in panels below.

    The top panel shows every metric whose name ends in "loss"; None where no line has one. The
    loss has the unit of what was minimised.
    """
    names = dict.fromkeys(name for line in metrics for name in line)
    columns = {name: _column(metrics, name) for name in (*names, "step", "horizon")}
    numeric = [name for name in names if np.isfinite(columns[name]).any()]
    losses = [name for name in numeric if name.endswith("loss")]
    panels = [name for name in _PANELS if name in numeric]
    if not losses:
        return None
    steps = columns["step"]
    every = max(1, math.ceil(len(steps) / _MOST_POINTS))
    data: list[dict[str, Any]] = []
    least, most = math.inf, -math.inf
    for index, name in enumerate(losses, start=1):
        values = columns[name]
        least, most = min(least, np.nanmin(values)), max(most, np.nanmax(values))
        look = index % len(STYLES)
        looks = {name: look}
        smooth = _smooth(values, columns["horizon"], every)
        if len(values) >= _MANY:
            raw = curve_line(name, looks, steps[::every], values[::every], "%{y:.4g}")
            raw |= {"line": {"color": f"@series-{look}:0.35", "width": 1}, "hoverinfo": "skip"}
            del raw["hovertemplate"]
            data.append(raw | {"showlegend": False})
        line = curve_line(name, looks, steps[::every], smooth, "%{y:.4g}")
        data.append(line | {"line": line["line"] | {"dash": "solid"}} if index == 1 else line)
    layout = empty_layout(300 + 140 * len(panels))
    share = 140 / (220 + 140 * len(panels))  # of one panel below the loss
    bottom = share * len(panels)
    layout["yaxis"] = titled_axis("loss (as minimised)") | {
        "type": "log" if least > 0 else "linear",
        "exponentformat": "power",
        "tickfont": {"size": 11},
        "domain": [bottom + 0.2 * share * bool(panels), 1.0],
        "dtick": 1 if least > 0 and most / least > 100 else None,  # within two decades finer
    }
    for row, name in enumerate(panels, start=1):
        line = curve_line(name, {name: 3 + row}, steps, columns[name], "%{y:.4g}")
        line["line"] |= {"shape": "hv", "dash": "solid"}
        data.append(line | _panel(row) | {"showlegend": False})
        _place_panel(layout, row, _PANELS[name], bottom - (row - 1) * share, share)
        layout[f"yaxis{row + 1}"] |= {"rangemode": "tozero", "nticks": 4}
    last = f"y{len(panels) + 1}" if panels else "y"
    layout["xaxis"] = titled_axis("step") | {"anchor": last}
    if "horizon" in panels:
        changes = steps[1:][np.diff(columns["horizon"]) != 0]
        edge = {"type": "line", "yref": "paper", "y0": 0, "y1": 1, "layer": "below"}
        edge["line"] = {"color": "@ink:0.35", "width": 1, "dash": "2px,3px"}
        layout["shapes"] = [edge | {"x0": x, "x1": x} for x in _numbers(changes)]
    return {"data": data, "layout": layout}


def _column(metrics: Sequence[Mapping[str, Any]], name: str) -> np.ndarray:
    values = [line.get(name) for line in metrics]
    return np.array([v if isinstance(v, int | float) else math.nan for v in values], dtype=float)


def _smooth(values: np.ndarray, horizon: np.ndarray, every: int) -> np.ndarray:
    """Every so many-th of a column's running median, begun anew where the horizon changes."""
    half = len(values) // 60 if len(values) >= _MANY else 0
    stages = np.split(values, 1 + np.flatnonzero(np.diff(np.nan_to_num(horizon))))
    smooth, begin = [], 0
    for stage in stages:
        padded = np.pad(stage, half, constant_values=math.nan)
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
        smooth.append(quantiles(windows[-begin % every :: every].T, (0.5,))[0])
        begin += len(stage)
    return np.concatenate(smooth)


# --- parts of every chart ---------------------------------------------------------------------


def curve_line(
    label: str, looks: Mapping[str, int], x: np.ndarray, y: np.ndarray, value: str
) -> dict[str, Any]:
    style = STYLES[looks[label]]
    colour = f"@series-{looks[label]}"
    dash = ",".join(f"{length}px" for length in style.dash) or "solid"
    every = max(1, math.ceil(len(x) / _MOST_POINTS))
    return {
        "type": "scatter",
        "mode": "lines" if len(x) > _FEW else "lines+markers",
        "marker": {"symbol": style.symbol, "size": 6, "color": colour},
        "name": plain_text(label),
        "legendgroup": plain_text(label),
        "x": _numbers(x[::every]),
        "y": _numbers(y[::every]),
        "line": {"color": colour, "width": min(style.width, 3.5), "dash": dash},
        "hovertemplate": value,
        "connectgaps": False,
    }


def quantile_band(
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
                "legendgroup": plain_text(label),
            }
        )
    return polygons


def empty_layout(height: int, left: int = 64) -> dict[str, Any]:
    """The looks that all charts share; `height` and the `left` margin in pixels."""
    return {
        "height": height,
        "margin": {"l": left, "r": 12, "t": 34, "b": 48},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 13, "color": "@ink"},
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom", "yref": "paper"},
        "hovermode": "x unified",
        "hoverlabel": {"bgcolor": "@page", "bordercolor": "@rule", "font": {"color": "@ink"}},
        "dragmode": False,
    }


def titled_axis(title: str) -> dict[str, Any]:
    """An axis whose `title` names its unit; it stays as it is, so that a page can be scrolled."""
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


def _place_panel(layout: dict[str, Any], row: int, title: str, top: float, height: float) -> None:
    """The axis of panel `row` (0 is the first) from `top` down, of so much of the chart."""
    domain = {"domain": [top - 0.82 * height, top]}
    layout[f"yaxis{row + 1}" if row else "yaxis"] = titled_axis(title) | domain


def note(text: str, **place: Any) -> dict[str, Any]:
    return {"text": text, "showarrow": False, "font": {"size": 12, "color": "@ink"}} | place


def plain_text(label: str) -> str:
    """A label that Plotly, which reads a little HTML, shows as it stands."""
    return html.escape(label, quote=False)


def _numbers(values: np.ndarray) -> list[float | None]:
    """Six figures of each value, None for a gap: JSON has no NaN."""
    return [float(f"{v:.6g}") if math.isfinite(v) else None for v in np.asarray(values, float)]


def quantiles(values: np.ndarray, levels: Sequence[float]) -> np.ndarray:
    """(levels, times) of values (episodes, times), gaps left out; NaN where all is a gap."""
    known = np.isfinite(values)
    whole, some = known.all(axis=0), known.any(axis=0) & ~known.all(axis=0)
    found = np.full((len(levels), values.shape[1]), math.nan)
    found[:, whole] = np.quantile(values[:, whole], levels, axis=0)
    # a hundred times slower a column, so only where it must be
    found[:, some] = np.nanquantile(values[:, some], levels, axis=0)
    return found
