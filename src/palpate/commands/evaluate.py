"""`palpate evaluate`: a trained controller in a world that its model could not see into."""

import math
from pathlib import Path

import jax

from palpate.commands import folders
from palpate.commands.in_world.evaluate import evaluate_in_world
from palpate.commands.train import find_task
from palpate.errors import PalpateError
from palpate.families.options import Evaluate, Found
from palpate.families.world_options import EvaluateInWorld
from palpate.models.files import load_model
from palpate.models.model import Model
from palpate.networks import CommandPolicy, load_policy
from palpate.runs.figure_names import lines_of, name_in_words, value_in_words
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.runs.storage import write_text
from palpate.tasks.task import Task
from palpate.trials.in_model import evaluate_in_model


def run(options: Evaluate | EvaluateInWorld) -> Path:
    """Evaluate and return the folder everything is in; see the two ways of it."""
    if isinstance(options, EvaluateInWorld):
        return evaluate_in_world(options)
    return evaluate_trials_of(options)


def evaluate_trials_of(options: Evaluate) -> Path:
    """Evaluate, print a table of all controllers, and return the folder everything is in.

    Raises `PalpateError` for a file that is no policy, or one for another task or model.
    """
    file = folders.product_of(options.policy, folders.POLICY, "train")
    policy, manifest = load_policy(file)
    if manifest.get("task") != options.task:
        raise PalpateError(
            f"{file} was trained for '{manifest.get('task')}', not for {options.task}"
        )
    task = find_task(options.task)
    model, inputs = None, {"policy": file, **options.inputs()}
    if options.model is not None:
        described = folders.product_of(options.model, folders.MODEL, "identify")
        model = options.prepare(load_model(described)[0])
        check_model(policy, model, task, str(described))
        inputs["model"] = described
    base, about = options.base(policy, manifest, model)
    options.check(policy, base)
    with folders.begin(options, f"evaluate {options.task}", inputs) as run:
        if not run.finished:
            found = options.evaluate(policy, manifest, run, base)
            figures, lines = [*found.figures], [about, *found.lines]
            if model is not None:
                inside, _ = evaluate_in_model(task, model, policy, options.seed)
                figures += inside
                lines += lines_of(inside)
            write_text(run.path / folders.TABLE, "\n".join(filter(None, lines)) + "\n")
            settings = found.settings | {folders.SUMMARY: summary_of(found, about)}
            folders.finish(run, figures, settings, found.split, warnings=[*found.notes])
        print((run.path / folders.TABLE).read_text(encoding="utf-8"), end="")
        for note in read_result(run.path / RESULT).warnings:
            print(f"note: {note}")
        title = f"What a controller does: {options.task}"
        return folders.hand_over(options, run, title)


def summary_of(found: Found, about: str) -> list[str]:
    """How the policy did beside the others, by what is counted first, and where: two sentences."""
    first, *others = found.figures
    beside = [of for of in others if of.name.startswith(f"{first.name}.")]
    against = [f"{name_in_words(of).split(', ')[-1]} {value_in_words(of)}" for of in beside]
    said = f"{name_in_words(first)}: {value_in_words(first)} over {found.settings['trials']} trials"
    said += f" ({', '.join(against)})" if against else ""
    where = about or "; ".join(f"{what}: {of}" for what, of in found.split.items())
    return [f"{sentence[0].upper()}{sentence[1:]}." for sentence in (said, where) if sentence]


def check_model(policy: CommandPolicy, model: Model, task: Task, described: str) -> None:
    """Raise `PalpateError` unless the policy can control the model, which is `described` so."""

    def features() -> jax.Array:
        start = task.starts(model, jax.random.key(0), 2)
        return task.features(start.state, start.goal)

    seen = jax.eval_shape(features).shape[-1]
    same_rate = math.isclose(policy.period, model.control_period, rel_tol=1e-4)
    wanted = policy.mean.shape[0], policy.action_shape
    if not same_rate or wanted != (seen, model.action_shape):
        raise PalpateError(
            f"the policy wants {wanted[0]} features and gives an action of shape {wanted[1]} every "
            f"{policy.period:.4g} s, the model in {described} has {seen} and {model.action_shape} "
            f"every {model.control_period:.4g} s: expected the model that the policy was trained "
            "through, or one of its size and rate"
        )
