"""`palpate reproduce rope-stabilization`: a rope recorded, identified, and brought to rest.

The nominal MuJoCo rope is recorded and identified, a policy is trained through what was found, and
is tried from four start poses in 125 MuJoCo ropes that were used for nothing else, beside a gripper
held still and a tuned swing damper in the same trials.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np

from palpate.experiments.experiment import Experiment, suffix
from palpate.experiments.rope.nominal import (
    BASE,
    FULL,
    QUICK,
    SHIPPED_SPLIT,
    identified_rope,
    identified_split,
    shipped_policy,
    trained_policy,
)
from palpate.families.rope.recording import constants
from palpate.networks import CommandPolicy
from palpate.runs import Figure, Result
from palpate.tasks.rope import RopeStabilization
from palpate.trials.controller import HeldStill
from palpate.trials.rope.baselines import TUNED, SwingDamper
from palpate.trials.rope.evaluation import (
    TRIAL_PERIODS,
    by_pose,
    evaluate,
    evaluation_trials,
    figures,
    summarise,
    table,
    write_trial_evidence,
)
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.trials import Episodes, StabilizationTrial
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
    experiment, size = Experiment(NAME, out, quick, seed), QUICK if quick else FULL
    if weights == "shipped":
        policy, about = shipped_policy()
        experiment.announce(size.part("evaluation"))
        origin = {"trained": SHIPPED_SPLIT}
    else:
        experiment.announce(size.minutes)
        model = identified_rope(experiment, size)
        task = RopeStabilization()
        policy, about = trained_policy(experiment, "train", task, model, size.training)
        origin = {
            "identified": identified_split(size, seed),
            "trained": "through the identified model alone",
        }
    first = experiment.uses(EVALUATION_SEEDS)
    trials = evaluation_trials(BASE, size.ropes, first)
    evaluated = _evaluated(experiment, policy, about, trials)
    print("\n".join(table(trials, evaluated)))
    return experiment.result(
        _figures(trials, evaluated),
        {
            "weights": weights,
            "policy": about,
            "swing_damper": dataclasses.asdict(TUNED),
            "world": constants(BASE),
            "trial_periods": TRIAL_PERIODS,
            "start_poses": START_POSES,
            "ropes": size.ropes,
        },
        origin
        | {
            "swing damper tuned": "other ropes, see `rope_baselines`",
            "evaluated": f"{size.ropes} sampled ropes, seed {first}",
        },
    )


def _evaluated(
    experiment: Experiment,
    policy: CommandPolicy,
    about: dict[str, Any],
    trials: list[StabilizationTrial],
) -> dict[str, Episodes]:
    controllers = {
        CONTROLLED: LearnedController(policy, RopeStabilization()),
        STILL: HeldStill(),
        DAMPER: SwingDamper(BASE),
    }
    configuration = {
        "stage": "evaluate",
        "seed": experiment.seed,
        "trials": len(trials),
        "policy": about,
        "swing_damper": dataclasses.asdict(TUNED),
        "world": constants(BASE),
    }
    with experiment.stage("evaluate", configuration) as stage:
        evaluated = evaluate(controllers, trials, stage.run)
        if not stage.finished:
            write_trial_evidence(stage.run, trials, evaluated, (CONTROLLED, STILL))
            stage.content = {"figures": [row.to_dict() for row in _figures(trials, evaluated)]}
    return evaluated


def _figures(trials: list[StabilizationTrial], evaluated: dict[str, Episodes]) -> list[Figure]:
    summaries = {name: summarise(trials, episodes) for name, episodes in evaluated.items()}
    own = summaries[CONTROLLED]
    rivals = figures(summaries[DAMPER])
    rows = [
        dataclasses.replace(row, rival=rival.value)
        for row, rival in zip(figures(own, bars=(SUCCESS_BAR, PERIODS_BAR)), rivals, strict=True)
    ]
    rows += [
        Figure("time_to_1pct_periods.failures_counted", own.periods_with_failures, "periods"),
        Figure("relapse_rate", own.relapsed / len(trials), ""),
    ]
    for pose, summary in by_pose(trials, evaluated[CONTROLLED]).items():
        rows += figures(summary, f".{pose}")
    for name in (STILL, DAMPER):
        rows += figures(summaries[name], f".{suffix(name)}")
    # Success asks for an instant of rest; these say how much the gripper trembles otherwise.
    for name, end in ((CONTROLLED, ""), (DAMPER, ".swing_damper")):
        at_once = summaries[name].at_rest_at_once / len(trials)
        rows.append(Figure(f"gripper_at_rest_at_once{end}", at_once, "", better="higher"))
        rows.append(Figure(f"gripper_speed_at_end{end}", summaries[name].final_speed, "m/s"))
    rows.append(_left_when_still(trials, evaluated[STILL]))
    return rows


def _left_when_still(trials: list[StabilizationTrial], episodes: Episodes) -> Figure:
    """Of all ropes held still, the least share of its energy that one has after three periods."""
    shares = [
        energy[math.floor(3.0 * trial.period / trial.configuration.control_period)] / energy[0]
        for trial, energy in zip(trials, episodes.energy, strict=True)
    ]
    least = float(np.nanmin(shares)) if np.any(np.isfinite(shares)) else None
    return Figure("least_energy_after_3_periods.held_still", least, "of its start", better="higher")
