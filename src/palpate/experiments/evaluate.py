"""`palpate evaluate`: a trained controller in a world that its model could not see into."""

from pathlib import Path

from palpate.errors import PalpateError
from palpate.experiments import folders
from palpate.experiments.options import Evaluate
from palpate.experiments.train import figures_in_model, named_task
from palpate.models.files import load_model
from palpate.networks import load_policy
from palpate.result import Result, read_result
from palpate.runs import RESULT
from palpate.storage import write_text

TABLE = "table.txt"


def run(options: Evaluate) -> Path:
    """Evaluate, print a table of all controllers, and return the folder everything is in.

    Raises `PalpateError` for a file that is no policy, or one for another task or model.
    """
    file = folders.product_of(options.policy, folders.POLICY, "train")
    policy, manifest = load_policy(file)
    if manifest.get("task") != options.task:
        raise PalpateError(
            f"{file} was trained for '{manifest.get('task')}', not for {options.task}"
        )
    configuration = folders.told(options, f"evaluate {options.task}")
    configuration["policy"] = folders.fingerprint(file)
    model = None
    if options.model is not None:
        described = folders.product_of(options.model, folders.MODEL, "identify")
        model = options.prepare(load_model(described)[0])
        configuration["model"] = folders.fingerprint(described)
    name = f"evaluate-{options.task}"
    with folders.open_run(options, name, configuration, None) as run:
        if not run.finished:
            found = options.evaluate(policy, run)
            figures = [*found.figures]
            if model is not None:
                figures += figures_in_model(named_task(options.task), model, policy, options.seed)
            result = Result(
                name=name,
                figures=figures,
                settings=configuration | found.settings | {"notes": found.notes},
                seeds=[options.seed],
                split=found.split,
                wall_time_s=run.elapsed,
            )
            write_text(run.path / TABLE, "\n".join(found.table) + "\n")
            run.finish(result.to_dict())
        print((run.path / TABLE).read_text(encoding="utf-8"), end="")
        notes = read_result(run.path / RESULT).settings["notes"]
        for note in notes:
            print(f"note: {note}")
        folders.hand_over(options, run, f"What a controller does: {options.task}", notes=notes)
        return run.path
