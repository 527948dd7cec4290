"""Simulation-based calibration: whether a posterior is what it says, tested on its own model.

Parameters are drawn from the prior, a motion is simulated with them, and the posterior given that
motion is sampled. The rank of the true value among independent posterior draws is then uniform,
for every parameter, if and only if likelihood, prior, transforms and sampler fit together (Talts,
Betancourt, Simpson, Vehtari and Gelman, arXiv 1804.06788; Cook, Gelman and Rubin 2006).

    found = [ranks_of(given, key, 16) for key in keys]
    p = p_values(np.concatenate([batch.rank for batch in found]), found[0].draws)

Whether it would notice is tested by a likelihood with the wrong noise (`sigma_factor`).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.stats import chi2

from palpate.errors import PalpateError
from palpate.identification.data.segments import known_start
from palpate.identification.posterior.diagnostics import bulk_size, rhat
from palpate.identification.posterior.likelihood import (
    MotionPosterior,
    from_start,
    known_scales,
    motion_posterior,
)
from palpate.identification.posterior.posterior import sample
from palpate.identification.samplers.local_global import CHAINS
from palpate.models.model import Model
from palpate.numerics.devices import one_on_each

THIN = 5  # draws of a chain for each that is kept: those that are kept are then independent


class Problem(eqx.Module):
    """What is simulated: the target's data are replaced by each simulation's.

    `noise` is what is added to each channel; the target's own scales are those of the likelihood.
    """

    target: MotionPosterior
    noise: Float[Array, " last"]


@dataclasses.dataclass(frozen=True)
class Ranks:
    """Of each simulation's true coordinates among its posterior's draws.

    `rank` counts the draws below the truth, 0 to `draws`. `size` is the bulk effective size, of
    all draws that they were taken from, and `rhat` the R-hat of the chains, of each coordinate.
    """

    rank: Int[np.ndarray, "simulations free"]
    size: Float[np.ndarray, "simulations free"]
    rhat: Float[np.ndarray, "simulations free"]
    draws: int


def problem(
    model: Model,
    pose: Float[Array, "segments ..."],
    action: Float[Array, "segments time ..."],
    noise: Float[np.ndarray, " last"],
    sigma_factor: float = 1.0,
) -> Problem:
    """Motions from rest at known poses under known actions, seen with a known noise.

    `sigma_factor` falsifies the noise of the likelihood, and only that: the test then has to fail.
    Raises `PalpateError` for noise that is not positive, or shapes that are not the model's.
    """
    horizon = action.shape[1]
    nothing = jnp.zeros((len(pose), horizon, *pose.shape[1:]), pose.dtype)
    segments = known_start(pose, jnp.zeros_like(pose), action, nothing)
    scales = known_scales(model, sigma_factor * np.asarray(noise))
    target = motion_posterior(model, segments, scales).with_one_rotation()
    return Problem(target, jnp.asarray(noise, pose.dtype))


def ranks_of(given: Problem, key: PRNGKeyArray, simulations: int, draws: int = 63) -> Ranks:
    """Simulate all side by side; sample each posterior as `bayesian.sample` does, and rank.

    But for the noise, which is known, all is tested that a recording meets: the search for modes,
    which does not know the truth, the chains, and the draws they end with. Raises as `sample`.
    """
    first, second = jax.random.split(key)
    truth, observed = jax.device_get(_simulate(given, jax.random.split(first, simulations)))
    seeds = np.asarray(jax.random.randint(second, (simulations,), 0, np.iinfo(np.int32).max))
    length = THIN * -(-draws // CHAINS)

    def one(of: tuple[np.ndarray, np.ndarray, int]) -> tuple[np.ndarray, ...]:
        true, data, seed = of
        target = eqx.tree_at(lambda t: t.segments.target, given.target, jnp.asarray(data))
        posterior = sample(target, chains=CHAINS, draws=length, seed=seed)
        rank = (posterior.thinned(draws) < true).sum(axis=0)
        return rank, bulk_size(posterior.draws.position), rhat(posterior.draws.position)

    found = one_on_each(one, zip(truth, observed, seeds.tolist(), strict=True))
    rank, size, mixed = (np.stack(of) for of in zip(*found, strict=True))
    return Ranks(rank, size, mixed, draws)


def p_values(
    ranks: Int[np.ndarray, "simulations free"], draws: int, bins: int = 16
) -> Float[np.ndarray, " free"]:
    """Of a chi-square test of each coordinate's ranks against the uniform distribution.

    Raises `PalpateError` when `bins` does not divide the `draws` + 1 ranks there are, or fewer
    than 5 simulations would fall into a bin.
    """
    if (draws + 1) % bins or len(ranks) < 5 * bins:
        raise PalpateError(
            f"{len(ranks)} simulations with {draws} draws do not fill {bins} bins evenly: expected "
            f"draws + 1 a multiple of the bins, and at least {5 * bins} simulations"
        )
    counts = histogram(ranks, draws, bins)
    expected = len(ranks) / bins
    return chi2.sf(np.sum(np.square(counts - expected), axis=1) / expected, bins - 1)


def histogram(
    ranks: Int[np.ndarray, "simulations free"], draws: int, bins: int = 16
) -> Int[np.ndarray, "free bins"]:
    """How many simulations have their rank in each bin, by coordinate."""
    of = ranks * bins // (draws + 1)
    return np.stack([np.bincount(column, minlength=bins) for column in of.T])


@eqx.filter_jit
def _simulate(given: Problem, keys: Array) -> tuple[Array, Array]:
    """True coordinates (simulations, free), and what was observed of the motions they make."""

    def one(key: PRNGKeyArray) -> tuple[Array, Array]:
        drawn, seen = jax.random.split(key)
        truth = jax.random.normal(drawn, (given.target.dimension,))
        motion = from_start(given.target.model(truth), given.target.segments)
        return truth, motion + given.noise * jax.random.normal(seen, motion.shape, motion.dtype)

    return jax.vmap(one)(keys)
