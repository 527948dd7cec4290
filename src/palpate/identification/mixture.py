"""A mixture of normal distributions fitted to draws of a posterior, that proposes others.

Expectation maximisation (Dempster, Laird and Rubin 1977) with the covariances' prior of Fraley and
Raftery, J. Classif. 24, 2007, here about each component's own diagonal.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import logsumexp

from palpate.identification.draws import pooled

COMPONENTS = 8  # at most
DRAWN = 10  # draws for each coordinate that a component is learnt from, at least
SHRINKAGE = 2.0  # draws for each coordinate that the diagonal counts as in a covariance
NARROWEST = 0.05  # variance of a component in that of all draws which is added to it
MOST, ROUNDS = 1500, 40  # draws that are used of all, evenly spaced; and of the maximisation


class Mixture(eqx.Module):
    """Normal distributions: logarithms of their weights, means, and roots of their covariances.

    `whitening` is the inverse of the root, `log_volume` the logarithm of its determinant.
    """

    log_weight: Float[Array, " components"]
    mean: Float[Array, "components free"]
    root: Float[Array, "components free free"]
    whitening: Float[Array, "components free free"]
    log_volume: Float[Array, " components"]

    def log_density(self, position: Float[Array, " free"]) -> Float[Array, ""]:
        """Logarithm of the density at a position."""
        white = jnp.einsum("kij,kj->ki", self.whitening, position - self.mean)
        square = jnp.sum(jnp.square(white), axis=1) + position.size * jnp.log(2.0 * jnp.pi)
        return jax.nn.logsumexp(self.log_weight - self.log_volume - 0.5 * square)

    def draw(self, key: Array, count: int) -> Float[Array, "count free"]:
        """Independent draws."""
        which, where = jax.random.split(key)
        chosen = jax.random.categorical(which, self.log_weight, shape=(count,))
        noise = jax.random.normal(where, (count, self.mean.shape[1]), self.mean.dtype)
        return self.mean[chosen] + jnp.einsum("nij,nj->ni", self.root[chosen], noise)


def fit_mixture(
    draws: Float[np.ndarray, "draws free"],
    covariance: Float[np.ndarray, "free free"],
    seed: int = 0,
) -> Mixture:
    """A mixture of as many normals as the draws can tell apart, by expectation maximisation.

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
    whole = np.linalg.cholesky(pooled(flat, covariance))
    white = np.linalg.solve(whole, (flat - centre).T).T
    begin = np.random.default_rng(seed).choice(count, used, replace=False)
    weight, mean = np.full(used, 1.0 / used), white[begin]
    spread = np.tile(0.5 * np.eye(size), (used, 1, 1))
    prior = SHRINKAGE * size
    for _ in range(ROUNDS if used > 1 else 1):
        each = _each(white, weight, mean, spread)
        share = np.exp(each - logsumexp(each, axis=1, keepdims=True))
        of = share.sum(axis=0) + 1e-9
        weight = (of + 1.0) / (of.sum() + used)
        mean = (share.T @ white) / of[:, None]
        off = white[None] - mean[:, None]
        scatter = np.einsum("nk,kni,knj->kij", share, off, off, optimize=True)
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
    return Mixture(*(jnp.asarray(part, jnp.zeros(()).dtype) for part in parts))


def _each(white: np.ndarray, weight, mean, covariance) -> np.ndarray:
    """Logarithms of weight times density of each component, without what all have in common."""
    found = []
    for share, centre, spread in zip(weight, mean, covariance, strict=True):
        root = np.linalg.cholesky(spread)
        off = np.linalg.solve(root, (white - centre).T)
        volume = np.log(np.diagonal(root)).sum()
        found.append(np.log(share) - volume - 0.5 * np.square(off).sum(axis=0))
    return np.stack(found, axis=1)
