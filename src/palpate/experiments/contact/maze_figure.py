"""How methods learn in the maze, in one picture: what an episode gives, and what it has cost."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from palpate.report.picture import canvas_of, legend_of, save_picture
from palpate.runs.run import read_metrics

BINS = 30  # of a training, over each of which episodes are counted


def draw(path: Path, trained: Mapping[str, Sequence[ArrayLike]]) -> None:
    """A PNG of trainings, of each its `curve_of`: shares of goals, and violations so far.

    Lines are means over a method's seeds, bands reach from the least to the most.
    """
    canvas = canvas_of(10, 4)
    goals, costs = canvas.subplots(1, 2)
    for number, (name, seeds) in enumerate(trained.items()):
        curves = [np.asarray(curve, float) for curve in seeds]
        steps, colour = curves[0][0], f"C{number % 10}"
        style = "-" if number < 10 else "--"
        for axis, of in ((goals, 1), (costs, 2)):
            values = np.ma.masked_invalid([curve[of] for curve in curves])  # where none ended
            axis.plot(steps, values.mean(axis=0), style, color=colour, label=name, lw=1.3)
            axis.fill_between(
                steps, values.min(axis=0), values.max(axis=0), color=colour,
                alpha=0.12, lw=0,
            )  # fmt: skip
    goals.set(ylabel="share of episodes that reach the goal", ylim=(0, 1))
    costs.set(ylabel="violations so far", yscale="symlog")
    for axis in (goals, costs):
        axis.set_xlabel("decisions")
    legend_of(canvas, "lower center", fontsize=7, ncols=6)
    save_picture(path, canvas)


def curve_of(folder: Path) -> np.ndarray:
    """(3, bins): decisions, the share of the bin's episodes that reached the goal, violations."""
    lines = read_metrics(folder)
    rows = []
    for part in np.array_split(np.arange(len(lines)), min(BINS, len(lines))):
        some = [lines[number] for number in part]
        episodes = sum(line["episodes"] for line in some)
        goals = sum(line["ends"].get("goal", 0) for line in some)
        share = goals / episodes if episodes else np.nan
        rows.append((some[-1]["step"], share, some[-1]["violations"]))
    return np.array(rows).T
