"""`palpate train`: an identified model in, a controller out.

Nothing here knows the task but by its name: `options.prepare` does.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from palpate.commands import folders
from palpate.commands.in_world.train import train_in_world
from palpate.families.options import Train
from palpate.families.world_options import TrainInWorld
from palpate.family import find
from palpate.learning import Training, train
from palpate.models.files import load_model
from palpate.models.model import Model
from palpate.networks import CommandPolicy, load_policy, save_controller
from palpate.parameters import describe
from palpate.report import write_evidence
from palpate.runs import Figure, Run
from palpate.runs.figure_names import lines_of, value_in_words
from palpate.runs.result import machine, read_result
from palpate.runs.run import RESULT
from palpate.tasks.task import Task
from palpate.trials.in_model import EPISODES, evaluate_in_model

POOR = 0.5  # share of successes below which a policy is warned of


def run(options: Train | TrainInWorld) -> Path:
    """Train and return the folder everything is in; see the two ways of it."""
    if isinstance(options, TrainInWorld):
        return train_in_world(options)
    return train_through_model(options)


def train_through_model(options: Train) -> Path:
    """Train, say how well the policy does in the model, and return the folder everything is in.

    Raises `PalpateError` for a model the task cannot use, and for folders that cannot be used.
    """
    file = folders.product_of(options.model, folders.MODEL, "identify")
    task = options.wanted()  # first: its file may bring the model's class
    model, about = load_model(file)
    for doubt in about.get(folders.DOUBTS, []):
        print(f"warning: {file} is not to be trusted: {doubt}", flush=True)
    options = options.completed(about)
    model = options.prepare(model)
    training = settings(options)
    words = f"train {options.task}"
    decided = {"task": constants(task), "training": dataclasses.asdict(training)}
    inputs = {"model": file, **folders.source_of(options.place)}
    with folders.begin(options, words, inputs, folders.POLICY, **decided) as run:
        if not run.finished:
            command = folders.command(options, f"train {options.place or options.task}")
            more = {"recordings": about.get("recordings", {})}
            policy = train_policy(
                task, model, training, options.seed, run, command=command, manifest=more
            )
            figures, evidence = evaluate_in_model(task, model, policy, options.seed)
            write_evidence(run.path, evidence)
            figures += options.in_world(*load_policy(run.path / folders.POLICY))
            split = {"scored": f"{EPISODES} new start states in the model it was trained on"}
            warnings = warnings_of(figures)
            shown = {folders.SUMMARY: summary_of(figures, warnings)}
            shown["predicted"] = about.get("observed", [])
            folders.finish(run, figures, shown, split, warnings=warnings)
        result = read_result(run.path / RESULT)
        print("\n".join(lines_of(result.figures)))
        for warning in result.warnings:
            print(f"warning: {warning}")
        title = f"How a controller was trained for {options.task}"
        folders.hand_over(options, run, title, folders.POLICY)
        return run.path


def train_policy(
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
    described = {
        "task": task.name,
        "command": command,
        "seed": seed,
        "training": dataclasses.asdict(training),
        "model": describe(model),
        "machine": machine(),
        "wall_time_s": run.elapsed,
    }
    save_controller(run.path / folders.POLICY, policy, {**manifest, **described})
    return policy


def find_task(name: str) -> Task:
    """The task of that name, as it is by default."""
    return find("tasks", name)()  # a task has defaults for all its fields


def settings(options: Train) -> Training:
    """The training that was asked for: what was not said is as it is by default."""
    names = ("iterations", "batch", "starts", "observation_noise")
    asked = {name: getattr(options, name) for name in names}
    return Training(**{name: value for name, value in asked.items() if value is not None})


def warnings_of(figures: Sequence[Figure]) -> list[str]:
    """What to say of a policy that succeeds too seldom, in its own model or beyond it."""
    known = {figure.name: figure.value for figure in figures}
    inside, outside = known.get("in_model.success"), known.get("in_world.success_rate")
    if inside is not None and inside < POOR:
        return [
            f"in its own model the policy succeeds in {inside:.0%} of the starts: expected at "
            f"least {POOR:.0%} before it is tried elsewhere; more --iterations or a larger --batch "
            "may help"
        ]
    if outside is not None and outside < POOR:
        return [
            f"the policy succeeds in {inside or 0.0:.0%} of the starts in its own model and in "
            f"{outside:.0%} of a few trials in a simulated world, which has noise, lag and what "
            "the model leaves out: the noise of your sensors as --observation-noise, a model "
            "identified from more motion, or more --iterations may help; `palpate evaluate` tries "
            "more worlds"
        ]
    return []


def summary_of(figures: Sequence[Figure], warnings: Sequence[str]) -> list[str]:
    """What was trained and how far to trust it: two sentences."""
    known = {figure.name: figure for figure in figures}
    inside, outside = known.get("in_model.success"), known.get("in_world.success_rate")
    said, tried = [], "Nothing but that model was tried"
    if inside is not None:
        said.append(
            f"In its own model the policy succeeds in {value_in_words(inside)} of the starts"
        )
    if outside is not None:
        tried = f"In a few trials in a simulated world it succeeds in {value_in_words(outside)}"
    said.append(f"{tried}; it is not to be trusted yet" if warnings else tried)
    return [f"{sentence}." for sentence in said]


def constants(task: Task) -> dict[str, Any]:
    """What a task was made with, for a run's configuration."""
    return {field.name: getattr(task, field.name) for field in dataclasses.fields(task)}
