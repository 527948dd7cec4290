"""`palpate reproduce maze-safe`: learning to push without ever pushing too hard, method by method.

Every method of `palpate train maze` but the reflex is trained with three seeds, in the same
environments, by the same number of decisions and updates, and its policy is tried in new episodes
by `palpate evaluate maze`: where it was trained, in mazes that it has never felt, and with a
noisier sensor. Policies that were trained before, in folders `maze-METHOD-SEED` below `out`, are
taken as they are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from palpate.commands import evaluate, train
from palpate.experiments.contact.maze_figure import draw
from palpate.experiments.experiment import Experiment, share_of
from palpate.families.contact.maze_options import EvaluateMaze, TrainMaze
from palpate.families.contact.methods import METHODS
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.worlds.maze.layout import UNSEEN

NAME = "maze-safe"
FIRST, TRIED = 1, 100_000  # seeds of the first training and, beyond it, of its episodes
OWN, BARE, PLAIN = "srl-vic", "no-recovery", "srl-vic-without-noise"
REFLEX = "bresa"  # which `maze-reflex` holds against decisions
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
    names = [OWN, PLAIN, *(name for name in METHODS if name not in (OWN, REFLEX))]
    experiment.announce({a: len(names) * size.seeds * time for a, time in MINUTES.items()})
    first = experiment.uses(FIRST, size.seeds)
    seeds = range(first, first + size.seeds)
    trained = {
        name: [policy_of(experiment, name, each, size.steps) for each in seeds] for name in names
    }
    home = {name: tried(experiment, folders, "home", size) for name, folders in trained.items()}
    mazes = UNSEEN[: size.mazes]
    away = {
        name: tried(experiment, trained[name], "unseen", size, mazes=mazes)
        for name in (OWN, "position-critic")
    }
    noisy = {
        name: tried(experiment, trained[name], "noisy", size, noise=NOISY) for name in (OWN, PLAIN)
    }
    costs = {name: [figures_in(folder) for folder in folders] for name, folders in trained.items()}
    draw(out / "learning-curves.png", trained)
    return experiment.result(
        figures(size.episodes, costs, home, away, noisy),
        {"steps": size.steps, "episodes": size.episodes, "unseen": mazes, "noisy": NOISY},
        {"trained": "by each seed", "tried": f"in episodes of seeds from {TRIED} on, used once"},
    )


def policy_of(experiment: Experiment, name: str, seed: int, steps: int) -> Path:
    """The folder of a policy, trained unless it was."""
    method, noise = (OWN, 0.0) if name == PLAIN else (name, 1.0)
    folder = experiment.out / f"maze-{name}-{seed}"
    train.run(TrainMaze(method=method, noise=noise, steps=steps, seed=seed, out=folder))  # type: ignore[arg-type]
    experiment.seconds += read_result(folder / RESULT).wall_time_s
    return folder


def tried(
    experiment: Experiment,
    policies: Sequence[Path],
    where: str,
    size: Size,
    mazes: tuple[str, ...] = (),
    noise: float = 1.0,
) -> list[Values]:
    """What `evaluate` finds of each policy."""
    found = []
    for policy in policies:
        folder = policy.with_name(f"{policy.name}-{where}")
        seed = TRIED + experiment.seed
        evaluate.run(
            EvaluateMaze(
                policy=policy, episodes=size.episodes, mazes=mazes, noise=noise, seed=seed,
                out=folder,
            )
        )  # fmt: skip
        experiment.seconds += read_result(folder / RESULT).wall_time_s
        found.append(figures_in(folder))
    return found


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


def figures(
    episodes: int,
    costs: Mapping[str, Sequence[Values]],
    home: Mapping[str, Sequence[Values]],
    away: Mapping[str, Sequence[Values]],
    noisy: Mapping[str, Sequence[Values]],
) -> list[Figure]:
    """What counts, pooled over the seeds, and then every method's own."""

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
    found = [
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
        share("unseen_violation_rate_with_position", away["position-critic"], "violation_rate",
              better="lower"),
        Figure("unseen_progress", mean(away[OWN], "progress"), "", 0.3, better="higher",
               rival=f"held still {mean(away[OWN], 'progress.held_still') or 0.0:.3g}"),
        share("unseen_success_rate", away[OWN], "success_rate"),
    ]  # fmt: skip
    for name, runs in (("noise", noisy[OWN]), ("no_noise", noisy[PLAIN])):
        found += [
            share(f"{name}.success_rate", runs, "success_rate"),
            share(f"{name}.violation_rate", runs, "violation_rate", better="lower"),
        ]
    for name, runs in home.items():
        own = name.replace("-", "_")
        found += [
            share(f"detail.{own}.success_rate", runs, "success_rate"),
            share(f"detail.{own}.violation_rate", runs, "violation_rate", better="lower"),
            Figure(f"detail.{own}.training_violations", violations[name], ""),
            Figure(f"detail.{own}.pretraining_violations",
                   total(costs[name], "pretraining.violations"), ""),
            Figure(f"detail.{own}.progress", mean(runs, "progress"), "", better="higher"),
        ]  # fmt: skip
    return found
