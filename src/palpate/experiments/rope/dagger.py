"""`palpate reproduce rope-dagger`: a policy that is lost where it was not trained, and mended.

The shipped stabiliser takes over from a gripper that has whirled the rope in small fast circles,
between its second and third way of turning as a whole (3.7 sqrt(g / L); the ways are at 2.76 and
4.33). No motion that it was trained on comes near: some ropes it whirls on, for good.
Self-supervised DAgger notices, collects what it sees, and trains on through a model of the nominal
rope that is identified here. Beside it the same extra training without what was collected.

The constants were chosen on ropes
and seeds that no figure is measured on.
"""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from palpate.experiments.experiment import Experiment, resumable
from palpate.experiments.rope.dagger_figure import draw
from palpate.experiments.rope.nominal import (
    BASE,
    FULL,
    QUICK,
    SHIPPED_SPLIT,
    Size,
    identified_rope,
    identified_split,
    shipped_policy,
)
from palpate.families.rope.recording import constants
from palpate.learning import Training
from palpate.learning.dagger import Outcome, dagger, go_on
from palpate.learning.loss_monitor import Observed
from palpate.models.rope import RopeState
from palpate.networks import CommandPolicy
from palpate.parameters import describe
from palpate.runs import Figure, Result
from palpate.runs.run import RESULT
from palpate.runs.storage import read_json
from palpate.tasks.rope import RopeStabilization
from palpate.trials.controller import Controller, FeedbackController, HeldStill
from palpate.trials.rope.baselines import TUNED, SwingDamper
from palpate.trials.rope.evaluation import (
    TRIAL_PERIODS,
    Summary,
    evaluation_trials,
    figures,
    summarise,
)
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.trials import Episodes, StabilizationTrial, settling_times
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

    size: Size  # of recording and identification
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
    observation_noise=BASE.observation_noise,
)
FULL_WORK = Work(
    FULL, _TRAINING, 10, 20, 40,
    {"identification": 2, "watching": 4, "training": 4, "evaluation": 8},
)  # fmt: skip
QUICK_WORK = Work(
    QUICK, dataclasses.replace(_TRAINING, iterations=40), 1, 4, 4,
    {"identification": 1, "watching": 1, "training": 1, "evaluation": 1},
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Situation:
    """Trials of `steps` control periods, before which the gripper whirls.

    `whirl`: its velocities (trials, steps before, 3) in m/s.
    """

    trials: list[StabilizationTrial]
    whirl: np.ndarray

    @property
    def steps(self) -> int:
        """Control periods from the take-over on: four periods of the longest rope drawn."""
        longest = dataclasses.replace(BASE, length=1.1 * BASE.length)
        return math.ceil(
            TRIAL_PERIODS * StabilizationTrial(longest, "", 0).period / BASE.control_period
        )

    def part(self, chosen: np.ndarray) -> "Situation":
        """Only the trials with these numbers."""
        return Situation([self.trials[trial] for trial in chosen], self.whirl[chosen])


def nominal(ropes: int, seed: int) -> Situation:
    """The start poses that the policy is known to work from: nothing whirls."""
    trials = evaluation_trials(BASE, ropes, seed)
    return Situation(trials, np.zeros((len(trials), 0, 3)))


def whirled(ropes: int, seed: int) -> Situation:
    """Sampled ropes, each whirled in a circle of its own rate, speed, sense and phase."""
    random = np.random.default_rng((seed, 2))
    configurations = sample_configurations(BASE, ropes, seed)
    seeds = random.integers(2**31, size=ropes)
    trials = [
        StabilizationTrial(configuration, "hanging", int(own))
        for configuration, own in zip(configurations, seeds, strict=True)
    ]
    return Situation(trials, np.stack([_whirl(rope, random) for rope in configurations]))


def _whirl(rope: RopeConfiguration, random: np.random.Generator) -> np.ndarray:
    """Gripper velocities (steps, 3) in m/s along a circle, from rest to full speed."""
    time = np.arange(round(WHIRL_DURATION / rope.control_period)) * rope.control_period
    rate = WHIRL * math.sqrt(rope.gravity / rope.length)
    rate *= 1 + WHIRL_SPREAD * random.uniform(-1, 1)
    angle = random.choice([-1, 1]) * rate * time + random.uniform(0, 2 * np.pi)
    speed = random.uniform(*WHIRL_SPEED) * np.minimum(1, time / WHIRL_RAMP)
    return speed[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)


class Follower(LearnedController):
    """A policy that watches until it takes over, and keeps what it saw and commanded.

    While others move the gripper it estimates velocities and knows the command in force.
    """

    def start(self, command: np.ndarray, observation: RopeObservation, goal: None) -> Any:
        """See `FeedbackController.start`."""
        self._seen: list[np.ndarray] = []
        self._commands: list[np.ndarray] = []
        return super().start(command, observation, goal)

    def follow(self, carry: Any, observation: RopeObservation, command: np.ndarray) -> Any:
        """The next carry while somebody else commands (worlds, 3) m/s for one control period."""
        window, _, step = carry
        window, _ = self.observer.update(window, observation)
        self._keep(observation, command)
        memory = self.policy.initial_carry(jnp.asarray(command, jnp.float32)[:, None])
        return window, memory, step + 1

    def decide(
        self, carry: Any, observation: RopeObservation, goal: None
    ) -> tuple[Any, np.ndarray]:
        """See `FeedbackController.decide`."""
        carry, command = super().decide(carry, observation, goal)
        self._keep(observation, command)
        return carry, command

    def observed(self, after: int) -> Observed:
        """What was seen after so many control periods, velocities as the policy estimates them."""
        positions = np.stack(self._seen, axis=1)
        commands = np.stack(self._commands, axis=1)[:, :, None]
        frames = self.observer.estimator.frames
        padded = np.pad(positions, ((0, 0), (frames - 1, 0), (0, 0), (0, 0)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, frames, axis=1)
        velocities = windows @ self.observer.estimator.weights
        before = commands[:, after - 1] if after else np.zeros_like(commands[:, 0])
        kept = positions[:, after:], velocities[:, after:], commands[:, after:], before
        position, velocity, actions, command = (jnp.asarray(part, jnp.float32) for part in kept)
        return Observed(RopeState(position, velocity), actions, command)

    def _keep(self, observation: RopeObservation, command: np.ndarray) -> None:
        self._seen.append(self.observer.positions(observation))
        self._commands.append(np.asarray(command))


class TakeOver(FeedbackController):
    """First the gripper whirls, then the controller has it."""

    def __init__(self, controller: Controller, whirl: np.ndarray):
        self._controller, self._whirl = controller, whirl
        self.period = controller.period

    def start(self, command: np.ndarray, observation: RopeObservation, goal: None) -> Any:
        """How many periods have passed, and what the controller carries."""
        if isinstance(self._controller, Follower):
            return 0, self._controller.start(command, observation, goal)
        return 0, self._controller.initial_carry(command)

    def decide(
        self, carry: Any, observation: RopeObservation, goal: None
    ) -> tuple[Any, np.ndarray]:
        """See `FeedbackController.decide`."""
        step, inner = carry
        if step >= self._whirl.shape[1]:
            inner, command = self._controller(inner, observation, goal, None)
        else:
            command = self._whirl[:, step]
            if isinstance(self._controller, Follower):
                inner = self._controller.follow(inner, observation, command)
        return (step + 1, inner), command


def tried(controller: Controller, situation: Situation) -> Episodes:
    """What happens from the instant on at which the controller takes over."""
    before = situation.whirl.shape[1]
    taking_over = TakeOver(controller, situation.whirl)
    episodes = run_trials(situation.trials, taking_over, before + situation.steps)
    return dataclasses.replace(
        episodes,
        energy=episodes.energy[:, before:],
        gripper_speed=episodes.gripper_speed[:, before:],
    )


def watched(policy: CommandPolicy, situation: Situation) -> Observed:
    """What a robot sees of a policy, without the trials whose simulation ended early."""
    follower = Follower(policy, RopeStabilization())
    failures = tried(follower, situation).failures
    whole = np.array([i for i in range(len(situation.trials)) if i not in failures], int)
    return jax.tree.map(lambda leaf: leaf[whole], follower.observed(situation.whirl.shape[1]))


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Identify, watch, train and evaluate below `out`; `quick` is the same work, smaller.

    Raises `PalpateError` when `out` holds another run's stages, or when this installation has no
    shipped weights.
    """
    experiment, work = Experiment(NAME, out, quick, seed), QUICK_WORK if quick else FULL_WORK
    experiment.announce(work.minutes)
    policy, manifest = shipped_policy()
    model = identified_rope(experiment, work.size)
    task, training = RopeStabilization(), work.training
    about = {
        "policy": manifest,
        "model": {row["name"]: row["value"] for row in describe(model)},
        "world": constants(BASE),
        "nominal_ropes": work.nominal,
        "watched_ropes": work.watched,
        "whirl": [WHIRL, WHIRL_SPREAD, *WHIRL_SPEED, WHIRL_DURATION, WHIRL_RAMP],
    }
    outcome = dagger(
        task,
        model,
        policy,
        lambda policy, seed: watched(policy, nominal(work.nominal, NOMINAL_SEEDS + seed)),
        lambda policy, seed: watched(policy, whirled(work.watched, WATCHED_SEEDS + seed)),
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
    shifted, usual = whirled(work.evaluated, first), nominal(work.nominal, first)
    before, after, without = (Follower(each, task) for each in (policy, outcome.policy, control))
    tries = {
        "before": (before, shifted),
        "after": (after, shifted),
        "control": (without, shifted),
        "held_still": (HeldStill(), shifted),
        "swing_damper": (SwingDamper(BASE), shifted),
        "nominal_before": (before, usual),
        "nominal_after": (after, usual),
    }
    settings = {
        "training": dataclasses.asdict(training),
        "swing_damper": dataclasses.asdict(TUNED),
    }
    configuration = {
        "stage": "evaluate",
        "seed": seed,
        "about": about,
        "trials": {name: len(situation.trials) for name, (_, situation) in tries.items()},
        **settings,
    }
    summaries = _evaluated(experiment, tries, configuration)
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
            "collected": [_counted(one.collected) for one in outcome.rounds],
            "trial_periods": TRIAL_PERIODS,
        },
        {
            "policy": SHIPPED_SPLIT,
            "identified": identified_split(work.size, seed),
            "calibrated": f"{4 * work.nominal} nominal trials, seed {calibrated}",
            "watched": f"{work.watched} whirled ropes a round, from {seen_from}",
            "evaluated": f"{work.evaluated} whirled ropes and {4 * work.nominal} nominal trials, "
            f"seed {first}",
        },
    )


def _evaluated(
    experiment: Experiment,
    tries: Mapping[str, tuple[Controller, Situation]],
    configuration: Mapping[str, Any],
) -> dict[str, Summary]:
    """How each controller does in its situation, in a stage that saves after every few trials."""
    work = [
        (
            name,
            np.arange(first, min(first + StabilizationTrial.side_by_side, len(situation.trials))),
        )
        for name, (_, situation) in tries.items()
        for first in range(0, len(situation.trials), StabilizationTrial.side_by_side)
    ]
    done = {
        name: np.full((2, len(situation.trials), situation.steps + 1), np.nan, np.float32)
        for name, (_, situation) in tries.items()
    }
    with experiment.stage("evaluate", configuration) as stage:
        for (name, chosen), note in resumable(stage.run, work, done, "evaluating"):
            controller, situation = tries[name]
            part = situation.part(chosen)
            episodes = tried(controller, part)
            done[name][:, chosen] = episodes.energy, episodes.gripper_speed
            settled = float(np.isfinite(settling_times(part.trials, episodes)).mean())
            note(controller=name, success_rate=settled)
        summaries = {
            name: summarise(situation.trials, _episodes(done[name]))
            for name, (_, situation) in tries.items()
        }
        rates = {name: summary.success_rate for name, summary in summaries.items()}
        stage.content = {"success_rates": rates}
    return summaries


def _episodes(values: np.ndarray) -> Episodes:
    energy, speed = values
    ended = np.flatnonzero(np.isnan(energy).any(axis=1)).tolist()
    return Episodes(energy, speed, np.empty((0,)), dict.fromkeys(ended, "it diverged"))


def _figures(summaries: Mapping[str, Summary], outcome: Outcome) -> list[Figure]:
    before, *_ = figures(summaries["before"], "_before", bars=(SUCCESS_BEFORE, None))
    rows = [
        dataclasses.replace(before, better="lower"),
        *figures(summaries["after"], "_after", bars=(SUCCESS_BAR, None)),
        Figure("rounds", outcome.trained_rounds, "", bar=ROUNDS),
    ]
    for name in ("control", "held_still", "swing_damper", "nominal_before", "nominal_after"):
        bar = summaries["nominal_before"].success_rate if name == "nominal_after" else None
        rows += figures(summaries[name], f"_{name}", bars=(bar, None))
    first = outcome.rounds[0].collected
    rows.append(Figure("share_of_trials_collected", float(first.any(axis=1).mean()), ""))
    return rows


def _counted(collected: np.ndarray) -> dict[str, int]:
    return {
        "trials": len(collected),
        "trials_with_a_shift": int(collected.any(axis=1).sum()),
        "states": int(collected.sum()),
    }
