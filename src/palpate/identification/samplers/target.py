"""What samplers sample: an unnormalised posterior in whitened coordinates."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Target(eqx.Module):
    """A posterior whose prior is N(0, 1) in each of its coordinates.

    A frozen pytree: data and structure are arrays in it, so that another data set of the same
    shapes compiles nothing anew, and a leading batch axis of a batch of them serves `vmap`.
    """

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """What each coordinate is, in order."""

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return len(self.names)

    @abstractmethod
    def log_likelihood(self, position: Float[Array, " free"]) -> Float[Array, ""]:
        """Logarithm of the data's density given the coordinates; may be NaN where it fails."""

    def density(self, position: Float[Array, " free"]) -> Float[Array, ""]:
        """Logarithm of likelihood times prior, minus infinity where it is not finite.

        The prior's normalisation is in it.
        """
        return self._density(self.log_likelihood(position), position)

    def _density(self, log_likelihood: Array, position: Array) -> Array:
        value = log_likelihood + log_prior(position)
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)

    def densities(self, positions: Float[Array, "batch free"]) -> Float[Array, " batch"]:
        """`density` at several positions; a target may have a faster way than one by one."""
        return jax.vmap(self.density)(positions)

    def curvatures(self, positions: Float[Array, "batch free"]) -> tuple[Array, Array, Array]:
        """`curvature` at several positions."""
        return jax.vmap(self.curvature)(positions)

    def curvature(self, position: Float[Array, " free"]) -> tuple[Array, Array, Array]:
        """The density, its slope, and a positive definite curvature of minus its logarithm.

        Here the Hessian of minus the log-likelihood with its eigenvalues made positive (Betancourt,
        arXiv 1212.4693, without softening), and the prior's identity added.
        """
        value, slope = jax.value_and_grad(self.density)(position)
        values, vectors = jnp.linalg.eigh(-jax.hessian(self.log_likelihood)(position))
        return value, slope, (vectors * (jnp.abs(values) + 1.0)) @ vectors.T


def log_prior(position: Float[Array, "*batch free"]) -> Float[Array, "*batch"]:
    """Logarithm of the standard normal density."""
    square = jnp.sum(jnp.square(position), axis=-1)
    return -0.5 * square - 0.5 * position.shape[-1] * jnp.log(2.0 * jnp.pi)
