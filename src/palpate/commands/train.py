"""`palpate train`: an identified model in, a controller out.

Nothing here knows the task but by its name: `options.prepare` does.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from palpate.commands import folders
from palpate.families.options import Train
from palpate.family import find
from palpate.learning import Training, simulate, train
from palpate.models.files import load_model
from palpate.models.model import Model
from palpate.networks import CommandPolicy, Controller, save_controller
from palpate.parameters import describe
from palpate.runs import Figure, Run
from palpate.runs.result import machine, read_result
from palpate.runs.run import RESULT
from palpate.tasks.task import Task

EPISODES = 256  # from start states that were not trained on, for the figures


def run(options: Train) -> Path:
    """Train, say how well the policy does in the model, and return the folder everything is in.

    Raises `PalpateError` for a model the task cannot use, and for folders that cannot be used.
    """
    file = folders.product_of(options.model, folders.MODEL, "identify")
    task = options.wanted()  # first: its file may bring the model's class
    model, about = load_model(file)
    model = options.prepare(model)
    training = settings(options)
    words = f"train {options.task}"
    decided = {"task": constants(task), "training": dataclasses.asdict(training)}
    inputs = {"model": file, **folders.source_of(options.place)}
    with folders.begin(options, words, inputs, folders.POLICY, **decided) as run:
        if not run.finished:
            command = folders.command(options, f"train {options.place or options.task}")
            more = {"recordings": about.get("recordings", {})}
            policy = trained(
                task, model, training, options.seed, run, command=command, manifest=more
            )
            figures = figures_in_model(task, model, policy, options.seed)
            split = {"scored": f"{EPISODES} new start states in the model it was trained on"}
            folders.finish(run, figures, split=split)
        for figure in read_result(run.path / RESULT).figures:
            print(line_of(figure))
        title = f"How a controller was trained for {options.task}"
        folders.hand_over(options, run, title, folders.POLICY)
        return run.path


def trained(
    task: Task,
    model: Model,
    training: Training,
    seed: int,
    run: Run,
    *,
    command: str,
    manifest: Mapping[str, Any] = MappingProxyType({}),
) -> CommandPolicy:
    """The policy that is trained in `run`, which keeps it with all that its reader has to know.

    `command`: what makes it again. `manifest`: what else its file is to say.
    """
    policy = train(task, model, training, seed, run)
    told = {
        "task": task.name,
        "command": command,
        "seed": seed,
        "training": dataclasses.asdict(training),
        "model": describe(model),
        "machine": machine(),
        "wall_time_s": run.elapsed,
    }
    save_controller(run.path / folders.POLICY, policy, {**manifest, **told})
    return policy


def named_task(name: str) -> Task:
    """The task of that name, as it is by default."""
    return find("tasks", name)()  # a task has defaults for all its fields


def settings(options: Train) -> Training:
    """The training that was asked for: what was not said is as it is by default."""
    names = ("iterations", "batch", "starts", "observation_noise")
    asked = {name: getattr(options, name) for name in names}
    return Training(**{name: value for name, value in asked.items() if value is not None})


def figures_in_model(task: Task, model: Model, policy: Controller, seed: int) -> list[Figure]:
    """Means over episodes in the model, from start states of another seed than the training's.

    They last twice as long as those trained on, for what has to stay as it is in the end.
    An outcome that some episodes do not have is averaged over those that do.
    """
    key = jax.random.fold_in(jax.random.key(seed), 1)
    steps = round(2 * task.duration / model.control_period)

    @jax.jit
    def outcome() -> dict[str, jax.Array]:
        start = task.starts(model, key, EPISODES)
        models = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (EPISODES, *leaf.shape)), model)
        states, actions = simulate(task, models, policy, start, steps)
        return task.outcome(models, start, states, actions)

    figures = []
    for name, values in outcome().items():
        known = np.asarray(values)[np.isfinite(values)]
        value = float(known.mean()) if known.size else None
        better = "higher" if name == "success" else "lower"
        unit = task.outcome_units.get(name, "")
        figures.append(Figure(f"in_model.{name}", value, unit, better=better))
    return figures


def line_of(figure: Figure) -> str:
    """For a person."""
    value = "none" if figure.value is None else f"{figure.value:.4g} {figure.unit}"
    return f"{figure.name.replace('_', ' ').replace('.', ': ')} {value}".rstrip()


def constants(task: Task) -> dict[str, Any]:
    """What a task was made with, for a run's configuration."""
    return {field.name: getattr(task, field.name) for field in dataclasses.fields(task)}
