"""Tempered sequential Monte Carlo: posteriors with several modes, and the evidence for a model.

Particles begin as draws of the prior and pass through densities prior x likelihood^t, t from 0 to
1. Each t is chosen so that half of the particles keep their effective number (Jasra, Stephens,
Doucet and Tsagaris, Scand. J. Stat. 38, 2011); then they are resampled and moved by Metropolis
steps of the shape of their own covariance (Chopin, Biometrika 89, 2002). The means of the weights
multiply to the evidence, the data's density under the model (Del Moral, Doucet and Jasra, J. R.
Stat. Soc. B 68, 2006).
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.identification.posterior.laplace import Modes
from palpate.identification.samplers.draws import Draws
from palpate.identification.samplers.target import Target, log_prior
from palpate.runs.progress import Watch, without_progress

KEPT = 0.5  # share of the particles that one change of temperature may leave effective
LONGEST = 200  # temperatures
ACCEPTANCE = 0.3
FEWEST = 2  # draws of the prior whose likelihood is finite: all copies of one never part
BISECTIONS = 24
IMPOSSIBLE = -1e30  # a log-likelihood that is not finite, as a number that survives arithmetic


class Particles(eqx.Module):
    """Equally weighted particles of a posterior, and the logarithm of the data's density.

    `temperature` is 1 when all of the data count; below it, the schedule ran out of `LONGEST`
    temperatures. `scale` is the length of the last Metropolis steps in posterior deviations,
    `acceptance` their rate, and `evaluations` how many densities were computed.
    """

    position: Float[Array, "particles free"]
    likelihood: Float[Array, " particles"]
    evidence: Float[Array, ""]
    temperature: Float[Array, ""]
    scale: Float[Array, ""]
    acceptance: Float[Array, ""]
    evaluations: Int[Array, ""]


def temper(target: Target, key: PRNGKeyArray, particles: int = 512, moves: int = 10) -> Particles:
    """Particles of the target's posterior, from its prior.

    `moves` Metropolis steps are made at each temperature. Raises `PalpateError` when fewer than
    two particles have a finite likelihood, or when the temperatures run out.
    """
    return _check(*_temper(target, key, particles, moves))


def populations(
    target: Target,
    modes: Modes,
    key: PRNGKeyArray,
    chains: int,
    draws: int,
    watch: Watch = without_progress,
) -> Draws:
    """As many independent populations as `chains`, of as many particles each as `draws`.

    They begin at draws of the prior and know nothing of the `modes`. `watch` goes through them.
    Raises as `temper`.
    """
    began, spent, found = time.monotonic(), [], []
    for one in watch(list(jax.random.split(key, chains))):
        now = time.monotonic()
        found.append(jax.device_get(temper(target, one, draws)))
        spent.append(time.monotonic() - now)
    position = np.stack([of.position for of in found])
    prior = np.asarray(log_prior(jnp.asarray(position)))
    return Draws(
        position=position,
        density=np.stack([of.likelihood for of in found]) + prior,
        acceptance=np.array([float(of.acceptance) for of in found]),
        divergences=0,
        evaluations=sum(int(of.evaluations) for of in found),
        seconds=time.monotonic() - began,
        compiling=max(0.0, spent[0] - min(spent)),
    )


def _check(particles: Particles, possible: Int[Array, ""]) -> Particles:
    """The particles, if so many draws of the prior were `possible` that there are any to trust."""
    temperature = float(particles.temperature)
    if int(possible) < FEWEST:
        raise PalpateError(
            "hardly any draw of the prior has a finite likelihood: expected a model that can "
            "predict the data somewhere; declare narrower priors, or check the data"
        )
    if temperature < 1.0:
        raise PalpateError(
            f"after {LONGEST} temperatures only {temperature:.2g} of the data count: "
            "take more particles or moves, or larger noise scales"
        )
    return particles


@eqx.filter_jit
def _temper(
    target: Target, key: PRNGKeyArray, particles: int, moves: int
) -> tuple[Particles, Array]:
    """The particles, and how many of the first had a finite likelihood; too few are left there."""
    likelihoods = jax.vmap(lambda p: finite(target.log_likelihood(p)))
    first, key = jax.random.split(key)
    position = jax.random.normal(first, (particles, target.dimension))
    zero = jnp.zeros((), position.dtype)
    count = jnp.asarray(particles)
    begin = Particles(position, likelihoods(position), zero, zero, zero + 0.5, zero, count)
    possible = jnp.sum(begin.likelihood > IMPOSSIBLE)

    def unfinished(carry) -> Bool[Array, ""]:
        index, state, _ = carry
        return (state.temperature < 1.0) & (index < LONGEST) & (possible >= FEWEST)

    def cool(carry):
        index, state, key = carry
        key, resampling, moving = jax.random.split(key, 3)
        change = next_change(state.likelihood, 1.0 - state.temperature)
        weight = change * state.likelihood
        gain = jax.nn.logsumexp(weight) - jnp.log(float(particles))
        temperature = jnp.where(change >= 1.0 - state.temperature, 1.0, state.temperature + change)
        covariance = weighted_covariance(state.position, jax.nn.softmax(weight))
        chosen = systematic(resampling, weight)
        position, likelihood, scale, acceptance = move(
            likelihoods, state.position[chosen], state.likelihood[chosen],
            temperature, covariance, state.scale, moving, moves,
        )  # fmt: skip
        state = Particles(
            position, likelihood, state.evidence + gain, temperature, scale, acceptance,
            state.evaluations + moves * particles,
        )  # fmt: skip
        return index + 1, state, key

    return jax.lax.while_loop(unfinished, cool, (0, begin, key))[1], possible


def move(
    likelihoods,
    position: Float[Array, "particles free"],
    likelihood: Float[Array, " particles"],
    temperature: Float[Array, ""],
    covariance: Float[Array, "free free"],
    scale: Float[Array, ""],
    key: PRNGKeyArray,
    moves: int,
) -> tuple[Array, Array, Array, Array]:
    """Metropolis steps that leave prior x likelihood^temperature as it is.

    `scale` times the covariance's root is a step's length; it is steered to an acceptance of 0.3
    between the steps. No step is to where the likelihood is `IMPOSSIBLE`, not even from there.
    Returns positions, their likelihoods, the scale and the mean acceptance.
    """
    size = position.shape[1]
    regular = covariance + 1e-6 * jnp.eye(size)
    root = jnp.linalg.cholesky(regular)

    def density(position: Array, likelihood: Array) -> Array:
        return temperature * likelihood - 0.5 * jnp.sum(jnp.square(position), axis=-1)

    def step(carry, key):
        position, likelihood, scale = carry
        noise, coin = jax.random.split(key)
        change = jax.random.normal(noise, position.shape, position.dtype) @ root.T
        proposed = position + scale * 2.38 / jnp.sqrt(1.0 * size) * change
        after = likelihoods(proposed)
        ratio = density(proposed, after) - density(position, likelihood)
        accepted = jnp.log(jax.random.uniform(coin, ratio.shape, ratio.dtype)) < ratio
        # Beside such a number the prior is lost: from one to another every step would be accepted.
        accepted &= after > IMPOSSIBLE
        position = jnp.where(accepted[:, None], proposed, position)
        rate = jnp.mean(accepted.astype(position.dtype))
        scale = jnp.clip(scale * jnp.exp(rate - ACCEPTANCE), 1e-3, 2.0)
        return (position, jnp.where(accepted, after, likelihood), scale), rate

    keys = jax.random.split(key, moves)
    (position, likelihood, scale), rates = jax.lax.scan(step, (position, likelihood, scale), keys)
    return position, likelihood, scale, jnp.mean(rates)


def finite(likelihood: Array) -> Array:
    """The log-likelihood, `IMPOSSIBLE` where it is not finite."""
    return jnp.where(jnp.isfinite(likelihood), likelihood, IMPOSSIBLE)


def systematic(
    key: PRNGKeyArray, log_weight: Float[Array, " particles"]
) -> Int[Array, " particles"]:
    """Indices of resampled particles, by one uniform number (Kitagawa 1996)."""
    count = log_weight.shape[0]
    cumulative = jnp.cumsum(jax.nn.softmax(log_weight))
    points = (jax.random.uniform(key) + jnp.arange(count)) / count
    return jnp.clip(jnp.searchsorted(cumulative, points * cumulative[-1]), 0, count - 1)


def effective_share(log_weight: Float[Array, " particles"]) -> Float[Array, ""]:
    """Effective sample size of weights over their number, 1 / (n sum w^2)."""
    weight = jax.nn.softmax(log_weight)
    return 1.0 / (jnp.sum(jnp.square(weight)) * log_weight.shape[0])


def weighted_covariance(position: Array, weight: Array) -> Array:
    """Of particles (particles, free) with weights that add up to one."""
    centred = position - weight @ position
    return (centred * weight[:, None]).T @ centred


def next_change(likelihood: Float[Array, " particles"], left: Float[Array, ""]) -> Float[Array, ""]:
    """The change of temperature that leaves the effective share `KEPT`, or all that is left.

    Bisected in the logarithm: the first changes are smaller than the last by orders of magnitude.
    """

    def halve(_, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = 0.5 * (low + high)
        kept = effective_share(jnp.exp(middle) * likelihood) >= KEPT
        return jnp.where(kept, middle, low), jnp.where(kept, high, middle)

    begin = jnp.log(left) - 40.0, jnp.log(left)
    low, _ = jax.lax.fori_loop(0, BISECTIONS, halve, begin)
    return jnp.where(effective_share(left * likelihood) >= KEPT, left, jnp.exp(low))
