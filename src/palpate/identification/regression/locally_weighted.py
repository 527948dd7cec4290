"""Locally weighted regression, plain and object-oriented: what can be learnt without physics.

For a query x a linear function is fitted to the data around it (Atkeson, Moore and Schaal 1997,
"Locally Weighted Learning", Artificial Intelligence Review 11:11-73):

    y(x) = [1, x] (X^T W X + ridge)^-1 X^T W Y,  W = diag k(x, x_j),  k = exp(-|x - x_j|^2 / 2 h^2)

with inputs and outputs in standard deviations of the data. The nearest datum always has the weight
one, or nothing would be left of the sum far from all data; the ridge holds slopes alone, and counts
in data. Bandwidth h and ridge are those whose predictions of each datum from all others are best.

The object-oriented kind (Scholz, Levihn, Isbell and Wingate 2014, "A Physics-Based Model Prior for
Object-Oriented MDPs", ICML) is one such regression for every vector of conditions, such as what
touches what on which side. In a condition that was never seen there is no regression to ask: the
plain one, of all data, then answers. Conditions are rows of booleans that the caller makes.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from palpate.errors import PalpateError
from palpate.numerics.arrays import as_array
from palpate.numerics.small_systems import cholesky, solve_lower, solve_upper

BANDWIDTHS = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 100.0)  # standard deviations; the last is linear
RIDGES = (1e-3, 1e-1, 3.0)  # data
LEFT_OUT = 200  # data that are predicted from the others, at most
_ROUNDING = 1e-5  # of the sum of weights
_CONSTANT = 1e-6  # of the largest value: an input that varies by less says nothing


class Regression(eqx.Module):
    """Inputs in standard deviations of the data, and how questions and answers are scaled."""

    inputs: Float[Array, "*parts data inputs"]
    centre: Float[Array, "*parts inputs"]
    scale: Float[Array, "*parts inputs"]
    target_centre: Float[Array, "*parts outputs"]
    target_scale: Float[Array, "*parts outputs"]

    def _asked(self, inputs: Float[Array, "*batch inputs"]) -> Float[Array, "queries inputs"]:
        return ((inputs - self.centre) / self.scale).reshape(-1, inputs.shape[-1])

    def _answered(self, outputs: Array, inputs: Array) -> Float[Array, "*batch outputs"]:
        scaled = outputs * self.target_scale + self.target_centre
        return scaled.reshape(*inputs.shape[:-1], -1)


class LocallyWeighted(Regression):
    """Data and how far each speaks for its neighbours; made by `locally_weighted`.

    `targets` are standardised too. Places without a datum have `weight` 0; a condition of no bits
    is the plain regression.
    """

    targets: Float[Array, "*parts data outputs"]
    condition: Bool[Array, "*parts data bits"]
    weight: Float[Array, "*parts data"]
    bandwidth: Float[Array, "*parts"]
    ridge: Float[Array, "*parts"]

    @eqx.filter_jit
    def __call__(
        self, inputs: Float[Array, "*batch inputs"], condition: Bool[Array, "*batch bits"]
    ) -> Float[Array, "*batch outputs"]:
        """The prediction at each of many inputs, of the regression of their condition."""
        asked = self._asked(inputs)
        weight = self._eligible(condition.reshape(len(asked), self.condition.shape[-1]))
        weight = _kernel(_squares(asked, self.inputs), weight, self.bandwidth)
        moments = weight @ _products(self.inputs, self.targets)
        predicted = _solve(moments, asked, self.ridge, self.targets.shape[-1])
        return self._answered(predicted, inputs)

    def _eligible(self, condition: Bool[Array, "queries bits"]) -> Float[Array, "queries data"]:
        """The data of the query's condition, all data where there is none."""
        same = self.weight * _same(condition, self.condition)
        return jnp.where(jnp.any(same > 0, axis=1, keepdims=True), same, self.weight)


def locally_weighted(
    inputs: np.ndarray,
    targets: np.ndarray,
    condition: np.ndarray | None = None,
    capacity: int | None = None,
) -> LocallyWeighted:
    """Fit to data: bandwidth and ridge by leave-one-out over at most 200 of them.

    Args:
        inputs: (data, inputs), any units.
        targets: (data, outputs), any units.
        condition: (data, bits) booleans: one regression for each distinct row. None: the plain one.
        capacity: room for that many data, so that the fit to more of them compiles nothing anew.

    Raises:
        PalpateError: no data, other shapes, numbers that are not finite, or too little room.
    """
    inputs, targets, condition = check_data(inputs, targets, condition)
    count = len(inputs)
    room = count if capacity is None else capacity
    if room < count:
        raise PalpateError(f"there are {count} data, more than the capacity of {room}: enlarge it")
    dtype = jnp.zeros(()).dtype
    (centre, scale), (target_centre, target_scale) = standard(inputs), standard(targets)
    arrays = {
        "inputs": _pad((inputs - centre) / scale, room),
        "targets": _pad((targets - target_centre) / target_scale, room),
        "weight": _pad(np.ones(count), room),
        **{"centre": centre, "scale": scale, "bandwidth": 1.0, "ridge": 1.0},
        **{"target_centre": target_centre, "target_scale": target_scale},
    }
    regression = LocallyWeighted(
        condition=as_array(_pad(condition, room)),
        **{name: as_array(values, dtype) for name, values in arrays.items()},
    )
    if count == 1:
        return regression  # which has nothing to be chosen by: it predicts the one datum
    # Evenly spread over the data; padded by repetition, so that their number compiles once.
    chosen = np.linspace(0, count - 1, LEFT_OUT).round().astype(int)
    bandwidth, ridge = _chosen(regression, as_array(chosen))
    return eqx.tree_at(lambda r: (r.bandwidth, r.ridge), regression, (bandwidth, ridge))


def check_data(
    inputs: np.ndarray, targets: np.ndarray, condition: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The data of a regression in double precision, and its conditions, of no bits if None.

    Raises `PalpateError` for shapes that do not belong together and numbers that are not finite.
    """
    inputs, targets = np.asarray(inputs, np.float64), np.asarray(targets, np.float64)
    if inputs.ndim != 2 or targets.ndim != 2 or len(inputs) != len(targets) or not len(inputs):
        raise PalpateError(
            "a regression needs inputs (data, inputs) and targets (data, outputs), at least one "
            f"datum, got {inputs.shape} and {targets.shape}"
        )
    if not (np.isfinite(inputs).all() and np.isfinite(targets).all()):
        raise PalpateError("a regression needs finite numbers: leave out data with gaps")
    condition = np.zeros((len(inputs), 0), bool) if condition is None else np.asarray(condition)
    if condition.ndim != 2 or len(condition) != len(inputs) or condition.dtype != bool:
        raise PalpateError(
            f"conditions are booleans of shape ({len(inputs)}, bits), got {condition.dtype} of "
            f"shape {condition.shape}"
        )
    return inputs, targets, condition


def standard(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of each column; one for a column that is constant."""
    centre, scale = values.mean(axis=0), values.std(axis=0)
    least = _CONSTANT * np.maximum(np.abs(values).max(axis=0), _CONSTANT)
    return centre, np.where(scale > least, scale, 1.0)


def _pad(values: np.ndarray, room: int) -> np.ndarray:
    return np.concatenate([values, np.zeros((room - len(values), *values.shape[1:]), values.dtype)])


def _same(one: Array, other: Array) -> Array:
    """Which rows of booleans equal which: the bits on which they agree, counted by products."""
    a, b = one.astype(float), other.astype(float)
    agreed = a @ b.T + (1.0 - a) @ (1.0 - b).T
    return agreed > one.shape[1] - 0.5


def _squares(one: Array, other: Array) -> Array:
    """Squared distances of every row of the one from every row of the other."""
    between = jnp.sum(one**2, axis=1)[:, None] - 2.0 * one @ other.T + jnp.sum(other**2, axis=1)
    return jnp.maximum(between, 0.0)


def _kernel(squares: Array, weight: Array, bandwidth: Array) -> Array:
    nearest = jnp.min(jnp.where(weight > 0, squares, jnp.inf), axis=1, keepdims=True)
    # A datum without weight may lie nearer than the nearest: its exponent would overflow.
    return weight * jnp.exp(jnp.minimum(nearest - squares, 0.0) / (2.0 * bandwidth**2))


def _products(inputs: Array, targets: Array) -> Array:
    """What sums up to X^T W X and X^T W Y: (data, (inputs + 1) (inputs + 1 + outputs))."""
    row = jnp.concatenate([jnp.ones_like(inputs[:, :1]), inputs], axis=1)
    both = jnp.concatenate([row, targets], axis=1)
    return (row[:, :, None] * both[:, None, :]).reshape(len(inputs), -1)


def _solve(moments: Array, asked: Array, ridge: Array, outputs: int) -> Array:
    size = asked.shape[1] + 1
    moments = moments.reshape(-1, size, size + outputs)
    held = jnp.ones(size, asked.dtype).at[0].set(0.0)
    # What rounding leaves of sums over all data must not make the matrix indefinite.
    least = _ROUNDING * moments[:, :1, :1]
    matrix = moments[:, :, :size] + (ridge + least) * jnp.diag(held)
    root = cholesky(matrix)
    slopes = solve_upper(root, solve_lower(root, moments[:, :, size:]))
    return slopes[:, 0] + jnp.einsum("qi,qio->qo", asked, slopes[:, 1:])


@eqx.filter_jit
def _chosen(regression: LocallyWeighted, left_out: Array) -> tuple[Array, Array]:
    """The bandwidth and ridge that predict the data best that are left out one at a time."""
    asked, wanted = regression.inputs[left_out], regression.targets[left_out]
    others = regression.weight * (left_out[:, None] != jnp.arange(len(regression.weight)))
    same = others * _same(regression.condition[left_out], regression.condition)
    weight = jnp.where(jnp.any(same > 0, axis=1, keepdims=True), same, others)
    squares = _squares(asked, regression.inputs)
    products = _products(regression.inputs, regression.targets)

    def errors(bandwidth: Array) -> Array:
        moments = _kernel(squares, weight, bandwidth) @ products
        solve = partial(_solve, moments, asked, outputs=wanted.shape[1])
        return jnp.stack([jnp.mean((solve(ridge) - wanted) ** 2) for ridge in ridges])

    ridges = jnp.asarray(RIDGES, asked.dtype)
    bandwidths = jnp.asarray(BANDWIDTHS, asked.dtype)
    table = jax.lax.map(errors, bandwidths)
    best = jnp.argmin(jnp.where(jnp.isfinite(table), table, jnp.inf))
    return bandwidths[best // len(RIDGES)], ridges[best % len(RIDGES)]
