"""Gaussian-process regression, exact: predictions with a variance, without physics.

Rasmussen and Williams 2006, "Gaussian Processes for Machine Learning", chapters 2 and 5: each
output, in standard deviations of the data, is a Gaussian process of its own with mean zero and

    k(x, x') = v^2 x . x' + s^2 exp(-1/2 sum_d (x_d - x'_d)^2 / l_d^2) + noise^2 [x is x']

whose v, s, length of each input (automatic relevance determination) and noise are those of the
greatest marginal likelihood, by L-BFGS from two beginnings. The linear term is for what motion over
a short time is nearly, so that the other need not stand for it by a length beyond all data.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.identification.regression.locally_weighted import Regression, check_data, standard
from palpate.numerics.arrays import as_array

LARGEST = 2000  # data: time grows with the cube of their number
_LENGTHS = 1.0, 8.0  # standard deviations, where the two descents begin
# Least and largest, in standard deviations of the output and of the inputs: single precision has
# to tell what is predicted from what cancels.
_SIZE, _NOISE, _SLOPE, _LENGTH = (1e-2, 10.0), (3e-3, 3.0), (1e-2, 10.0), (1e-2, 100.0)
_ITERATIONS = 100


class GaussianProcess(Regression):
    """Data, what they were fitted with, and their covariance solved; made by `gaussian_process`.

    For each output `solved` is K^-1 y, `whitener` the inverse of K's Cholesky factor, and `linear`
    the slopes that the linear term comes to.
    """

    length: Float[Array, "*parts outputs inputs"]
    size: Float[Array, "*parts outputs"]
    noise: Float[Array, "*parts outputs"]
    slope: Float[Array, "*parts outputs"]
    linear: Float[Array, "*parts outputs inputs"]
    solved: Float[Array, "*parts outputs data"]
    whitener: Float[Array, "*parts outputs data data"]

    def __call__(
        self, inputs: Float[Array, "*batch inputs"], condition: Array | None = None
    ) -> Float[Array, "*batch outputs"]:
        """The posterior's mean. A Gaussian process has no use for conditions."""
        asked = self._asked(inputs)
        mean = jnp.einsum("oqn,on->qo", self._near(asked), self.solved) + asked @ self.linear.T
        return self._answered(mean, inputs)

    def variance(self, inputs: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """The posterior's variance of a new observation, noise included, in the target's unit^2."""
        asked = self._asked(inputs)
        far = self.slope[:, None, None] ** 2 * (asked @ self.inputs.T)
        whitened = jnp.einsum("oij,oqj->oqi", self.whitener, self._near(asked) + far)
        before = self.size[:, None] ** 2 + self.slope[:, None] ** 2 * jnp.sum(asked**2, axis=1)
        left = jnp.maximum(before - jnp.sum(whitened**2, axis=2), 0.0) + self.noise[:, None] ** 2
        return (left.T * self.target_scale**2).reshape(*inputs.shape[:-1], -1)

    def _near(self, asked: Array) -> Array:
        """The squared exponential of every query and every datum, for each output."""

        def of(length: Array, size: Array) -> Array:
            # Differences first: the square of a sum would lose what the solved data cancel.
            between = (asked[:, None] - self.inputs) / length
            return size**2 * jnp.exp(-0.5 * jnp.sum(between**2, axis=-1))

        return jax.vmap(of)(self.length, self.size)


def gaussian_process(inputs: np.ndarray, targets: np.ndarray) -> GaussianProcess:
    """Fit to data, in double precision.

    Args:
        inputs: (data, inputs), any units.
        targets: (data, outputs), any units.

    Raises:
        PalpateError: no data, more than 2000, other shapes, or numbers that are not finite.
    """
    inputs, targets, _ = check_data(inputs, targets)
    if len(inputs) > LARGEST:
        raise PalpateError(
            f"an exact Gaussian process of {len(inputs)} data takes too long: expected at most "
            f"{LARGEST}, for instance every {-(-len(inputs) // LARGEST)}th"
        )
    centre, scale = standard(inputs)
    target_centre, target_scale = standard(targets)
    x = (inputs - centre) / scale
    processes = [_process(x, y) for y in ((targets - target_centre) / target_scale).T]
    shared = x, centre, scale, target_centre, target_scale
    dtype = jnp.zeros(()).dtype
    fields = *shared, *(np.stack(values) for values in zip(*processes, strict=True))
    return GaussianProcess(*(as_array(values, dtype) for values in fields))


def _process(x: np.ndarray, y: np.ndarray) -> tuple[Any, ...]:
    """Length, size, noise, slope, linear, solved and whitener of one output."""
    squares, products = (x[:, None] - x) ** 2, x @ x.T
    free = _fit(squares, products, y)
    size, noise, slope = np.exp(free[:3])
    near, far = _kernels(free, squares, products)
    factor = np.linalg.cholesky(near + far + noise**2 * np.eye(len(y)))
    whitener = scipy.linalg.solve_triangular(factor, np.eye(len(y)), lower=True)
    solved = whitener.T @ (whitener @ y)
    return np.exp(free[3:]), size, noise, slope, slope**2 * x.T @ solved, solved, whitener


def log_marginal_likelihood(
    free: np.ndarray, squares: np.ndarray, products: np.ndarray, y: np.ndarray
) -> tuple[float, np.ndarray]:
    """ln p(y | x) and its gradient (Rasmussen and Williams, equations 5.8 and 5.9).

    `free` is ln (size, noise, slope, lengths ...), `squares` the squared differences of the inputs
    (data, data, inputs), `products` their inner products (data, data).
    """
    near, far = _kernels(free, squares, products)
    noise = np.exp(2 * free[1])
    factor = scipy.linalg.cho_factor(near + far + noise * np.eye(len(y)), lower=True)
    solved = scipy.linalg.cho_solve(factor, y)
    value = -0.5 * y @ solved - np.log(np.diag(factor[0])).sum() - 0.5 * len(y) * np.log(2 * np.pi)
    inner = np.outer(solved, solved) - scipy.linalg.cho_solve(factor, np.eye(len(y)))
    shared = inner * near
    sizes = shared.sum(), noise * np.trace(inner), (inner * far).sum()
    lengths = 0.5 * np.tensordot(shared, squares, axes=2) * np.exp(-2 * free[3:])
    return value, np.concatenate([sizes, lengths])


def _kernels(
    free: np.ndarray, squares: np.ndarray, products: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The squared exponential and the linear covariance, without noise."""
    near = np.exp(2 * free[0] - 0.5 * squares @ np.exp(-2 * free[3:]))
    return near, np.exp(2 * free[2]) * products


def _fit(squares: np.ndarray, products: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The hyper-parameters of the greatest marginal likelihood, as their logarithms."""

    def loss(free: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = log_marginal_likelihood(free, squares, products, y)
        return -value, -slope

    inputs = squares.shape[2]
    bounds = np.log([_SIZE, _NOISE, _SLOPE, *[_LENGTH] * inputs])
    found = [
        scipy.optimize.minimize(
            loss,
            np.log([0.5, 0.1, 0.5, *[length] * inputs]),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": _ITERATIONS},
        )
        for length in _LENGTHS
    ]
    return min(found, key=lambda one: one.fun).x
