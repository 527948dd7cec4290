"""What `palpate identify` says of any result: units, names, parameters, lines to read."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from palpate.commands import folders
from palpate.commands.identification.data import Data
from palpate.identification.verdicts import uninformed
from palpate.models.model import Model
from palpate.report.evidence import parameter_of
from palpate.report.motion import PANELS
from palpate.report.parameter_words import elements, interval
from palpate.runs import Result


def units_of(unit: str, model: Model) -> tuple[str, ...]:
    """The unit of each entry of an observation's last axis, as its channel has it: "m, m, rad"."""
    several = tuple(unit.split(", "))
    count = model.observation_shape[-1] if model.observation_shape else 1
    return several if len(several) == count else (unit,) * count


def predicted_names(data: Data, model: Model) -> list[str]:
    """What the first numbers of an observation are called, with their units: "angle (rad)"."""
    count, units = math.prod(model.observation_shape), units_of(data.unit, model)
    names = [*data.observed]
    if len(names) != count:
        names = [f"{' '.join(names)} {index + 1}" for index in range(count)]
    return [f"{name} ({units[i % len(units)]})" for i, name in enumerate(names[:PANELS])]


def typical_and_worst(errors: np.ndarray, what: str) -> dict[str, int]:
    """Which of several errors is the median, and which the greatest; NaN is neither."""
    order, known = np.argsort(errors), np.isfinite(errors).sum()  # NaN comes last
    typical, worst = int(order[known // 2]), int(order[known - 1])
    both = {f"typical {what}": typical, f"worst {what}": worst}
    return both if known > 1 and typical != worst else {"": typical}


def split(data: Data) -> dict[str, Any]:
    """Which trials were fitted and which scored, for the result."""
    return {
        "fitted": [trial.name for trial in data.fitted.trials],
        "validation": [trial.name for trial in data.validation.trials]
        if data.validation
        else "none: all trials were fitted, and the errors are those on them",
    }


def or_none(value: float) -> float | None:
    """None for what JSON lacks: the error of a model that diverged, or of what nobody saw."""
    return value if math.isfinite(value) else None


def show(result: Result) -> None:
    """Print hypotheses, parameters, what the data cannot tell, and the errors."""
    settings = result.settings
    probability = settings.get("probability", {})
    compared = {**settings.get("by_itself", {}), "structure": probability}
    for what, of in compared.items():
        if len(of) > 1:
            shares = ", ".join(f"{name} {share:.2g}" for name, share in of.items())
            alone = "" if what == "structure" else " by itself"
            likely = max(of, key=of.__getitem__)
            print(f"{what}{alone}: {likely} (probability of each: {shares})")
    cells = [("parameter", "identified", "90 % interval", "")]
    cells += [_cells(row) for row in result.parameters if not row["fixed"]]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        print("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip())
    if fixed := [row["name"] for row in result.parameters if row["fixed"]]:
        print(f"not identified: {', '.join(fixed)} (as given)")
    for row in result.parameters:
        if row["verdict"] and not uninformed(row["verdict"]):
            print(f"warning: {row['name']}: {row['verdict']}")
    for warning in result.warnings:
        print(f"warning: {warning}")
    for sentence in settings.get(folders.SUMMARY, []):
        print(sentence)


def _cells(row: dict[str, Any]) -> tuple[str, str, str, str]:
    known = parameter_of(row)
    within = "not told by the data" if known.uninformed else interval(known)
    note = "one value for all elements" if row["shared"] and np.size(row["value"]) > 1 else ""
    return known.name, f"{elements(known)} {known.unit}".rstrip(), within, note


def describe_doubts(doubts: Sequence[str]) -> str:
    return f"It is not to be trusted: {doubts[0]}." if doubts else ""


def informed_parameters(rows: Sequence[dict[str, Any]]) -> str:
    """Of how many free parameters the data tell something, and of which they tell nothing."""
    free = [row for row in rows if not (row["fixed"] or row.get("derived"))]
    left = [row["name"].replace("_", " ") for row in free if uninformed(row["verdict"])]
    said = f"The data tell {len(free) - len(left)} of {len(free)} parameters"
    return f"{said}; they say nothing of {', '.join(left)}." if left else f"{said}."
