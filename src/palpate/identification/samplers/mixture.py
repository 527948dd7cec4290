"""A mixture of distributions fitted to draws of a posterior, that proposes others.

Normal ones are fitted, by expectation maximisation (Dempster, Laird and Rubin 1977) with the
covariances' prior of Fraley and Raftery, J. Classif. 24, 2007, here about each component's own
diagonal. What proposes has Student's distributions of the same means and shapes in their place: of
the tails few draws were seen.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.special import gammaln

from palpate.identification.samplers.draws import pooled_covariance
from palpate.numerics.arrays import as_array

COMPONENTS = 8  # at most
DEGREES = 10  # of freedom of Student's distributions
DRAWN = 10  # draws for each coordinate that a component is learnt from, at least
SHRINKAGE = 2.0  # draws for each coordinate that the diagonal counts as in a covariance
NARROWEST = 0.05  # variance of a component in that of all draws which is added to it
MOST, ROUNDS = 4000, 25  # draws that are used of all, evenly spaced; and of the maximisation


class Mixture(eqx.Module):
    """Student's distributions: logarithms of their weights, means, and roots of their scales.

    `whitening` is the inverse of the root, `log_volume` the logarithm of its determinant.
    """

    log_weight: Float[Array, " components"]
    mean: Float[Array, "components free"]
    root: Float[Array, "components free free"]
    whitening: Float[Array, "components free free"]
    log_volume: Float[Array, " components"]

    def log_density(self, position: Float[Array, " free"]) -> Float[Array, ""]:
        """Logarithm of the density at a position."""
        return jax.nn.logsumexp(self._each(position))

    def log_shares(self, position: Float[Array, " free"]) -> Float[Array, " components"]:
        """Logarithm of the probability that a draw at this position is of each component."""
        return jax.nn.log_softmax(self._each(position))

    def _each(self, position: Array) -> Array:
        white = jnp.einsum("kij,kj->ki", self.whitening, position - self.mean)
        size, half = position.size, 0.5 * (DEGREES + position.size)
        beyond = jnp.log1p(jnp.sum(jnp.square(white), axis=1) / DEGREES)
        unit = gammaln(half) - gammaln(0.5 * DEGREES) - 0.5 * size * math.log(math.pi * DEGREES)
        return self.log_weight - self.log_volume + unit - half * beyond

    def draw(
        self, which: Float[Array, ""], normal: Float[Array, " numbers"]
    ) -> Float[Array, " free"]:
        """A draw, made of one number from 0 to 1 and normal ones, `free` and `DEGREES` of them."""
        of = one_of(self.log_weight, which)
        noise, scale = jnp.split(normal, [normal.size - DEGREES])
        return self.mean[of] + self.root[of] @ noise / jnp.sqrt(jnp.mean(jnp.square(scale)))


def one_of(log_shares: Float[Array, " components"], which: Float[Array, ""]) -> Int[Array, ""]:
    """The component that a number from 0 to 1 falls to, by their shares."""
    total = jnp.cumsum(jnp.exp(log_shares))
    below = jnp.minimum(which, 1.0 - jnp.finfo(which.dtype).eps)  # it may have been rounded to 1
    return jnp.argmax(total > below * total[-1])


def fit_mixture(
    draws: Float[np.ndarray, "draws free"],
    covariance: Float[np.ndarray, "free free"],
    seed: int = 0,
) -> Mixture:
    """A mixture of as many components as the draws can tell apart.

    Of as many components whatever the draws are: those that they are too few for have no weight.
    The `covariance` that was believed in before is worth a few draws of that of all, and those of
    the components are drawn to their diagonal: both keep what few or equal draws tell regular.
    `seed` says at which of them the components begin.
    """
    flat = np.asarray(draws, np.float64)
    flat = flat[np.linspace(0, len(flat) - 1, min(len(flat), MOST)).round().astype(int)]
    count, size = flat.shape
    used = int(np.clip(count // (DRAWN * size), 1, COMPONENTS))
    centre = flat.mean(axis=0)
    whole = np.linalg.cholesky(pooled_covariance(flat, covariance))
    white = np.linalg.solve(whole, (flat - centre).T)
    begin = np.random.default_rng(seed).choice(count, used, replace=False)
    weight, mean = np.full(used, 1.0 / used), white[:, begin].T
    spread = np.tile(0.5 * np.eye(size), (used, 1, 1))
    prior = SHRINKAGE * size
    for _ in range(ROUNDS if used > 1 else 1):
        share = _logarithms(white, weight, mean, spread)
        share = np.exp(share - share.max(axis=0))
        share /= share.sum(axis=0)
        of = share.sum(axis=1) + 1e-9
        weight = (of + 1.0) / (of.sum() + used)
        mean = (share @ white.T) / of[:, None]
        second = (share[:, None] * white).reshape(-1, count) @ white.T
        # About its mean: the draws are white, so that nothing cancels.
        scatter = second.reshape(spread.shape) - of[:, None, None] * _outer_products(mean)
        diagonal = np.einsum("kii->ki", scatter) / of[:, None] + NARROWEST
        spread = scatter + prior * np.einsum("ki,ij->kij", diagonal, np.eye(size))
        spread = spread / (of + prior)[:, None, None]
    root = whole @ np.linalg.cholesky(spread)
    more = COMPONENTS - used
    log_weight = np.concatenate([np.log(weight), np.full(more, -np.inf)])
    mean = np.concatenate([mean @ whole.T + centre, np.tile(centre, (more, 1))])
    root = np.concatenate([root, np.tile(whole, (more, 1, 1))])
    volume = np.log(np.einsum("kii->ki", root)).sum(axis=1)
    parts = log_weight, mean, root, np.linalg.inv(root), volume
    return Mixture(*(as_array(part, jnp.zeros(()).dtype) for part in parts))


def _outer_products(vectors: Float[np.ndarray, "components free"]) -> np.ndarray:
    """Their outer products with themselves."""
    return vectors[:, :, None] * vectors[:, None, :]


def _logarithms(white: np.ndarray, weight, mean, covariance) -> np.ndarray:
    """Logarithms of weight times density, (components, draws), but for what all have in common.

    `white` is (free, draws): one product of matrices is for all components, and sums run over
    whole rows.
    """
    root = np.linalg.cholesky(covariance)
    whitening = np.linalg.inv(root)
    volume = np.log(np.einsum("kii->ki", root)).sum(axis=1)
    off = whitening.reshape(-1, len(white)) @ white
    off -= (whitening @ mean[..., None]).reshape(-1, 1)
    squared = np.square(off, out=off).reshape(*mean.shape, -1).sum(axis=1)
    return (np.log(weight) - volume)[:, None] - 0.5 * squared
