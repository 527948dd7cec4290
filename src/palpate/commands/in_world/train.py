"""`palpate train` of what learns in a world, by trial and error."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands import folders
from palpate.commands.in_world.episodes import at_its_best, play_episodes
from palpate.families.world_options import TrainInWorld
from palpate.learning.off_policy import train_off_policy
from palpate.networks import save_controller
from palpate.networks.guarded import ActorPolicy, load_actor
from palpate.runs import Figure, Run
from palpate.runs.figure_names import lines_of
from palpate.runs.result import machine, read_result
from palpate.runs.run import RESULT


def train_in_world(options: TrainInWorld) -> Path:
    """Train, try the policy in new episodes, and return the folder everything is in.

    Raises `PalpateError` for options that cannot be met, and as `train_off_policy`.
    """
    words = f"train {options.task}"
    decided = {"training": dataclasses.asdict(options.training()), "constants": options.constants()}
    with folders.begin(options, words, options.inputs(), folders.POLICY, **decided) as run:
        if not run.finished:
            policy, figures = train_policy_in_world(options, run)
            make = functools.partial(options.make, policy=policy)
            tried = play_episodes(make, at_its_best(policy), options.tried, options.seed + 1)
            figures += options.figures(tried, ".tried")
            options.show(run, policy)
            settings: dict[str, Any] = {folders.SUMMARY: [f"{line}." for line in lines_of(figures)]}
            split = {"tried": f"{options.tried} new episodes of the world it was trained in"}
            folders.finish(run, figures, settings, split)
        result = read_result(run.path / RESULT)
        print("\n".join(lines_of(result.figures)))
        title = f"How a controller was trained for {options.task}"
        folders.hand_over(options, run, title, folders.POLICY)
        return run.path


def train_policy_in_world(options: TrainInWorld, run: Run) -> tuple[ActorPolicy, list[Figure]]:
    """The policy that is trained in `run`, which keeps it; and what the training cost."""
    path = run.path / folders.POLICY
    offline = options.collected()
    environments = options.make_for_training()
    try:
        state = train_off_policy(
            environments,
            options.agent(),
            options.training(),
            options.seed,
            run,
            offline=offline,
        )
    finally:
        environments.close()
    lines = run.metrics()
    figures = [
        Figure("training.violations", lines[-1]["violations"], ""),
        Figure("training.episodes", sum(line["episodes"] for line in lines), ""),
        Figure(
            "pretraining.violations",
            0.0 if offline is None else float(np.sum((offline.cost > 0) & offline.whole)),
            "",
        ),
        Figure("pretraining.steps", 0 if offline is None else int(np.sum(offline.whole)), ""),
    ]
    policy = options.policy(state)
    save_controller(
        path,
        policy,
        {
            "task": options.task,
            "command": folders.command(options, f"train {options.task}"),
            "seed": options.seed,
            "options": folders.configuration_of(options, f"train {options.task}"),
            "training": dataclasses.asdict(options.training()),
            "constants": options.constants(),
            "figures": {figure.name: figure.value for figure in figures},
            "machine": machine(),
            "wall_time_s": run.elapsed,
        },
    )
    return load_actor(path)[0], figures
