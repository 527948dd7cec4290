"""How many samples which method needs to predict a push: a panel for each kind of furniture."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from palpate.experiments.furniture.one_shot_regression import OURS, RIVALS
from palpate.report.picture import canvas_of, curve, legend_of, save_picture
from palpate.report.style import STYLES

ACROSS = 3  # panels in a row
LOOKS = STYLES[2], STYLES[1], STYLES[3], STYLES[4]
STILL = 1.0  # share of one who predicts that nothing moves


def shares_figure(out: Path, compared: Mapping[str, Mapping[str, Any]]) -> None:
    """Error share over the number of samples by method, of what each stage found; writes a PNG.

    What diverged lies beyond the axis.
    """
    rows = -(-len(compared) // ACROSS)
    canvas = canvas_of(3.4 * ACROSS, 2.5 * rows + 0.5)
    axes = canvas.subplots(rows, ACROSS, squeeze=False, sharex=True, sharey=True).ravel()
    for axis in axes[len(compared) :]:
        axis.set_visible(False)
    for index, (axis, (kind, stage)) in enumerate(zip(axes, compared.items(), strict=False)):
        axis.axhline(STILL, color=STYLES[0].light, lw=1.0, label="nothing moves")
        for style, method in zip(LOOKS, (OURS, *RIVALS), strict=True):
            found = {int(size): share for size, share in stage["shares"][method].items()}
            curve(axis, list(found), list(found.values()), style, method)
        axis.set(title=kind, xscale="log", yscale="log", ylim=(1e-4, 30.0))
        axis.spines[["top", "right"]].set_visible(False)
        if index % ACROSS == 0:
            axis.set_ylabel("error² / displacement²")
        if index >= len(compared) - ACROSS:
            axis.set_xlabel("samples of 0.1 s since it moved")
    legend_of(canvas, "upper center")
    save_picture(out, canvas)
