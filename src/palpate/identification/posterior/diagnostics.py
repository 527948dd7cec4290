"""How far Markov chains may be trusted: rank-normalised R-hat and effective sample sizes.

Vehtari, Gelman, Simpson, Carpenter and Buerkner, "Rank-normalization, folding, and localization",
Bayesian Analysis 16, 2021 (arXiv 1903.08008). All functions take draws as (chains, draws, ...) and
return an array over the trailing axes, in float64. A quantity that never changes has nothing to
mix: its R-hat is 1 and its size the number of draws.
"""

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri
from scipy.stats import rankdata

from palpate.errors import PalpateError

TAILS = 0.05, 0.95  # quantiles that the tail size is of
FEWEST = 4  # draws of a chain: two of each half, of which a variance can be taken


def rhat(draws: Float[np.ndarray, "chains draws ..."]) -> Float[np.ndarray, "..."]:
    """Rank-normalised split R-hat, the greater of bulk and folded (equation 14 ff.).

    Below 1.01 the chains tell the same. Raises `PalpateError` for fewer than 4 draws, or NaN.
    """
    whole = _check(draws)
    values = _halve(whole)
    folded = np.abs(values - np.median(values, axis=(0, 1)))
    found = np.maximum(_rhat(_normalise_ranks(values)), _rhat(_normalise_ranks(folded)))
    return np.where(_constant(whole), 1.0, found).reshape(np.shape(draws)[2:])


def bulk_size(draws: Float[np.ndarray, "chains draws ..."]) -> Float[np.ndarray, "..."]:
    """Effective number of independent draws for the centre of the distribution (section 4.2)."""
    whole = _check(draws)
    found = _effective_size(_normalise_ranks(_halve(whole)))
    return np.where(_constant(whole), _number(whole), found).reshape(np.shape(draws)[2:])


def tail_size(draws: Float[np.ndarray, "chains draws ..."]) -> Float[np.ndarray, "..."]:
    """Effective number of independent draws for the 5 % and 95 % quantiles, the lesser one."""
    whole = _check(draws)
    sizes = []
    for level in TAILS:
        below = (whole <= np.quantile(whole, level, axis=(0, 1))).astype(np.float64)
        sizes.append(np.where(_constant(below), _number(whole), _effective_size(_halve(below))))
    return np.minimum(*sizes).reshape(np.shape(draws)[2:])


def _check(draws: np.ndarray) -> np.ndarray:
    """The draws as (chains, draws, quantities)."""
    values = np.asarray(draws, np.float64)
    if values.ndim < 2 or values.shape[1] < FEWEST:
        raise PalpateError(
            f"expected draws of shape (chains, at least {FEWEST} draws, ...), got {values.shape}"
        )
    if not np.all(np.isfinite(values)):
        raise PalpateError("a draw is NaN or infinite: expected finite draws to judge chains by")
    return values.reshape(*values.shape[:2], -1)


def _number(values: np.ndarray) -> float:
    return float(values.shape[0] * values.shape[1])


def _constant(values: np.ndarray) -> np.ndarray:
    return np.ptp(values, axis=(0, 1)) == 0.0


def _halve(values: np.ndarray) -> np.ndarray:
    """Each chain as two, so that a drift along it shows."""
    half = values.shape[1] // 2
    return np.concatenate([values[:, :half], values[:, values.shape[1] - half :]])


def _normalise_ranks(values: np.ndarray) -> np.ndarray:
    """Normal quantiles of the ranks over all chains (equation 14)."""
    chains, draws = values.shape[:2]
    ranks = rankdata(values.reshape(chains * draws, -1), axis=0).reshape(values.shape)
    return ndtri((ranks - 0.375) / (chains * draws + 0.25))


def _rhat(values: np.ndarray) -> np.ndarray:
    """R-hat of chains (equations 1 to 4)."""
    draws = values.shape[1]
    within = np.mean(np.var(values, axis=1, ddof=1), axis=0)
    between = draws * np.var(np.mean(values, axis=1), axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt((draws - 1) / draws + between / (draws * within))


def _effective_size(values: np.ndarray) -> np.ndarray:
    """Of split chains, by Geyer's initial monotone sequence (equations 10 to 13)."""
    chains, draws = values.shape[:2]
    centred = values - values.mean(axis=1, keepdims=True)
    padded = np.fft.rfft(centred, n=2 * draws, axis=1)
    covariance = np.fft.irfft(np.abs(padded) ** 2, n=2 * draws, axis=1)[:, :draws] / draws
    within = np.mean(covariance[:, 0], axis=0) * draws / (draws - 1)
    plus = within * (draws - 1) / draws
    if chains > 1:
        plus = plus + np.var(values.mean(axis=1), axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = 1.0 - (within - covariance.mean(axis=0)) / plus
    correlation[0] = 1.0
    pairs = correlation[: 2 * (draws // 2)]
    pairs = pairs[0::2] + pairs[1::2]
    # Up to the first pair that is not positive, and never growing (Geyer 1992).
    positive = np.cumprod(pairs > 0.0, axis=0, dtype=bool)
    monotone = np.minimum.accumulate(np.where(positive, pairs, 0.0), axis=0)
    # A single correlation beyond the pairs counts while positive, which steadies short chains.
    after = np.argmin(positive, axis=0) * np.any(~positive, axis=0) + np.all(positive, axis=0) * (
        len(pairs) - 1
    )
    single = np.take_along_axis(correlation, 2 * after[None], axis=0)[0]
    time = -1.0 + 2.0 * monotone.sum(axis=0) + np.maximum(single, 0.0)
    total = chains * draws
    return total / np.maximum(time, 1.0 / np.log10(total))
