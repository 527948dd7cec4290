"""`palpate reproduce rope-tracking`: a rope recorded, identified, and led along paths by its tip.

The nominal MuJoCo rope is recorded and identified, a policy is trained on random paths through what
was found, and is tried in MuJoCo on ropes drawn around the nominal one and on a lemniscate, an egg
and a sine, none of which it was trained on. Beside it, in the same trials: MPPI and CEM through the
same model within 10 ms a decision, MPPI with more time than there is, and grippers that are held
still, or moved along the path without looking.

Each stage is a run in a folder below `out`, and resumes there.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from palpate.experiments.experiment import suffix
from palpate.experiments.rope.stabilization import (
    BASE,
    FULL,
    QUICK,
    Size,
    announce,
    finish,
    identified_rope,
    trained_policy,
    wall_time,
)
from palpate.families.rope.recording import constants
from palpate.learning import Training
from palpate.models.rope import Rope
from palpate.networks import CommandPolicy
from palpate.planning.sampling import SamplingPlanner, samples_within
from palpate.runs import Figure, Result, Run
from palpate.runs.storage import read_json, write_json
from palpate.tasks.rope import RopeTracking
from palpate.tasks.rope.paths import CURVES
from palpate.tasks.rope.tracking import hanging_rope
from palpate.trials.rope.followers import (
    LearnedFollower,
    PlannedFollower,
    blind_followers,
    decision_times,
    planner,
)
from palpate.trials.rope.tracking import (
    DURATIONS,
    SIZES,
    TILTS,
    Followed,
    Follower,
    PathTrial,
    by_path,
    figures,
    follow,
    path_trials,
    summarise,
    table,
    write_path_evidence,
)

NAME = "rope-tracking"
ERROR_BAR, RATIO_BAR = 3.0, 1.0  # cm
BUDGET = 0.01  # s, a planner's decision
UNHURRIED = 2048, 4  # samples and iterations of a planner that may take longer
EVALUATION_SEEDS = 955_000  # of ropes, paths and noise, used by nothing else
TRAINED, CHAIN = "controlled", "as a chain"
MPPI_10, CEM_10, MPPI_MORE = "MPPI 10 ms", "CEM 10 ms", "MPPI unhurried"

_NOISE = BASE.observation_noise
_TRAINING = Training(iterations=2000, starts=4000, observation_noise=_NOISE)
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
    size = SMALL if quick else SIZE
    announce(NAME, size.minutes)
    model, spent = identified_rope(out, size, seed)
    command = f"palpate reproduce {NAME} --seed {seed}{' --quick' if quick else ''}"
    policy, about = trained_policy(
        out / "train", RopeTracking(), model, size.training, seed, command
    )
    samples, measured = _planner_samples(out / "planners", model, seed)
    trials = path_trials(BASE, size.ropes, EVALUATION_SEEDS + seed)
    evaluated = _evaluated(out, size, model, policy, about, samples, trials, seed)
    followed, unhurried, times, took = evaluated
    spent += about["wall_time_s"] + measured + took
    lines = table(trials, followed)
    some, slow = unhurried
    print("\n".join([*lines, *table(some, slow)]))
    return Result(
        NAME,
        _figures(trials, followed, some, slow, times),
        {
            "quick": quick,
            "policy": about,
            "planner_samples": samples,
            "unhurried_samples_and_iterations": UNHURRIED,
            "world": constants(BASE),
            "sizes_m": SIZES,
            "durations_s": DURATIONS,
            "tilts_rad": TILTS,
            "ropes": size.ropes,
        },
        [seed],
        {
            "identified": f"the nominal rope, {size.recorded_trials} motions, seeds from {seed}",
            "trained": "through the identified model alone, on random sums of sinusoids",
            "planners tuned": "three trials of seed 7000",
            "evaluated": (
                f"{', '.join(CURVES)}, each with {size.ropes} sampled ropes, "
                f"seed {EVALUATION_SEEDS + seed}"
            ),
        },
        spent,
    )


def _planner_samples(path: Path, model: Rope, seed: int) -> tuple[dict[str, int], float]:
    """How many samples MPPI and CEM have within the budget on this machine; kept in `path`."""
    with Run.open(path, {"stage": "planners", "seed": seed, "budget_s": BUDGET}) as run:
        file = run.path / "samples.json"
        if not run.finished:
            samples = {}
            for method in ("mppi", "cem"):
                samples[method], _ = samples_within(
                    BUDGET,
                    lambda count, method=method: _decision(planner(method, model, count), model),
                )
            write_json(file, samples)
            finish(run, NAME, "planners", {"samples": samples})
        return read_json(file), wall_time(run)


def _decision(planner: SamplingPlanner, model: Rope) -> Callable[[], Any]:
    """A function that takes one decision about a hanging rope."""
    plan = planner.init(jnp.zeros((1, 3)), jax.random.key(0))
    state, goals = hanging_rope(model), jnp.zeros((planner.horizon, 3))
    return lambda: planner(plan, state, goals)


def _evaluated(
    out: Path,
    size: Size,
    model: Rope,
    policy: CommandPolicy,
    about: dict[str, Any],
    samples: dict[str, int],
    trials: list[PathTrial],
    seed: int,
):
    """What everybody does, in two stages: the planner that takes its time has fewer trials."""
    task = RopeTracking()
    planned: dict[str, list[PlannedFollower]] = {}

    def planning(name: str, method: str, count: int, iterations: int | None = None) -> Follower:
        chosen = planner(method, model, count, iterations)

        def make(paths: np.ndarray) -> PlannedFollower:
            follower = PlannedFollower(chosen, paths, seed)
            planned.setdefault(name, []).append(follower)
            return follower

        return make

    followers: dict[str, Follower] = {
        TRAINED: lambda paths: LearnedFollower(policy, task, paths),
        **blind_followers(BASE),
        MPPI_10: planning(MPPI_10, "mppi", samples["mppi"]),
        CEM_10: planning(CEM_10, "cem", samples["cem"]),
    }
    unhurried = {MPPI_MORE: planning(MPPI_MORE, "mppi", *UNHURRIED)}
    some = [trials[i] for of in by_path(trials).values() for i in of[:SLOW_ROPES]]
    stages, spent = [], 0.0
    for folder, who, which in (
        ("evaluate", followers, trials),
        ("evaluate-unhurried", unhurried, some),
    ):
        configuration = {
            "stage": folder,
            "seed": seed,
            "trials": len(which),
            "ropes": size.ropes,
            "policy": about,
            "samples": samples,
        }
        with Run.open(out / folder, configuration) as run:
            followed = follow(who, which, run)
            if not run.finished:
                shown = next(iter(who))
                write_path_evidence(run, which, followed, shown)
                finish(run, NAME, folder, {"decision_ms": decision_times(planned)})
            times = read_json(run.path / "result.json")["decision_ms"]
            spent += wall_time(run)
        stages.append((which, followed, times))
    (_, followed, times), (some, slow, more) = stages
    return followed, (some, slow), times | more, spent


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
    rows.append(Figure("ratio_to_mppi_10ms", _ratio(own.mean, rival.mean), "", bar=RATIO_BAR))
    same = [index for of in by_path(trials).values() for index in of[:SLOW_ROPES]]
    here, more = summarise(trials, followed[TRAINED], same), summarise(some, slow[MPPI_MORE])
    rows.append(Figure("ratio_to_mppi_unhurried", _ratio(here.mean, more.mean), ""))
    rows.append(Figure("ratio_to_chain", _ratio(own.mean, summaries[CHAIN].mean), ""))
    for path, chosen in by_path(trials).items():
        rows += figures(summarise(trials, followed[TRAINED], chosen), f".{path}")
    for name, summary in (summaries | {MPPI_MORE: more}).items():
        if name != TRAINED:
            rows += figures(summary, f".{suffix(name)}")
    for name, (median, late) in times.items():
        rows.append(Figure(f"decision_ms_median.{suffix(name)}", median, "ms"))
        rows.append(Figure(f"decision_ms_p99.{suffix(name)}", late, "ms"))
    return rows


def _ratio(own: float | None, rival: float | None) -> float | None:
    return None if own is None or rival is None else own / rival
