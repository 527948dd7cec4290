"""`palpate reproduce rope-stabilization`: a rope recorded, identified, and brought to rest.

The nominal MuJoCo rope is recorded and identified, a policy is trained through what was found, and
is tried from four start poses in 125 MuJoCo ropes that were used for nothing else, beside a gripper
held still and a tuned swing damper in the same trials.
"""

import dataclasses
import functools
import math
from pathlib import Path
from typing import Literal

import numpy as np

from palpate.experiments.experiment import Experiment, suffix
from palpate.experiments.rope import nominal
from palpate.families.rope.recording import constants
from palpate.runs import Figure, Result
from palpate.tasks.rope import RopeStabilization
from palpate.trials.rope import stabilization
from palpate.trials.rope.baselines import TUNED, baselines
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.stabilization import Episodes, StabilizationTrial, summarise
from palpate.trials.trial import by_group, table
from palpate.worlds.rope.rope import START_POSES

NAME = "rope-stabilization"
EVALUATION_SEEDS = 910_000  # the evaluation draws from here on, the recording from `seed` on
SUCCESS_BAR, PERIODS_BAR = 0.99, 0.9
CONTROLLED, STILL, DAMPER = "controlled", "held still", "swing damper"


def reproduce(
    out: Path,
    *,
    quick: bool = False,
    seed: int = 0,
    weights: Literal["trained", "shipped"] = "trained",
) -> Result:
    """Record, identify, train and evaluate below `out`; with shipped weights only evaluate.

    `quick` is the same work at a smaller size. Raises `PalpateError` when `out` holds another
    run's stages, or when this installation has no shipped weights.
    """
    experiment, size = Experiment(NAME, out, quick, seed), nominal.QUICK if quick else nominal.FULL
    task = RopeStabilization()
    if weights == "shipped":
        policy, about = nominal.shipped_policy()
        experiment.announce(size.part("evaluation"))
        origin = {"trained": nominal.SHIPPED_SPLIT}
    else:
        experiment.announce(size.minutes)
        model = nominal.identified_rope(experiment, size)
        policy, about = nominal.trained_policy(experiment, "train", task, model, size.training)
        origin = {
            "identified": nominal.identified_split(size, seed),
            "trained": "through the identified model alone",
        }
    first = experiment.uses(EVALUATION_SEEDS)
    trials = stabilization.evaluation_trials(nominal.BASE, size.ropes, first)
    used = {
        "policy": about,
        "swing_damper": dataclasses.asdict(TUNED),
        "world": constants(nominal.BASE),
    }
    controllers = {CONTROLLED: LearnedController(policy, task), **baselines(nominal.BASE)}
    show = functools.partial(stabilization.write_trial_evidence, shown=(CONTROLLED, STILL))
    evaluated, _ = experiment.evaluated("evaluate", used, controllers, trials, show)
    print("\n".join(table(trials, evaluated)))
    return experiment.result(
        _figures(trials, evaluated),
        {
            "weights": weights,
            **used,
            "trial_periods": stabilization.TRIAL_PERIODS,
            "start_poses": START_POSES,
            "ropes": size.ropes,
        },
        origin
        | {
            "swing damper tuned": "other ropes, see `palpate.trials.rope.baselines`",
            "evaluated": f"{size.ropes} sampled ropes, seed {first}",
        },
    )


def _figures(trials: list[StabilizationTrial], evaluated: dict[str, Episodes]) -> list[Figure]:
    summaries = {name: summarise(trials, episodes) for name, episodes in evaluated.items()}
    own = summaries[CONTROLLED]
    bars = SUCCESS_BAR, PERIODS_BAR
    rows = [
        dataclasses.replace(row, rival=rival.value)
        for row, rival in zip(own.figures(bars=bars), summaries[DAMPER].figures(), strict=True)
    ]
    rows += [
        Figure("time_to_1pct_periods.failures_counted", own.periods_with_failures, "periods"),
        Figure("relapse_rate", own.relapsed / len(trials), ""),
    ]
    for pose, part in by_group(trials, evaluated[CONTROLLED]).items():
        rows += StabilizationTrial.figures(*part, f".{pose}")
    for name in (STILL, DAMPER):
        rows += summaries[name].figures(f".{suffix(name)}")
    # Success asks for an instant of rest; these say how much the gripper trembles otherwise.
    for name, end in ((CONTROLLED, ""), (DAMPER, ".swing_damper")):
        at_once = summaries[name].at_rest_at_once / len(trials)
        rows.append(Figure(f"gripper_at_rest_at_once{end}", at_once, "", better="higher"))
        rows.append(Figure(f"gripper_speed_at_end{end}", summaries[name].final_speed, "m/s"))
    rows.append(_energy_left_when_still(trials, evaluated[STILL]))
    return rows


def _energy_left_when_still(trials: list[StabilizationTrial], episodes: Episodes) -> Figure:
    """Of all ropes held still, the least share of its energy that one has after three periods."""
    shares = [
        energy[math.floor(3.0 * trial.period / trial.control_period)] / energy[0]
        for trial, energy in zip(trials, episodes.energy, strict=True)
    ]
    least = float(np.nanmin(shares)) if np.any(np.isfinite(shares)) else None
    return Figure("least_energy_after_3_periods.held_still", least, "of its start", better="higher")
