"""`palpate reproduce`: a headline experiment from nothing, held against its bars."""

import inspect
import math
import re
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

KEPT = Path(__file__).parents[3] / "results" / "quick"  # of quick runs, in a checkout
SAME = 1e-3  # relative: other processors add up in another order
# What a clock measured, by how experiments name it; another run, another figure.
CLOCK = re.compile(
    r"(wall_time|planning|sampling|training)_s($|_)|(decision|cpu)_ms|_per_s_|(^|\.)seconds($|[._])|^speedup|^exponent$"
)


def run(options: Reproduce, name: str) -> Path:
    """Reproduce the experiment `name`, print a line for each figure, and return its folder.

    `reproduce(out, *, quick, seed, ...) -> Result`, which its family names, does the work. A quick
    run is held against the kept quick run, where this is a checkout that has one.
    Raises `PalpateError` for an option that this experiment does not have.
    """
    reproduce = find("experiments", name)
    given = _arguments_of(name, reproduce, options)
    out = options.out or folders.RUNS / (f"{name}-quick" if options.quick else name)
    if options.fresh and out.is_dir():
        folders.start_over(out, f"reproduce {name}")
    result = reproduce(out, **given)
    write_json(out / RESULT, result.to_dict())
    print("\n".join(result.lines()))
    kept = KEPT / f"{name}.json"
    if options.quick and kept.exists():
        print("\n".join(compare(result, read_result(kept))))
    page = build_report(runs_in(out), out / folders.REPORT, name)
    print(f"result: {out / RESULT}")
    print(f"report: {page}")
    return out


def compare(result: Result, kept: Result) -> list[str]:
    """Whether each figure is as in the kept run of the same size and seeds, a line each.

    Figures that a clock measured are left out, and one that only one of them has is named.
    """
    if result.seeds[:1] != kept.seeds[:1]:  # the first is the one that was asked for
        return [f"the kept quick run has the seed {kept.seeds[0]}: there is nothing to compare"]
    before = {figure.name: figure.value for figure in kept.figures}
    now = {figure.name: figure.value for figure in result.figures}
    lines = []
    for name in [*now, *(name for name in before if name not in now)]:
        if CLOCK.search(name):
            continue
        if name not in now or name not in before:
            lines.append(f"{name}: only in {'this' if name in now else 'the kept'} run")
        else:
            lines.append(f"{name}: {_difference(now[name], before[name])}")
    same = sum(line.endswith("as kept") for line in lines)
    return [*lines, f"{same} of {len(lines)} figures as kept; times are not compared"]


def _difference(value: float | None, kept: float | None) -> str:
    if value == kept:
        return "as kept"
    if value is None or kept is None:
        shown = ("none" if number is None else f"{number:.4g}" for number in (value, kept))
        return ", kept ".join(shown)
    if math.isclose(value, kept, rel_tol=SAME):
        return "as kept"
    change = "" if kept == 0 else f" ({100 * (value - kept) / abs(kept):+.2g} %)"
    return f"{value:.4g}, kept {kept:.4g}{change}"


def _arguments_of(name: str, function: Callable[..., Result], options: Reproduce) -> dict[str, Any]:
    given = {"quick": options.quick, "seed": options.seed}
    for option in ("weights", "mocap", "maps"):
        value = getattr(options, option)
        if value is not None:
            if option not in inspect.signature(function).parameters:
                raise PalpateError(f"{name} has no --{option}: leave it out")
            given[option] = value
    return given
