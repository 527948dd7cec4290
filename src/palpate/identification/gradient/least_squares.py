"""Least squares through a model: normal equations by forward mode, damped steps, intervals.

What is fitted are the parameters and, for each segment, the state that it starts in: a smoothed
start is off, and a model held to it would bend its parameters to make up for that (errors in
variables). A start's errors are whitened by their deviation (`Segments.moved`) and eliminated.

With few unknowns and many residuals the Jacobian is taken column by column in forward mode and only
products of its columns are kept: memory does not grow with the recording.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from palpate.errors import PalpateError
from palpate.identification.data.prediction import observation_scale, predict, residuals
from palpate.identification.data.segments import Segments, SegmentSource
from palpate.identification.verdicts import undecided, verdict
from palpate.numerics.arrays import as_array
from palpate.parameters import FreeParameters, value_of
from palpate.recordings import Aligned

Free = dict[str, Array]

GROUP = 4  # segments whose Jacobians are held at a time
BLOCKS = 10  # pieces of a trial whose scores are taken as independent of one another
QUANTILE = 1.6449  # of the normal distribution: 90 % within
# The loss is quadratic for small errors and linear beyond: a few bad markers or a stretch that the
# model cannot explain must not decide the fit. The knee is relative to how far things move.
KNEE = 0.01
# Residuals next to one another are not independent: the prior weighs in a fit as if one in so many
# were, of the size that residuals have, but no more than `Settings.prior_weight`.
DEPENDENT = 400.0


class Objective(eqx.Module):
    """Mean loss of the residuals over `scale` at parameters and errors of the segments' starts.

    Half the square of a residual, less beyond `knee` (pseudo-Huber; None: nowhere less), beside
    what priors say of the parameters and of the starts. These weigh as in a maximum a posteriori
    estimate whose noise is of the size that the residuals have.
    """

    coordinates: FreeParameters
    scale: Float[Array, "#last"] = eqx.field(converter=jnp.asarray)
    knee: float | None = eqx.field(static=True, default=None)
    prior_weight: float = eqx.field(static=True, default=0.0)

    def loss(
        self, free: Free, offset: Float[Array, "segments 2 ..."], segments: Segments
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """What is minimised, and of it the mean loss of the residuals."""
        count = jnp.maximum(jnp.sum(segments.seen), 1)
        mean = jnp.sum(pseudo_huber(self.relative(free, offset, segments), self.knee)) / count
        variance = jax.lax.stop_gradient(2.0 * mean)
        prior = self.weight(variance) * self.coordinates.penalty(free)
        starts = 0.5 * variance * jnp.sum(jnp.square(offset)) / count
        return mean + prior + starts, mean

    def weight(self, variance: Array) -> Array:
        """Of the parameters' prior in a loss per residual, for relative residuals of a variance."""
        return jnp.minimum(self.prior_weight, variance / DEPENDENT)

    def relative(self, free: Free, offset: Array, segments: Segments) -> Array:
        """Residuals over the scale."""
        model = self.coordinates.build(free)
        begun = segments.moved(offset)
        return residuals(model, predict(model, begun), segments) / self.scale

    def products(
        self,
        free: Free,
        offset: Array,
        segments: Segments,
        curved: bool = False,
    ) -> Float[np.ndarray, "segments blocks columns columns"]:
        """Products of the weighted columns of the Jacobian and the residual, by tenth of a segment.

        Columns: the free values in the order of `ravel_pytree`, the errors of a segment's own
        start, the residual. A few segments at a time. Those of the Jacobian with itself have the
        weights whose slope is the loss's, or, `curved`, its curvature (pseudo-Huber's is less,
        beyond the knee by far).
        """
        everything = jax.tree.map(np.asarray, (offset, segments))
        size, parts = min(GROUP, segments.count), []
        for first in range(0, segments.count, size):
            # The last group repeats its last segment: all have one shape, which is compiled once.
            chosen = np.minimum(np.arange(first, first + size), segments.count - 1)
            own = jax.tree.map(lambda x, c=chosen: x[c], everything)
            parts.append(np.asarray(_products(self, free, own, np.asarray(curved))))
        return np.concatenate(parts)[: segments.count]

    def step(
        self, free: Free, offset: Array, damping: Array, segments: Segments
    ) -> tuple[Free, Array, Array, Array]:
        """A damped Gauss-Newton step: parameters, starts, damping, and the mean loss before.

        Refused steps return what was given and ten times the damping.
        """
        flat, unravel = ravel_pytree(free)
        before, mean = _value(self, free, offset, segments)
        count = float(jnp.sum(segments.seen))
        variance = 2.0 * float(mean)
        products = self.products(free, offset, segments).sum(axis=1, dtype=np.float64)
        own = np.asarray(offset, np.float64).reshape(len(products), -1)
        reduced = _eliminate(products, flat.size, variance, own)
        weight = float(self.weight(jnp.asarray(variance))) * count
        matrix = reduced.matrix + weight * np.eye(flat.size)
        gradient = reduced.gradient + weight * np.asarray(flat)
        diagonal = np.diag(np.diag(matrix) + 1e-12)
        change = np.linalg.solve(matrix + float(damping) * diagonal, -gradient)
        proposal = self.coordinates.project(unravel(flat + as_array(change, flat.dtype)))
        moved = own + reduced.start - reduced.slope @ change
        starts = as_array(moved.reshape(offset.shape), offset.dtype)
        after, _ = _value(self, proposal, starts, segments)
        if np.isfinite(after) and after < before:
            return proposal, starts, jnp.maximum(damping / 3.0, 1e-7), mean
        return free, offset, jnp.minimum(damping * 10.0, 1e7), mean


@eqx.filter_jit
def _products(
    objective: Objective,
    free: Free,
    starting: tuple[Array, Segments],
    curved: Bool[np.ndarray | Array, ""],
) -> Array:
    offset, segments = starting
    flat, unravel = ravel_pytree(free)
    unknowns, starts = flat.size, offset[0].size

    def relative(flat: Array, offset: Array) -> Array:
        return objective.relative(unravel(flat), offset, segments)

    residual, push = jax.linearize(relative, flat, offset)

    def along(direction: Array) -> Array:
        moved = jnp.broadcast_to(direction[unknowns:], (segments.count, starts))
        return push(direction[:unknowns], moved.reshape(offset.shape))

    directions = jnp.eye(unknowns + starts, dtype=flat.dtype)
    columns = jax.vmap(along)(directions)
    weight, bend = segments.seen.astype(flat.dtype), jnp.ones_like(residual)
    if objective.knee is not None:
        share = objective.knee / jnp.sqrt(jnp.square(residual) + objective.knee**2)
        weight, bend = weight * share, jnp.where(curved, share, bend)
    # The curvature is the weight times `bend` squared; with the residual it is the slope.
    columns = jnp.concatenate([columns * bend, residual[None] / bend]) * jnp.sqrt(weight)
    time = -residual.shape[1] % BLOCKS
    padded = jnp.pad(columns, [(0, 0), (0, 0), (0, time)] + [(0, 0)] * (columns.ndim - 3))
    blocks = padded.reshape(len(columns), segments.count, BLOCKS, -1)
    products = jnp.einsum("isbt,jsbt->sbij", blocks, blocks)
    straight = jnp.pad(bend * columns[-1], [(0, 0), (0, time)] + [(0, 0)] * (residual.ndim - 2))
    squares = jnp.sum(jnp.square(straight.reshape(segments.count, BLOCKS, -1)), axis=-1)
    return products.at[..., -1, -1].set(squares)


@eqx.filter_jit
def _value(objective: Objective, free: Free, offset: Array, segments: Segments):
    return objective.loss(free, offset, segments)


@dataclasses.dataclass(frozen=True)
class Reduced:
    """Normal equations from which the segments' starts were eliminated, by segment where it says.

    At a change x of the parameters the best change of a start is `start` - `slope` x.
    """

    matrix: Float[np.ndarray, "free free"]
    gradient: Float[np.ndarray, " free"]
    start: Float[np.ndarray, "segments starts"]
    slope: Float[np.ndarray, "segments starts free"]


def _eliminate(
    products: Float[np.ndarray, "segments columns columns"],
    free: int,
    variance: float,
    offset: Float[np.ndarray, "segments starts"],
) -> Reduced:
    """By Schur's complement; the starts' prior has the precision `variance` of the residuals."""
    own = products[:, free:-1, free:-1] + variance * np.eye(offset.shape[1])
    slope = np.linalg.solve(own, products[:, free:-1, :free])
    pull = products[:, free:-1, -1] + variance * offset
    start = -np.linalg.solve(own, pull[..., None])[..., 0]
    across = products[:, :free, free:-1]
    return Reduced(
        matrix=(products[:, :free, :free] - across @ slope).sum(axis=0),
        gradient=(products[:, :free, -1] + np.einsum("sij,sj->si", across, start)).sum(axis=0),
        start=start,
        slope=slope,
    )


def pseudo_huber(relative: Array, knee: float | None) -> Array:
    """Quadratic (1/2 r^2) for small residuals, linear beyond the knee; None: quadratic always."""
    if knee is None:
        return 0.5 * jnp.square(relative)
    return knee * (jnp.sqrt(jnp.square(relative) + knee**2) - knee)


@dataclasses.dataclass(frozen=True)
class Intervals:
    """90 % intervals of the free parameters and what the data could not tell.

    `lower` and `upper` by parameter path, in its unit and shape; `verdict` a sentence or None;
    `warnings` about combinations of parameters.
    """

    lower: dict[str, np.ndarray]
    upper: dict[str, np.ndarray]
    verdict: dict[str, str | None]
    warnings: tuple[str, ...]


def intervals(coordinates: FreeParameters, free: Free, aligned: Aligned) -> Intervals:
    """Gauss-Newton intervals of a fit, in the sandwich form that forgives correlated residuals.

    With J the derivatives of the residuals by the parameters, the starts following as fits best,
    A = J^T C J / s^2 + 1 (the prior's precision is one in whitened coordinates) and the scores
    g_b = J^T W r / s^2 over a tenth of a trial each, the covariance is
    A^-1 (sum g_b g_b^T + 1) A^-1 (Huber 1967; White 1982): residuals next to each other in time are
    not counted as independent evidence. W r is the loss's slope and C its curvature: beyond the
    knee far less than W, by which intervals of noise of twice the knee were half as wide as they
    should be. Never below the covariance A^-1 of independent noise. The step that a descent has
    left to go widens them as an error of its size.

    Raises `PalpateError` for a trial that cannot be predicted to its end.
    """
    segments = SegmentSource.of(aligned, coordinates.reference).whole()
    offset = jnp.zeros((segments.count, 2, *segments.pose.shape[1:]))
    objective = Objective(coordinates, observation_scale(aligned, coordinates.reference), KNEE)
    flat, unravel = ravel_pytree(free)
    # The best starts first: about others the parameters' slope is a small difference of large sums.
    products = objective.products(free, offset, segments)
    alone = products[:, :, flat.size :, flat.size :].sum(axis=1, dtype=np.float64)
    if (lost := ~np.isfinite(alone).all(axis=(1, 2))).any():
        raise PalpateError(
            f"trial {np.argmax(lost)} cannot be predicted from its start to its end: errors or "
            "their slopes are no finite numbers; cut it where it jumps, or leave it out"
        )
    freedom = int(np.sum(segments.seen)) - flat.size
    nowhere = np.zeros((segments.count, offset[0].size))
    own = _eliminate(alone, 0, _noise(alone, freedom), nowhere).start
    offset = jnp.asarray(own.reshape(offset.shape), offset.dtype)
    products = objective.products(free, offset, segments, curved=True).astype(np.float64)
    total = products.sum(axis=1)
    noise = _noise(total[:, flat.size :, flat.size :], freedom)
    reduced = _eliminate(total, flat.size, noise, own)
    # From all columns to J, and to the residuals that are left at the best starts.
    count, identity = segments.count, np.eye(flat.size)
    itself, nothing = np.repeat(identity[None], count, axis=0), np.zeros((count, flat.size))
    to_slope = np.concatenate([itself, -reduced.slope, nothing[:, None]], axis=1)
    to_residual = np.concatenate([nothing, reduced.start, np.ones((count, 1))], axis=1)
    scores = np.einsum("sif,sbij,sj->sbf", to_slope, products, to_residual) / noise
    scores = scores.reshape(-1, flat.size)
    information = reduced.matrix / noise
    inverse = np.linalg.inv(information + identity)
    sandwich = inverse @ (scores.T @ scores + identity) @ inverse
    # Scores that a few blocks dominate can exceed what was believed before any data: no more than
    # the prior's variance, which is one.
    left = inverse @ (reduced.gradient / noise + np.asarray(flat))
    spread = np.maximum(np.diag(sandwich), np.diag(inverse)) + np.square(left)
    variance = np.minimum(spread, 1.0)
    deviation = unravel(jnp.asarray(np.sqrt(variance), flat.dtype))
    lower, upper, verdicts = {}, {}, {}
    for path, declaration in coordinates.declarations.items():
        reference = value_of(coordinates.reference, path)
        for edge, sign in ((lower, -QUANTILE), (upper, QUANTILE)):
            value = declaration.prior.to_value(free[path] + sign * deviation[path], reference)
            edge[path] = np.broadcast_to(np.asarray(value), reference.shape)
        share, shift = (np.asarray(of[path]).ravel() for of in (deviation, free))
        verdicts[path] = verdict(undecided(share, shift))
    return Intervals(lower, upper, verdicts, _undecided(information, unravel))


def _noise(products: Float[np.ndarray, "segments columns columns"], freedom: int) -> float:
    """Variance of the residuals that are left at the best starts, which it weighs in turn.

    Of products without parameters; `freedom` is how many residuals those leave.
    """
    values, vectors = np.linalg.eigh(products[:, :-1, :-1])
    values = np.maximum(values, 0.0)
    pulls = np.square(np.einsum("sij,si->sj", vectors, products[:, :-1, -1]))
    squares, noise = products[:, -1, -1].sum(), products[:, -1, -1].sum() / max(freedom, 1)
    for _ in range(100):
        noise = max(float(noise), 1e-20)
        explained = pulls * (values + 2.0 * noise) / np.square(values + noise)
        left = max(freedom - np.sum(values / (values + noise)), 1.0)
        noise = (squares - explained.sum()) / left
    return max(float(noise), 1e-20)


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
