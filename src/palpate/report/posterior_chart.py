"""A static figure of posteriors: the ranks of a calibration."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from scipy.stats import binom

from palpate.report.style import STYLES
from palpate.runs.storage import write_bytes

ACROSS = 4  # panels in a row


def rank_figure(
    out: str | Path,
    names: Sequence[str],
    counts: Mapping[str, Int[np.ndarray, "free bins"]],
) -> Path:
    """Histograms of ranks, a panel for each parameter and a line for each kind of `counts`.

    The band holds 99 % of the counts of a bin when all is well. Writes a PNG.
    """
    canvas, axes = _panels(len(names))
    first = next(iter(counts.values()))
    simulations, bins = int(first[0].sum()), first.shape[1]
    band = binom.ppf((0.005, 0.995), simulations, 1.0 / bins)
    edges = np.linspace(0.0, 1.0, bins + 1)
    for index, name in enumerate(names):
        axis = axes[index]
        axis.axhspan(*band, color=STYLES[0].light, alpha=0.3, lw=0, label="99 % when calibrated")
        for style, (label, values) in zip((STYLES[2], STYLES[1]), counts.items(), strict=False):
            dashes = (0, style.dash) if style.dash else "-"
            axis.stairs(values[index], edges, color=style.light, ls=dashes, lw=1.6, label=label)
        axis.set(title=name, xlim=(0.0, 1.0), ylim=(0.0, None))
        if index % ACROSS == 0:
            axis.set_ylabel("simulations")
        if index >= len(names) - ACROSS:
            axis.set_xlabel("rank of the truth / draws")
    return _save(canvas, axes, Path(out))


def _panels(count: int) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    rows = -(-count // ACROSS)
    canvas = Figure(figsize=(2.9 * ACROSS, 2.2 * rows + 0.5), layout="constrained")
    axes = canvas.subplots(rows, ACROSS, squeeze=False).ravel()
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)
        axis.locator_params(axis="x", nbins=4)
        axis.title.set_fontsize(9)
        axis.xaxis.label.set_fontsize(9)
    for axis in axes[count:]:
        axis.set_visible(False)
    return canvas, axes


def _save(canvas: Any, axes: Any, out: Path) -> Path:
    shown = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            shown.setdefault(label, handle)
    place = {"loc": "outside upper center", "ncols": len(shown), "frameon": False}
    canvas.legend(shown.values(), shown.keys(), fontsize=9, **place)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    write_bytes(out, buffer.getvalue())
    return out
