"""`palpate identify`: recordings in; a fitted model or draws of models, and how far to trust them.

Nothing here knows what was recorded: the options of each family do.
"""

import dataclasses
import importlib.util
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.commands import folders
from palpate.commands.identification import draws, fit, tables
from palpate.commands.identification.data import Data, read
from palpate.errors import DoubtfulResultError, PalpateError
from palpate.families.options import Hypotheses, Identify
from palpate.identification.declarations import with_values_of
from palpate.identification.gradient.descent import Settings, check_shapes
from palpate.identification.gradient.residual import (
    Correction,
    ResidualSettings,
    check_correctable,
    fit_residual,
)
from palpate.identification.identify import FITS, Identified, identify
from palpate.identification.posterior.comparison import cut_pieces
from palpate.identification.posterior.files import write_netcdf, write_posterior
from palpate.identification.posterior.posterior import check_numbers
from palpate.identification.posterior.predictive import check_seen
from palpate.models.files import load_model, save_model
from palpate.models.model import Model
from palpate.parameters import parameters_of, value_of, with_values
from palpate.report import write_evidence
from palpate.runs import Run
from palpate.runs.result import read_result
from palpate.runs.run import RESULT
from palpate.runs.storage import check_writable, write_bytes

DRAWS, NETCDF = "posterior.npz", "posterior.nc"
RESIDUAL = "residual"  # the folder of its run
TRUSTED = 5.0  # s of a prediction, by which a fit is judged
ADAM = "adam"  # an older name of the method "gradient"


def run(options: Identify) -> Path:
    """Identify, print what a person wants to know, and return the folder everything is in.

    Raises `PalpateError` for recordings, names, numbers and folders that cannot be used; before
    anything takes minutes. And `DoubtfulResultError` in the end, when all is written, if what was
    found is not to be trusted: the recording's or the fit's own problems say why.
    """
    _check(options)
    data = read(options)
    reference = _begun(options.reference(data.shown, data.fitted_aligned), options)
    check_shapes(reference, data.fitted_aligned)
    check_shapes(reference, data.validation_aligned)
    if options.residual:  # now, and not after the physics was fitted
        check_correctable(reference, data.fitted_aligned)
    if not options.fits:
        cut_pieces(data.fitted_aligned, reference, *_lengths_of_segments(options))
        check_seen(cut_pieces(data.validation_aligned, reference, *_lengths_of_segments(options)))
    product = folders.MODEL if options.fits else DRAWS
    inputs: dict[str, Path | Sequence[Path]] = {
        "recordings": options.recordings,
        "validate": options.validate,
        **folders.source_of(options.place),
    }
    if options.init is not None:
        inputs["init"] = (_model_file(options.init),)
    words = f"identify {options.family}"
    of_a_fit = dataclasses.asdict(_settings(options)) if options.fits else {}
    with folders.begin(options, words, inputs, product, **of_a_fit) as run:
        if not run.finished:
            for problem in data.problems:  # at once: the fit that follows takes minutes
                print(f"warning: {problem}", flush=True)
            hypotheses = options.hypotheses(data.shown, data.fitted_aligned)
            models = {of: _begun(one, options) for of, one in hypotheses.models.items()}
            found = identify(
                {of: options.sufficient(one, data.shown) for of, one in models.items()},
                data.fitted_aligned,
                _method(options),
                settings=_settings(options),
                chains=options.chains,
                draws=options.draws,
                seed=options.seed,
                one_object=options.one_object,
                piece=options.piece,
                run=run,
            )
            hypotheses = dataclasses.replace(hypotheses, models=models)
            options.write_products(run.path, found.model, data.shown)
            write = _write_fit if options.fits else _write_draws
            write(run, options, data, hypotheses, found)
        result = read_result(run.path / RESULT)
        tables.show(result)
        if options.arviz is not None:
            write_bytes(options.arviz, (run.path / NETCDF).read_bytes())
            print(f"for ArviZ: {options.arviz}")
        title = f"What was found out about the {options.family}"
        written = folders.hand_over(options, run, title, product)
        if doubts := result.settings.get(folders.DOUBTS):
            raise DoubtfulResultError(f"{written} is not to be trusted: {doubts[0]}")
        return run.path


def _check(options: Identify) -> None:
    """Raise `PalpateError` for options that do not go together, or cannot be met here."""
    options.check()
    check_numbers(options.chains, options.draws)
    if options.fits and any(x is not None for x in (options.chains, options.draws, options.arviz)):
        raise PalpateError(
            f"--method {options.method} fits one model: --draws, --chains and --arviz are for "
            "nuts, metropolis, local-global and smc"
        )
    if not options.fits and (options.residual or options.iterations):
        raise PalpateError(
            f"--method {options.method} draws models: --residual and --iterations are for "
            "gradient and levenberg-marquardt"
        )
    if options.arviz is not None and importlib.util.find_spec("arviz") is None:
        raise PalpateError("--arviz needs the extra 'bayes': pip install 'palpate[bayes]'")
    if options.arviz is not None:
        check_writable(options.arviz)


def _begun(model: Model, options: Identify) -> Model:
    """The model as it was declared, with the values that were asked for to start from."""
    if options.init is not None:
        model = with_values_of(model, load_model(_model_file(options.init))[0])
    return options.declared(model)


def _model_file(path: Path) -> Path:
    return folders.product_of(path, folders.MODEL, "identify")


def _lengths_of_segments(options: Identify) -> tuple[float, bool]:
    """How trials are cut into pieces for draws."""
    return options.piece, options.one_object


def _method(options: Identify) -> str:
    return "gradient" if options.method == ADAM else options.method


def _settings(options: Identify) -> Settings:
    """Of a fit."""
    settings = Settings(seed=options.seed)
    if options.fits:
        settings = dataclasses.replace(settings, method=FITS[_method(options)])
    if options.iterations:
        settings = dataclasses.replace(settings, iterations=options.iterations)
    return settings


def _write_fit(
    run: Run, options: Identify, data: Data, hypotheses: Hypotheses, found: Identified
) -> None:
    """The model, evidence and result into the run's folder; the result last."""
    (start,) = hypotheses.models.values()
    # Into the model as it was declared: what did not show in these recordings is still there.
    values = {path: value_of(found.model, path) for path in parameters_of(found.model)}
    found = dataclasses.replace(found, model=with_values(start, values))
    correction, earlier = (
        _correction(found.model, data, options, run) if options.residual else (None, 0.0)
    )
    wall_time = run.elapsed + earlier
    report = fit.FitReport.of(start, found.model, data, correction)
    figures, parameters = report.figures(wall_time), fit.fit_rows(found)
    doubts = _doubts(options, data, report.scored.within(TRUSTED))
    summary = fit.summary_of_fit(report, figures, parameters, doubts)
    settings = report.settings() | {folders.DOUBTS: doubts, folders.SUMMARY: summary}
    save_model(
        run.path / folders.MODEL,
        report.delivered,
        {
            folders.DOUBTS: doubts,
            "recordings": dict(data.fitted.provenance),
            "observed": settings["predicted"],
            **({} if data.noise is None else {"observation_noise": data.noise}),
            "figures": {figure.name: figure.value for figure in figures},
            "parameters": [
                {key: row[key] for key in ("name", "lower", "upper", "verdict")}
                for row in parameters
            ],
        },
    )
    write_evidence(run.path, report.evidence())
    rows = {
        "parameters": parameters,
        "warnings": [
            *(*doubts, *options.bounds(found.model), *found.warnings),
            *filter(None, [fit.shareable(parameters)]),
        ],
        "wall_time_s": wall_time,
    }
    folders.finish(run, figures, settings, tables.split(data), **rows)


def _doubts(options: Identify, data: Data, error: float) -> list[str]:
    """Why a result is not to be trusted: a misfit by itself only where nothing explains it."""
    misfit = options.misfit(data.fitted_aligned, error)
    return [*data.problems] or [misfit] * bool(misfit)


def _correction(model: Model, data: Data, options: Identify, run: Run) -> tuple[Correction, float]:
    """A network on top of the physics where that helps; the recording to score on is not seen.

    And the seconds that earlier processes spent on it: it is a run of its own, below this one's.
    """
    settings = ResidualSettings(seed=options.seed)
    configuration = {**run.configuration, RESIDUAL: dataclasses.asdict(settings)}
    began = time.monotonic()
    with Run.open(run.path / RESIDUAL, configuration, fresh=options.fresh) as own:
        correction = fit_residual(model, data.fitted_aligned, settings, own)
        earlier = max(0.0, own.elapsed - (time.monotonic() - began))
        if not own.finished:
            own.finish({"kept": correction.kept, "reason": correction.reason})
    return correction, earlier


def _write_draws(
    run: Run, options: Identify, data: Data, hypotheses: Hypotheses, found: Identified
) -> None:
    """Draws, evidence and result into the run's folder; the result last."""
    comparison = found.comparison
    assert comparison is not None  # by the method
    posterior = comparison.posterior
    write_posterior(run.path / DRAWS, posterior, hypotheses.models[comparison.structure])
    if options.arviz is not None:
        write_netcdf(run.path / NETCDF, posterior)
    model = posterior.target.coordinates.reference
    pieces = cut_pieces(data.validation_aligned, model, *_lengths_of_segments(options))
    predicted, score = posterior.predict(pieces), posterior.score(pieces)
    evidence = draws.expected_errors(predicted, pieces, model)
    evidence |= draws.posterior_motion(posterior, predicted, pieces)
    write_evidence(run.path, evidence)
    everything = np.ones(model.observation_shape[-1], bool)
    doubts = _doubts(options, data, score.pooled(everything))
    settings = {
        folders.DOUBTS: doubts,
        "structure": comparison.structure,
        "probability": comparison.probability,
        "by_itself": hypotheses.by_itself,
        "sampler": posterior.sampler,
        "pieces": pieces.count,
        "scored_on": "what was fitted" if data.validation is None else "what was not fitted",
        "observation_unit": tables.units_of(data.unit, model)[0],
        "predicted": tables.predicted_names(data, model),
    }
    figures = draws.posterior_figures(posterior, score, model, run.elapsed, data.unit)
    meanings = options.meanings(posterior.models(), posterior.prior)
    parameters = [*draws.posterior_rows(posterior), *meanings]
    rows = {"parameters": parameters, "warnings": [*doubts, *found.warnings]}
    settings[folders.SUMMARY] = draws.summary_of_draws(figures, settings, parameters)
    folders.finish(run, figures, settings, tables.split(data), **rows)
