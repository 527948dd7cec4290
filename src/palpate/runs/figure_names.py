"""What figures are called when a person reads them; `result.json` keeps their own names."""

from collections.abc import Iterable

from palpate.runs.result import Figure

# Of each part of a name ("in_model.success"), without the unit that it ends in ("time_to_1pct_s")
# unless only that tells two apart.
NAMES = {
    "l1": "mean error",
    "l1_fitted_trials": "mean error on the trials it was fitted to",
    "l1_physics": "mean error without the correction",
    "l1_ratio_to_physics": "mean error as a share of that without the correction",
    "correction_size": "size of the correction as a share of the physics",
    "rmse": "error (root mean square)",
    "rmse_at_end": "error at the end (root mean square)",
    "tip_rmse": "error of the tip (root mean square)",
    "tip_rmse_per_length": "error of the tip per length",
    "coverage_90": "coverage of the 90 % intervals",
    "coverage_90_over": "coverage of the 90 % intervals, at most",
    "log_score": "log score",
    "rhat_max_predictions": "disagreement of the chains (R-hat; 1 is none)",
    "ess_min": "effective draws, at least",
    "wall_time": "time it took",
    "success_rate": "success",
    "reached_rate": "goal reached",
    "time_to_1pct": "time to 1 % energy",
    "settling_time": "time until at rest",
    "settling": "time until at rest",
    "planning": "time to plan",
    "carried": "distance while carrying",
    "lost_share": "frames in which it was lost",
    "late_over_1ms": "deadlines missed by more than 1 ms",
    "decision_p99": "slowest decisions (99th percentile)",
    "turnaround_p99": "slowest answers to a state (99th percentile)",
    "brakes": "times it braked",
    "onnx_difference": "difference from the policy",
    "recall": "parts found (recall)",
    "precision": "of what was found, parts that are there (precision)",
    "type_accuracy": "joint type right",
    "axis_deg": "direction of the axis",
    "axis_cm": "place of hinges",
    "miou": "points of a part (IoU)",
    "tree_accuracy": "tree right",
    "axis_coverage_90": "coverage of the axis by 90 % intervals",
}
PLACES = {"in_model": "in the model", "in_world": "in a simulated world"}
_SHARES = (
    "success",
    "coverage_90",
    "coverage_90_over",
    "_rate",
    "_share",
)  # how the name of a percentage ends


def name_in_words(figure: Figure) -> str:
    """Its name as a person would say it: "time to 1 % energy, held still"."""
    parts = [
        part if part in NAMES else part.removesuffix(f"_{figure.unit}")
        for part in figure.name.split(".")
    ]
    known = next((part for part in parts if part in NAMES), None)
    if known is None:
        known = next(part for part in (*parts, parts[0]) if part not in PLACES)
    others = [PLACES.get(part, part) for part in parts if part != known]
    return ", ".join([NAMES.get(known, known), *others]).replace("_", " ")


def value_in_words(figure: Figure) -> str:
    """Its value with the unit: "1.21 s", "98 %"; "never" of a time that did not come."""
    if figure.value is None:
        return "never" if name_in_words(figure).startswith("time") else "unknown"
    return f"{number_in_words(figure, figure.value)} {figure.unit}".rstrip()


def lines_of(figures: Iterable[Figure]) -> list[str]:
    """For a person: what never came is said once, not in each unit."""
    lines = (f"{name_in_words(figure)}: {value_in_words(figure)}" for figure in figures)
    return list(dict.fromkeys(lines))


def number_in_words(figure: Figure, number: int | float | str | None) -> str:
    """One of this figure's numbers, such as its bar: four digits, or percent to three.

    What is said in words stays as it is; "–" where there is nothing.
    """
    if not isinstance(number, int | float):
        return number or "–"
    share = not figure.unit and any(part.endswith(_SHARES) for part in figure.name.split("."))
    return f"{100 * number:.3g} %" if share else f"{number:.4g}"
