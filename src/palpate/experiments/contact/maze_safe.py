"""`palpate reproduce maze-safe`: learning to push without ever pushing too hard, method by method.

Every method of `palpate train maze` but the reflex is trained with three seeds, in the same
environments, by the same number of decisions and updates, and its policy is tried in new episodes
by `palpate evaluate maze`: where it was trained, in mazes that it has never felt, and with a
noisier sensor. Trainings stand beside each other, one on each core. What is found of one is in a
small folder `METHOD-SEED-found` below `out`, and is taken as it is; so are policies that were
trained before, in folders `maze-METHOD-SEED`.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from palpate.commands import evaluate, folders, train
from palpate.experiments.contact.maze_figure import curve_of, draw
from palpate.experiments.experiment import Experiment, share_of
from palpate.families.contact.maze_options import EvaluateMaze, TrainMaze
from palpate.families.contact.methods import METHODS
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.worlds.maze.layout import UNSEEN

NAME = "maze-safe"
# Seeds of the first training (others were seen while constants were chosen, see
# `palpate.families.contact.methods`), and of episodes.
FIRST, TRIED = 31, 100_000
OWN, BARE, PLAIN = "srl-vic", "no-recovery", "srl-vic-without-noise"
POSITION = "position-critic"
# What `maze-reflex` holds against decisions, and `maze-passive` against those that draw more.
ELSEWHERE = "bresa", "passive"
CONSTANTS = tuple(name for name, make in METHODS.items() if make().stiffness is not None)
MORE_VIOLATIONS = 1.5  # times ours: a rival with more is none
NOISY = 2.0  # times the sensor's noise
MINUTES = {"a training": 6, "its episodes": 2}

Values = dict[str, float | None]


@dataclass(frozen=True)
class Size:
    """Seeds, decisions of a training, and episodes of each policy at home and elsewhere."""

    seeds: int
    steps: int
    episodes: int
    mazes: int


FULL, QUICK = Size(3, 150_000, 500, 10), Size(1, 4_000, 10, 2)


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Train and evaluate below `out`; `quick` is one seed and hardly learns anything.

    Raises `PalpateError` when `out` holds other runs.
    """
    experiment, size = Experiment(NAME, out, quick, seed), QUICK if quick else FULL
    names = [OWN, BARE, *(name for name in METHODS if name not in (OWN, BARE, *ELSEWHERE)), PLAIN]
    cores = 1 if quick else 2
    experiment.announce(
        {of: len(names) * size.seeds * each // cores for of, each in MINUTES.items()}
    )
    first = experiment.uses(FIRST, size.seeds)
    grid = [(name, each) for each in range(first, first + size.seeds) for name in names]
    experiment.on_every_core(of_training, grid, "trainings")
    found = {name: [] for name in names}
    for name, each in grid:
        found[name].append(of_training(experiment, name, each))
    draw(out / "learning-curves.png", {n: [one["curve"] for one in r] for n, r in found.items()})
    return experiment.result(
        figures(size.episodes, found),
        {"steps": size.steps, "episodes": size.episodes, "unseen": UNSEEN[: size.mazes],
         "noisy": NOISY, "training": found[OWN][0]["training"]},
        {"trained": "by each seed", "tried": f"in episodes of seeds from {TRIED} on, used once"},
    )  # fmt: skip


def of_training(experiment: Experiment, name: str, seed: int) -> dict[str, Any]:
    """What a training cost, and what its policy's episodes gave where it is tried.

    It stands in a folder of its own, which is small and all that the result is made of. The policy
    is in the folder `maze-NAME-SEED`, trained unless it was.
    """
    size = QUICK if experiment.quick else FULL
    options = TrainMaze(
        method=OWN if name == PLAIN else name, noise=0.0 if name == PLAIN else 1.0,  # type: ignore[arg-type]
        steps=size.steps, seed=seed, out=experiment.out / f"maze-{name}-{seed}",
    )  # fmt: skip
    about = {
        "options": folders.configuration_of(options, "train maze"),
        "training": dataclasses.asdict(options.training()),
        "constants": options.constants(),
        "size": dataclasses.asdict(size),
    }

    def work() -> dict[str, Any]:
        folder = train.run(options)
        places: dict[str, dict[str, Any]] = {"home": {}}
        if name in (OWN, POSITION):
            places["away"] = {"mazes": UNSEEN[: size.mazes]}
        if name in (OWN, PLAIN):
            places["noisy"] = {"noise": NOISY}
        found: dict[str, Any] = {
            where: evaluate_policy(folder, where, size.episodes, TRIED + experiment.seed, **asked)
            for where, asked in places.items()
        }
        return found | {
            "costs": figures_in(folder),
            "curve": [[each if each == each else None for each in row] for row in curve_of(folder)],
            "training": about["training"],
        }

    return experiment.found(f"{name}-{seed}-found", about, work)


def evaluate_policy(policy: Path, where: str, episodes: int, seed: int, **asked: Any) -> Values:
    """What `evaluate` finds of a policy."""
    folder = policy.with_name(f"{policy.name}-{where}")
    options = EvaluateMaze(policy=policy, episodes=episodes, seed=seed, out=folder, **asked)
    return figures_in(evaluate.run(options))


def figures_in(folder: Path) -> Values:
    """A finished run's figures by name."""
    return {figure.name: figure.value for figure in read_result(folder / RESULT).figures}  # type: ignore[misc]


def mean(runs: Sequence[Values], name: str) -> float | None:
    """Over the seeds; None where one does not know it."""
    values = [run.get(name) for run in runs]
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if len(known) == len(values) else None


def total(runs: Sequence[Values], name: str) -> float:
    """Over the seeds."""
    return sum(run[name] or 0.0 for run in runs)


def figures(episodes: int, found: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Figure]:
    """What counts, pooled over the seeds, and then every method's own, by `of_training`."""

    def all_of(where: str, *names: str) -> dict[str, list[Values]]:
        return {name: [one[where] for one in found[name]] for name in names or found}

    costs, home = all_of("costs"), all_of("home")
    away, noisy = all_of("away", OWN, POSITION), all_of("noisy", OWN, PLAIN)

    def share(name: str, runs: Sequence[Values], of: str, **held: object) -> Figure:
        count = episodes * len(runs)
        return share_of(name, round((mean(runs, of) or 0.0) * count), count, **held)  # type: ignore[arg-type]

    violations = {name: total(runs, "training.violations") for name, runs in costs.items()}
    before = total(costs[OWN], "pretraining.violations")
    baseline = violations[BARE]
    success = {name: mean(runs, "success_rate") or 0.0 for name, runs in home.items()}
    broken = {name: mean(runs, "violation_rate") or 0.0 for name, runs in home.items()}
    rivals = {n: success[n] for n in CONSTANTS if broken[n] <= MORE_VIOLATIONS * broken[OWN]}
    best = max(rivals, key=lambda name: rivals[name], default=None)
    listed = [
        share("success_rate", home[OWN], "success_rate", bar=0.9,
              rival=f"{BARE} {success[BARE]:.3g}"),
        share("violation_rate", home[OWN], "violation_rate", better="lower"),
        Figure("violations_ratio", violations[OWN] / baseline if baseline else None, "", 0.2),
        Figure("violations_ratio_with_pretraining",
               (violations[OWN] + before) / baseline if baseline else None, ""),
        Figure("baseline_violations", baseline, "", 200, better="higher"),
        share("k300_success_rate", home["k300"], "success_rate", bar=0.2, better="lower"),
        Figure("constant_gap", success[OWN] - max(rivals.values(), default=0.0), "", 0.05,
               better="higher", rival=f"{best} {rivals[best]:.3g}" if best else "none so safe"),
        Figure("stiffness_contrast", mean(home[OWN], "stiffness_contrast"), "", 2.0,
               better="higher"),
        Figure("risk_rank_correlation", mean(home[OWN], "risk_rank_correlation"), "", 0.6,
               better="higher"),
        Figure("risk_gain_over_force", mean(home[OWN], "risk_gain_over_force"), "", 0.1,
               better="higher"),
        share("unseen_violation_rate", away[OWN], "violation_rate", bar=0.02, better="lower"),
        share("unseen_violation_rate_with_position", away[POSITION], "violation_rate",
              better="lower"),
        Figure("unseen_progress", mean(away[OWN], "progress"), "", 0.3, better="higher",
               rival=f"held still {mean(away[OWN], 'progress.held_still') or 0.0:.3g}"),
        share("unseen_success_rate", away[OWN], "success_rate"),
    ]  # fmt: skip
    for name, runs in (("noise", noisy[OWN]), ("no_noise", noisy[PLAIN])):
        listed += [
            share(f"{name}.success_rate", runs, "success_rate"),
            share(f"{name}.violation_rate", runs, "violation_rate", better="lower"),
        ]
    for name, runs in home.items():
        own = name.replace("-", "_")
        listed += [
            share(f"detail.{own}.success_rate", runs, "success_rate"),
            share(f"detail.{own}.violation_rate", runs, "violation_rate", better="lower"),
            Figure(f"detail.{own}.training_violations", violations[name], ""),
            Figure(f"detail.{own}.pretraining_violations",
                   total(costs[name], "pretraining.violations"), ""),
            Figure(f"detail.{own}.progress", mean(runs, "progress"), "", better="higher"),
        ]  # fmt: skip
    return listed
