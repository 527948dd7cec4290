"""Pictures of experiments: panels, curves with their spread, and the file."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from palpate.report.style import Style
from palpate.runs.storage import write_bytes


def canvas_of(width: float | int, height: float | int) -> Any:
    """An empty Matplotlib figure, inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def curve(axis: Any, x: Any, y: Any, style: Style, label: str, **look: Any) -> None:
    """A line in the look of its series."""
    shape = {"ls": style.linestyle, "lw": style.width, "marker": style.marker, "ms": 4}
    axis.plot(x, y, label=label, color=style.light, **(shape | look))


def band(axis: Any, x: Any, low: np.ndarray, high: np.ndarray, style: Style) -> None:
    """What lies between two curves: the spread of a series."""
    axis.fill_between(x, low, high, color=style.light, alpha=0.17, linewidth=0)


def legend_of(canvas: Any, axis: Any, place: str) -> None:
    """One legend for all panels, with the series of one of them, outside at `place`."""
    lines, names = axis.get_legend_handles_labels()
    canvas.legend(lines, names, loc=f"outside {place}", ncols=len(names), frameon=False)


def save_picture(path: Path, canvas: Any) -> None:
    """Write a PNG, without the name of the program, so that the same figure is the same file."""
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    write_bytes(path, buffer.getvalue())
