"""`palpate reproduce rope-generalization`: ropes never seen, pushed, seen badly, late and seldom.

The policy that ships was trained for one rope, and only that rope is identified here. It then has
to stabilise three others, of other length, mass and distribution of mass; ropes that are pushed,
while they settle and once they are at rest; and ropes whose markers are noisy, or come 50, 25 or 10
times a second and late. Nothing is identified or trained anew: the length is measured when a trial
starts, by which rope and time are scaled (Froude's similarity), and between measurements the model
predicts. Beside it, in a part of the same trials, the policy as it is used otherwise.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.experiments.experiment import Experiment, ratio, share_of
from palpate.experiments.rope import nominal
from palpate.experiments.rope.nominal import BASE
from palpate.families.rope.recording import constants
from palpate.networks import Controller
from palpate.runs import Figure, Result
from palpate.tasks.rope import RopeStabilization
from palpate.trials.rope.learned import LearnedController, ObservedController
from palpate.trials.rope.stabilization import (
    TRIAL_PERIODS,
    Episodes,
    StabilizationTrial,
    Summary,
    evaluation_trials,
    lasting,
    summarise,
    write_trial_evidence,
)
from palpate.trials.trial import groups
from palpate.worlds.rope.rope import Disturbance, RopeConfiguration

NAME = "rope-generalization"
SUCCESS_BAR, TIME_BAR = 0.95, 1.3
SEEDS = 970_000  # of ropes, noise and pushes, used by nothing else
PUSH, PUSH_DURATION = (0.3, 0.6), 0.1  # N, s
PUSHED_BETWEEN = 0.3, 1.0  # share of the length from the gripper on
SETTLING, SETTLED = 0.5, 3.0  # s after the start, when a rope is pushed


@dataclasses.dataclass(frozen=True)
class Row:
    """Ropes drawn around `base`; `pushed`: s after the start at which each is pushed once."""

    base: RopeConfiguration
    pushed: float | None = None


def _rope(**changes: Any) -> Row:
    return Row(dataclasses.replace(BASE, **changes))


# Written down before the first evaluation.
ROWS = {
    "nominal": Row(BASE),
    "short and light": _rope(length=0.75, mass=0.05),
    "long and heavy": _rope(length=1.25, mass=0.2),
    "weighted": _rope(mass_distribution=lambda place: 1 + 2 * place, tip_mass=0.04),
    "pushed while settling": Row(BASE, SETTLING),
    "pushed at rest": Row(BASE, SETTLED),
    "noise of 2 mm": _rope(observation_noise=2e-3),
    "noise of 5 mm": _rope(observation_noise=5e-3),
    "50 Hz": _rope(observation_rate=50.0, observation_delay=0.02),
    "25 Hz": _rope(observation_rate=25.0, observation_delay=0.03),
    "10 Hz": _rope(observation_rate=10.0, observation_delay=0.05),
}
ROPES = {"full": 15, "quick": 1}  # from each start pose
PLAIN_ROPES = 3  # of them, with the policy as it is used otherwise
CONTROLLED, PLAIN = "controlled", "as shipped"


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Identify the nominal rope below `out` and try every row; `quick` is the same, smaller.

    Raises `PalpateError` when `out` holds another run's stages, or when this installation has no
    shipped policy.
    """
    experiment, size = Experiment(NAME, out, quick, seed), nominal.QUICK if quick else nominal.FULL
    minutes = {"identification": 1, "rows": 2} if quick else {"identification": 2, "rows": 20}
    experiment.announce({"recording": 1} | minutes)
    policy, about = nominal.shipped_policy()
    model, task = nominal.identified_rope(experiment, size), RopeStabilization()
    ropes, first = ROPES["quick" if quick else "full"], experiment.uses(SEEDS)
    summaries, plain = {}, {}
    for name, row in ROWS.items():
        trials = _trials(row, ropes, first)
        some = lasting([trials[i] for pose in groups(trials).values() for i in pose[:PLAIN_ROPES]])
        observed = ObservedController(policy, task, model, row.base.observation_noise)
        used = experiment, name, row, about
        summaries[name] = _evaluate(*used, {CONTROLLED: observed}, trials)
        print(summaries[name].line(name), flush=True)
        plain[name] = _evaluate(*used, {PLAIN: LearnedController(policy, task)}, some)
        print(plain[name].line(f"  {PLAIN}"), flush=True)
    return experiment.result(
        _figures(summaries, plain),
        {
            "weights": "shipped",
            "policy": about,
            "rows": {name: _changes_of(row) for name, row in ROWS.items()},
            "push_N": PUSH,
            "push_s": PUSH_DURATION,
            "ropes": ropes,
            "trial_periods": TRIAL_PERIODS,
        },
        {
            "identified": nominal.identified_split(size, seed),
            "trained": nominal.SHIPPED_SPLIT,
            "evaluated": f"{ropes} ropes drawn around each row's from each start pose, "
            f"seed {first}",
        },
    )


def _changes_of(row: Row) -> dict[str, Any]:
    """What a row differs in from the nominal one."""
    own, nominal = dataclasses.asdict(row.base), dataclasses.asdict(BASE)
    changes = {name: value for name, value in own.items() if value != nominal[name]}
    return changes | ({} if row.pushed is None else {"pushed_at_s": row.pushed})


def _trials(row: Row, ropes: int, seed: int) -> list[StabilizationTrial]:
    """Sampled ropes from each start pose, each pushed from a side and at a place of its own."""
    trials = evaluation_trials(row.base, ropes, seed)
    if row.pushed is None:
        return trials
    random = np.random.default_rng((seed, 3))
    pushed = []
    for trial in trials:
        angle, force = random.uniform(0, 2 * np.pi), random.uniform(*PUSH)
        direction = force * np.cos(angle), force * np.sin(angle), 0.0
        place = random.uniform(*PUSHED_BETWEEN)
        push = Disturbance(row.pushed, PUSH_DURATION, direction, place)
        rope = dataclasses.replace(trial.configuration, disturbances=(push,))
        pushed.append(dataclasses.replace(trial, configuration=rope))
    return pushed


def _evaluate(
    experiment: Experiment,
    name: str,
    row: Row,
    about: dict[str, Any],
    controllers: dict[str, Controller],
    trials: list[StabilizationTrial],
) -> Summary:
    """How a controller does in trials of the row."""
    (who,) = controllers
    folder = f"{name}/{who}".replace(" ", "-")
    world = {"row": _changes_of(row), "world": constants(row.base), "policy": about}
    evaluated, _ = experiment.evaluated(folder, world, controllers, trials, write_trial_evidence)
    return summarise(trials, _after_push(row, evaluated[who]))


def _after_push(row: Row, episodes: Episodes) -> Episodes:
    """From the end of the push on: its 1 % is of the energy that the rope has then."""
    pushed = 0.0 if row.pushed is None else row.pushed + PUSH_DURATION
    return episodes.after(round(pushed / row.base.control_period))


def _figures(summaries: dict[str, Summary], plain: dict[str, Summary]) -> list[Figure]:
    nominal = summaries["nominal"]
    ratios = [ratio(summary.periods, nominal.periods) for summary in summaries.values()]
    seconds = [ratio(summary.time, nominal.time) for summary in summaries.values()]
    least = min(summaries.values(), key=lambda summary: summary.success_rate)
    rows = [
        share_of(
            "success_rate_worst", least.successes, least.trials, bar=SUCCESS_BAR,
            seed_document="succeeds on three ropes",
            rival=min(summary.success_rate for summary in plain.values()),
        ),
        Figure("time_ratio_worst", _worst(ratios), "", bar=TIME_BAR),
        Figure("time_ratio_worst.seconds", _worst(seconds), ""),
    ]  # fmt: skip
    for (name, summary), slower in zip(summaries.items(), ratios, strict=True):
        end = name.replace(" ", "_")  # Hz stays Hz
        rows += summary.figures(f".{end}")
        rows.append(Figure(f"time_ratio.{end}", slower, ""))
        rows += plain[name].figures(f".{end}.as_shipped")[:2]
    return rows


def _worst(ratios: Sequence[float | None]) -> float | None:
    """The greatest; unknown where one is, because no rope of that row came to rest."""
    known = [ratio for ratio in ratios if ratio is not None]
    return max(known) if len(known) == len(ratios) else None
