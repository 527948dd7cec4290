"""`palpate reproduce maze-arm`: what a tip has learnt in the maze, done by a seven-axis arm.

Policies of `palpate train maze --method srl-vic`, one for each seed, feel their way with the arm
(`palpate evaluate maze --world arm`) and are not trained anew. Beside them stand the same policies
on the tip of 1 kg that they were trained on, and an arm that is told to hold still. Trainings in
folders `maze-srl-vic-SEED` below `out`, as `palpate reproduce maze-safe` leaves them, are taken as
they are.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands import folders, train
from palpate.commands.in_world.episodes import at_its_best, play_episodes
from palpate.experiments.contact.maze_safe import FIRST
from palpate.experiments.experiment import Experiment
from palpate.families.contact.episodes import figures
from palpate.families.contact.maze_options import EvaluateMaze, TrainMaze
from palpate.networks.guarded import load_actor
from palpate.runs import Figure, Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT

NAME = "maze-arm"
METHOD = "srl-vic"
POLICIES, QUICK_POLICIES = 3, 1  # seeds of the trainings
TRIED = 400_000  # added to a training's seed: that of the episodes its policy is tried in
QUICK_STEPS, QUICK_ENVIRONMENTS = 200, 4
EPISODES, QUICK_EPISODES = {"arm": 500, "tip": 500, "still": 30}, {"arm": 3, "tip": 3, "still": 1}
MINUTES = {"training": 8, "arm": 5, "tip": 1, "still": 1}  # of a policy
BARS = {"success_rate": 0.80, "violation_rate": 0.02}
PRINTED = "a real arm, 6 of 6"  # arXiv 2406.13744, in a maze of its own

Episodes = dict[str, list[Any]]  # what `palpate.learning.off_policy.evaluate` gives, as lists


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Try policies below `out`; one whose training is finished there is taken as it is.

    `quick` is one short training and few episodes. Raises `PalpateError` when `out` holds other
    runs.
    """
    experiment, count = Experiment(NAME, out, quick, seed), QUICK_POLICIES if quick else POLICIES
    experiment.announce({of: 1 if quick else each * count for of, each in MINUTES.items()})
    first, whole = experiment.uses(FIRST, count), QUICK_EPISODES if quick else EPISODES
    found: dict[str, list[Episodes]] = {who: [] for who in whole}
    for number in range(count):
        folder = train_on_tip(experiment, first + number)
        for who, episodes in whole.items():
            share = len(range(number, episodes, count))
            about = {"policy": folder.name, "episodes": share}
            work = functools.partial(evaluate_policy, folder, who, share, TRIED + first + number)
            found[who].append(experiment.found(f"{folder.name}-{who}", about, work)["episodes"])
    settings = {"episodes": whole, "command": f"palpate train maze --method {METHOD}"}
    split = "new episodes in the maze that the policies were trained in, on the tip alone"
    return experiment.result(pooled_figures(found), settings, split)


def train_on_tip(experiment: Experiment, seed: int) -> Path:
    """The folder of the training on the tip."""
    folder = experiment.out / f"maze-{METHOD}-{seed}"
    small: dict[str, Any] = {}
    if experiment.quick:
        small = {"steps": QUICK_STEPS, "environments": QUICK_ENVIRONMENTS}
    train.run(TrainMaze(method=METHOD, seed=seed, out=folder, **small))
    experiment.seconds += read_result(folder / RESULT).wall_time_s
    return folder


def evaluate_policy(folder: Path, who: str, episodes: int, seed: int) -> dict[str, Episodes]:
    """So many episodes of the policy on the arm or the tip, or of an arm that holds "still"."""
    policy, manifest = load_actor(folder / folders.POLICY)
    options = EvaluateMaze(policy=folder, world="tip" if who == "tip" else "arm")
    make = functools.partial(options.make, manifest=manifest, policy=policy)
    act = (lambda seen: np.zeros((len(seen), 4))) if who == "still" else at_its_best(policy)
    ended = play_episodes(make, act, episodes, seed)
    return {"episodes": {name: values.tolist() for name, values in ended.items()}}


def pooled_figures(found: dict[str, list[Episodes]]) -> list[Figure]:
    """Figures of all policies' episodes together: the arm's with their bars, then the others'."""
    pooled = {
        who: figures({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
        for who, parts in found.items()
    }
    tip = {figure.name: figure.value for figure in pooled["tip"]}
    listed = []
    for who, those in pooled.items():
        for figure in those:
            held: dict[str, Any] = {"name": f"detail.{who}.{figure.name}"}
            if who == "arm" and figure.name in BARS:
                rival = f"the tip {tip[figure.name]:.3g}"
                printed = PRINTED if figure.name == "success_rate" else None
                held = {"bar": BARS[figure.name], "seed_document": printed, "rival": rival}
            listed.append(dataclasses.replace(figure, **held))
    return listed
