"""`palpate report`: runs on disk in, one page out."""

from pathlib import Path

from palpate.commands import folders
from palpate.commands.options import Report
from palpate.errors import PalpateError
from palpate.report import build_report
from palpate.runs.run import CONFIGURATION, ENVIRONMENT, RESULT
from palpate.runs.storage import read_json


def run(options: Report) -> Path:
    """Write the page, say where it is, and return its path.

    Raises `PalpateError` for a folder that is not there or holds no run.
    """
    if not options.runs:
        raise PalpateError("no run is named: expected at least one folder, such as runs/demo")
    runs = [found for folder in options.runs for found in runs_in(folder)]
    page = options.out or options.runs[0] / folders.REPORT
    if not page.suffix:
        page = page / folders.REPORT
    title = options.title or " and ".join(folder.resolve().name for folder in options.runs)
    print(f"report: {build_report(runs, page, title)}")
    return page


def runs_in(folder: Path) -> list[Path]:
    """The run in `folder`, and those below it from the earliest to the latest.

    Without any it is the folder itself, for the report to say what it expects there.
    """
    below = [path.parent for path in folder.rglob(CONFIGURATION) if path.parent != folder]
    below.sort(key=lambda path: (read_json(path / ENVIRONMENT).get("date", ""), str(path)))
    own = (folder / RESULT).exists() or (folder / CONFIGURATION).exists() or not below
    return [folder, *below] if own else below
