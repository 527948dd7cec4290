"""Any method for any model: recordings in; a fitted model or draws, and how far to trust them, out.

    found = identify(model, recording.align(model.control_period), "nuts")
    found.lower["mass"], found.upper["mass"], found.verdict["mass"], found.warnings

A fit descends through the model (`gradient.descent`) and has intervals by least squares; draws are
those of a posterior (`posterior.posterior`). Several models are hypotheses about what was recorded,
which draws compare and a fit cannot.
"""

import dataclasses
import functools
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from palpate.errors import PalpateError
from palpate.family import check_name
from palpate.identification.gradient import descent
from palpate.identification.gradient.descent import Settings
from palpate.identification.gradient.least_squares import Intervals, intervals
from palpate.identification.posterior.comparison import PIECE, Comparison, compare, posterior_of
from palpate.identification.posterior.posterior import SAMPLERS, Posterior
from palpate.identification.verdicts import verdict
from palpate.models.model import Model
from palpate.parameters import FreeParameters
from palpate.recordings import Aligned
from palpate.runs import Run
from palpate.runs.progress import progress

FITS = {"gradient": "adam", "levenberg-marquardt": "levenberg-marquardt"}  # how each descends
METHODS = (*FITS, *SAMPLERS)
INTERVAL = 0.05, 0.95  # of the draws


@dataclasses.dataclass(frozen=True)
class Identified(Intervals):
    """What was found of a model, and how far to trust it.

    `model` is the fitted one, or the most probable of the draws, of which the intervals are then
    quantiles. `comparison`, None of a fit, has draws and hypotheses' probabilities.
    """

    model: Model
    comparison: Comparison | None = None

    @property
    def posterior(self) -> Posterior | None:
        """The draws, None of a fit."""
        return None if self.comparison is None else self.comparison.posterior


def identify(
    model: Model | Mapping[str, Model],
    aligned: Aligned,
    method: str = "gradient",
    *,
    settings: Settings | None = None,
    chains: int | None = None,
    draws: int | None = None,
    seed: int = 0,
    one_object: bool = False,
    piece: float = PIECE,
    run: Run | None = None,
) -> Identified:
    """Identify the free parameters of a model from aligned trials by one of `METHODS`.

    `model` is where it starts, and says what is free, shared or fixed; or hypotheses by name.
    `settings` and `run` are those of a fit (`descent.identify`; its method and seed are taken from
    here); `chains` and `draws` those of draws (`posterior.sample`), as are `one_object` and the
    seconds of a `piece` (`posterior_of`).

    Raises `PalpateError` for an unknown method, several hypotheses to a fit, and as those do.
    """
    check_name("method", method, METHODS)
    hypotheses = {"": model} if isinstance(model, Model) else model
    if method in FITS:
        if len(hypotheses) > 1:
            raise PalpateError(
                f"{method} fits one model, and here are {', '.join(hypotheses)}: expected one of "
                f"them, or a method that draws and compares: {', '.join(SAMPLERS)}"
            )
        settings = dataclasses.replace(settings or Settings(), method=FITS[method], seed=seed)
        (start,) = hypotheses.values()
        return fit(start, aligned, settings, run)
    targets = {
        name: posterior_of(one, aligned, one_object, piece) for name, one in hypotheses.items()
    }
    watch = functools.partial(progress, description="a posterior")
    return summarise_draws(compare(targets, draws, chains, seed, method, watch))


def fit(start: Model, aligned: Aligned, settings: Settings, run: Run | None) -> Identified:
    """A fit and its intervals; see `descent.identify`."""
    model = descent.identify(start, aligned, settings, run)
    coordinates = FreeParameters(model)
    found = intervals(coordinates, coordinates.initial, aligned)
    return Identified(**vars(found), model=model)


def summarise_draws(comparison: Comparison) -> Identified:
    """The draws of the most probable hypothesis with their intervals."""
    posterior = comparison.posterior
    lower, upper = (
        {
            path: np.asarray(np.quantile(of, level, axis=(0, 1)))
            for path, of in posterior.values.items()
        }
        for level in INTERVAL
    )
    best = posterior.flat[np.argmax(posterior.draws.density)]
    rows = posterior.rows_of
    return Identified(
        lower=lower,
        upper=upper,
        verdict={
            path: verdict(np.array([row.undecided for row in of])) for path, of in rows.items()
        },
        warnings=posterior.warnings,
        model=posterior.target.model(jnp.asarray(best)),
        comparison=comparison,
    )
