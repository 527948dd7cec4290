"""`palpate reproduce rope-ablation`: what each part of the training is worth, at equal budget.

The same identified rope as in `rope-stabilization`, and trainings that differ in one switch and
nothing else: iterations, batch, network and seed are the same. Each policy is tried in the same
MuJoCo ropes. There is no bar: what a part is worth is what is to be found out.
"""

import dataclasses
from pathlib import Path

import numpy as np

from palpate.experiments.experiment import Experiment, suffix
from palpate.experiments.rope.nominal import (
    BASE,
    FULL,
    QUICK,
    identified_rope,
    identified_split,
    trained_policy,
)
from palpate.experiments.rope.stabilization import EVALUATION_SEEDS
from palpate.report.picture import band, canvas_of, save_picture
from palpate.report.style import STYLES
from palpate.runs import Result
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
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.trials import Episodes, StabilizationTrial

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
ROPES = {"full": 25, "quick": 1}


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Train and evaluate all five below `out`; `quick` is the same work at a smaller size.

    Raises `PalpateError` when `out` holds the stages of another run.
    """
    experiment, size = Experiment(NAME, out, quick, seed), QUICK if quick else FULL
    ropes, count = ROPES["quick" if quick else "full"], 1 + len(LEFT_OUT)
    full = dataclasses.replace(size.training, iterations=size.training.iterations // BUDGET)
    evaluating = round(count * size.minutes["evaluation"] / 3 * ropes / FULL.ropes) + 1
    training = round(count * size.minutes["training"] / BUDGET)
    minutes = size.part("recording", "identification")
    experiment.announce(minutes | {"training": training, "evaluation": evaluating})
    print(
        f"each of {count} trainings: {full.iterations} iterations of {full.batch} episodes, "
        f"network of {full.depth} x {full.width}",
        flush=True,
    )
    model = identified_rope(experiment, size)
    controllers, abouts, task = {}, {}, RopeStabilization()
    for name, switch in {FULL_TRAINING: None, **LEFT_OUT}.items():
        without = dataclasses.replace(full, **({switch: False} if switch else {}))
        folder = f"train-{name.replace(' ', '-')}"
        policy, abouts[name] = trained_policy(experiment, folder, task, model, without)
        controllers[name] = LearnedController(policy, task)
    first = experiment.uses(EVALUATION_SEEDS)
    trials = evaluation_trials(BASE, ropes, first)
    configuration = {"stage": "evaluate", "seed": seed, "trials": len(trials), "policies": abouts}
    with experiment.stage("evaluate", configuration) as stage:
        evaluated = evaluate(controllers, trials, stage.run)
        if not stage.finished:
            write_trial_evidence(stage.run, trials, evaluated, (FULL_TRAINING,))
            draw(stage.path / FIGURE, trials, evaluated)
        print(f"figure: {stage.path / FIGURE}")
    print("\n".join(table(trials, evaluated)))
    return experiment.result(
        [
            row
            for name, episodes in evaluated.items()
            for row in figures(summarise(trials, episodes), f".{suffix(name)}")
        ],
        {
            "training": dataclasses.asdict(full),
            "switched_off": LEFT_OUT,
            "ropes": ropes,
            "training_seconds": {name: about["wall_time_s"] for name, about in abouts.items()},
        },
        {
            "identified": identified_split(size, seed),
            "evaluated": f"{ropes} sampled ropes, seed {first}",
        },
    )


def draw(path: Path, trials: list[StabilizationTrial], evaluated: dict[str, Episodes]) -> None:
    """A PNG: the energy with and without each part of the training, success rates and times.

    Energies are medians over all trials with the band in which nine in ten lie, on a log scale.
    """
    period = trials[0].configuration.control_period
    names = [name for name in evaluated if name != FULL_TRAINING]
    canvas = canvas_of(11, 7)
    grid = canvas.add_gridspec(2, len(names), height_ratios=(1.3, 1))
    for place, name in enumerate(names):
        axis = canvas.add_subplot(grid[0, place])
        for shown, style, line in ((FULL_TRAINING, STYLES[1], "-"), (name, STYLES[2], "--")):
            share = evaluated[shown].energy / evaluated[shown].energy[:, :1]
            low, middle, high = np.nanquantile(share, (0.05, 0.5, 0.95), axis=0)
            time = np.arange(share.shape[1]) * period
            band(axis, time, low, high, style)
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
        look = {"color": colour, "ecolor": "black", "capsize": 3}
        rate, (low, high) = summary.success_rate, summary.interval
        # Rounded, a limit of the interval may lie on the other side of a rate of 0 or 1.
        error = [[max(0.0, rate - low)], [max(0.0, high - rate)]]
        rates.barh(place, rate, xerr=error, **look)
        if summary.periods is not None:
            times.barh(place, summary.periods, xerr=summary.margin or 0.0, **look)
    rates.set(xlabel="success rate, 95 % interval", xlim=(0, 1.02))
    times.set(xlabel="mean time to 1 % energy (periods), 95 % interval")
    for axis in (rates, times):
        axis.set_yticks(range(len(summaries)), list(summaries))
        axis.invert_yaxis()
    times.tick_params(labelleft=False)
    save_picture(path, canvas)
