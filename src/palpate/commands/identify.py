"""`palpate identify`: recordings in, a fitted model and how far to trust it out.

Nothing here knows what was recorded: `options.prepare` and `options.start` do.
"""

import dataclasses
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands import folders
from palpate.commands.identify_data import Data, read
from palpate.errors import PalpateError
from palpate.families.options import Identify
from palpate.family import check_name
from palpate.identification.data.prediction import PredictionError, prediction_error
from palpate.identification.gradient.descent import Settings, check_shapes, identify
from palpate.identification.gradient.least_squares import Intervals, intervals
from palpate.identification.gradient.residual import (
    Correction,
    ResidualSettings,
    check_correctable,
    fit_residual,
)
from palpate.models.files import save_model
from palpate.models.model import Model
from palpate.parameters import (
    FreeParameters,
    declare,
    describe,
    format_value,
    parameters_of,
)
from palpate.report import write_evidence
from palpate.report.charts import quantiles
from palpate.runs import Figure, Result, Run
from palpate.runs.result import read_result
from palpate.runs.run import RESULT

RESIDUAL = "residual"  # the folder of its run
CORRECTION = "correction"  # what the result's settings say of it
UNITS = {"m": (100.0, "cm")}  # a person reads these errors in another unit


@dataclasses.dataclass(frozen=True)
class Identified:
    """A fitted model, its intervals, and its errors beside those of the model it started from.

    Where a correction was asked for, `physics` is the error without it; where it was kept, `fit`
    and `validation` are with it.
    """

    model: Model
    intervals: Intervals
    fit: PredictionError
    validation: PredictionError
    start: PredictionError
    correction: Correction | None = None
    physics: PredictionError | None = None

    @property
    def delivered(self) -> Model:
        """What is handed over: the model, corrected where that was kept."""
        return self.model if self.correction is None else self.correction.model


def run(options: Identify) -> Path:
    """Identify, print what a person wants to know, and return the folder everything is in.

    Raises `PalpateError` for recordings, names and folders that cannot be used.
    """
    settings = _settings(options)
    data = read(options)
    start = with_declarations(
        options.start(data.fitted_aligned), options.free, options.fixed, options.shared
    )
    check_shapes(start, data.fitted_aligned)
    check_shapes(start, data.validation_aligned)
    if options.residual:  # now, and not after the physics was fitted
        check_correctable(start, data.fitted_aligned)
    name = f"identify-{options.family}"
    with folders.open_run(options, name, _configuration(options, settings), folders.MODEL) as run:
        if not run.finished:
            identified, earlier = fit(start, data, settings, run), 0.0
            if options.residual:
                identified, earlier = _with_correction(identified, data, options, run)
            _write(run, name, options, data, identified, run.elapsed + earlier)
        result = read_result(run.path / RESULT)
        _print(result)
        title = f"What was found out about the {options.family}"
        notes = list(result.warnings)
        if CORRECTION in result.settings:
            notes.append(_told_of(result.settings[CORRECTION]))
        folders.hand_over(options, run, title, folders.MODEL, notes)
        return run.path


def with_declarations(
    model: Model, free: tuple[str, ...], fixed: tuple[str, ...], shared: tuple[str, ...]
) -> Model:
    """The model with some parameters freed, fixed or shared by name.

    Raises `PalpateError` for a name the model does not have, or one that is both free and fixed.
    """
    declared = parameters_of(model)
    for name in (*free, *fixed, *shared):
        check_name("parameter", name, declared)
    if both := sorted(set(fixed) & {*free, *shared}):
        raise PalpateError(f"'{both[0]}' cannot be fixed and identified at the same time")
    changes: dict[str, dict[str, Any]] = {}
    for names, change in (
        (free, {"fixed": False}),
        (fixed, {"fixed": True}),
        (shared, {"shared": True}),
    ):
        for name in names:
            changes.setdefault(name, {}).update(change)
    return declare(model, **changes)


def fit(start: Model, data: Data, settings: Settings, run: Run | None = None) -> Identified:
    """Identify from `start`, and score the result on the trials held out."""
    model = identify(start, data.fitted_aligned, settings, run)
    coordinates = FreeParameters(model)
    fitted = prediction_error(model, data.fitted_aligned)
    held_out = data.validation is not None
    return Identified(
        model=model,
        intervals=intervals(coordinates, coordinates.initial, data.fitted_aligned),
        fit=fitted,
        validation=prediction_error(model, data.validation_aligned) if held_out else fitted,
        start=prediction_error(start, data.validation_aligned),
    )


def _with_correction(
    identified: Identified, data: Data, options: Identify, run: Run
) -> tuple[Identified, float]:
    """With a network on top of the physics where that helps; the recording to score on is not seen.

    And the seconds that earlier processes spent on it: it is a run of its own, below this one's.
    """
    settings = ResidualSettings(seed=options.seed)
    configuration = {**run.configuration, RESIDUAL: dataclasses.asdict(settings)}
    began = time.monotonic()
    with Run.open(run.path / RESIDUAL, configuration, fresh=options.fresh) as own:
        correction = fit_residual(identified.model, data.fitted_aligned, settings, own)
        earlier = max(0.0, own.elapsed - (time.monotonic() - began))
        if not own.finished:
            own.finish({"kept": correction.kept, "reason": correction.reason})
    found = dataclasses.replace(identified, correction=correction, physics=identified.validation)
    if not correction.kept:
        return found, earlier
    fitted = prediction_error(correction.model, data.fitted_aligned)
    held_out = data.validation is not None
    scored = prediction_error(correction.model, data.validation_aligned) if held_out else fitted
    return dataclasses.replace(found, fit=fitted, validation=scored), earlier


def evidence(identified: Identified, unit: str) -> dict[str, np.ndarray]:
    """The errors over the horizon, and for a chain of points the median validation trial.

    `unit`: of what is observed.
    """
    error = identified.validation
    arrays = {
        "horizon.time": error.horizon,
        "horizon.identified": error.rmse,
        "horizon.start model": identified.start.rmse,
    }
    if identified.physics is not None and identified.physics is not error:
        arrays["horizon.physics alone"] = identified.physics.rmse
    if is_chain(error, unit):
        low, high = quantiles(_root_mean_square(chain_error(error)), (0.1, 0.9))
        arrays |= {"horizon.identified.low": low, "horizon.identified.high": high}
        scored = np.isfinite(error.by_trial).sum()  # the others, NaN, are sorted last
        trial = int(np.argsort(error.by_trial)[scored // 2])
        seen = np.asarray(error.segments.seen[trial])
        arrays["motion.time"] = error.horizon
        arrays["motion.observed"] = np.where(seen, error.segments.target[trial], np.nan)
        arrays["motion.predicted"] = np.asarray(error.prediction[trial])
    return arrays


def is_chain(error: PredictionError, unit: str) -> bool:
    """Whether what is observed is points in space, the last of which is called the tip."""
    return unit == "m" and error.segments.target.ndim == 4 and error.segments.target.shape[-1] == 3


def chain_error(error: PredictionError) -> np.ndarray:
    """Distance (trials, times, points) of each point from where it was seen, NaN if it was not."""
    off = np.where(error.segments.seen, error.prediction - error.segments.target, np.nan)
    return np.linalg.norm(off, axis=-1)


def _root_mean_square(error: np.ndarray) -> np.ndarray:
    """Over the last axis; NaN is left out, and comes out where there is nothing else."""
    count = np.isfinite(error).sum(axis=-1)
    return np.sqrt(np.nansum(error**2, axis=-1) / np.where(count > 0, count, np.nan))


def rows(identified: Identified) -> list[dict[str, Any]]:
    """The parameters for `result.json`: what `describe` says, with intervals and verdicts."""
    found = identified.intervals
    return [
        row
        | {
            "lower": _listed(found.lower.get(row["name"])),
            "upper": _listed(found.upper.get(row["name"])),
            "verdict": found.verdict.get(row["name"]),
        }
        for row in describe(identified.model)
    ]


def _listed(value: Any) -> Any:
    return None if value is None else np.asarray(value).tolist()


def _settings(options: Identify) -> Settings:
    settings = Settings(method=options.method, seed=options.seed)
    if options.iterations:
        settings = dataclasses.replace(settings, iterations=options.iterations)
    return settings


def _configuration(options: Identify, settings: Settings) -> dict[str, Any]:
    return {
        **folders.configuration_of(options, f"identify {options.family}"),
        "recordings": [folders.fingerprint(path) for path in options.recordings],
        "validate": [folders.fingerprint(path) for path in options.validate],
        **dataclasses.asdict(settings),
    }


def _write(
    run: Run, name: str, options: Identify, data: Data, identified: Identified, wall_time: float
) -> None:
    """The model, evidence and result into the run's folder; the result last."""
    figures = _figures(identified, data, wall_time)
    parameters = rows(identified)
    save_model(
        run.path / folders.MODEL,
        identified.delivered,
        {
            "recordings": dict(data.fitted.provenance),
            "figures": {figure.name: figure.value for figure in figures},
            "parameters": [
                {key: row[key] for key in ("name", "lower", "upper", "verdict")}
                for row in parameters
            ],
        },
    )
    write_evidence(run.path, evidence(identified, data.unit))
    scored, error = data.validation_aligned, identified.validation
    result = Result(
        name=name,
        figures=figures,
        settings=run.configuration
        | {
            "observation_unit": data.unit,
            "scored_trials": len(scored.length),
            "scored_duration_s": float(np.median(scored.length) - 1) * scored.period,
            "end_s": float(error.horizon[error.last_seen]),
        }
        | _correction_settings(identified.correction, data),
        seeds=[options.seed],
        split={
            "fitted": [trial.name for trial in data.fitted.trials],
            "validation": [trial.name for trial in data.validation.trials]
            if data.validation
            else "none: the only trial was fitted, and the errors are those on it",
        },
        wall_time_s=wall_time,
        parameters=parameters,
        warnings=list(identified.intervals.warnings),
    )
    run.finish(result.to_dict())


def _correction_settings(correction: Correction | None, data: Data) -> dict[str, Any]:
    """What became of the correction, where one was asked for."""
    if correction is None:
        return {}
    scale, _ = UNITS.get(data.unit, (1.0, data.unit))
    told = {
        "kept": correction.kept,
        "reason": correction.reason,
        "size": correction.size,
        "held_out": [data.fitted.trials[index].name for index in correction.held_out],
        "held_out_l1": [
            scale * error.mean_absolute for error in (correction.physics, correction.corrected)
        ],
    }
    return {CORRECTION: told}


def _told_of(correction: dict[str, Any]) -> str:
    """The sentence for a person."""
    size = f"; it is {correction['size']:.1%} of what the physics changes in a control period"
    return f"correction by a network {correction['reason']}{size if correction['kept'] else ''}"


def _figures(identified: Identified, data: Data, wall_time: float) -> list[Figure]:
    scale, unit = UNITS.get(data.unit, (1.0, data.unit))
    found, start = identified.validation, identified.start

    def end(error: PredictionError) -> float:
        return float(error.rmse[error.last_seen])

    def figure(name: str, error: float, start: float | None = None) -> Figure:
        rival = None if start is None else f"start model {start * scale:.3g} {unit}"
        return Figure(f"{name}_{unit}", _known(error * scale), unit, rival=rival)

    figures = [
        figure("l1", found.mean_absolute, start.mean_absolute),
        figure("rmse_at_end", end(found), end(start)),
        figure("l1_fitted_trials", identified.fit.mean_absolute),
        Figure("wall_time_s", wall_time, "s"),
    ]
    if identified.physics is not None and identified.correction is not None:
        alone = identified.physics.mean_absolute
        ratio = _known(found.mean_absolute / alone)
        figures.append(figure("l1_physics", alone))
        figures.append(Figure("l1_ratio_to_physics", ratio, ""))
        figures.append(Figure("correction_size", _known(identified.correction.size), ""))
    if is_chain(found, data.unit):
        (tip,) = _root_mean_square(chain_error(found)[..., -1].reshape(1, -1))
        figures.append(Figure("tip_rmse_m", _known(float(tip)), "m"))
    return figures


def _known(value: float) -> float | None:
    """None for what JSON lacks: the error of a model that diverged, or of what nobody saw."""
    return value if math.isfinite(value) else None


def _print(result: Result) -> None:
    """Parameters, what the data cannot tell, and the error."""
    free = [row for row in result.parameters if not row["fixed"]]
    cells = [("parameter", "identified", "90 % interval", "")]
    for row in free:
        note = "one value for all elements" if row["shared"] and np.size(row["value"]) > 1 else ""
        cells.append((row["name"], format_value(row["value"], row["unit"]), _interval(row), note))
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        print("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip())
    if fixed := [row["name"] for row in result.parameters if row["fixed"]]:
        print(f"not identified: {', '.join(fixed)} (as given)")
    for row in free:
        if row["verdict"]:
            print(f"warning: {row['name']}: {row['verdict']}")
    for warning in result.warnings:
        print(f"warning: {warning}")
    error, settings = result.figures[0], result.settings
    fitted = isinstance(result.split, dict) and isinstance(result.split["validation"], str)
    on = "the fitted trial" if fitted else "validation"
    count = settings["scored_trials"]
    value = "unknown" if error.value is None else f"{error.value:.3f} {error.unit}"
    print(
        f"mean absolute error (L1) {value} over "
        f"{count} {'trial' if count == 1 else 'trials'} of "
        f"{round(settings['scored_duration_s'], 1):g} s ({on})"
    )
    if CORRECTION in settings:
        print(_told_of(settings[CORRECTION]))


def _interval(row: dict[str, Any]) -> str:
    """The interval of one value; of several, what is typical relative to their values."""
    if str(row["verdict"]).startswith("not told by the data:"):
        return "not told by the data"
    value, low, high = (np.ravel(row[key]) for key in ("value", "lower", "upper"))
    if low.size == 1 or (row["shared"] and np.ptp(low) <= 1e-6 * abs(low[0])):
        return f"{low[0]:.3g} to {high[0]:.3g}"
    below, above = (np.median((edge - value) / np.abs(value)) for edge in (low, high))
    return f"typically {below:+.0%} to {above:+.0%}"
