"""Pictures of results: panels, curves with their spread, and the files, still or moving."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import PalpateError
from palpate.report.style import Style
from palpate.runs.storage import write_bytes

# Without date or the name of the program: the same figure is the same file.
_STAMPS = {".png": {"Software": None}, ".svg": {"Date": None}}


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


def legend_of(canvas: Any, place: str, **look: Any) -> None:
    """One legend for all panels, outside at `place`; a series that several show stands once."""
    series: dict[str, Any] = {}
    for axis in canvas.axes:
        for line, name in zip(*axis.get_legend_handles_labels(), strict=True):
            series.setdefault(name, line)
    settings = {"loc": f"outside {place}", "ncols": len(series), "frameon": False}
    canvas.legend(list(series.values()), list(series), **(settings | look))


def check_suffix(path: Path) -> None:
    """Raise `PalpateError` for a file that is to be neither a .png nor a .svg."""
    if path.suffix not in _STAMPS:
        expected = " or ".join(_STAMPS)
        raise PalpateError(f"{path} has the suffix '{path.suffix}': expected {expected}")


def save_picture(path: Path, canvas: Any, dpi: int | str = 150) -> None:
    """Write a Matplotlib figure, as SVG where `path` ends so, else as PNG."""
    kind, buffer = ".svg" if path.suffix == ".svg" else ".png", io.BytesIO()
    canvas.savefig(buffer, format=kind[1:], dpi=dpi, metadata=_STAMPS[kind])
    write_bytes(path, buffer.getvalue())


def save_animation(
    path: Path, pictures: Sequence[Any], milliseconds: int | list[int], **settings: Any
) -> None:
    """Write pictures of PIL as an endless animation, .gif or .webp; each stands so long."""
    buffer, first = io.BytesIO(), pictures[0]
    kept = {"append_images": pictures[1:], "duration": milliseconds, "loop": 0, **settings}
    first.save(buffer, path.suffix[1:].upper(), save_all=True, **kept)
    write_bytes(path, buffer.getvalue())
