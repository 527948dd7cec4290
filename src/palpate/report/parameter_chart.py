"""What was identified, as dots with whiskers."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from palpate.report.charts import Chart, empty_layout, plain_text, titled_axis
from palpate.report.evidence import Parameter
from palpate.report.parameter_words import number

_SURE, _UNINFORMED = "identified, 90 % interval", "not told by the data"
_FIXED, _UNSURE = "fixed", "no interval"
_SYMBOLS = {
    _SURE: "circle",
    _UNINFORMED: "diamond-open",
    _FIXED: "circle-open",
    _UNSURE: "x-thin-open",
}
_REACH = 10.0  # an interval that goes on beyond this factor is drawn to there, with an arrow
_ARROWS = "triangle-left", "triangle-right"
_TICKS = [0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 2.0]
_TICKS_OF_DECADES = [0.001, 0.01, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 100.0, 1000.0]
_GAP = 15.0  # pixels above and below a parameter
_COLOUR = "@series-1"


class _Dot(NamedTuple):
    """One element: its place and size in pixels, and its numbers relative to the median."""

    kind: str
    y: float
    value: float
    lower: float
    upper: float
    size: float
    text: str


def parameters(rows: Sequence[Parameter]) -> Chart | None:
    """Dots with 90 % whiskers relative to each parameter's median, on a log axis; no unit.

    A parameter of several elements has a dot for each, one under the other. Filled is what was
    identified, hollow what was fixed, a diamond what the data did not tell, a cross what has no
    interval. Parameters that are not positive have no place on the axis and are left to the table;
    None when there is no other.
    """
    drawn = [row for row in rows if row.value.size and np.all(row.value > 0)]
    if not drawn:
        return None
    dots, ticks, top = [], [], 0.0
    for row in drawn:
        pitch = min(5.0, 110.0 / row.value.size)
        ticks.append(top + _GAP + pitch * (row.value.size - 1) / 2)
        dots += _dots(row, top + _GAP, pitch)
        top = dots[-1].y + _GAP
    least = min(dot.value for dot in dots) / _REACH
    most = max(dot.value for dot in dots) * _REACH
    intervals = [dot for dot in dots if dot.kind in (_SURE, _UNINFORMED)]
    shown = [(max(dot.lower, least), min(dot.upper, most)) for dot in intervals]
    whiskers = {
        "x": [x for ends in shown for x in (*ends, None)],
        "y": [y for dot in intervals for y in (-dot.y, -dot.y, None)],
        "line": {"color": _COLOUR, "width": 2},
        "hoverinfo": "skip",
    }
    data = [{"type": "scatter", "mode": "lines", "showlegend": False} | whiskers]
    for kind, symbol in _SYMBOLS.items():
        data += _markers(kind, symbol, [dot for dot in dots if dot.kind == kind], legend=True)
    for side, symbol in enumerate(_ARROWS):
        beyond = [
            dot._replace(value=ends[side], text="the interval goes on")
            for dot, ends in zip(intervals, shown, strict=True)
            if ends[side] != (dot.lower, dot.upper)[side]
        ]
        data += _markers("beyond", symbol, beyond, legend=False)
    limits = [0.8, 1.25, *(dot.value for dot in dots), *(end for ends in shown for end in ends)]
    return {"data": data, "layout": _layout(drawn, ticks, top, min(limits), max(limits))}


def _dots(row: Parameter, top: float, pitch: float) -> Iterator[_Dot]:
    middle = float(np.median(row.value))
    for index, (value, lower, upper) in enumerate(
        zip(row.value, row.lower, row.upper, strict=True)
    ):
        known = math.isfinite(upper - lower)
        kind = _UNINFORMED if row.uninformed else _SURE
        kind = _FIXED if row.fixed else kind if known else _UNSURE
        element = f"[{index}]" if row.value.size > 1 else ""
        text = f"{row.name}{element} = {number(value)} {row.unit}".rstrip()
        text += f" ({number(lower)} to {number(upper)})" if kind in (_SURE, _UNINFORMED) else ""
        yield _Dot(
            kind=kind,
            y=top + pitch * index,
            value=float(value) / middle,
            lower=float(lower) / middle,
            upper=float(upper) / middle,
            size=8.0 if row.value.size == 1 else max(3.0, pitch + 1.0),
            text=plain_text(text),
        )


def _markers(name: str, symbol: str, dots: Sequence[_Dot], legend: bool) -> list[dict[str, Any]]:
    """A trace of markers at the dots; none without dots."""
    marker = {
        "symbol": symbol,
        "size": [dot.size for dot in dots],
        "opacity": 1,
        "color": _COLOUR,
        "line": {"color": _COLOUR, "width": 1.5},
    }
    trace = {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": [dot.value for dot in dots],
        "y": [-dot.y for dot in dots],
        "text": [dot.text for dot in dots],
        "marker": marker,
        "hovertemplate": "%{text}<extra></extra>",
        "showlegend": legend,
        "cliponaxis": False,
    }
    return [trace] if dots else []


def _layout(
    rows: Sequence[Parameter], ticks: Sequence[float], height: float, low: float, high: float
) -> dict[str, Any]:
    layout = empty_layout(round(height) + 110, left=10) | {"hovermode": "closest"}
    along = _TICKS if high / low < 4 else _TICKS_OF_DECADES
    layout["xaxis"] = titled_axis("value / its median (1)") | {
        "type": "log",
        "range": [math.log10(low / 1.15), math.log10(high * 1.15)],
        "tickvals": along,
        "ticktext": [f"{tick:g}×" for tick in along],
        "tickangle": 0,
    }
    layout["yaxis"] = titled_axis("") | {
        "tickvals": [-tick for tick in ticks],
        "ticktext": [plain_text(row.name.replace("_", " ")) for row in rows],
        "range": [-height, 0],
        "automargin": True,
        "showgrid": False,
    }
    return layout
