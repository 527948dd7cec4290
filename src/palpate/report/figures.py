"""Static figures and drawn animations for documents, by Matplotlib: no browser, no OpenGL.

What they show is what the page shows, in the same looks (`palpate.report.style`), on white.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from palpate.errors import PalpateError
from palpate.report.charts import quantiles
from palpate.report.evidence import Curves, Motion
from palpate.report.style import STYLES, Style, numbered
from palpate.storage import write_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NOTHING = "the motion holds nothing but gaps: there is nothing to draw"
_INK, _QUIET, _RULE = "#1c2127", "#5b6570", "#dfe3e7"
_FIGURES, _ANIMATIONS = (".png", ".svg"), (".webp", ".gif")
_SETTINGS: Any = {
    "font.size": 9,
    "axes.edgecolor": _RULE,
    "axes.labelcolor": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "xtick.color": _QUIET,
    "ytick.color": _QUIET,
    "svg.hashsalt": "palpate",  # or two drawings of the same differ in their names
}


def motion_figure(
    out: str | Path,
    motion: Motion,
    instants: Sequence[float],
    energy: Curves | None = None,
) -> Path:
    """Draw a motion at several `instants` (s) and, beside them, energies on a log scale.

    Each panel shows the frame nearest to its instant in the vertical plane in which the object
    moves most, equally scaled in metres. `out` is a `.png` or `.svg`; the same input gives the
    same bytes.

    Raises `PalpateError` for another suffix, no instants, or a file that cannot be written.
    """
    import matplotlib
    from matplotlib.figure import Figure

    out = _suffixed(out, _FIGURES)
    if not len(instants):
        raise PalpateError("a motion figure needs at least one instant, in seconds")
    labels = [*motion.chains, *(energy.values if energy else ())]
    looks = {label: STYLES[index] for label, index in numbered(labels).items()}
    frames = [int(np.argmin(np.abs(motion.time - instant))) for instant in instants]
    seen = {label: _in_plane(motion, chain) for label, chain in motion.chains.items()}
    limits = _limits(chain[frames] for chain in seen.values())
    panel = 1.4 * np.clip(np.ptp(limits[0]) / np.ptp(limits[1]), 0.5, 2.0)
    widths = [panel] * len(instants) + [2.8] * (energy is not None)
    with matplotlib.rc_context(_SETTINGS):
        figure = Figure(figsize=(sum(widths) + 0.8, 2.4), dpi=200, layout="constrained")
        axes = figure.subplots(1, len(widths), width_ratios=widths, squeeze=False)[0]
        for ax, frame in zip(axes, frames, strict=False):
            for label, chain in seen.items():
                _draw_chain(ax, chain[frame], looks[label], label)
            ax.set(xlim=limits[0], ylim=limits[1], aspect="equal", xlabel="m")
            ax.set_title(f"{motion.time[frame]:.2f} s", color=_INK)
            ax.set_xticks(_round_ticks(*limits[0]))
            if ax is axes[0]:
                ax.set_ylabel("height (m)")
            else:
                ax.set_yticklabels([])
        if energy is not None:
            _draw_energy(axes[-1], energy, looks)
        _legend(figure)
        _save(figure, out)
    return out


def motion_animation(out: str | Path, motion: Motion, rate: float = 20.0) -> Path:
    """Draw a motion as a looping picture at `rate` frames a second, seen from the side and above.

    `out` is a `.webp` or `.gif`. It is what a machine without OpenGL shows in place of a rendered
    scene. Raises `PalpateError` for another suffix or a file that cannot be written.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    out = _suffixed(out, _ANIMATIONS)
    looks = {label: STYLES[index] for label, index in numbered(motion.chains).items()}
    seen = {label: _from_above(chain) for label, chain in motion.chains.items()}
    floor = _floor(motion)
    limits = _limits([*seen.values(), floor])
    times = np.arange(motion.time[0], motion.time[-1], 1.0 / rate)
    frames = np.abs(motion.time[:, None] - times).argmin(axis=0)
    pictures = []
    with matplotlib.rc_context(_SETTINGS):
        height = 4.8 * np.clip(np.ptp(limits[1]) / np.ptp(limits[0]), 0.4, 1.6)
        figure = Figure(figsize=(4.8, height + 0.4), dpi=100)
        canvas = FigureCanvasAgg(figure)
        ax = figure.add_axes((0.0, 0.0, 1.0, height / (height + 0.4)))
        ax.set(xlim=limits[0], ylim=limits[1], aspect="equal")
        ax.set_axis_off()
        ax.plot(*floor.T, color=_RULE, lw=0.8, zorder=0)
        paths = {label: ax.plot([], [], color=looks[label].light, lw=1)[0] for label in seen}
        chains = {label: _draw_chain(ax, seen[label][0], looks[label], label) for label in seen}
        _legend(figure)
        clock = ax.text(0.02, 0.02, "", transform=ax.transAxes, color=_QUIET)
        for frame in frames:
            for label, chain in seen.items():
                recent = slice(
                    max(0, int(np.searchsorted(motion.time, motion.time[frame] - 1))), frame + 1
                )
                paths[label].set_data(*chain[recent, -1].T)
                line, end = chains[label]
                line.set_data(*chain[frame].T)
                end.set_data(*chain[frame, -1:].T)
            clock.set_text(f"{motion.time[frame]:.2f} s")
            canvas.draw()
            pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    buffer = io.BytesIO()
    kind = out.suffix[1:]
    more = {"quality": 75, "method": 4} if kind == "webp" else {"optimize": True}
    pictures[0].save(
        buffer,
        format=kind,
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 / rate),
        loop=0,
        **more,
    )
    write_bytes(out, buffer.getvalue())
    return out


# --- projections ------------------------------------------------------------------------------


def _in_plane(motion: Motion, chain: np.ndarray) -> np.ndarray:
    """(frames, points, 2): along the horizontal direction of the greatest spread, and height."""
    level = np.concatenate([c[..., :2].reshape(-1, 2) for c in motion.chains.values()])
    level = level[np.isfinite(level).all(axis=1)]
    if not len(level):
        raise PalpateError(_NOTHING)
    _, vectors = np.linalg.eigh(np.cov(level, rowvar=False, bias=True))
    along = vectors[:, -1] * np.sign(vectors[np.argmax(np.abs(vectors[:, -1])), -1])
    return np.stack([chain[..., :2] @ along, chain[..., 2]], axis=-1)


def _from_above(points: np.ndarray, yaw: float = -0.9, pitch: float = 0.28) -> np.ndarray:
    """An orthographic view of points (..., 3), turned about z and then tilted; radians."""
    x, y, z = np.moveaxis(points, -1, 0)
    right = np.cos(yaw) * x - np.sin(yaw) * y
    away = np.sin(yaw) * x + np.cos(yaw) * y
    return np.stack([right, np.cos(pitch) * z + np.sin(pitch) * away], axis=-1)


def _floor(motion: Motion) -> np.ndarray:
    """The lines of a grid beneath the motion as `_from_above` shows it, NaN between them."""
    every = np.concatenate([chain.reshape(-1, 3) for chain in motion.chains.values()])
    every = every[np.isfinite(every).all(axis=1)]
    if not len(every):
        raise PalpateError(_NOTHING)
    low, high = every.min(axis=0), every.max(axis=0)
    reach = 0.3 * np.linalg.norm(high - low)
    lines = []
    for share in np.linspace(-1, 1, 7):
        for ends in ([[share, -1], [share, 1]], [[-1, share], [1, share]]):
            level = (low + high)[:2] / 2 + reach * np.array(ends)
            lines += [*np.column_stack([level, [low[2]] * 2]), [np.nan] * 3]
    return _from_above(np.array(lines))


def _limits(seen: Any) -> tuple[tuple[float, float], tuple[float, float]]:
    every = np.concatenate([chain.reshape(-1, 2) for chain in seen])
    if not np.isfinite(every).any():
        raise PalpateError(_NOTHING)
    low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
    margin = 0.06 * max(*(high - low), 1e-3)
    (left, bottom), (right, top) = low - margin, high + margin
    return (float(left), float(right)), (float(bottom), float(top))


def _round_ticks(low: float, high: float) -> list[float]:
    step = float(max(s for s in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0) if s <= max(high - low, 0.05)))
    step = step if (high - low) / step >= 1 else step / 2
    return [float(t) for t in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step]


# --- drawing ----------------------------------------------------------------------------------


def _draw_chain(ax: "Axes", points: np.ndarray, style: Style, label: str) -> tuple[Any, Any]:
    look = {"color": style.light, "lw": style.width * 0.75, "marker": style.marker}
    look["linestyle"] = _dashes(style)
    every = max(1, round(len(points) / 8))
    (line,) = ax.plot(*points.T, ms=3, markevery=(0, every), label=label, **look)
    (end,) = ax.plot(*points[-1:].T, ms=6, color=style.light, marker=style.marker)
    return line, end


def _draw_energy(ax: "Axes", energy: Curves, looks: dict[str, Style]) -> None:
    for label, values in energy.values.items():
        style = looks[label]
        low, median, high = quantiles(np.maximum(values, 1e-9), (0.05, 0.5, 0.95))
        if len(values) > 1:
            ax.fill_between(energy.time, low, high, color=style.light, alpha=0.16, lw=0)
        ax.plot(
            energy.time,
            median,
            color=style.light,
            lw=style.width * 0.75,
            ls=_dashes(style),
            label=label,
        )
    ax.axhline(0.01, color=_INK, lw=0.8, ls=(0, (4, 3)))
    ax.set(yscale="log", ylim=(10**-4.2, None), xlabel="time (s)")
    ax.set_title("energy relative to the start", color=_INK)
    ax.set_yticks([1e-4, 1e-3, 1e-2, 1e-1, 1], ["0.01 %", "0.1 %", "1 %", "10 %", "100 %"])
    ax.minorticks_off()


def _dashes(style: Style) -> Any:
    """Matplotlib counts dashes in widths of the line."""
    return (0, tuple(length / style.width for length in style.dash)) if style.dash else "-"


def _legend(figure: "Figure") -> None:
    """One legend for all panels, a label that stands in several shown once."""
    handles = {}
    for ax in figure.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if len(handles) > 1:
        across = max(1, int(figure.get_figwidth() / 1.6))  # inches that an entry takes
        place = {"loc": "outside upper left", "ncols": across, "frameon": False}
        figure.legend(handles.values(), handles.keys(), handlelength=3.5, **place)


def _suffixed(out: str | Path, known: tuple[str, ...]) -> Path:
    out = Path(out)
    if out.suffix not in known:
        raise PalpateError(f"{out} has the suffix '{out.suffix}': expected {' or '.join(known)}")
    return out


def _save(figure: "Figure", out: Path) -> None:
    buffer = io.BytesIO()
    stamp = {"Date": None} if out.suffix == ".svg" else {"Software": None}
    figure.savefig(buffer, format=out.suffix[1:], metadata=stamp)
    write_bytes(out, buffer.getvalue())
