"""Pictures by Matplotlib: panels, curves with their spread, one legend, and the file."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.report.style import Style
from palpate.runs.storage import write_bytes


def canvas_of(width: float | int, height: float | int, dpi: int = 150) -> Any:
    """An empty Matplotlib figure, inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=dpi, layout="constrained")


def curve(axis: Any, x: Any, y: Any, style: Style, label: str, **look: Any) -> None:
    """A line in the look of its series."""
    shape = {"ls": style.linestyle, "lw": style.width, "marker": style.marker, "ms": 4}
    axis.plot(x, y, label=label, color=style.light, **(shape | look))


def band(axis: Any, x: Any, low: np.ndarray, high: np.ndarray, style: Style) -> None:
    """What lies between two curves: the spread of a series."""
    axis.fill_between(x, low, high, color=style.light, alpha=0.17, linewidth=0)


def legend_of(canvas: Any, place: str, **look: Any) -> None:
    """One legend for all panels outside at `place`, a label that stands in several shown once."""
    handles = {}
    for axis in canvas.axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    look = {"ncols": len(handles), "frameon": False} | look
    canvas.legend(list(handles.values()), list(handles), loc=f"outside {place}", **look)


def save_picture(path: Path, canvas: Any) -> None:
    """Write a PNG or SVG, without program and date, so that the same figure is the same file."""
    buffer = io.BytesIO()
    stamp = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    canvas.savefig(buffer, format=path.suffix[1:] or "png", metadata=stamp)
    write_bytes(path, buffer.getvalue())


def image_of(canvas: Any) -> Any:
    """A figure as Pillow's image."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    drawn = FigureCanvasAgg(canvas)
    drawn.draw()
    return Image.fromarray(np.asarray(drawn.buffer_rgba())[..., :3].copy())


def save_animation(
    path: Path, pictures: Sequence[Any], milliseconds: int | list[int], **options: Any
) -> None:
    """Write Pillow's images as an endless GIF or WebP, each shown for so many milliseconds."""
    buffer = io.BytesIO()
    options |= {"save_all": True, "append_images": pictures[1:], "loop": 0}
    pictures[0].save(buffer, path.suffix[1:].upper(), duration=milliseconds, **options)
    write_bytes(path, buffer.getvalue())
