"""`palpate reproduce maze-reflex`: motions that are interrupted, against decisions overruled.

Two tasks, the maze that is felt through and the first navigation task of Recovery RL, each learnt
by `palpate train` with the same agent, critic and recovery: once where the recovery takes the place
of risky decisions (`srl-vic`), and once where it interrupts what is under way (`bresa`). Violations
are those of the training itself, the ones before it printed beside. Bresa (arXiv 2503.21989) prints
that they "sharply decrease", and no number.

Trainings stand beside each other, one on each core. What is found of one is in a small folder
`TASK-METHOD-SEED-found` below `out`, and is taken as it is; so are trainings in folders
`TASK-METHOD-SEED`, as `palpate reproduce maze-safe` leaves them.
"""

import functools
import time
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands import folders, train
from palpate.commands.in_world.episodes import at_its_best, play_episodes
from palpate.experiments.contact.maze_safe import FIRST
from palpate.experiments.experiment import Experiment, mean_of, ratio, share_of
from palpate.families.contact.maze_options import EvaluateMaze, TrainMaze
from palpate.families.contact.navigation_options import EvaluateNavigation, TrainNavigation
from palpate.networks.guarded import load_actor
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT

NAME = "maze-reflex"
TRAININGS, QUICK_TRAININGS = 3, 1  # seeds
TRIED = 400_000  # added to a training's seed: that of the episodes its policy is tried in
EPISODES, QUICK_EPISODES = 500, 4
QUICK_STEPS, QUICK_ENVIRONMENTS = 200, 4
OVERRULED, INTERRUPTED = METHODS = "srl-vic", "bresa"
TASKS: dict[str, tuple[Any, Any]] = {
    "maze": (TrainMaze, EvaluateMaze),
    "navigation": (TrainNavigation, EvaluateNavigation),
}
OTHER_RATES = {5: 0.2, 20: 0.05}  # Hz: s of a decision in the maze, trained at 10 Hz
MINUTES = {"maze": 100, "navigation": 8}  # of a seed
RATIO, WORSE, BASELINE, FAST = 0.2, -0.02, 200.0, 0.2  # the bars; the last in ms
TIMED = 50  # decisions

Found = dict[str, Any]  # of one training: its figures, and how its policy's episodes ended


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Train and try below `out`; a training that is finished there is taken as it is.

    `quick` is one seed, few steps and few episodes. Raises `PalpateError` when `out` holds other
    runs.
    """
    experiment, count = Experiment(NAME, out, quick, seed), QUICK_TRAININGS if quick else TRAININGS
    experiment.announce({task: 2 if quick else each * count for task, each in MINUTES.items()})
    first = experiment.uses(FIRST, count)
    seeds = range(first, first + count)
    grid = [(task, method, each) for each in seeds for task in TASKS for method in METHODS]
    experiment.on_every_core(of_training, grid, "trainings")
    found = {
        (task, method): [of_training(experiment, task, method, each) for each in seeds]
        for task in TASKS
        for method in METHODS
    }
    reflex = training_of(experiment, "maze", INTERRUPTED, first)
    timed = experiment.found("decision", {"timed": TIMED}, lambda: decision(reflex))
    listed = [figure for task in TASKS for figure in figures_of(task, found)]
    listed.append(Figure("decision_p99_ms", timed["p99_ms"], "ms", FAST))
    listed.append(Figure("detail.decision_median_ms", timed["median_ms"], "ms"))
    settings = {"methods": METHODS, "episodes": QUICK_EPISODES if quick else EPISODES}
    split = "policies are tried in new episodes of the worlds they were trained in"
    return experiment.result(listed, settings, split)


def training_of(experiment: Experiment, task: str, method: str, seed: int) -> Any:
    """Options of a training, which is small when the experiment is quick."""
    small = {"steps": QUICK_STEPS, "environments": QUICK_ENVIRONMENTS} if experiment.quick else {}
    out = experiment.out / f"{task}-{method}-{seed}"
    return TASKS[task][0](method=method, seed=seed, out=out, **small)


def of_training(experiment: Experiment, task: str, method: str, seed: int) -> Found:
    """What a training cost, and what became of its policy's episodes, at every rate."""
    options = training_of(experiment, task, method, seed)
    episodes = QUICK_EPISODES if experiment.quick else EPISODES
    rates = OTHER_RATES if task == "maze" else {}
    about = {
        "options": folders.configuration_of(options, f"train {task}"),
        "constants": options.constants(),
        "episodes": episodes,
        "rates": list(rates),
    }

    def work() -> Found:
        folder = train.run(options)
        policy, manifest = load_actor(folder / folders.POLICY)

        def tried(**asked: Any) -> dict[str, int]:
            trial = TASKS[task][1](policy=folder, seed=TRIED + seed, **asked)
            make = functools.partial(trial.make, manifest=manifest, policy=policy)
            ended = play_episodes(make, at_its_best(policy), episodes, trial.seed)
            ends = {end: int(np.sum(ended["end"] == end)) for end in ("goal", "violation")}
            return ends | {"of": episodes}

        found: Found = {
            figure.name: figure.value for figure in read_result(folder / RESULT).figures
        }
        found["tried-0"] = tried()
        for rate, period in rates.items():
            found[f"tried-{rate}"] = tried(decision_period=period)
        return found

    return experiment.found(f"{task}-{method}-{seed}-found", about, work)


def decision(training: Any) -> dict[str, float]:
    """How long the reflex takes in each control period of one world, less its impedance's force.

    Of the policy of a training, which is done unless it was.
    """
    folder = train.run(training)
    policy, manifest = load_actor(folder / folders.POLICY)
    environments, act = EvaluateMaze(policy=folder).make(1, manifest, policy), at_its_best(policy)
    filtered: Any = environments.law  # which counts energy, and lets all pass
    reflex: Any = filtered.law
    times: dict[Any, list[float]] = {reflex: [], reflex.law: []}

    def clocked(law: Any, command: Any, observation: Any) -> np.ndarray:
        began = time.perf_counter()
        done = command(observation)
        times[law].append(1e3 * (time.perf_counter() - began))
        return done

    for law in times:
        law.command = functools.partial(clocked, law, law.command)
    seen, _ = environments.reset(seed=training.seed)
    for _ in range(TIMED):
        seen = environments.step(act(seen))[0]
    own = np.subtract(times[reflex], times[reflex.law])
    return {"median_ms": float(np.median(own)), "p99_ms": float(np.quantile(own, 0.99))}


def figures_of(task: str, found: dict[tuple[str, str], list[Found]]) -> list[Figure]:
    """The two methods against each other, pooled over trainings; then each of them."""

    def pooled(method: str, *names: str) -> float:
        return float(sum(one[name] for one in found[task, method] for name in names))

    def share(method: str, end: str, rate: int = 0, better: str = "higher") -> Figure:
        tried = [one[f"tried-{rate}"] for one in found[task, method]]
        name = f"detail.{task}.{method}{f'.{rate}_hz' * bool(rate)}.{end}_rate"
        counts = (sum(one[key] for one in tried) for key in (end, "of"))
        return share_of(name, *counts, better=better)

    own, other = (pooled(method, "training.violations") for method in (INTERRUPTED, OVERRULED))
    every = "training.violations", "pretraining.violations"
    whole = ratio(pooled(INTERRUPTED, *every), pooled(OVERRULED, *every) or None)
    better, worse = (share(method, "goal").value or 0.0 for method in (INTERRUPTED, OVERRULED))
    listed = [
        Figure(f"{task}.violations_ratio", ratio(own, other or None), "", RATIO),
        Figure(f"{task}.success_difference", better - worse, "", WORSE, better="higher"),
        Figure(f"{task}.baseline_violations", other, "", BASELINE, better="higher"),
        Figure(f"detail.{task}.violations_ratio_with_pretraining", whole, ""),
    ]
    for method in METHODS:
        counts = [one["training.violations"] for one in found[task, method]]
        listed.append(mean_of(f"detail.{task}.{method}.violations", counts))
        for rate in (0, *(OTHER_RATES if task == "maze" else ())):
            listed.append(share(method, "goal", rate))
            listed.append(share(method, "violation", rate, "lower"))
    return listed
