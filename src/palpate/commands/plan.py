"""`palpate plan`: a problem in; a plan and what shows it out.

Nothing here knows what is planned: `options.read` does.
"""

from pathlib import Path

from palpate.commands import folders
from palpate.families.options import Plan


def run(options: Plan) -> Path:
    """Plan, say what is to be done, and return the path of the plan.

    Raises `PalpateError` for a problem that cannot be read, and when no plan was found: the
    sentence says why.
    """
    problem = options.read()
    name = f"plan-{options.problem}"
    configuration = folders.configuration_of(options, f"plan {options.problem}") | problem.inputs
    with folders.open_run(options, name, configuration, folders.PLAN) as run:
        if not run.finished:
            folders.finish(run, options, name, problem.solve(run))
        print("\n".join(problem.describe(run.path / folders.PLAN)))
        folders.hand_over(options, run, problem.title, folders.PLAN)
        for picture in sorted(run.path.glob("*.png")):
            print(f"picture: {picture}")
        return folders.deliver(options, run, folders.PLAN)
