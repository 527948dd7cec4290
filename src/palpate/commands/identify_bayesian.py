"""`palpate identify` with a posterior: recordings in, draws of models and what they predict out.

Nothing here knows what was recorded: `options.prepare` and `options.hypotheses` do.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands import folders
from palpate.errors import PalpateError
from palpate.families.options import Hypotheses, IdentifyBayesian
from palpate.identification.data.prediction import or_nan
from palpate.identification.data.segments import Segments, difference
from palpate.identification.posterior.comparison import (
    PIECE,
    Comparison,
    compare,
    cut_pieces,
    posterior_of,
)
from palpate.identification.posterior.files import write_posterior
from palpate.identification.posterior.posterior import (
    Posterior,
    check_numbers,
)
from palpate.identification.posterior.predictive import Predicted, Score, check_seen
from palpate.identification.verdicts import verdict
from palpate.models.model import Model
from palpate.parameters import format_value
from palpate.recordings import Recording, join
from palpate.recordings.files import read_recording
from palpate.report import write_evidence
from palpate.runs import Figure, Result, Run
from palpate.runs.result import read_result
from palpate.runs.run import RESULT

DRAWS = "posterior.npz"
LEVEL = 0.9
SHORTEST = 0.5  # s of recordings, in all


def run(options: IdentifyBayesian) -> Path:
    """Identify, print what a person wants to know, and return the folder everything is in.

    Raises `PalpateError` for recordings and folders that cannot be used, and for fewer draws than
    can be judged; before anything takes minutes.
    """
    check_numbers(options.chains, options.draws)
    fitted, period = _read(options, options.recordings)
    scored = _read(options, options.validate)[0] if options.validate else None
    name = f"identify-{options.family}"
    configuration = {
        **folders.configuration_of(options, f"identify {options.family}"),
        "recordings": [folders.fingerprint(path) for path in options.recordings],
        "validate": [folders.fingerprint(path) for path in options.validate],
    }
    with folders.open_run(options, name, configuration, DRAWS) as run:
        if not run.finished:
            shown = [fitted] if scored is None else [fitted, scored]
            aligned, asked = (
                recording.align(period, options.observation, options.action)
                for recording in (fitted, scored or fitted)
            )
            # First of all: where nothing can be cut, nobody waits in vain.
            reference = options.reference(shown, period)
            cut_pieces(aligned, reference)
            pieces = cut_pieces(asked, reference)
            check_seen(pieces)
            hypotheses = options.hypotheses(shown, period)
            targets = {
                name: posterior_of(options.sufficient(model, shown), aligned)
                for name, model in hypotheses.models.items()
            }
            found = compare(targets, options.draws, options.chains, options.seed)
            _write(run, name, options, (fitted, scored), pieces, hypotheses, found)
        result = read_result(run.path / RESULT)
        _print(result)
        title = f"What was found out about the {options.family}"
        folders.hand_over(options, run, title, DRAWS, list(result.warnings))
        return run.path


def _read(options: IdentifyBayesian, paths: tuple[Path, ...]) -> tuple[Recording, float]:
    """The recordings as the family needs them, and their period without the clock's jitter."""
    if not paths:
        raise PalpateError("no recording is named: expected at least one file or log")
    recording = options.prepare(
        join([
            read_recording(
                path, rate=options.rate, unit=options.unit, up=options.up,
                topics=options.topics or (),
            )
            for path in paths
        ])
    )  # fmt: skip
    for note in dict.fromkeys(recording.notes):
        print(f"note: {note}")
    periods = [trial[options.observation].nominal_period for trial in recording.trials]
    period = 1.0 / options.rate if options.rate else float(f"{np.median(periods):.5g}")
    lasting = sum(float(np.ptp(trial[options.observation].time)) for trial in recording.trials)
    if lasting < SHORTEST:
        raise PalpateError(
            f"{' and '.join(map(str, paths))} last {lasting:.3g} s in all: expected at least "
            f"{SHORTEST:g} s of motion"
        )
    return recording, period


def rows(posterior: Posterior) -> list[dict[str, Any]]:
    """The parameters for `result.json`: medians, 90 % intervals and what the data left open."""
    declared = posterior.target.coordinates.declarations
    found = []
    for path, declaration in declared.items():
        of = [row for row in posterior.table if row.name.partition("[")[0] == path]
        found.append({
            "name": path,
            "value": [row.median for row in of],
            "unit": declaration.unit,
            "about": declaration.about,
            "fixed": False,
            "shared": declaration.shared,
            "lower": [row.lower for row in of],
            "upper": [row.upper for row in of],
            "verdict": verdict(np.array([row.undecided for row in of])),
        })  # fmt: skip
    return found


def _write(
    run: Run,
    name: str,
    options: IdentifyBayesian,
    recordings: tuple[Recording, Recording | None],
    pieces: Segments,
    hypotheses: Hypotheses,
    found: Comparison,
) -> None:
    """Draws, evidence and result into the run's folder; the result last.

    `recordings` are what was fitted and, if that is another, what `pieces` to score on are from.
    """
    posterior, (fitted, scored) = found.posterior, recordings
    write_posterior(run.path / DRAWS, posterior, hypotheses.models[found.structure])
    model = posterior.target.coordinates.reference
    predicted = posterior.predict(pieces)
    score = posterior.score(pieces)
    meanings = options.meanings(posterior.models(), posterior.prior)
    write_evidence(run.path, _horizon(predicted, pieces, model))
    settings = run.configuration | {
        "structure": found.structure,
        "probability": found.probability,
        "by_itself": hypotheses.by_itself,
        "pieces": pieces.count,
        "scored_on": "recordings that were not fitted" if scored else "what was fitted",
        "observation_unit": model.observation_units[0],
    }
    run.finish(
        Result(
            name=name,
            figures=_figures(posterior, score, model, run.elapsed),
            settings=settings,
            seeds=[options.seed],
            split={
                "fitted": [trial.name for trial in fitted.trials],
                "validation": [trial.name for trial in scored.trials]
                if scored
                else "none: errors and coverage are those on the fitted trials",
            },
            wall_time_s=run.elapsed,
            parameters=[*rows(posterior), *meanings],
            warnings=list(posterior.warnings),
        ).to_dict()
    )


def _figures(posterior: Posterior, score: Score, model: Model, wall_time: float) -> list[Figure]:
    units = model.observation_units
    errors = {unit: score.pooled(np.array(units) == unit) for unit in dict.fromkeys(units)}
    return [
        # None for what JSON lacks: the error of what nobody saw.
        *(Figure(f"rmse_{u}", e if math.isfinite(e) else None, u) for u, e in errors.items()),
        Figure("coverage_90", score.coverage[LEVEL], ""),
        Figure("log_score", score.log_score, "", better="higher"),
        Figure("rhat_max_predictions", posterior.rhat_of_predictions, ""),
        Figure("ess_min", posterior.size_of_predictions, "", better="higher"),
        Figure("divergences", posterior.draws.divergences, ""),
        Figure("wall_time_s", wall_time, "s"),
    ]


def _horizon(predicted: Predicted, pieces: Segments, model: Model) -> dict[str, np.ndarray]:
    """How the error of position grows, and how large it is expected to be, NaN if unseen."""
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


def _print(result: Result) -> None:
    """Structure, parameters, what the data cannot tell, and how predictions fared."""
    settings = result.settings
    compared = {**settings.get("by_itself", {}), "structure": settings["probability"]}
    for what, probability in compared.items():
        if len(probability) > 1 or len(compared) > 1:
            told = ", ".join(f"{name} {share:.2g}" for name, share in probability.items())
            most = max(probability, key=probability.__getitem__)
            alone = "" if what == "structure" else " by itself"
            print(f"{what}{alone}: {most} (probability of each: {told})")
    width = max(len(row["name"]) for row in result.parameters)
    for row in result.parameters:
        several = len(row["value"]) > 1
        for number, (value, low, high) in enumerate(
            zip(row["value"], row["lower"], row["upper"], strict=True)
        ):
            told = "" if row["verdict"] is None else f"  ({row['verdict']})"
            name = f"{row['name']}[{number}]" if several else row["name"]
            print(
                f"{name:{width + 3}}  {format_value(value, row['unit'])}"
                f"  [{low:.3g}, {high:.3g}]{told}"
            )
    for warning in result.warnings:
        print(f"warning: {warning}")
    values = {figure.name: figure for figure in result.figures}
    coverage = values["coverage_90"].value or 0.0
    errors = ", ".join(
        f"{'unknown' if figure.value is None else f'{figure.value:.3g}'} {figure.unit}"
        for name, figure in values.items()
        if name.startswith("rmse_")
    )
    print(
        f"predicted over {PIECE:g} s: root mean square error {errors}; 90 % intervals hold "
        f"{coverage:.0%} of what was seen ({settings['scored_on']})"
    )
