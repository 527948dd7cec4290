"""`palpate reproduce rope-rivals`: the policy that ships, and what else brings a rope to rest.

In MuJoCo ropes drawn as for `rope-stabilization`, from the same four start poses, side by side: the
shipped policy; one trained with the same settings through the undamped model (Lv et al. 2017) that
was identified from the same recording; MPPI, CEM and gradient MPC through the damped model, with
what fits into 10 ms a decision and with more; SAC, which acts in the damped model and does not
differentiate it; the tuned swing damper; a gripper held still. There is no bar: who is better is
what is to be found out.

SAC needs the extra `sac`, and is not run without it.
"""

import dataclasses
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from palpate.experiments.experiment import Experiment, decision_figures, suffix
from palpate.experiments.rope import nominal
from palpate.experiments.rope.model import remove_damping
from palpate.experiments.rope.nominal import Size
from palpate.families.rope.recording import constants
from palpate.learning import Training
from palpate.models.rope import Rope
from palpate.planning.gradient import iterations_within
from palpate.planning.sampling import samples_within
from palpate.runs import Figure, Result
from palpate.tasks.rope import RopeStabilization
from palpate.trials.rope.baselines import TUNED, baselines
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.planners import (
    TUNING,
    PlannedStabiliser,
    decision_about,
    stabilising_planner,
)
from palpate.trials.rope.stabilization import (
    Episodes,
    StabilizationTrial,
    evaluation_trials,
    lasting,
    write_trial_evidence,
)
from palpate.trials.trial import first_of_each_group, table

NAME = "rope-rivals"
BUDGET = 0.01  # s, a decision of a planner in a hurry
EVALUATION_SEEDS = 960_000  # of ropes and noise, used by nothing else
SHIPPED, UNDAMPED, SAC = "policy", "undamped policy", "SAC"
METHODS = {"mppi": samples_within, "cem": samples_within, "gradient": iterations_within}
UNHURRIED = {"mppi": 2048, "cem": 2048, "gradient": 5}  # samples; iterations
SIZE = dataclasses.replace(
    nominal.FULL,
    ropes=2,
    minutes={"recording": 1, "identification": 5, "training": 9, "SAC": 10, "evaluation": 10},
)
SMALL = dataclasses.replace(
    nominal.QUICK,
    training=dataclasses.replace(nominal.QUICK.training, iterations=60, batch=64, starts=1600),
    ropes=1,
    minutes={"recording and identification": 1, "training": 1, "SAC": 1, "evaluation": 2},
)
ROUNDS, FEW_ROUNDS = 60, 3  # of SAC: episodes that each of its environments goes through
NOT_RUN = "not run: it needs the package stable-baselines3, pip install 'palpate[sac]'"
# When quick: from how many start poses all are tried, and those unhurried, which have this share.
POSES, SLOW_POSES, LESS = 2, 1, 4


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Identify with and without damping, train the rival policy and evaluate all below `out`.

    `quick` is the same work at a smaller size. Raises `PalpateError` when `out` holds the stages of
    another run, or when this installation has no shipped weights.
    """
    experiment, size = Experiment(NAME, out, quick, seed), SMALL if quick else SIZE
    installed = sac_installed()
    stages = [stage for stage in size.minutes if installed or stage != SAC]
    experiment.announce(size.part(*stages))
    if not installed:
        print(f"{SAC}: {NOT_RUN}", flush=True)
    policy, about = nominal.shipped_policy()
    model, task = nominal.identified_rope(experiment, size), RopeStabilization()
    # The rope without damping that suits the same recording best, from what was found with it.
    lively = nominal.fitted_rope(
        experiment,
        "identify-undamped",
        size,
        dataclasses.replace(remove_damping(model), drive="position").constrain(),
        nominal.recorded_markers(out),
    )
    rival, rival_about = nominal.trained_policy(
        experiment, "train-undamped", task, lively, size.training
    )
    sizes = nominal.sizes_within(
        experiment, BUDGET, METHODS,
        lambda method, size: decision_about(stabilising_planner(method, model, size), jnp.ones(())),
    )  # fmt: skip
    hurried = _planners_of(model, sizes, "10 ms", seed)
    more = {method: -(-most // (LESS if quick else 1)) for method, most in UNHURRIED.items()}
    unhurried = _planners_of(model, more, "unhurried", seed)
    first = experiment.uses(EVALUATION_SEEDS)
    trials = evaluation_trials(nominal.BASE, size.ropes, first)
    if quick:
        trials = lasting([trials[index] for index in first_of_each_group(trials)[:POSES]])
    chosen = first_of_each_group(trials)[: SLOW_POSES if quick else None]
    some = lasting([trials[index] for index in chosen])
    settings = {
        "quick": quick,
        "policies": {SHIPPED: about, UNDAMPED: rival_about},
        "planners": dataclasses.asdict(TUNING),
        "within_10_ms": sizes,
        "unhurried": more,
        "swing_damper": dataclasses.asdict(TUNED),
        "world": constants(nominal.BASE),
        "ropes": size.ropes,
    }
    others = {
        SHIPPED: LearnedController(policy, task),
        UNDAMPED: LearnedController(rival, task),
        **baselines(nominal.BASE),
    }
    show = write_trial_evidence
    whole, times = experiment.evaluated("evaluate", settings, others | hurried, trials, show)
    slow, more_times = experiment.evaluated("evaluate-unhurried", settings, unhurried, some, show)
    free, free_about = {}, None
    if installed:
        rounds = FEW_ROUNDS if quick else ROUNDS
        free[SAC], free_about = _model_free(experiment, model, size, rounds, trials)
    lines, unmeasured = table(trials, whole | free), []
    if not installed:
        lines.append(f"{SAC:28s} {NOT_RUN}")
        unmeasured.append(Figure(f"success_rate.{suffix(SAC)}", None, "", better="higher"))
    print("\n".join([*lines, *table(some, slow)]))
    same = {f"{name} same trials": whole[name].part(chosen) for name in (SHIPPED, *hurried)}
    return experiment.result(
        [
            *_rows(trials, whole | free),
            *_rows(some, slow | same),
            *unmeasured,
            *decision_figures(times | more_times),
            *_effort(size.training, rival_about, free_about),
        ],
        settings | {SAC: free_about or NOT_RUN},
        {
            "identified": nominal.identified_split(size, seed),
            "trained": f"{UNDAMPED}: through the undamped model of the same recording alone",
            f"{SAC} trained": "in the damped model alone, drawn as in our own training",
            "planners tuned": "ropes of seed 7100, see `palpate.trials.rope.planners`",
            "evaluated": (
                f"{len(trials)} trials of {size.ropes} sampled ropes, seed {first}; "
                "planners unhurried in the first of each pose"
            ),
        },
    )


def sac_installed() -> bool:
    """Whether the library of SAC is there."""
    return importlib.util.find_spec("stable_baselines3") is not None


def _model_free(
    experiment: Experiment,
    model: Rope,
    size: Size,
    rounds: int,
    trials: Sequence[StabilizationTrial],
) -> tuple[Episodes, dict[str, Any]]:
    """What SAC does after so many rounds of training, and how it was trained."""
    from palpate.experiments.rivals.soft_actor_critic import Sac, trained_actor

    seed = experiment.seed
    actor, about = trained_actor(
        experiment.out / "train-sac", model, size.training, Sac(rounds), seed
    )
    experiment.seconds += about["wall_time_s"]
    controllers = {SAC: LearnedController(actor, RopeStabilization())}
    evaluated, _ = experiment.evaluated(
        "evaluate-sac", {"policy": about}, controllers, trials, write_trial_evidence
    )
    return evaluated[SAC], about


def _effort(
    training: Training, own: Mapping[str, Any], free: Mapping[str, Any] | None
) -> list[Figure]:
    """Control periods simulated to train, and the seconds that took: our method's and SAC's."""
    task = RopeStabilization()
    steps = task.duration / nominal.BASE.control_period * sum(task.stages) / len(task.stages)
    effort = {UNDAMPED: (training.iterations * training.batch * round(steps), own["wall_time_s"])}
    if free is not None:
        effort[SAC] = free["environment_steps"], free["wall_time_s"]
    rows = []
    for name, (simulated, seconds) in effort.items():
        rows.append(Figure(f"simulated_steps.{suffix(name)}", simulated, ""))
        rows.append(Figure(f"training_s.{suffix(name)}", seconds, "s"))
    return rows


def _planners_of(
    model: Rope, sizes: Mapping[str, int], when: str, seed: int
) -> dict[str, PlannedStabiliser]:
    """Those of the planners that have a size."""
    return {
        f"{method} {when}": PlannedStabiliser(stabilising_planner(method, model, size), seed)
        for method, size in sizes.items()
        if size
    }


def _rows(trials: Sequence[StabilizationTrial], evaluated: Mapping[str, Episodes]) -> list[Figure]:
    return [
        row
        for name, episodes in evaluated.items()
        for row in StabilizationTrial.figures(trials, episodes, f".{suffix(name)}")
    ]
