"""`palpate reproduce rope-dagger`: a policy that is lost where it was not trained, and mended.

The shipped stabiliser takes over from a gripper that has whirled the rope in small fast circles,
between its second and third way of turning as a whole (3.7 sqrt(g / L); the ways are at 2.76 and
4.33). No motion that it was trained on comes near: some ropes it whirls on, for good.
Self-supervised DAgger notices, collects what it sees, and trains on through a model of the nominal
rope that is identified here. Beside it the same extra training without what was collected.

The constants were chosen on ropes and seeds that no figure is measured on.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from palpate.experiments.experiment import Experiment, suffix
from palpate.experiments.rope import nominal
from palpate.experiments.rope.dagger_figure import draw
from palpate.families.rope.recording import constants
from palpate.learning import Training
from palpate.learning.dagger import Outcome, dagger, go_on
from palpate.learning.loss_monitor import Observed
from palpate.models.rope import RopeState
from palpate.networks import CommandPolicy, Controller
from palpate.parameters import describe
from palpate.runs import Figure, Result
from palpate.runs.run import RESULT
from palpate.runs.storage import read_json
from palpate.tasks.rope import RopeStabilization
from palpate.trials.controller import FeedbackController, Noted
from palpate.trials.rope.baselines import TUNED, baselines
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.stabilization import (
    TRIAL_PERIODS,
    Episodes,
    StabilizationTrial,
    Summary,
    evaluation_trials,
    summarise,
)
from palpate.trials.trial import run_trials
from palpate.worlds.rope.rope import RopeConfiguration, RopeObservation, sample_configurations

NAME = "rope-dagger"
WHIRL = 3.7  # rad/s of the circling gripper, in sqrt(g / L)
WHIRL_SPREAD = 0.03  # half-width of its draw, relative
WHIRL_SPEED = (0.74, 0.78)  # m/s of the gripper, drawn between
WHIRL_DURATION, WHIRL_RAMP = 2.0, 0.5  # s, of which it takes to reach that speed
ROUNDS = 3
SUCCESS_BEFORE, SUCCESS_BAR = 0.7, 0.95
# Seeds of what is watched, of what is evaluated, and of the nominal trials that calibrate.
WATCHED_SEEDS, EVALUATED_SEEDS, NOMINAL_SEEDS = 720_000, 930_000, 740_000


@dataclasses.dataclass(frozen=True)
class Work:
    """How much work a reproduction is."""

    size: nominal.Size  # of recording and identification
    training: Training  # what each round adds
    nominal: int  # ropes from each start pose, to calibrate on and to evaluate
    watched: int  # whirled ropes in each round
    evaluated: int  # whirled ropes
    minutes: dict[str, int]


# Of a policy that is trained already: whole episodes, all perturbations.
_TRAINING = Training(
    iterations=200,
    horizon_curriculum=False,
    noise_curriculum=False,
    learning_rate=3e-4,
    observation_noise=nominal.BASE.observation_noise,
)
FULL_WORK = Work(
    nominal.FULL, _TRAINING, 10, 20, 40,
    {"identification": 2, "watching": 4, "training": 4, "evaluation": 8},
)  # fmt: skip
QUICK_WORK = Work(
    nominal.QUICK, dataclasses.replace(_TRAINING, iterations=40), 1, 4, 4,
    {"identification": 1, "watching": 1, "training": 1, "evaluation": 1},
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class WhirledTrial(StabilizationTrial):
    """A rope that is to come to rest after its gripper was whirled.

    `whirl`: the gripper's velocities (steps before the controller takes over, 3) in m/s.
    """

    whirl: np.ndarray = dataclasses.field(kw_only=True, compare=False)

    @classmethod
    def goals(cls, trials: Sequence["WhirledTrial"]) -> np.ndarray:
        """See `Trial`: the velocities, (worlds, steps before, 3) in m/s."""
        return np.stack([trial.whirl for trial in trials])

    @classmethod
    def figures(
        cls, trials: Sequence["WhirledTrial"], record: Episodes, suffix: str = ""
    ) -> list[Figure]:
        """See `Summary.figures`; from the instant on at which the controller takes over."""
        return super().figures(trials, record.after(len(trials[0].whirl)), suffix)


def nominal_trials(ropes: int, seed: int) -> list[StabilizationTrial]:
    """From the start poses that the policy is known to work from: nothing whirls."""
    trials = evaluation_trials(nominal.BASE, ropes, seed)
    return [dataclasses.replace(trial, steps=_steps()) for trial in trials]


def whirled_trials(ropes: int, seed: int) -> list[WhirledTrial]:
    """Sampled ropes, each whirled in a circle of its own rate, speed, sense and phase."""
    random = np.random.default_rng((seed, 2))
    configurations = sample_configurations(nominal.BASE, ropes, seed)
    seeds = random.integers(2**31, size=ropes)
    whirls = [_whirl(rope, random) for rope in configurations]
    return [
        WhirledTrial(rope, "hanging", int(own), len(whirl) + _steps(), whirl=whirl)
        for rope, own, whirl in zip(configurations, seeds, whirls, strict=True)
    ]


def _steps() -> int:
    """Control periods from the take-over on: four periods of the longest rope drawn."""
    longest = dataclasses.replace(nominal.BASE, length=1.1 * nominal.BASE.length)
    period = StabilizationTrial(longest, "", 0).period
    return math.ceil(TRIAL_PERIODS * period / nominal.BASE.control_period)


def _whirl(rope: RopeConfiguration, random: np.random.Generator) -> np.ndarray:
    """Gripper velocities (steps, 3) in m/s along a circle, from rest to full speed."""
    time = np.arange(round(WHIRL_DURATION / rope.control_period)) * rope.control_period
    rate = WHIRL * math.sqrt(rope.gravity / rope.length)
    rate *= 1 + WHIRL_SPREAD * random.uniform(-1, 1)
    angle = random.choice([-1, 1]) * rate * time + random.uniform(0, 2 * np.pi)
    speed = random.uniform(*WHIRL_SPEED) * np.minimum(1, time / WHIRL_RAMP)
    return speed[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)


class TakeOver(FeedbackController):
    """First the gripper moves as the goal says, then the controller has it.

    A policy watches meanwhile: it estimates velocities and knows the command in force.
    """

    def __init__(self, controller: Controller):
        self._controller, self.period = controller, controller.period

    def start(self, command: np.ndarray, observation: RopeObservation, goal: Any) -> Any:
        """How many periods have passed, and what the controller carries."""
        if isinstance(self._controller, LearnedController):
            return 0, self._controller.start(command, observation, None)
        return 0, self._controller.initial_carry(command)

    def decide(self, carry: Any, observation: RopeObservation, goal: Any) -> tuple[Any, np.ndarray]:
        """See `FeedbackController.decide`; `goal`: velocities (worlds, steps before, 3) in m/s."""
        step, inner = carry
        if goal is None or step >= goal.shape[1]:
            inner, command = self._controller(inner, observation, None, None)
        else:
            command = goal[:, step]
            if isinstance(self._controller, LearnedController):
                inner = self._controller.follow(inner, observation, command)
        return (step + 1, inner), command


def watch(policy: CommandPolicy, trials: Sequence[StabilizationTrial]) -> Observed:
    """What a robot sees of a policy from the instant on at which it takes over.

    Without the trials whose simulation ended early; velocities as the policy estimates them.
    """
    learned = LearnedController(policy, RopeStabilization())
    noted, observer = Noted(TakeOver(learned)), learned.observer
    failures = run_trials(trials, noted).failures
    whole = [index for index in range(len(trials)) if index not in failures]
    seen = [observer.positions(observation)[whole] for observation in noted.observations]
    positions = np.stack(seen, axis=1)
    commands = np.stack(noted.actions, axis=1)[whole][:, :, None]
    frames = observer.estimator.frames
    padded = np.pad(positions, ((0, 0), (frames - 1, 0), (0, 0), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, frames, axis=1)
    velocities = windows @ observer.estimator.weights
    after = len(trials[0].whirl) if isinstance(trials[0], WhirledTrial) else 0
    before = commands[:, after - 1] if after else np.zeros_like(commands[:, 0])
    kept = positions[:, after:], velocities[:, after:], commands[:, after:], before
    position, velocity, actions, command = (jnp.asarray(part, jnp.float32) for part in kept)
    return Observed(RopeState(position, velocity), actions, command)


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Identify, watch, train and evaluate below `out`; `quick` is the same work, smaller.

    Raises `PalpateError` when `out` holds another run's stages, or when this installation has no
    shipped weights.
    """
    experiment, work = Experiment(NAME, out, quick, seed), QUICK_WORK if quick else FULL_WORK
    experiment.announce(work.minutes)
    policy, manifest = nominal.shipped_policy()
    model = nominal.identified_rope(experiment, work.size)
    task, training = RopeStabilization(), work.training
    about = {
        "policy": manifest,
        "model": {row["name"]: row["value"] for row in describe(model)},
        "world": constants(nominal.BASE),
        "nominal_ropes": work.nominal,
        "watched_ropes": work.watched,
        "whirl": [WHIRL, WHIRL_SPREAD, *WHIRL_SPEED, WHIRL_DURATION, WHIRL_RAMP],
    }
    outcome = dagger(
        task,
        model,
        policy,
        lambda policy, seed: watch(policy, nominal_trials(work.nominal, NOMINAL_SEEDS + seed)),
        lambda policy, seed: watch(policy, whirled_trials(work.watched, WATCHED_SEEDS + seed)),
        training,
        out,
        seed=seed,
        rounds=ROUNDS,
        about=about,
    )
    calibrated = experiment.uses(NOMINAL_SEEDS)
    seen_from = experiment.uses(WATCHED_SEEDS + 1, len(outcome.rounds))
    control = policy
    for number in range(1, outcome.trained_rounds + 1):
        folder = out / f"control-{number}-train"
        control = go_on(task, model, control, training, folder, seed + number, about)
    if outcome.rounds[0].collected.any():
        energy = "energy (J)", model.energy
        draw(out / "collected.png", task, model, outcome, training.starts, seed, energy)
    first = experiment.uses(EVALUATED_SEEDS)
    policies = {"before": policy, "after": outcome.policy, "control": control}
    controllers = {name: LearnedController(each, task) for name, each in policies.items()}
    settings = {
        "training": dataclasses.asdict(training),
        "swing_damper": dataclasses.asdict(TUNED),
    }
    used = {"about": about, **settings}
    shifted, usual = whirled_trials(work.evaluated, first), nominal_trials(work.nominal, first)
    tried = {
        suffix(name): TakeOver(controller)
        for name, controller in (controllers | baselines(nominal.BASE)).items()
    }
    again = {name: controllers[name] for name in ("before", "after")}
    of_whirled, _ = experiment.evaluated("evaluate", used, tried, shifted)
    of_nominal, _ = experiment.evaluated("evaluate-nominal", used, again, usual)
    begun = len(shifted[0].whirl)
    summaries = {name: summarise(shifted, one.after(begun)) for name, one in of_whirled.items()}
    summaries |= {f"nominal_{name}": summarise(usual, one) for name, one in of_nominal.items()}
    print("\n".join(summary.line(name) for name, summary in summaries.items()))
    # The rounds of DAgger are runs of their own.
    every = [read_json(path)["wall_time_s"] for path in sorted(out.glob(f"*/{RESULT}"))]
    experiment.seconds = sum(every)
    return experiment.result(
        _figures(summaries, outcome),
        {
            **about,
            **settings,
            "alarm": dataclasses.asdict(outcome.alarm),
            "collected": [_count(one.collected) for one in outcome.rounds],
            "trial_periods": TRIAL_PERIODS,
        },
        {
            "policy": nominal.SHIPPED_SPLIT,
            "identified": nominal.identified_split(work.size, seed),
            "calibrated": f"{4 * work.nominal} nominal trials, seed {calibrated}",
            "watched": f"{work.watched} whirled ropes a round, from {seen_from}",
            "evaluated": f"{work.evaluated} whirled ropes and {4 * work.nominal} nominal trials, "
            f"seed {first}",
        },
    )


def _figures(summaries: Mapping[str, Summary], outcome: Outcome) -> list[Figure]:
    before, *_ = summaries["before"].figures("_before", (SUCCESS_BEFORE, None))
    rows = [
        dataclasses.replace(before, better="lower"),
        *summaries["after"].figures("_after", (SUCCESS_BAR, None)),
        Figure("rounds", outcome.trained_rounds, "", bar=ROUNDS),
    ]
    for name in ("control", "held_still", "swing_damper", "nominal_before", "nominal_after"):
        bar = summaries["nominal_before"].success_rate if name == "nominal_after" else None
        rows += summaries[name].figures(f"_{name}", (bar, None))
    first = outcome.rounds[0].collected
    rows.append(Figure("share_of_trials_collected", float(first.any(axis=1).mean()), ""))
    return rows


def _count(collected: np.ndarray) -> dict[str, int]:
    return {
        "trials": len(collected),
        "trials_with_a_shift": int(collected.any(axis=1).sum()),
        "states": int(collected.sum()),
    }
