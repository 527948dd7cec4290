"""What `palpate identify` says of draws: figures, parameters, evidence, a summary."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from palpate.commands import folders
from palpate.commands.identification.tables import (
    describe_doubts,
    informed_parameters,
    or_none,
    typical_and_worst,
    units_of,
)
from palpate.identification.data.prediction import or_nan
from palpate.identification.data.segments import Segments, difference
from palpate.identification.posterior.comparison import PIECE
from palpate.identification.posterior.posterior import MIXED, Posterior, spread_out
from palpate.identification.posterior.predictive import Predicted, Score
from palpate.identification.verdicts import verdict
from palpate.models.model import Model
from palpate.report.motion import in_numbers, in_space
from palpate.runs import Figure
from palpate.runs.figure_names import value_in_words

LEVEL, SHORT = 0.9, 0.1  # of the intervals, and how far their coverage may fall short of it
FAN, LINES = "draws", 40  # of the page's fan


def posterior_rows(posterior: Posterior) -> list[dict[str, Any]]:
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


def posterior_figures(
    posterior: Posterior, score: Score, model: Model, wall_time: float, unit: str
) -> list[Figure]:
    """Errors of each unit that is observed, coverage, and how far the chains may be trusted."""
    units = units_of(unit, model)
    errors = {of: score.pooled(np.array(units) == of) for of in dict.fromkeys(units)}
    return [
        *(Figure(f"rmse_{of}", or_none(error), of) for of, error in errors.items()),
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


def posterior_motion(
    posterior: Posterior, predicted: Predicted, pieces: Segments
) -> dict[str, np.ndarray]:
    """Evidence of the pieces whose error is the median and the worst: a fan beside the observed."""
    model = posterior.target.coordinates.reference
    seen, target = np.asarray(pieces.seen), np.asarray(pieces.target)
    off = difference(model, predicted.motion.mean(axis=0), target)
    axes = tuple(range(1, seen.ndim))
    square = np.where(seen, off**2, 0.0).sum(axis=axes) / or_nan(seen.sum(axis=axes))
    some = spread_out(len(predicted.motion), LINES)
    models = posterior.target.models(jnp.asarray(posterior.thinned(len(predicted.motion))[some]))
    arrays: dict[str, np.ndarray] = {}
    for group, piece in typical_and_worst(square, "piece").items():
        observed = np.where(seen[piece], target[piece], np.nan)
        draws = {FAN: (models, predicted.motion[some, piece])}
        arrays |= {} if arrays else in_numbers(model, observed, draws)
        arrays |= in_space(model, observed, draws, group=group)
    return arrays


def summary_of_draws(
    figures: Sequence[Figure], settings: Mapping[str, Any], rows: Sequence[dict[str, Any]]
) -> list[str]:
    """What draws say, and how far to trust them: two sentences."""
    errors = [figure for figure in figures if figure.name == f"rmse_{figure.unit}"]
    known = {figure.name: figure for figure in figures}
    inside, rhat = known["coverage_90"], known["rhat_max_predictions"].value
    found = (
        f"Draws of the model ({settings['structure']}) predict {settings['scored_on']}, "
        f"{PIECE:g} s ahead, within {' and '.join(map(value_in_words, errors))} (root mean square)."
    )
    held = f"Its 90 % intervals hold {value_in_words(inside)} of what was seen"
    if inside.value is not None and inside.value < LEVEL - SHORT:
        held += ", too little to rely on them"
    held += f". {informed_parameters(rows)}"
    if rhat is not None and rhat >= MIXED:
        held += f" Draw more: the chains do not agree yet (R-hat {rhat:.3g})."
    return [found, describe_doubts(settings[folders.DOUBTS]) or held]
