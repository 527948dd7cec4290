"""Small systems solved side by side are those that LAPACK solves one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.numerics.small_systems import cholesky, solve, solve_lower, solve_upper


def _systems(count: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    factor = random.normal(size=(count, size, size))
    matrices = factor @ np.swapaxes(factor, 1, 2) + np.eye(size)
    return matrices.astype(np.float32), random.normal(size=(count, size, 3)).astype(np.float32)


@pytest.mark.parametrize("size", [1, 6, 20])
def test_solutions_are_lapacks(size):
    matrices, right = _systems(7, size)
    right = jnp.asarray(right)
    root = cholesky(jnp.asarray(matrices))
    np.testing.assert_allclose(root, np.linalg.cholesky(matrices), rtol=2e-4, atol=2e-4)
    np.testing.assert_allclose(root @ solve_lower(root, right), right, rtol=1e-3, atol=1e-3)
    transposed = np.swapaxes(np.asarray(root), 1, 2)
    np.testing.assert_allclose(transposed @ solve_upper(root, right), right, rtol=1e-3, atol=1e-3)
    expected = np.linalg.solve(matrices.astype(float), np.asarray(right, float))[..., 0]
    np.testing.assert_allclose(solve(root, right[..., 0]), expected, rtol=5e-3, atol=5e-3)


def test_derivatives_are_those_of_closed_forms():
    matrices, right = _systems(1, 4)
    matrix, right = jnp.asarray(matrices[0]), jnp.asarray(right[0, :, 0])

    def energy(matrix: jax.Array) -> jax.Array:
        half = solve_lower(cholesky(matrix), right[:, None])
        return jnp.sum(jnp.square(half))

    slope = jax.grad(energy)(matrix)
    solved = np.linalg.solve(matrices[0], np.asarray(right))
    symmetric = 0.5 * (slope + slope.T)
    np.testing.assert_allclose(symmetric, -np.outer(solved, solved), rtol=1e-3, atol=1e-4)


def test_many_at_once_within_a_loop_come_to_an_end():
    # LAPACK's calls wait for each other here, for ever, where there are few cores
    matrices, right = _systems(3000, 12)

    @jax.jit
    def repeated(matrices: jax.Array, right: jax.Array) -> jax.Array:
        def again(total: jax.Array, _: None) -> tuple[jax.Array, None]:
            once = solve_lower(cholesky(matrices), total)
            twice = solve_lower(cholesky(2.0 * matrices), total)
            return right + 1e-3 * (once + twice), None

        return jax.lax.scan(again, right, length=4)[0]

    assert np.all(np.isfinite(repeated(jnp.asarray(matrices), jnp.asarray(right))))


def test_what_is_not_positive_definite_is_not_finite():
    assert not np.all(np.isfinite(cholesky(-jnp.eye(3))))
