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
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.stats import chi2

from palpate.errors import PalpateError
from palpate.identification.diagnostics import bulk_size
from palpate.identification.draws import pooled
from palpate.identification.hamiltonian import BLOCK, GAIN, chain
from palpate.identification.laplace import STARTS, Modes, search
from palpate.identification.likelihood import (
    MotionPosterior,
    from_start,
    known_scales,
    motion_posterior,
)
from palpate.identification.segments import known_start
from palpate.models.model import Model

WARM_UP = 12  # blocks; the metric is learnt after each but the first and the last
LEAPS = 12  # of a trajectory: more than a quarter turn, with the metric of the posterior
THIN = 16  # draws for each that is kept: curved posteriors are explored slowly


class Problem(eqx.Module):
    """What is simulated: the target's data are replaced by each simulation's.

    `noise` is what is added to each channel; the target's own scales are those of the likelihood.
    """

    target: MotionPosterior
    noise: Float[Array, " last"]


@dataclasses.dataclass(frozen=True)
class Ranks:
    """Of each simulation's true coordinates among its posterior's draws.

    `rank` counts the draws below the truth, 0 to `draws`; `size` is the bulk effective size of
    the draws that were kept, for each coordinate.
    """

    rank: Int[np.ndarray, "simulations free"]
    size: Float[np.ndarray, "simulations free"]
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
    return Problem(motion_posterior(model, segments, scales), jnp.asarray(noise, pose.dtype))


def ranks_of(given: Problem, key: PRNGKeyArray, simulations: int, draws: int = 63) -> Ranks:
    """Simulate, sample and rank, all simulations side by side.

    Every posterior begins at the best of several climbs that do not know the truth, with a metric
    of its own. Raises `PalpateError` when a chain of draws is not finite.
    """
    first, second, third = jax.random.split(key, 3)
    truth, observed = _simulated(given, jax.random.split(first, simulations))
    size = truth.shape[1]
    noise = np.array(jax.random.normal(second, (simulations, STARTS, size)))
    noise[:, 0] = 0.0
    parameters = np.arange(size) < given.target.parameters
    modes = search(partial(_look, given.target, observed), noise, parameters)
    position = _sampled(given.target, observed, modes, third, draws)
    if not np.all(np.isfinite(position)):
        raise PalpateError("a posterior draw is not finite: expected a model that stays finite")
    kept = position[:, THIN - 1 :: THIN][:, :draws]
    return Ranks(
        rank=(kept < np.asarray(truth)[:, None]).sum(axis=1),
        size=np.stack([bulk_size(chain[None]) for chain in kept]),
        draws=draws,
    )


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


def _with(target: MotionPosterior, observed: Array) -> MotionPosterior:
    return eqx.tree_at(lambda t: t.segments.target, target, observed)


@eqx.filter_jit
def _simulated(given: Problem, keys: Array) -> tuple[Array, Array]:
    """True coordinates (simulations, free), and what was observed of the motions they make."""

    def one(key: PRNGKeyArray) -> tuple[Array, Array]:
        drawn, seen = jax.random.split(key)
        truth = jax.random.normal(drawn, (given.target.dimension,))
        motion = from_start(given.target.model(truth), given.target.segments)
        return truth, motion + given.noise * jax.random.normal(seen, motion.shape, motion.dtype)

    return jax.vmap(one)(keys)


@eqx.filter_jit
def _look(
    target: MotionPosterior, observed: Array, position: Float[Array, "simulations starts free"]
) -> tuple[Array, Array, Array]:
    one = lambda data, here: jax.vmap(_with(target, data).curvature)(here)  # noqa: E731
    return _divided(jax.vmap(one))(observed, position)


def _sampled(
    target: MotionPosterior, observed: Array, modes: Modes, key: PRNGKeyArray, draws: int
) -> Float[np.ndarray, "simulations steps free"]:
    """One chain for each data set, warm-up left out."""
    count, size = len(observed), target.dimension
    covariance = np.asarray(modes.covariance[:, 0], np.float64)
    state = tuple(np.asarray(x[:, 0]) for x in (modes.position, modes.density, modes.slope))
    step = np.full(count, np.log(1.2 * size**-0.25), np.float32)
    kept, recent = [], []
    for index in range(WARM_UP + -(-draws * THIN // BLOCK)):
        root = np.linalg.cholesky(covariance).astype(np.float32)
        keys = jax.random.split(jax.random.fold_in(key, index), count)
        gain = np.float32(GAIN if index < WARM_UP else 0.0)
        state, block = jax.device_get(_block(target, observed, state, root, step, keys, gain))
        if index < WARM_UP:
            step = np.median(block.step[:, BLOCK // 2 :], axis=1)
            recent = [*recent[-1:], block.position]
            if 0 < index < WARM_UP - 1:
                last = np.concatenate(recent, axis=1)
                covariance = np.stack(
                    [pooled(m[None], c) for m, c in zip(last, covariance, strict=True)]
                )
        else:
            kept.append(block.position)
    return np.concatenate(kept, axis=1)


@eqx.filter_jit
def _block(target, observed, state, root, step, keys, gain):
    def one(data, state, root, step, key):
        return chain(_with(target, data), state, root, step, key, gain, LEAPS)

    return _divided(jax.vmap(one))(observed, state, root, step, keys)


def _divided(function):
    """The function of batches with the simulations divided over the devices, if they can be."""

    def call(*batches):
        devices = jax.devices()
        if len(jax.tree.leaves(batches)[0]) % len(devices):
            return function(*batches)
        each = PartitionSpec("simulations")
        mesh = Mesh(devices, ("simulations",))
        return jax.shard_map(function, mesh=mesh, in_specs=each, out_specs=each, check_vma=False)(
            *batches
        )

    return call
