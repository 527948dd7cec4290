"""The ranks of a calibration: a panel for each parameter."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int
from scipy.stats import binom

from palpate.report.picture import canvas_of, legend_of, save_picture
from palpate.report.style import STYLES

ACROSS = 4  # panels in a row


def rank_figure(
    out: Path, names: Sequence[str], counts: Mapping[str, Int[np.ndarray, "free bins"]]
) -> None:
    """Histograms of ranks, a panel for each parameter and a line for each kind of `counts`.

    The band holds 99 % of the counts of a bin when all is well. Writes a PNG.
    """
    rows = -(-len(names) // ACROSS)
    canvas = canvas_of(2.9 * ACROSS, 2.2 * rows + 0.5)
    axes = canvas.subplots(rows, ACROSS, squeeze=False).ravel()
    for axis in axes[len(names) :]:
        axis.set_visible(False)
    first = next(iter(counts.values()))
    simulations, bins = int(first[0].sum()), first.shape[1]
    band = binom.ppf((0.005, 0.995), simulations, 1.0 / bins)
    edges = np.linspace(0.0, 1.0, bins + 1)
    for index, (axis, name) in enumerate(zip(axes, names, strict=False)):
        axis.axhspan(*band, color=STYLES[0].light, alpha=0.3, lw=0, label="99 % when calibrated")
        for style, (label, values) in zip((STYLES[2], STYLES[1]), counts.items(), strict=False):
            look = {"color": style.light, "ls": style.linestyle, "lw": 1.6}
            axis.stairs(values[index], edges, label=label, **look)
        axis.set_title(name, fontsize=9)
        axis.set(xlim=(0.0, 1.0), ylim=(0.0, None))
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)
        axis.locator_params(axis="x", nbins=4)
        if index % ACROSS == 0:
            axis.set_ylabel("simulations")
        if index >= len(names) - ACROSS:
            axis.set_xlabel("rank of the truth / draws", fontsize=9)
    legend_of(canvas, "upper center")
    save_picture(out, canvas)
