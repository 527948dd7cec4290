"""The demo's picture, by Matplotlib, in the looks of the page (`palpate.report.style`) on white."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import PalpateError
from palpate.report.charts import quantiles
from palpate.report.evidence import Curves, Motion
from palpate.report.picture import band, canvas_of, curve, legend_of, save_picture
from palpate.report.style import STYLES, style_indices

_INK, _QUIET, _RULE = "#1c2127", "#5b6570", "#dfe3e7"
_SETTINGS: Any = {
    "font.size": 9,
    "axes.edgecolor": _RULE,
    "axes.labelcolor": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "xtick.color": _QUIET,
    "ytick.color": _QUIET,
}


def motion_figure(out: Path, motion: Motion, instants: Sequence[float], energy: Curves) -> Path:
    """Draw a motion at several `instants` (s) and, beside them, energies on a log scale.

    Each panel shows the frame nearest to its instant in the vertical plane in which the object
    moves most, equally scaled in metres. The same input gives the same bytes of a PNG.

    Raises `PalpateError` for a motion of nothing but gaps.
    """
    import matplotlib

    looks = {of: STYLES[i] for of, i in style_indices([*motion.chains, *energy.values]).items()}
    frames = [int(np.argmin(np.abs(motion.time - instant))) for instant in instants]
    seen = {of: chain[frames] for of, chain in _in_plane(motion).items()}
    points = np.concatenate([chain.reshape(-1, 2) for chain in seen.values()])
    if not np.isfinite(points).any():
        raise PalpateError("the motion holds nothing but gaps: there is nothing to draw")
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    margin = 0.06 * max(*(high - low), 1e-3)
    (left, bottom), (right, top) = low - margin, high + margin
    panel = 1.4 * np.clip((right - left) / (top - bottom), 0.5, 2.0)
    widths = [panel] * len(instants) + [2.8]
    with matplotlib.rc_context(_SETTINGS):
        canvas = canvas_of(sum(widths) + 0.8, 2.4, dpi=200)
        *axes, last = canvas.subplots(1, len(widths), width_ratios=widths)
        for index, (axis, frame) in enumerate(zip(axes, frames, strict=True)):
            for label, chain in seen.items():
                (x, y), look = chain[index].T, looks[label]
                thin = {"ms": 3, "markevery": (0, max(1, round(len(x) / 8)))}
                curve(axis, x, y, look, label, lw=0.75 * look.width, **thin)
                curve(axis, x[-1:], y[-1:], look, label, ms=6)
            axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="m")
            axis.set_title(f"{motion.time[frame]:.2f} s", color=_INK)
            axis.set_xticks([round((left + right) / 2, 1)])
            axis.set(ylabel="" if index else "height (m)", **{"yticklabels": []} if index else {})
        for label, values in energy.values.items():
            low, median, high = quantiles(np.maximum(values, 1e-9), (0.05, 0.5, 0.95))
            band(last, energy.time, low, high, looks[label])
            thin = 0.75 * looks[label].width
            curve(last, energy.time, median, looks[label], label, lw=thin, marker="")
        last.axhline(0.01, color=_INK, lw=0.8, ls=(0, (4, 3)))
        last.set(yscale="log", ylim=(10**-4.2, None), xlabel="time (s)")
        last.set_title("energy relative to the start", color=_INK)
        last.set_yticks([1e-4, 1e-3, 1e-2, 1e-1, 1], ["0.01 %", "0.1 %", "1 %", "10 %", "100 %"])
        last.minorticks_off()
        across = max(1, int(canvas.get_figwidth() / 1.6))  # inches that an entry takes
        legend_of(canvas, "upper left", ncols=across, handlelength=3.5)
        save_picture(out, canvas)
    return out


def _in_plane(motion: Motion) -> dict[str, np.ndarray]:
    """(frames, points, 2): along the horizontal direction of the greatest spread, and height."""
    level = np.concatenate([c[..., :2].reshape(-1, 2) for c in motion.chains.values()])
    level = level[np.isfinite(level).all(axis=1)]
    along = np.array([1.0, 0.0])
    if len(level):
        _, vectors = np.linalg.eigh(np.cov(level, rowvar=False, bias=True))
        along = vectors[:, -1] * np.sign(vectors[np.argmax(np.abs(vectors[:, -1])), -1])
    return {
        label: np.stack([chain[..., :2] @ along, chain[..., 2]], axis=-1)
        for label, chain in motion.chains.items()
    }
