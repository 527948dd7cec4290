"""Symmetric positive definite systems of a few unknowns, thousands side by side.

JAX hands such batches to LAPACK on the threads that also run the rest of the program, which can
wait for each other for ever (seen with JAX 0.10 on two cores). These are loops over columns.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.jit
def cholesky(matrix: Float[Array, "*batch size size"]) -> Float[Array, "*batch size size"]:
    """Lower triangular L with L L' = `matrix`; not finite where that is not positive definite."""
    rows = jnp.arange(matrix.shape[-1])

    def eliminate(rest: Array, index: Array) -> tuple[Array, Array]:
        column = jnp.take(rest, index, axis=-1)
        pivot = jnp.take(column, index, axis=-1)[..., None]
        column = jnp.where(rows >= index, column, 0.0) / jnp.sqrt(pivot)
        return rest - column[..., :, None] * column[..., None, :], column

    _, columns = jax.lax.scan(eliminate, matrix, rows)
    return jnp.moveaxis(columns, 0, -1)


def solve_lower(
    root: Float[Array, "*batch size size"], right: Float[Array, "*batch size columns"]
) -> Float[Array, "*batch size columns"]:
    """L^-1 `right` for a lower triangular L."""
    return _substitute(root, right, backwards=False)


def solve_upper(
    root: Float[Array, "*batch size size"], right: Float[Array, "*batch size columns"]
) -> Float[Array, "*batch size columns"]:
    """L'^-1 `right` for a lower triangular L."""
    return _substitute(jnp.swapaxes(root, -1, -2), right, backwards=True)


def solve(
    root: Float[Array, "*batch size size"], right: Float[Array, "*batch size"]
) -> Float[Array, "*batch size"]:
    """(L L')^-1 `right` for a lower triangular L."""
    return solve_upper(root, solve_lower(root, right[..., None]))[..., 0]


@functools.partial(jax.jit, static_argnames="backwards")
def _substitute(triangle: Array, right: Array, backwards: bool) -> Array:
    """Solve for one unknown after another, the last one first if `backwards`."""

    def substitute(rest: Array, index: Array) -> tuple[Array, Array]:
        column = jnp.take(triangle, index, axis=-1)
        found = jnp.take(rest, index, axis=-2)
        found = found / jnp.take(column, index, axis=-1)[..., None]
        return rest - column[..., :, None] * found[..., None, :], found

    order = jnp.arange(triangle.shape[-1])
    _, found = jax.lax.scan(substitute, right, order, reverse=backwards)
    return jnp.moveaxis(found, 0, -2)
