"""What `palpate identify` says of what it found: figures, parameters, evidence, lines to read."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from palpate.commands import folders
from palpate.commands.identify_data import Data
from palpate.identification.data.prediction import PredictionError, or_nan, prediction_error
from palpate.identification.data.segments import Segments, difference
from palpate.identification.gradient.residual import Correction
from palpate.identification.identify import Identified
from palpate.identification.posterior.comparison import PIECE
from palpate.identification.posterior.posterior import MIXED, Posterior, spread_out
from palpate.identification.posterior.predictive import Predicted, Score
from palpate.identification.verdicts import uninformed, verdict
from palpate.models.model import Model
from palpate.parameters import describe, format_value
from palpate.report.charts import quantiles
from palpate.runs import Figure, Result
from palpate.runs.figure_names import value_in_words

LEVEL = 0.9
PANELS, FAN = 6, 40  # numbers of an observation, and draws, that the page shows
_START = "start model "
CORRECTION = "correction"  # what the result's settings say of it
UNITS = {"m": (100.0, "cm")}  # a person reads these errors of a fit in another unit


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


def _compared(
    model: Model, target: np.ndarray, seen: np.ndarray, predictions: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Evidence of one motion: what was observed (times, ...), and predictions (lines, times, ...).

    Angles run on beyond a full turn, so that no line jumps.
    """
    rows = np.where(seen, np.arange(len(seen)).reshape(-1, *(1,) * (seen.ndim - 1)), -1)
    last = np.maximum.accumulate(rows)
    filled = np.take_along_axis(target, np.where(last < 0, seen.argmax(axis=0), last), axis=0)
    turned = np.cumsum(difference(model, filled[1:], filled[:-1]), axis=0)
    path = filled[0] + np.concatenate([np.zeros_like(turned[:1]), turned])
    lines = {"observed": np.where(seen, path, np.nan)[None]} | {
        label: path + difference(model, lines, np.broadcast_to(filled, lines.shape))
        for label, lines in predictions.items()
    }
    return {"prediction.time": model.control_period * np.arange(1, len(seen) + 1)} | {
        f"prediction.{label}": np.moveaxis(of.reshape(*of.shape[:2], -1)[..., :PANELS], 0, -1)
        for label, of in lines.items()
    }


def drawn_motion(predicted: Predicted, pieces: Segments, model: Model) -> dict[str, np.ndarray]:
    """Evidence of the piece whose error is the median: a fan of draws beside what was observed."""
    seen, target = np.asarray(pieces.seen), np.asarray(pieces.target)
    off = difference(model, predicted.motion.mean(axis=0), target)
    axes = tuple(range(1, seen.ndim))
    square = np.where(seen, off**2, 0.0).sum(axis=axes) / or_nan(seen.sum(axis=axes))
    order = np.argsort(square)  # NaN, of what nobody saw, comes last
    piece = int(order[np.isfinite(square).sum() // 2])
    draws = predicted.motion[spread_out(len(predicted.motion), FAN), piece]
    return _compared(model, target[piece], seen[piece], {"draws": draws})


def split(data: Data) -> dict[str, Any]:
    """Which trials were fitted and which scored, for the result."""
    return {
        "fitted": [trial.name for trial in data.fitted.trials],
        "validation": [trial.name for trial in data.validation.trials]
        if data.validation
        else "none: all trials were fitted, and the errors are those on them",
    }


# --- a fit --------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class FitReport:
    """A fitted model and its errors beside those of the model it started from.

    Where a correction was kept, `fitted` and `scored` are with it; `physics` is without any.
    """

    delivered: Model
    fitted: PredictionError
    scored: PredictionError
    start: PredictionError
    physics: PredictionError
    data: Data
    correction: Correction | None

    @classmethod
    def of(
        cls, start: Model, physics: Model, data: Data, correction: Correction | None
    ) -> "FitReport":
        """Score what was found on the trials held out, or on the fitted ones if none were."""
        model = correction.model if correction is not None and correction.kept else physics
        scored, before = (prediction_error(of, data.validation_aligned) for of in (model, start))
        held_out = data.validation is not None
        fitted = prediction_error(model, data.fitted_aligned) if held_out else scored
        alone = scored if model is physics else prediction_error(physics, data.validation_aligned)
        return cls(model, fitted, scored, before, alone, data, correction)

    def figures(self, wall_time: float) -> list[Figure]:
        """Errors of each unit that is observed, and the seconds it took."""
        figures = []
        for unit, entries in self._units().items():
            scale, shown = UNITS.get(unit, (1.0, unit))
            errors = [
                _errors(self.delivered, error, entries)
                for error in (self.scored, self.start, self.fitted)
            ]
            (l1, end), (start_l1, start_end), (fitted_l1, _) = [
                (scale * mean, scale * last) for mean, last in errors
            ]
            figures += [
                Figure(f"l1_{shown}", _known(l1), shown, rival=_rival(start_l1, shown)),
                Figure(f"rmse_at_end_{shown}", _known(end), shown, rival=_rival(start_end, shown)),
                Figure(f"l1_fitted_trials_{shown}", _known(fitted_l1), shown),
            ]
        figures.append(Figure("wall_time_s", wall_time, "s"))
        if self.correction is not None:
            scale, shown = UNITS.get(self.data.unit, (1.0, self.data.unit))
            alone = self.physics.mean_absolute
            ratio = _known(self.scored.mean_absolute / alone)
            size = _known(self.correction.size)
            figures += [
                Figure(f"l1_physics_{shown}", _known(alone * scale), shown),
                Figure("l1_ratio_to_physics", ratio, ""),
                Figure("correction_size", size, ""),
            ]
        if self._is_chain():
            (tip,) = _root_mean_square(_distances(self.scored)[..., -1].reshape(1, -1))
            figures.append(Figure("tip_rmse_m", _known(float(tip)), "m"))
        return figures

    def settings(self) -> dict[str, Any]:
        """What was scored, and what became of a correction, for the result."""
        scored = self.data.validation_aligned
        known = {
            "observation_unit": units_of(self.data.unit, self.delivered)[0],
            "scored_trials": len(scored.length),
            "scored_duration_s": float(np.median(scored.length) - 1) * scored.period,
            "end_s": float(self.scored.horizon[self.scored.last_seen]),
            "predicted": predicted_names(self.data, self.delivered),
        }
        if self.correction is None:
            return known
        correction, trials = self.correction, self.data.fitted.trials
        scale, _ = UNITS.get(self.data.unit, (1.0, self.data.unit))
        compared = correction.physics, correction.corrected
        about = {
            "kept": correction.kept,
            "reason": correction.reason,
            "size": correction.size,
            "held_out": [trials[index].name for index in correction.held_out],
            "held_out_l1": [scale * error.mean_absolute for error in compared],
        }
        return known | {CORRECTION: about}

    def evidence(self) -> dict[str, np.ndarray]:
        """The errors over the horizon, and for a chain of points the median validation trial."""
        error = self.scored
        arrays = {
            "horizon.time": error.horizon,
            "horizon.identified": error.rmse,
            "horizon.start model": self.start.rmse,
        }
        if self.correction is not None and self.correction.kept:
            arrays["horizon.physics alone"] = self.physics.rmse
        if self._is_chain():
            low, high = quantiles(_root_mean_square(_distances(error)), (0.1, 0.9))
            arrays |= {"horizon.identified.low": low, "horizon.identified.high": high}
            trial = self._median_trial()
            seen = np.asarray(error.segments.seen[trial])
            arrays["motion.time"] = error.horizon
            arrays["motion.observed"] = np.where(seen, error.segments.target[trial], np.nan)
            arrays["motion.predicted"] = np.asarray(error.prediction[trial])
        else:
            trial = self._median_trial()
            predicted = {"identified": error.prediction, "start model": self.start.prediction}
            arrays |= _compared(
                self.delivered,
                np.asarray(error.segments.target[trial]),
                np.asarray(error.segments.seen[trial]),
                {label: np.asarray(of[trial])[None] for label, of in predicted.items()},
            )
        return arrays

    def _median_trial(self) -> int:
        scored = np.isfinite(self.scored.by_trial).sum()  # the others, NaN, are sorted last
        return int(np.argsort(self.scored.by_trial)[scored // 2])

    def _units(self) -> dict[str, np.ndarray]:
        """Which entries of the last axis of an observation are in each unit."""
        units = units_of(self.data.unit, self.delivered)
        return {unit: np.array([u == unit for u in units]) for unit in dict.fromkeys(units)}

    def _is_chain(self) -> bool:
        """Whether what is observed is points in space, the last of which is called the tip."""
        shape = self.scored.segments.target.shape
        return self.data.unit == "m" and len(shape) == 4 and shape[-1] == 3


def _errors(model: Model, error: PredictionError, entries: np.ndarray) -> tuple[float, float]:
    """Mean absolute error of some entries of the last axis, and root mean square at the end."""
    if entries.all():
        return error.mean_absolute, float(error.rmse[error.last_seen])
    seen = np.asarray(error.segments.seen)[..., entries]
    off = difference(model, error.prediction, np.asarray(error.segments.target))[..., entries]
    off = np.where(seen, off, 0.0)
    last = seen[:, error.last_seen]
    square = np.square(off[:, error.last_seen]).sum()
    return float(np.abs(off).sum() / or_nan(seen.sum())), float(
        np.sqrt(square / or_nan(last.sum() / entries.sum()))
    )


def _distances(error: PredictionError) -> np.ndarray:
    """Distance (trials, times, points) of each point from where it was seen, NaN if it was not."""
    off = np.where(error.segments.seen, error.prediction - error.segments.target, np.nan)
    return np.linalg.norm(off, axis=-1)


def _root_mean_square(error: np.ndarray) -> np.ndarray:
    """Over the last axis; NaN is left out, and comes out where there is nothing else."""
    count = np.isfinite(error).sum(axis=-1)
    return np.sqrt(np.nansum(error**2, axis=-1) / or_nan(count))


def fitted_rows(found: Identified) -> list[dict[str, Any]]:
    """The parameters for `result.json`: what `describe` says, with intervals and verdicts."""
    return [
        row
        | {
            "lower": _listed(found.lower.get(row["name"])),
            "upper": _listed(found.upper.get(row["name"])),
            "verdict": found.verdict.get(row["name"]),
        }
        for row in describe(found.model)
        if np.size(row["value"])  # a model without wheels, links or contacts has none of theirs
    ]


def _listed(value: Any) -> Any:
    return None if value is None else np.asarray(value).tolist()


def describe_correction(correction: Mapping[str, Any]) -> str:
    """The sentence for a person."""
    size = f"; it is {correction['size']:.1%} of what the physics changes in a control period"
    return f"Correction by a network {correction['reason']}{size if correction['kept'] else ''}"


# --- draws --------------------------------------------------------------------------------------


def drawn_rows(posterior: Posterior) -> list[dict[str, Any]]:
    """The parameters for `result.json`: medians, 90 % intervals and what the data left open."""
    declared = posterior.target.coordinates.declarations
    return [
        {
            "name": path,
            "elements": [row.name for row in rows],
            "value": [row.median for row in rows],
            "unit": declared[path].unit,
            "about": declared[path].about,
            "fixed": False,
            "shared": declared[path].shared,
            "lower": [row.lower for row in rows],
            "upper": [row.upper for row in rows],
            "verdict": verdict(np.array([row.undecided for row in rows])),
        }
        for path, rows in posterior.rows_of.items()
    ]


def drawn_figures(
    posterior: Posterior, score: Score, model: Model, wall_time: float, unit: str
) -> list[Figure]:
    """Errors of each unit that is observed, coverage, and how far the chains may be trusted."""
    units = units_of(unit, model)
    errors = {of: score.pooled(np.array(units) == of) for of in dict.fromkeys(units)}
    return [
        *(Figure(f"rmse_{of}", _known(error), of) for of, error in errors.items()),
        Figure("coverage_90", score.coverage[LEVEL], ""),
        Figure("log_score", score.log_score, "", better="higher"),
        Figure("rhat_max_predictions", posterior.rhat_of_predictions, ""),
        Figure("ess_min", posterior.size_of_predictions, "", better="higher"),
        Figure("divergences", posterior.draws.divergences, ""),
        Figure("wall_time_s", wall_time, "s"),
    ]


def expected_errors(predicted: Predicted, pieces: Segments, model: Model) -> dict[str, np.ndarray]:
    """How the error of what comes first in an observation grows, and is expected to; NaN if unseen.

    Of a pose that is the position.
    """
    unit = model.observation_units[0]
    of = np.array([u == unit for u in model.observation_units])
    seen = np.asarray(pieces.seen)[..., of]
    off = difference(model, np.asarray(predicted.motion), np.asarray(pieces.target))[..., of]
    mean = np.where(seen, off.mean(axis=0), 0.0)
    axes = (0, *range(2, mean.ndim))
    count = or_nan(seen.sum(axis=axes))
    spread = np.where(seen, np.var(np.asarray(predicted.observed)[..., of], axis=0), 0.0)
    return {
        "horizon.time": model.control_period * np.arange(1, pieces.horizon + 1),
        "horizon.error": np.sqrt(np.square(mean).sum(axis=axes) / count),
        "horizon.expected": np.sqrt(spread.sum(axis=axes) / count),
    }


# --- both ---------------------------------------------------------------------------------------


def _rival(value: float, unit: str) -> str:
    return f"{_START}{value:.3g} {unit}"


def _known(value: float) -> float | None:
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
    cells += [line for row in result.parameters if not row["fixed"] for line in _lines(row)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for line in cells:
        print("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip())
    if fixed := [row["name"] for row in result.parameters if row["fixed"]]:
        print(f"not identified: {', '.join(fixed)} (as given)")
    for row in result.parameters:
        if row["verdict"]:
            print(f"warning: {row['name']}: {row['verdict']}")
    for warning in result.warnings:
        print(f"warning: {warning}")
    for sentence in settings.get(folders.SUMMARY, []):
        print(sentence)


def _lines(row: dict[str, Any]) -> list[tuple[str, str, str, str]]:
    """What is printed of a parameter: of draws a line for each element, of a fit one for all."""
    if isinstance(row["value"], list) and ("elements" in row or row.get("derived")):
        several = len(row["value"]) > 1
        names = [
            f"{row['name']}[{i}]" if several else row["name"] for i in range(len(row["value"]))
        ]
        names = row.get("elements", names)
        values = zip(names, row["value"], row["lower"], row["upper"], strict=True)
        return [
            (name, format_value(value, row["unit"]), f"{low:.3g} to {high:.3g}", "")
            for name, value, low, high in values
        ]
    note = "one value for all elements" if row["shared"] and np.size(row["value"]) > 1 else ""
    return [(row["name"], format_value(row["value"], row["unit"]), _interval(row), note)]


def _interval(row: dict[str, Any]) -> str:
    """The interval of one value; of several, what is typical relative to their values."""
    if uninformed(row["verdict"]):
        return "not told by the data"
    value, low, high = (np.ravel(row[key]) for key in ("value", "lower", "upper"))
    if low.size == 1 or (row["shared"] and np.ptp(low) <= 1e-6 * abs(low[0])):
        return f"{low[0]:.3g} to {high[0]:.3g}"
    below, above = (np.median((edge - value) / np.abs(value)) for edge in (low, high))
    return f"typically {below:+.0%} to {above:+.0%}"


def summary_of_fit(
    report: FitReport, figures: Sequence[Figure], rows: Sequence[dict[str, Any]], doubts: list[str]
) -> list[str]:
    """What a fit found, and how far to trust it: two sentences."""
    settings = report.settings()
    count, held_out = settings["scored_trials"], report.data.validation is not None
    errors = [figure for figure in figures if figure.name == f"l1_{figure.unit}"]
    said = " and ".join(map(value_in_words, errors))
    before = " and ".join(str(figure.rival).removeprefix(_START) for figure in errors)
    found = (
        f"The model predicts {count} trial{'' if count == 1 else 's'} of "
        f"{round(settings['scored_duration_s'], 1):g} s, which it was {'not ' if held_out else ''}"
        f"fitted to, with a mean error of {said} ({before} before it was fitted)."
    )
    if CORRECTION in settings:
        found += f" {describe_correction(settings[CORRECTION])}."
    told = _told(rows)
    if not held_out:
        told += " No trial was held out, so the error on other motions is unknown."
    return [found, _doubted(doubts) or told]


def summary_of_draws(
    figures: Sequence[Figure], settings: Mapping[str, Any], rows: Sequence[dict[str, Any]]
) -> list[str]:
    """What draws say, and how far to trust them: two sentences."""
    errors = [figure for figure in figures if figure.name == f"rmse_{figure.unit}"]
    known = {figure.name: figure for figure in figures}
    inside, apart = known["coverage_90"], known["rhat_max_predictions"].value
    found = (
        f"Draws of the model ({settings['structure']}) predict {settings['scored_on']} {PIECE:g} s "
        f"ahead within {' and '.join(map(value_in_words, errors))} (root mean square)."
    )
    held = f"Its 90 % intervals hold {value_in_words(inside)} of what was seen. {_told(rows)}"
    if apart is not None and apart >= MIXED:
        held += f" Draw more: the chains do not agree yet (R-hat {apart:.3g})."
    return [found, _doubted(settings[folders.DOUBTS]) or held]


def _doubted(doubts: Sequence[str]) -> str:
    return f"It is not to be trusted: {doubts[0]}." if doubts else ""


def _told(rows: Sequence[dict[str, Any]]) -> str:
    """Of how many free parameters the data tell something, and of which they tell nothing."""
    free = [row for row in rows if not (row["fixed"] or row.get("derived"))]
    left = [row["name"].replace("_", " ") for row in free if uninformed(row["verdict"])]
    said = f"The data tell {len(free) - len(left)} of {len(free)} parameters"
    return f"{said}; they say nothing of {', '.join(left)}." if left else f"{said}."
