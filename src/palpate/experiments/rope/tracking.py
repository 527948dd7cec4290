"""`palpate reproduce rope-tracking`: a rope recorded, identified, and led along paths by its tip.

The nominal MuJoCo rope is recorded and identified, a policy is trained on random paths through what
was found, and is tried in MuJoCo on ropes drawn around the nominal one and on a lemniscate, an egg
and a sine, none of which it was trained on. Beside it, in the same trials: MPPI and CEM through the
same model within 10 ms a decision, and MPPI with more time than there is; and grippers that are
held still, or moved along the path without looking. Planners plan as if the gripper followed at
once, which lags by 10 ms; the policy was trained with lags of 0 to 30 ms.
"""

import dataclasses
from pathlib import Path

import jax.numpy as jnp

from palpate.experiments.experiment import Experiment, decision_figures, ratio, suffix
from palpate.experiments.rope import nominal
from palpate.families.rope.recording import constants
from palpate.planning.sampling import samples_within
from palpate.runs import Figure, Result
from palpate.tasks.rope import RopeTracking
from palpate.tasks.rope.paths import CURVES
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.planners import PlannedFollower, decision_about, following_planner
from palpate.trials.rope.tracking import (
    DURATIONS,
    SIZES,
    TILTS,
    Followed,
    PathTrial,
    blind_controllers,
    path_trials,
    summarise,
    write_path_evidence,
)
from palpate.trials.trial import by_group, groups, table

NAME = "rope-tracking"
ERROR_BAR, RATIO_BAR = 3.0, 1.0  # cm
BUDGET = 0.01  # s, a planner's decision
UNHURRIED = 2048, 4  # samples and iterations of a planner that may take longer
EVALUATION_SEEDS = 955_000  # of ropes, paths and noise, used by nothing else
TUNING_SEED = 7000  # of the trials that the planners were tuned on
TRAINED, CHAIN = "controlled", "as a chain"
MPPI_10, MPPI_MORE = "MPPI 10 ms", "MPPI unhurried"
METHODS = {"mppi": samples_within, "cem": samples_within}

_TRAINING = dataclasses.replace(nominal.FULL.training, starts=4000)
SIZE = dataclasses.replace(
    nominal.FULL,
    training=_TRAINING,
    ropes=10,
    minutes={"recording": 1, "identification": 3, "training": 11, "evaluation": 12},
)
SMALL = dataclasses.replace(
    nominal.QUICK,
    training=dataclasses.replace(_TRAINING, iterations=150, batch=64, starts=1600),
    ropes=1,
    minutes={"recording": 1, "identification": 1, "training": 1, "evaluation": 3},
)
SLOW_ROPES = 1  # of them, for the planner that takes longer


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Record, identify, train and evaluate below `out`; `quick` is the same at a smaller size.

    Raises `PalpateError` when `out` holds the stages of another run.
    """
    experiment, size = Experiment(NAME, out, quick, seed), SMALL if quick else SIZE
    experiment.announce(size.minutes)
    model, task = nominal.identified_rope(experiment, size), RopeTracking()
    policy, about = nominal.trained_policy(experiment, "train", task, model, size.training)
    samples = nominal.sizes_within(
        experiment, BUDGET, METHODS,
        lambda method, size: decision_about(following_planner(method, model, size), jnp.zeros(3)),
    )  # fmt: skip
    first = experiment.uses(EVALUATION_SEEDS)
    trials = path_trials(nominal.BASE, size.ropes, first)
    some = [trials[i] for of in groups(trials).values() for i in of[:SLOW_ROPES]]
    work = {"ropes": size.ropes, "policy": about, "samples": samples}
    controllers = {
        TRAINED: LearnedController(policy, task),
        **blind_controllers(nominal.BASE),
        **{
            f"{method.upper()} 10 ms": PlannedFollower(following_planner(method, model, size), seed)
            for method, size in samples.items()
            if size
        },
    }
    unhurried = {MPPI_MORE: PlannedFollower(following_planner("mppi", model, *UNHURRIED), seed)}
    show = write_path_evidence
    followed, times = experiment.evaluated("evaluate", work, controllers, trials, show)
    slow, more = experiment.evaluated("evaluate-unhurried", work, unhurried, some, show)
    print("\n".join([*table(trials, followed), *table(some, slow)]))
    return experiment.result(
        _figures(trials, followed, some, slow, times | more),
        {
            "policy": about,
            "planner_samples": samples,
            "unhurried_samples_and_iterations": UNHURRIED,
            "planners_lag_s": 0.0,
            "policy_trained_with_lag_up_to_s": task.action_lag,
            "world": constants(nominal.BASE),
            "sizes_m": SIZES,
            "durations_s": DURATIONS,
            "tilts_rad": TILTS,
            "ropes": size.ropes,
        },
        {
            "identified": nominal.identified_split(size, seed),
            "trained": "through the identified model alone, on random sums of sinusoids",
            "planners tuned": f"three trials of seed {TUNING_SEED}",
            "evaluated": (
                f"{', '.join(CURVES)}, each with {size.ropes} sampled ropes, seed {first}"
            ),
        },
    )


def _figures(
    trials: list[PathTrial],
    followed: dict[str, Followed],
    some: list[PathTrial],
    slow: dict[str, Followed],
    times: dict[str, list[float]],
) -> list[Figure]:
    summaries = {name: summarise(trials, whole) for name, whole in followed.items()}
    own, rival = summaries[TRAINED], summaries.get(MPPI_10)
    rivalled = None if rival is None else rival.mean
    head, *rows = own.figures(bar=ERROR_BAR)
    same = [index for of in groups(trials).values() for index in of[:SLOW_ROPES]]
    here, more = summarise(some, followed[TRAINED].part(same)), summarise(some, slow[MPPI_MORE])
    rows = [
        dataclasses.replace(head, rival=rivalled),
        *rows,
        Figure("ratio_to_mppi_10ms", ratio(own.mean, rivalled), "", bar=RATIO_BAR),
        Figure("ratio_to_mppi_unhurried", ratio(here.mean, more.mean), ""),
        Figure("ratio_to_chain", ratio(own.mean, summaries[CHAIN].mean), ""),
    ]
    for path, part in by_group(trials, followed[TRAINED]).items():
        rows += PathTrial.figures(*part, f".{path}")
    for name, summary in (summaries | {MPPI_MORE: more}).items():
        if name != TRAINED:
            rows += summary.figures(f".{suffix(name)}")
    return rows + decision_figures(times)
