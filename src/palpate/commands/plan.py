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
    words = f"plan {options.problem}"
    with folders.begin(options, words, product=folders.PLAN, **problem.inputs) as run:
        if not run.finished:
            figures = problem.solve(run)
            *_, whole = problem.describe(run.path / folders.PLAN)
            folders.finish(run, figures, {folders.SUMMARY: [f"{whole}."]})
        print("\n".join(problem.describe(run.path / folders.PLAN)))
        path = folders.hand_over(options, run, problem.title, folders.PLAN)
        for picture in sorted(run.path.glob("*.png")):
            print(f"picture: {picture}")
        return path
