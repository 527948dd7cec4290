"""Static figures for documents, by Matplotlib: no browser, no OpenGL.

What they show is what the page shows, in the same looks (`palpate.report.style`), on white.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from palpate.errors import PalpateError
from palpate.report.charts import quantiles
from palpate.report.evidence import Curves, Motion
from palpate.report.picture import canvas_of, legend_of, save_picture
from palpate.report.style import STYLES, Style, numbered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NOTHING = "the motion holds nothing but gaps: there is nothing to draw"
_INK, _QUIET, _RULE = "#1c2127", "#5b6570", "#dfe3e7"
_SUFFIXES = (".png", ".svg")
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

    out = Path(out)
    if out.suffix not in _SUFFIXES:
        expected = " or ".join(_SUFFIXES)
        raise PalpateError(f"{out} has the suffix '{out.suffix}': expected {expected}")
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
        figure = canvas_of(sum(widths) + 0.8, 2.4, dpi=200)
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
        if len(looks) > 1:
            across = max(1, int(figure.get_figwidth() / 1.6))  # inches that an entry takes
            legend_of(figure, "upper left", ncols=across, handlelength=3.5)
        save_picture(out, figure)
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


def _draw_chain(ax: "Axes", points: np.ndarray, style: Style, label: str) -> None:
    look = {"color": style.light, "lw": style.width * 0.75, "marker": style.marker}
    look["linestyle"] = style.linestyle
    every = max(1, round(len(points) / 8))
    ax.plot(*points.T, ms=3, markevery=(0, every), label=label, **look)
    ax.plot(*points[-1:].T, ms=6, color=style.light, marker=style.marker)


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
            ls=style.linestyle,
            label=label,
        )
    ax.axhline(0.01, color=_INK, lw=0.8, ls=(0, (4, 3)))
    ax.set(yscale="log", ylim=(10**-4.2, None), xlabel="time (s)")
    ax.set_title("energy relative to the start", color=_INK)
    ax.set_yticks([1e-4, 1e-3, 1e-2, 1e-1, 1], ["0.01 %", "0.1 %", "1 %", "10 %", "100 %"])
    ax.minorticks_off()
