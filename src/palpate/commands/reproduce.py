"""`palpate reproduce`: a headline experiment from nothing, held against its bars."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from palpate.commands import folders
from palpate.commands.options import Reproduce
from palpate.commands.report import runs_in
from palpate.errors import PalpateError
from palpate.family import find
from palpate.report import build_report
from palpate.runs import Result
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.runs.storage import write_json

KEPT = Path(__file__).parents[3] / "results"  # of full runs, in a checkout


def run(options: Reproduce, name: str) -> Path:
    """Reproduce the experiment `name`, print a line for each figure, and return its folder.

    `reproduce(out, *, quick, seed, ...) -> Result`, which its family names, does the work.
    Raises `PalpateError` for an option that this experiment does not have.
    """
    reproduce = find("experiments", name)
    given = _given(name, reproduce, options)
    out = options.out or folders.RUNS / (f"{name}-quick" if options.quick else name)
    if options.fresh and out.is_dir():
        folders.start_over(out, f"reproduce {name}")
    result = reproduce(out, **given)
    write_json(out / RESULT, result.to_dict())
    print("\n".join(result.lines()))
    kept = KEPT / f"{name}.json"
    if options.quick and kept.exists():
        print("\n".join(beside(result, read_result(kept))))
    page = build_report(runs_in(out), out / folders.REPORT, name)
    print(f"result: {out / RESULT}")
    print(f"report: {page}")
    return out


def beside(result: Result, kept: Result) -> list[str]:
    """Whether each figure that has a spread in the kept full run lies within it, a line each."""
    known = {figure.name: figure for figure in kept.figures}
    lines = []
    for figure in result.figures:
        full = known.get(figure.name)
        if full is None or full.value is None or full.spread is None or figure.value is None:
            continue
        within = abs(figure.value - full.value) <= full.spread
        lines.append(
            f"{figure.name}: {figure.value:.4g} is {'within' if within else 'outside'} the full "
            f"run's {full.value:.4g} +- {full.spread:.2g}"
        )
    return lines


def _given(name: str, function: Callable[..., Result], options: Reproduce) -> dict[str, Any]:
    given = {"quick": options.quick, "seed": options.seed}
    for option in ("weights", "mocap", "maps"):
        value = getattr(options, option)
        if value is not None:
            if option not in inspect.signature(function).parameters:
                raise PalpateError(f"{name} has no --{option}: leave it out")
            given[option] = value
    return given
