"""Hypotheses about what was recorded, compared by how probable they make it.

All of them are alike before. The posterior of the most probable one is what is handed over.
"""

import dataclasses
from collections.abc import Mapping

import jax
import numpy as np

from palpate.identification.data.segments import Segments, cut, noise_scale, stands_still
from palpate.identification.posterior.likelihood import (
    MotionPosterior,
    inferred_scales,
    motion_posterior,
)
from palpate.identification.posterior.posterior import (
    LOCAL_GLOBAL,
    Posterior,
    check_numbers,
    prepare_sampler,
    sample,
)
from palpate.identification.posterior.settled import Settled, settle_each
from palpate.models.model import Model
from palpate.recordings import Aligned
from palpate.runs.progress import Watch, without_progress

PIECE = 2.0  # s, of what is fitted, and of what is predicted open loop
STILL = 0.1  # s


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The posterior of the most probable hypothesis, and how probable each is."""

    posterior: Posterior
    structure: str
    probability: dict[str, float]


def compare(
    targets: Mapping[str, MotionPosterior],
    draws: int | None = None,
    chains: int | None = None,
    seed: int = 0,
    method: str = LOCAL_GLOBAL,
    watch: Watch = without_progress,
) -> Comparison:
    """Compare hypotheses by their evidence and sample the posterior of the most probable.

    The evidence is Laplace's at the best mode of each: tempered particles (`tempered.temper`) give
    it without the assumption of a normal posterior, and take many times as long. Raises as
    `posterior.sample`.
    """
    check_numbers(chains, draws)
    with prepare_sampler(next(iter(targets.values())), chains, method):
        explored = explore(targets, seed, watch)
    probability = shares({name: settled.evidence for name, settled in explored.items()})
    structure = max(probability, key=probability.__getitem__)
    posterior = sample(
        explored[structure], method, chains=chains, draws=draws, seed=seed, watch=watch
    )
    return Comparison(posterior, structure, probability)


def explore(
    targets: Mapping[str, MotionPosterior], seed: int = 0, watch: Watch = without_progress
) -> dict[str, Settled]:
    """The modes of each."""
    key = jax.random.fold_in(jax.random.key(seed), 1)
    return {name: settle_each(target, key, watch) for name, target in targets.items()}


def shares(logarithms: Mapping[str, float]) -> dict[str, float]:
    """How probable each is given the logarithms of their evidence, all alike before."""
    most = max(logarithms.values())
    weights = {name: float(np.exp(value - most)) for name, value in logarithms.items()}
    return {name: weight / sum(weights.values()) for name, weight in weights.items()}


def posterior_of(
    model: Model, aligned: Aligned, one_object: bool = False, seconds: float = PIECE
) -> MotionPosterior:
    """What is to be sampled: of pieces of the trials, the first of each from rest if it is so.

    With `one_object` the leading entries of an observation are points of one thing: they share
    noise scales (`inferred_scales`), and ring where their start is off (`motion_posterior`).
    """
    scales = inferred_scales(model, noise_scale(aligned, model), one_object)
    pieces = cut_pieces(aligned, model, seconds, one_object)
    return motion_posterior(model, pieces, scales, ringing=one_object).with_one_rotation()


def cut_pieces(
    aligned: Aligned, model: Model, seconds: float = PIECE, one_object: bool = False
) -> Segments:
    """Consecutive pieces of the trials, for a posterior to be fitted to or held against."""
    return cut(aligned, model, seconds, begins_at_rest(aligned, model), ringing=one_object)


def begins_at_rest(aligned: Aligned, model: Model) -> bool:
    """Whether nothing moves beyond the noise in the first tenth of a second of any trial."""
    frames = max(2, round(STILL / aligned.period))
    noise = noise_scale(aligned, model)
    for observed in aligned.observation:
        early, late = observed[:frames], observed[frames : 2 * frames]
        if len(late) < frames or not (np.isfinite(early).all() and np.isfinite(late).all()):
            return False  # nobody knows
        if not stands_still(model, early, late, noise):
            return False
    return True
