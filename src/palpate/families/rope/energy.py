"""The energy left in a rope over time: what its evaluations add to a run's page.

`evidence.npz` holds `energy.time` (times,) in s and, for each controller, `energy.<label>`
(episodes, times), relative to the start of its episode.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from palpate.report import charts
from palpate.report.evidence import Curves, Piece


def show(curves: Curves, looks: Mapping[str, int]) -> tuple[str, charts.Chart]:
    """The caption and the chart of the energy that is left in each of several episodes."""
    ends = []
    for label, values in curves.values.items():
        (median,) = charts.quantiles(values, (0.5,))
        above = np.flatnonzero(~(median < 0.01))
        stays = 0 if not above.size else above[-1] + 1
        if stays < len(curves.time):
            ends.append(f"{label} stays below 1 % from {curves.time[stays]:.3g} s on")
        else:
            ends.append(f"{label} does not come to stay below 1 %")
    episodes = max(len(values) for values in curves.values.values())
    caption = "Energy left in the object, in percent of its start"
    if episodes > 1:
        caption += f": the median of {episodes} episodes and the band that holds 90 % of them"
    return f"{caption}; {', '.join(ends)}.", chart(curves, looks)


def chart(curves: Curves, looks: Mapping[str, int]) -> charts.Chart:
    """Median energy over the episodes and their 5-95 % band on a log scale, the 1 % line marked."""
    data: list[dict[str, Any]] = []
    largest = 1.0
    for label, values in curves.values.items():
        # what has come to rest may lie a rounding below zero, where a logarithm has no place
        low, median, high = charts.quantiles(np.maximum(values, 1e-9), (0.05, 0.5, 0.95))
        largest = max(largest, float(np.nanmax(high, initial=1.0)))
        if len(values) > 1:
            data += charts.quantile_band(label, looks, curves.time, low, high)
        data.append(charts.curve_line(label, looks, curves.time, median, "%{y:.2%}"))
    layout = charts.empty_layout(380)
    layout["xaxis"] = charts.titled_axis("time (s)")
    decades = range(-4, math.ceil(math.log10(largest)) + 1)
    layout["yaxis"] = charts.titled_axis("energy relative to the start (%)") | {
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
        charts.note("1 %: at rest", xref="paper", x=1, xanchor="right", y=-2, yanchor="bottom")
    ]
    return {"data": data, "layout": layout}


ENERGY = Piece("Energy", ("episodes", "times"), show)
