"""`palpate reproduce rope-tracking`: a rope recorded, identified, and led along paths by its tip.

The nominal MuJoCo rope is recorded and identified, a policy is trained on random paths through what
was found, and is tried in MuJoCo on ropes drawn around the nominal one and on a lemniscate, an egg
and a sine, none of which it was trained on. Beside it, in the same trials: MPPI and CEM through the
same model within 10 ms a decision, and MPPI with more time than there is; and grippers that are
held still, or moved along the path without looking. Planners plan as if the gripper followed at
once, which lags by 10 ms; the policy was trained with lags of 0 to 30 ms.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from palpate.experiments.experiment import Experiment, decision_figures, ratio, suffix
from palpate.experiments.rope.nominal import (
    BASE,
    FULL,
    QUICK,
    identified_rope,
    identified_split,
    trained_policy,
)
from palpate.families.rope.recording import constants
from palpate.learning import Training
from palpate.models.rope import Rope
from palpate.planning.sampling import SamplingPlanner, samples_within
from palpate.runs import Figure, Result
from palpate.runs.storage import read_json, write_json
from palpate.tasks.rope import RopeTracking
from palpate.tasks.rope.paths import CURVES
from palpate.tasks.rope.tracking import hanging_rope
from palpate.trials.controller import Controller
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.planners import PlannedFollower, decision_times, following_planner
from palpate.trials.rope.tracking import (
    DURATIONS,
    SIZES,
    TILTS,
    Followed,
    PathTrial,
    blind_controllers,
    figures,
    path_trials,
    summarise,
    table,
    write_path_evidence,
)
from palpate.trials.trial import evaluate_trials, groups

NAME = "rope-tracking"
ERROR_BAR, RATIO_BAR = 3.0, 1.0  # cm
BUDGET = 0.01  # s, a planner's decision
UNHURRIED = 2048, 4  # samples and iterations of a planner that may take longer
EVALUATION_SEEDS = 955_000  # of ropes, paths and noise, used by nothing else
TUNING_SEED = 7000  # of the trials that the planners were tuned on
TRAINED, CHAIN = "controlled", "as a chain"
MPPI_10, CEM_10, MPPI_MORE = "MPPI 10 ms", "CEM 10 ms", "MPPI unhurried"

_TRAINING = Training(iterations=2000, starts=4000, observation_noise=BASE.observation_noise)
SIZE = dataclasses.replace(
    FULL,
    training=_TRAINING,
    ropes=10,
    minutes={"recording": 1, "identification": 3, "training": 11, "evaluation": 12},
)
SMALL = dataclasses.replace(
    QUICK,
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
    model, task = identified_rope(experiment, size), RopeTracking()
    policy, about = trained_policy(experiment, "train", task, model, size.training)
    samples = _planner_samples(experiment, model)
    first = experiment.uses(EVALUATION_SEEDS)
    trials = path_trials(BASE, size.ropes, first)
    some = [trials[i] for of in groups(trials).values() for i in of[:SLOW_ROPES]]
    work = {"seed": seed, "ropes": size.ropes, "policy": about, "samples": samples}
    planned = {
        MPPI_10: PlannedFollower(following_planner("mppi", model, samples["mppi"]), seed),
        CEM_10: PlannedFollower(following_planner("cem", model, samples["cem"]), seed),
    }
    controllers = {
        TRAINED: LearnedController(policy, task),
        **blind_controllers(BASE),
        **planned,
    }
    unhurried = {MPPI_MORE: PlannedFollower(following_planner("mppi", model, *UNHURRIED), seed)}
    followed, times = _followed(experiment, "evaluate", work, controllers, trials)
    slow, more = _followed(experiment, "evaluate-unhurried", work, unhurried, some)
    print("\n".join([*table(trials, followed), *table(some, slow)]))
    return experiment.result(
        _figures(trials, followed, some, slow, times | more),
        {
            "policy": about,
            "planner_samples": samples,
            "unhurried_samples_and_iterations": UNHURRIED,
            "planners_lag_s": 0.0,
            "policy_trained_with_lag_up_to_s": task.action_lag,
            "world": constants(BASE),
            "sizes_m": SIZES,
            "durations_s": DURATIONS,
            "tilts_rad": TILTS,
            "ropes": size.ropes,
        },
        {
            "identified": identified_split(size, seed),
            "trained": "through the identified model alone, on random sums of sinusoids",
            "planners tuned": f"three trials of seed {TUNING_SEED}",
            "evaluated": (
                f"{', '.join(CURVES)}, each with {size.ropes} sampled ropes, seed {first}"
            ),
        },
    )


def _planner_samples(experiment: Experiment, model: Rope) -> dict[str, int]:
    """How many samples MPPI and CEM have within the budget on this machine, from a stage."""
    configuration = {"stage": "planners", "seed": experiment.seed, "budget_s": BUDGET}
    with experiment.stage("planners", configuration) as stage:
        file = stage.path / "samples.json"
        if not stage.finished:
            samples = {}
            for method in ("mppi", "cem"):
                samples[method], _ = samples_within(
                    BUDGET,
                    lambda count, method=method: _decision(
                        following_planner(method, model, count), model
                    ),
                )
            write_json(file, samples)
            stage.content = {"samples": samples}
        return read_json(file)


def _decision(planner: SamplingPlanner, model: Rope) -> Callable[[], Any]:
    """A function that takes one decision about a hanging rope."""
    plan = planner.init(jnp.zeros((1, 3)), jax.random.key(0))
    state, goals = hanging_rope(model), jnp.zeros((planner.horizon, 3))
    return lambda: planner(plan, state, goals)


def _followed(
    experiment: Experiment,
    folder: str,
    work: dict[str, Any],
    controllers: Mapping[str, Controller],
    trials: list[PathTrial],
) -> tuple[dict[str, Followed], dict[str, list[float]]]:
    """What all controllers do in a stage, and how long planners took to decide, ms."""
    configuration = work | {"stage": folder, "trials": len(trials)}
    with experiment.stage(folder, configuration) as stage:
        followed = evaluate_trials(controllers, trials, stage.run)
        if not stage.finished:
            write_path_evidence(stage.run, trials, followed, next(iter(controllers)))
            planned = {n: c for n, c in controllers.items() if isinstance(c, PlannedFollower)}
            stage.content = {"decision_ms": decision_times(planned)}
    return followed, read_json(stage.path / "result.json")["decision_ms"]


def _figures(
    trials: list[PathTrial],
    followed: dict[str, Followed],
    some: list[PathTrial],
    slow: dict[str, Followed],
    times: dict[str, list[float]],
) -> list[Figure]:
    summaries = {name: summarise(trials, whole) for name, whole in followed.items()}
    own, rival = summaries[TRAINED], summaries[MPPI_10]
    rows = figures(own, bar=ERROR_BAR)
    rows[0] = dataclasses.replace(rows[0], rival=rival.mean)
    rows.append(Figure("ratio_to_mppi_10ms", ratio(own.mean, rival.mean), "", bar=RATIO_BAR))
    same = [index for of in groups(trials).values() for index in of[:SLOW_ROPES]]
    here, more = summarise(trials, followed[TRAINED], same), summarise(some, slow[MPPI_MORE])
    rows.append(Figure("ratio_to_mppi_unhurried", ratio(here.mean, more.mean), ""))
    rows.append(Figure("ratio_to_chain", ratio(own.mean, summaries[CHAIN].mean), ""))
    for path, chosen in groups(trials).items():
        rows += figures(summarise(trials, followed[TRAINED], chosen), f".{path}")
    for name, summary in (summaries | {MPPI_MORE: more}).items():
        if name != TRAINED:
            rows += figures(summary, f".{suffix(name)}")
    return rows + decision_figures(times)
