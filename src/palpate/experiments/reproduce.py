"""`palpate reproduce`: a headline experiment from nothing, held against its bars."""

import importlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from palpate.errors import PalpateError
from palpate.experiments import folders
from palpate.experiments.options import Reproduce
from palpate.experiments.page import runs_in
from palpate.report import build_report
from palpate.result import Result, read_result
from palpate.runs import RESULT
from palpate.storage import write_json

KEPT = Path(__file__).parents[3] / "results"  # of full runs, in a checkout


def run(options: Reproduce, name: str) -> Path:
    """Reproduce the experiment `name`, print a line for each figure, and return its folder.

    `reproduce(out, *, quick, seed, ...) -> Result` in the module of that name does the work.
    Raises `PalpateError` for an option that this experiment does not have.
    """
    module = importlib.import_module(f"palpate.experiments.{name.replace('-', '_')}")
    given = _given(name, module.reproduce, options)
    out = options.out or folders.RUNS / (f"{name}-quick" if options.quick else name)
    if options.fresh and out.is_dir():
        folders.start_over(out, f"reproduce {name}")
    result = module.reproduce(out, **given)
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
