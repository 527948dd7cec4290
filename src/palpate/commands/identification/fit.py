"""What `palpate identify` says of a fitted model: figures, parameters, evidence, a summary."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from palpate.commands.identification.data import Data
from palpate.commands.identification.tables import (
    describe_doubts,
    informed_parameters,
    or_none,
    predicted_names,
    typical_and_worst,
    units_of,
)
from palpate.identification.data.prediction import PredictionError, or_nan, prediction_error
from palpate.identification.data.segments import difference
from palpate.identification.gradient.residual import Correction
from palpate.identification.identify import Identified
from palpate.identification.verdicts import uninformed
from palpate.models.model import Model
from palpate.parameters import describe
from palpate.report.charts import quantiles
from palpate.report.motion import in_numbers, in_space
from palpate.runs import Figure
from palpate.runs.figure_names import value_in_words

AGREEING = 0.6  # of a parameter's intervals, that have to hold one value
_START = "start model "
CORRECTION = "correction"  # what the result's settings say of it
UNITS = {"m": (100.0, "cm")}  # a person reads these errors of a fit in another unit


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
                Figure(f"l1_{shown}", or_none(l1), shown, rival=_rival(start_l1, shown)),
                Figure(f"rmse_at_end_{shown}", or_none(end), shown, rival=_rival(start_end, shown)),
                Figure(f"l1_fitted_trials_{shown}", or_none(fitted_l1), shown),
            ]
        figures.append(Figure("wall_time_s", wall_time, "s"))
        if self.correction is not None:
            scale, shown = UNITS.get(self.data.unit, (1.0, self.data.unit))
            alone = self.physics.mean_absolute
            ratio = or_none(self.scored.mean_absolute / alone)
            size = or_none(self.correction.size)
            figures += [
                Figure(f"l1_physics_{shown}", or_none(alone * scale), shown),
                Figure("l1_ratio_to_physics", ratio, ""),
                Figure("correction_size", size, ""),
            ]
        if self._is_chain():
            (tip,) = _root_mean_square(_distances(self.scored)[..., -1].reshape(1, -1))
            figures.append(Figure("tip_rmse_m", or_none(float(tip)), "m"))
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
        """The errors over the horizon, and the typical and the worst of the trials scored."""
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
        for index, (group, trial) in enumerate(typical_and_worst(error.by_trial, "trial").items()):
            seen, model = np.asarray(error.segments.seen[trial]), self.delivered
            observed = np.where(seen, error.segments.target[trial], np.nan)
            predicted = model, error.prediction[trial]
            arrays |= in_space(model, observed, {"predicted": predicted}, group=group)
            if not (index or self._is_chain()):
                start = model, self.start.prediction[trial]
                lines = {"identified": predicted, "start model": start}
                arrays |= in_numbers(model, observed, lines)
        return arrays

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


def fit_rows(found: Identified) -> list[dict[str, Any]]:
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


def shareable(rows: Sequence[Mapping[str, Any]]) -> str:
    """A sentence about parameters whose elements may as well have one value; "" without any.

    Those whose intervals hold one and the same value for `AGREEING` of three or more elements. What
    it costs is how much narrower that value's own interval would be: of independent errors the
    inverse variances add up.
    """
    found, narrower = [], 1.0
    for row in rows:
        said = row["fixed"] or row["shared"] or row["lower"] is None or uninformed(row["verdict"])
        if said or np.size(row["value"]) < 3:
            continue
        value, lower, upper = (np.ravel(row[key]) for key in ("value", "lower", "upper"))
        held = ((lower <= value[:, None]) & (value[:, None] <= upper)).sum(axis=1).max()
        if held < AGREEING * value.size:
            continue
        if (lower > 0).all():  # as it is searched, by its logarithm
            lower, upper = np.log(lower), np.log(upper)
        width = np.maximum(upper - lower, np.finfo(float).tiny)
        found.append(row["name"])
        narrower = max(narrower, float(np.median(width) * np.sqrt(np.sum(width**-2.0))))
    if not found:
        return ""
    return (
        f"one value may do for all elements of {', '.join(found)}: with --shared {' '.join(found)} "
        f"intervals are up to {narrower:.2g} times narrower"
    )


def describe_correction(correction: Mapping[str, Any]) -> str:
    """The sentence for a person."""
    size = f"; it is {correction['size']:.1%} of what the physics changes in a control period"
    return f"Correction by a network {correction['reason']}{size if correction['kept'] else ''}"


def _rival(value: float, unit: str) -> str:
    return f"{_START}{value:.3g} {unit}"


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
    trust = informed_parameters(rows)
    if not held_out:
        trust += " No trial was held out, so the error on other motions is unknown."
    return [found, describe_doubts(doubts) or trust]
