"""Least squares through a model: normal equations by forward mode, damped steps, intervals.

With few parameters and many residuals the Jacobian is taken column by column in forward mode and
only J^T J is kept: memory does not grow with the recording.
"""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from palpate.identification.data.prediction import Windows, WindowSource, residuals
from palpate.identification.verdicts import UNDECIDED, verdict
from palpate.parameters import FreeParameters, value_of
from palpate.recordings import Aligned

Free = dict[str, Array]

GROUP = 4  # windows whose Jacobians are held at a time
BLOCKS = 10  # pieces of a trial whose scores are taken as independent of one another
QUANTILE = 1.6449  # of the normal distribution: 90 % within


class System(eqx.Module):
    """Gauss-Newton quantities at some free values, in flat whitened coordinates."""

    matrix: Float[Array, "free free"]  # J^T W J
    gradient: Float[Array, " free"]  # J^T W r
    scores: Float[Array, "blocks free"]  # J^T W r over each piece of each trial
    squares: Float[Array, ""]  # sum of squared residuals
    count: Float[Array, ""]  # residuals seen


@dataclasses.dataclass(frozen=True)
class NormalEquations:
    """Normal equations of the residuals over `scale`, reweighted beyond `knee` (pseudo-Huber).

    A `knee` of None gives plain least squares.
    """

    coordinates: FreeParameters
    scale: float
    knee: float | None = None

    def at(self, free: Free, windows: Windows) -> System:
        """Assemble over all windows, a few at a time."""
        flat, unravel = ravel_pytree(free)
        parts = [
            _assemble(
                self.coordinates,
                unravel,
                flat,
                jax.tree.map(lambda x, f=first: x[f : f + GROUP], windows),
                self.scale,
                self.knee,
            )
            for first in range(0, windows.start.shape[0], GROUP)
        ]
        return functools.reduce(_add, parts)

    def step(self, free: Free, damping: Array, windows: Windows, prior_weight: float):
        """A damped Gauss-Newton step: new free values, new damping, and the loss before.

        The prior counts `prior_weight` per residual, as in the loss. Refused steps return the old
        free values and ten times the damping.
        """
        system = self.at(free, windows)
        flat, unravel = ravel_pytree(free)
        count = np.asarray(system.count, np.float64)
        weight = prior_weight * count
        matrix = np.asarray(system.matrix, np.float64) + weight * np.eye(flat.size)
        gradient = np.asarray(system.gradient, np.float64) + weight * np.asarray(flat)
        diagonal = np.diag(np.diag(matrix) + 1e-12)
        change = np.linalg.solve(matrix + float(damping) * diagonal, -gradient)
        proposal = self.coordinates.project(unravel(flat + jnp.asarray(change, flat.dtype)))
        before = self._loss(free, windows, prior_weight)
        after = self._loss(proposal, windows, prior_weight)
        if np.isfinite(after) and after < before:
            return proposal, jnp.maximum(damping / 3.0, 1e-7), before
        return free, jnp.minimum(damping * 10.0, 1e7), before

    def _loss(self, free: Free, windows: Windows, prior_weight: float) -> Array:
        mean = _loss(self.coordinates, free, windows, self.scale, self.knee)
        return mean + prior_weight * self.coordinates.penalty(free)


def pseudo_huber(relative: Array, knee: float) -> Array:
    """Quadratic (1/2 r^2) for small residuals, linear beyond the knee."""
    return knee * (jnp.sqrt(jnp.square(relative) + knee**2) - knee)


def mean_loss(
    coordinates: FreeParameters, free: Free, windows: Windows, scale: float, knee: float | None
) -> Float[Array, ""]:
    """Mean over what was seen of half the squared relative residual, pseudo-Huber with a knee."""
    relative = residuals(coordinates.build(free), windows) / scale
    each = 0.5 * jnp.square(relative) if knee is None else pseudo_huber(relative, knee)
    return jnp.sum(each) / jnp.maximum(jnp.sum(windows.seen), 1)


_loss = eqx.filter_jit(mean_loss)


@eqx.filter_jit
def _assemble(coordinates, unravel, flat: Array, windows: Windows, scale, knee) -> System:
    def relative(flat: Array) -> Array:
        return residuals(coordinates.build(unravel(flat)), windows) / scale

    residual = relative(flat)
    _, push = jax.linearize(relative, flat)
    columns = jax.vmap(push)(jnp.eye(flat.size, dtype=flat.dtype))
    weight = jnp.ones_like(residual)
    if knee is not None:
        weight = knee / jnp.sqrt(jnp.square(residual) + knee**2)
    weight = jnp.where(windows.seen, weight, 0.0)
    count, time = residual.shape[:2]
    weighted = (columns * weight).reshape(flat.size, -1)
    pieces = jnp.pad(
        columns * (weight * residual),
        [(0, 0), (0, 0), (0, -time % BLOCKS)] + [(0, 0)] * (residual.ndim - 2),
    ).reshape(flat.size, count * BLOCKS, -1)
    return System(
        matrix=weighted @ columns.reshape(flat.size, -1).T,
        gradient=weighted @ residual.reshape(-1),
        scores=pieces.sum(-1).T,
        squares=jnp.sum(jnp.where(windows.seen, jnp.square(residual), 0.0)),
        count=jnp.sum(windows.seen).astype(flat.dtype),
    )


def _add(one: System, other: System) -> System:
    return System(
        one.matrix + other.matrix,
        one.gradient + other.gradient,
        jnp.concatenate([one.scores, other.scores]),
        one.squares + other.squares,
        one.count + other.count,
    )


@dataclasses.dataclass(frozen=True)
class Intervals:
    """90 % intervals of the free parameters and what the data could not tell.

    `lower` and `upper` by parameter path, in its unit and shape; `verdict` a sentence or None;
    `warnings` about combinations of parameters.
    """

    lower: dict[str, Array]
    upper: dict[str, Array]
    verdict: dict[str, str | None]
    warnings: tuple[str, ...]


def intervals(coordinates: FreeParameters, free: Free, aligned: Aligned) -> Intervals:
    """Gauss-Newton intervals of a fit, in the sandwich form that forgives correlated residuals.

    With A = J^T J / s^2 + 1 (the prior's precision is one in whitened coordinates) and the scores
    g_b = J^T r / s^2 over a tenth of a trial each, the covariance is A^-1 (sum g_b g_b^T + 1) A^-1
    (Huber 1967; White 1982): residuals next to each other in time are not counted as independent
    evidence. Never below the covariance A^-1 of independent noise.
    """
    windows = WindowSource.of(aligned).whole()
    system = NormalEquations(coordinates, 1.0).at(free, windows)
    flat, unravel = ravel_pytree(free)
    noise = float(system.squares) / max(float(system.count) - flat.size, 1.0)
    noise = max(noise, 1e-20)
    identity = np.eye(flat.size)
    information = np.asarray(system.matrix, np.float64) / noise
    scores = np.asarray(system.scores, np.float64) / noise
    precision = information + identity
    inverse = np.linalg.inv(precision)
    sandwich = inverse @ (scores.T @ scores + identity) @ inverse
    # Scores that a few blocks dominate can exceed what was believed before any data: no more than
    # the prior's variance, which is one.
    variance = np.minimum(np.maximum(np.diag(sandwich), np.diag(inverse)), 1.0)
    deviation = unravel(jnp.asarray(np.sqrt(variance), flat.dtype))
    lower, upper, verdicts = {}, {}, {}
    for path, declaration in coordinates.declarations.items():
        reference = value_of(coordinates.reference, path)
        low, high = (
            jnp.broadcast_to(
                declaration.prior.to_value(free[path] + sign * deviation[path], reference),
                reference.shape,
            )
            for sign in (-QUANTILE, QUANTILE)
        )
        lower[path], upper[path] = low, high
        verdicts[path] = verdict(np.ravel(deviation[path]) > UNDECIDED)
    return Intervals(lower, upper, verdicts, _undecided(information, unravel))


def _undecided(information: Float[np.ndarray, "free free"], unravel: Any) -> tuple[str, ...]:
    """Name combinations of several parameters that the data leave free although each has a say.

    For masses and stiffnesses together without a measured force, say. Least information first.
    """
    combinations = []
    for direction in _free_combinations(information):
        # By the largest element: one stiffness beside the masses of all nodes counts as much.
        relative = np.abs(direction) / np.max(np.abs(direction))
        parts = unravel(jnp.asarray(relative, jnp.zeros(()).dtype)).items()
        involved = tuple(path for path, part in parts if float(jnp.max(part)) > 0.1)
        if len(involved) > 1 and involved not in combinations:
            combinations.append(involved)
    return tuple(
        f"the data cannot tell {', '.join(involved)} apart: scaled together they predict the same; "
        "fix one of them (by weighing, or from a data sheet) or read only their ratios"
        for involved in combinations
    )


def _free_combinations(information: Float[np.ndarray, "free free"]) -> list[np.ndarray]:
    """Unit directions with less information than the prior's, which is one, least first.

    Only among elements that alone have more: the others, which any direction may contain, are
    undecided by themselves. Where the information is equal, eigenvectors are arbitrary mixtures of
    one another; eliminated like equations, they are as many directions of few elements each.
    """
    decided = np.flatnonzero(np.diag(information) >= 1.0)
    values, vectors = np.linalg.eigh(information[np.ix_(decided, decided)])
    rows = np.zeros((int(np.sum(values < 1.0)), len(information)))
    rows[:, decided] = vectors[:, values < 1.0].T
    for i in range(len(rows)):
        row, column = divmod(int(np.argmax(np.abs(rows[i:]))), rows.shape[1])
        rows[[i, i + row]] = rows[[i + row, i]]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column] / rows[i, column], rows[i])
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return sorted(rows, key=lambda row: row @ information @ row)
