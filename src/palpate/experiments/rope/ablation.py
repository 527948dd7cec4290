"""`palpate reproduce rope-ablation`: what each part of the training is worth, at equal budget.

The same identified rope as in `rope-stabilization`, and trainings that differ in one switch and
nothing else: iterations, batch, network and seed are the same. Each policy is tried in the same
MuJoCo ropes. There is no bar: what a part is worth is what is to be found out.
"""

import dataclasses
import io
from pathlib import Path

import numpy as np

from palpate.experiments.rope.stabilization import (
    BASE,
    EVALUATION_SEEDS,
    FULL,
    QUICK,
    Size,
    announce,
    finish,
    identified_rope,
    trained_policy,
    wall_time,
)
from palpate.report.style import STYLES
from palpate.runs import Result, Run
from palpate.runs.storage import write_bytes
from palpate.tasks.rope import RopeStabilization
from palpate.tasks.rope.stabilization import STABILISED
from palpate.trials.rope.evaluation import (
    evaluate,
    evaluation_trials,
    figures,
    summarise,
    table,
    write_trial_evidence,
)
from palpate.trials.rope.trials import Episodes, LearnedController, Trial

NAME = "rope-ablation"
FIGURE = "ablation.png"
FULL_TRAINING = "full"
# What is left out, and the switch of `Training` that does it.
LEFT_OUT = {
    "no horizon curriculum": "horizon_curriculum",
    "no noise curriculum": "noise_curriculum",
    "no randomisation": "randomisation",
    "no augmentation": "augmentation",
}
BUDGET = 4  # each training has this part of rope-stabilization's iterations
ROPES = 25


def _sized(size: Size, ropes: int) -> Size:
    iterations = size.training.iterations // BUDGET
    return dataclasses.replace(
        size, training=dataclasses.replace(size.training, iterations=iterations), ropes=ropes
    )


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Train and evaluate all five below `out`; `quick` is the same work at a smaller size.

    Raises `PalpateError` when `out` holds the stages of another run.
    """
    size = _sized(QUICK, 1) if quick else _sized(FULL, ROPES)
    count = 1 + len(LEFT_OUT)
    announce(
        NAME,
        {
            "recording": size.minutes["recording"],
            "identification": size.minutes["identification"],
            "training": round(count * size.minutes["training"] / BUDGET),
            "evaluation": round(count * size.minutes["evaluation"] / 3 * size.ropes / FULL.ropes)
            + 1,
        },
    )
    print(
        f"each of {count} trainings: {size.training.iterations} iterations of "
        f"{size.training.batch} episodes, network of {size.training.depth} x {size.training.width}",
        flush=True,
    )
    model, spent = identified_rope(out, size, seed)
    switches = {FULL_TRAINING: {}} | {name: {switch: False} for name, switch in LEFT_OUT.items()}
    controllers, abouts, task = {}, {}, RopeStabilization()
    command = f"palpate reproduce {NAME} --seed {seed}{' --quick' if quick else ''}"
    for name, switch in switches.items():
        training = dataclasses.replace(size.training, **switch)
        path = out / f"train-{name.replace(' ', '-')}"
        policy, abouts[name] = trained_policy(path, task, model, training, seed, command)
        controllers[name] = LearnedController(policy, task)
        spent += abouts[name]["wall_time_s"]
    trials = evaluation_trials(BASE, size.ropes, EVALUATION_SEEDS + seed)
    configuration = {"stage": "evaluate", "seed": seed, "trials": len(trials), "policies": abouts}
    with Run.open(out / "evaluate", configuration) as run:
        evaluated = evaluate(controllers, trials, run)
        if not run.finished:
            write_trial_evidence(run, trials, evaluated, (FULL_TRAINING,))
            draw(run.path / FIGURE, trials, evaluated)
            finish(run, NAME, "evaluate", {})
        spent += wall_time(run)
        print(f"figure: {run.path / FIGURE}")
    print("\n".join(table(trials, evaluated)))
    rows = []
    for name, episodes in evaluated.items():
        rows += figures(summarise(trials, episodes), f".{name.replace(' ', '_')}")
    return Result(
        NAME,
        rows,
        {
            "quick": quick,
            "training": dataclasses.asdict(size.training),
            "switched_off": LEFT_OUT,
            "ropes": size.ropes,
            "training_seconds": {name: about["wall_time_s"] for name, about in abouts.items()},
        },
        [seed],
        {
            "identified": f"the nominal rope, {size.recorded_trials} motions, seeds from {seed}",
            "evaluated": f"{size.ropes} sampled ropes, seed {EVALUATION_SEEDS + seed}",
        },
        spent,
    )


def draw(path: Path, trials: list[Trial], evaluated: dict[str, Episodes]) -> None:
    """A PNG: the energy with and without each part of the training, success rates and times.

    Energies are medians over all trials with the band in which nine in ten lie, on a log scale.
    """
    from matplotlib.figure import Figure as Canvas

    period = trials[0].configuration.control_period
    names = [name for name in evaluated if name != FULL_TRAINING]
    canvas = Canvas(figsize=(11, 7), layout="constrained")
    grid = canvas.add_gridspec(2, len(names), height_ratios=(1.3, 1))
    for place, name in enumerate(names):
        axis = canvas.add_subplot(grid[0, place])
        for shown, style, line in ((FULL_TRAINING, STYLES[1], "-"), (name, STYLES[2], "--")):
            share = evaluated[shown].energy / evaluated[shown].energy[:, :1]
            low, middle, high = np.nanquantile(share, (0.05, 0.5, 0.95), axis=0)
            time = np.arange(share.shape[1]) * period
            axis.fill_between(time, low, high, color=style.light, alpha=0.2, linewidth=0)
            axis.semilogy(time, middle, line, color=style.light, label=shown)
        axis.axhline(STABILISED, color="black", linewidth=0.8, linestyle=":")
        axis.set(title=name, xlabel="time (s)", ylim=(1e-5, 2))
        axis.legend(loc="upper right", fontsize=8)
        if place == 0:
            axis.set_ylabel("energy, share of the start's")
        else:
            axis.tick_params(labelleft=False)
    summaries = {name: summarise(trials, episodes) for name, episodes in evaluated.items()}
    half = len(names) // 2
    rates, times = canvas.add_subplot(grid[1, :half]), canvas.add_subplot(grid[1, half:])
    for place, (name, summary) in enumerate(summaries.items()):
        colour = STYLES[1 if name == FULL_TRAINING else 2].light
        rate, (low, high) = summary.success_rate, summary.interval
        error = [[max(0.0, rate - low)], [max(0.0, high - rate)]]  # rounded, a limit may be past 1
        rates.barh(place, rate, xerr=error, color=colour, ecolor="black", capsize=3)
        if summary.periods is not None:
            margin = summary.margin or 0.0
            times.barh(place, summary.periods, xerr=margin, color=colour, ecolor="black", capsize=3)
    rates.set(xlabel="success rate, 95 % interval", xlim=(0, 1.02))
    times.set(xlabel="mean time to 1 % energy (periods), 95 % interval")
    for axis in (rates, times):
        axis.set_yticks(range(len(summaries)), list(summaries))
        axis.invert_yaxis()
    times.tick_params(labelleft=False)
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=150)
    write_bytes(path, buffer.getvalue())
