"""What self-supervised DAgger collected, and why, in one picture."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from palpate.learning.dagger import Outcome, Round
from palpate.models.model import Model
from palpate.report.picture import canvas_of, curve, save_picture
from palpate.report.style import STYLES
from palpate.tasks.task import Start, Task

SHOWN = 1000  # states of each kind, at most


def draw(
    path: Path,
    task: Task,
    model: Model,
    outcome: Outcome,
    pool: int,
    seed: int,
    quantity: tuple[str, Callable[[Any], Any]],
) -> None:
    """A PNG of the first round, which has to have collected something.

    Above, the trial that departed most: the loss of every instant, its mean over the next horizon
    with both predictions of that, and the instants that were collected; beside it the score of
    every trial against the limit. Below, where the collected states lie among `pool` starts of the
    task and nominal operation: their first two principal components, and the distance from the
    nearest start (features in standard deviations of the pool) by a `quantity` of a state, its name
    with unit and its value.
    """
    first = outcome.rounds[0]
    canvas = canvas_of(11, 7.5)
    axes = canvas.subplots(2, 2)
    _loss_over_time(axes[0, 0], model.control_period, first)
    _scores(axes[0, 1], model.control_period, outcome)
    trials, columns = np.nonzero(first.collected)
    steps = first.comparison.steps[columns]
    usual = np.indices(outcome.nominal.observed.shape).reshape(2, -1)
    starts = {
        "starts of the training": task.starts(model, jax.random.key(seed), pool),
        "nominal operation": outcome.nominal_seen.starts(
            task, jnp.asarray(usual[0]), jnp.asarray(outcome.nominal.steps[usual[1]])
        ),
        "collected": first.seen.starts(task, jnp.asarray(trials), jnp.asarray(steps)),
    }
    _where(axes[1], task, starts, quantity)
    save_picture(path, canvas)


def _loss_over_time(axis: Any, period: float, one: Round) -> None:
    comparison = one.comparison
    trial = int(np.argmax(np.where(one.collected, comparison.observed, -np.inf).max(axis=1)))
    loss = comparison.loss[trial]
    axis.plot(np.arange(len(loss)) * period, loss, color=STYLES[0].light, lw=3, label="observed")
    time = comparison.steps * period
    values = {
        "observed, mean over the horizon": comparison.observed,
        "predicted by the model": comparison.predicted,
        "promised by training": comparison.promised,
    }
    for style, (label, each) in zip(STYLES[1:], values.items(), strict=False):
        curve(axis, time, each[trial], style, label, ms=3, lw=1.2)
    marked = one.collected[trial]
    axis.plot(time[marked], comparison.observed[trial, marked], "k|", ms=11, label="collected")
    axis.set(title=f"trial {trial}", xlabel="time (s)", ylabel="loss (as minimised)")
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "ncols": 3}
    axis.legend(frameon=False, fontsize=8, **below)


def _scores(axis: Any, period: float, outcome: Outcome) -> None:
    kinds = {
        "nominal": (outcome.nominal, STYLES[0], "-"),
        "watched": (outcome.rounds[0].comparison, STYLES[2], "--"),
    }
    for label, (comparison, style, line) in kinds.items():
        score = outcome.alarm.score(comparison)
        time = comparison.steps * period
        axis.plot(time, score.T, color=style.light, ls=line, lw=0.7)
        axis.plot([], [], color=style.light, ls=line, label=label)
    axis.axhline(outcome.alarm.limit, color="k", lw=1, ls=":", label="limit")
    axis.set(title="every trial", xlabel="time (s)", ylabel="gap to the predictions (of nominal)")
    axis.legend(frameon=False, fontsize=8)


def _where(
    axes: Any, task: Task, starts: dict[str, Start], quantity: tuple[str, Callable[[Any], Any]]
) -> None:
    name, of = quantity
    seen = {
        label: np.asarray(task.features(start.state, start.goal), float)
        for label, start in starts.items()
    }
    pool, *_ = seen.values()
    middle, scale = pool.mean(axis=0), np.maximum(pool.std(axis=0), 1e-6)
    seen = {label: (features - middle) / scale for label, features in seen.items()}
    pool, *_ = seen.values()
    directions = np.linalg.svd(pool, full_matrices=False)[2][:2]
    for (label, features), style in zip(seen.items(), STYLES, strict=False):
        every = np.linspace(0, len(features) - 1, min(SHOWN, len(features))).astype(int)
        some, values = features[every], np.asarray(of(starts[label].state))[every]
        few = len(some) < 100  # and easily lost among the others
        look = {"color": style.light, "marker": style.marker, "s": 40 if few else 7, "lw": 0}
        look |= {"label": label, "alpha": 0.9 if few else 0.6}
        axes[0].scatter(*(some @ directions.T).T, **look)
        # Of a start of the pool the nearest is itself: the second is another.
        squares = (some**2).sum(1)[:, None] + (pool**2).sum(1) - 2 * some @ pool.T
        rank = 1 if features is pool else 0
        nearest = np.sqrt(np.maximum(np.partition(squares, rank, axis=1)[:, rank], 0))
        axes[1].scatter(values, nearest, **look)
    axes[0].set(title="where they lie", xlabel="first principal component", ylabel="second")
    axes[1].set(title="how far from training", xlabel=name, ylabel="nearest start (deviations)")
    axes[0].legend(frameon=False, fontsize=8)
