"""What a posterior predicts for motions it was not fitted to, and whether that was right."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.identification.data.prediction import or_nan
from palpate.identification.data.segments import Segments, difference
from palpate.identification.posterior.discrepancy import COVARIANCES
from palpate.identification.posterior.likelihood import MotionPosterior, from_start

LANES = 2048  # pieces times draws that are simulated at a time


@dataclasses.dataclass(frozen=True)
class Predicted:
    """Predictions of some pieces by draws of a posterior, in the observation's units.

    `motion` is what each draw's model does from a start drawn within its deviation, `observed`
    the same as a sensor would show it, with the discrepancy and noise of that draw, and
    `deviation` the standard deviation of what was added.
    """

    motion: Float[np.ndarray, "draws segments time ..."]
    observed: Float[np.ndarray, "draws segments time ..."]
    deviation: Float[np.ndarray, "draws segments time ..."]

    def interval(self, level: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper ends (segments, time, ...) that hold this share of the draws."""
        tail = 0.5 - 0.5 * level
        lower, upper = np.quantile(self.observed, (tail, 1.0 - tail), axis=0)
        return lower, upper


@dataclasses.dataclass(frozen=True)
class Score:
    """How predictions fared against what was then observed.

    `coverage` is the share of observations inside the central interval of each level, over all
    that was seen; `coverage_by_channel` the same for each element of an observation. `log_score`
    is the mean logarithm of the predictive density of an observed number (higher is better;
    Gneiting and Raftery, J. Am. Stat. Assoc. 102, 2007). `error` is the root mean square of the
    posterior mean's error by channel, and `spread` that of the predictive deviation, which is as
    large when the posterior is honest. `seen` counts what was seen of each channel; where that is
    nothing, the channel's numbers are NaN.
    """

    coverage: dict[float, float]
    coverage_by_channel: dict[float, np.ndarray]
    log_score: float
    error: np.ndarray
    spread: np.ndarray
    seen: np.ndarray

    def pooled(self, channels: Bool[np.ndarray, " last"]) -> float:
        """Root mean square of `error` over all that was seen of these entries of an observation.

        NaN where that is nothing.
        """
        count = self.seen[..., channels]
        square = np.square(self.error[..., channels]) * count
        return float(np.sqrt(square[count > 0].sum() / or_nan(np.asarray(count.sum()))))


def predict(
    target: MotionPosterior,
    position: Float[np.ndarray, "draws free"],
    segments: Segments,
    seed: int,
) -> Predicted:
    """Predict the pieces with each draw of a posterior; the pieces' targets are not looked at.

    Raises `PalpateError` when a draw's motion is not finite, naming the draw and the piece.
    """
    time = target.coordinates.reference.control_period * np.arange(1, segments.horizon + 1)
    # A little of the identity: in the first frames nothing has grown yet.
    little = 1e-9 * time[-1] ** 3 * np.eye(len(time))
    roots = [np.linalg.cholesky(covariance(time) + little) for covariance in COVARIANCES]
    force = target.coordinates.reference.observes_force
    root = jnp.asarray(np.stack(roots)[force.astype(int)], jnp.zeros(()).dtype)
    chunk = max(1, LANES // segments.count)
    keys = jax.random.split(jax.random.key(seed), len(position))
    parts = []
    for first in range(0, len(position), chunk):
        # Padded to the chunk, so that one size is compiled.
        rows = np.minimum(np.arange(first, first + chunk), len(position) - 1)
        part = _predict(target, jnp.asarray(position[rows]), segments, root, keys[rows])
        parts.append([np.asarray(x)[: len(position) - first] for x in part])
    motion, observed, deviation = (np.concatenate(column) for column in zip(*parts, strict=True))
    broken = ~np.isfinite(motion).reshape(*motion.shape[:2], -1).all(axis=2)
    if broken.any():
        draw, piece = map(int, np.argwhere(broken)[0])
        raise PalpateError(
            f"draw {draw} of the posterior predicts no finite motion for piece {piece}: "
            "leave the piece out, or declare narrower priors"
        )
    return Predicted(motion, observed, deviation)


def check_seen(segments: Segments) -> None:
    """Raise `PalpateError` when these pieces show nothing to hold predictions against."""
    if not np.asarray(segments.seen).any():
        raise PalpateError("nothing is seen in these pieces: there is nothing to score against")


def score(
    target: MotionPosterior,
    predicted: Predicted,
    segments: Segments,
    levels: tuple[float, ...] = (0.5, 0.9),
) -> Score:
    """Hold predictions against the pieces' targets, over what was seen in them.

    Raises as `check_seen`.
    """
    check_seen(segments)
    seen = np.asarray(segments.seen)
    model = target.coordinates.reference

    def beyond(motion: np.ndarray) -> np.ndarray:
        """Prediction minus observation by draw, angles wrapped."""
        return difference(model, motion, np.asarray(segments.target))

    observed, motion = beyond(predicted.observed), beyond(predicted.motion)
    channels = tuple(range(2))
    counts = seen.sum(axis=channels)
    coverage, by_channel = {}, {}
    for level in levels:
        tail = 0.5 - 0.5 * level
        lower, upper = np.quantile(observed, (tail, 1.0 - tail), axis=0)
        inside = (lower <= 0.0) & (upper >= 0.0) & seen
        coverage[level] = float(inside.sum() / seen.sum())
        by_channel[level] = inside.sum(axis=channels) / or_nan(counts)
    variance = np.square(predicted.deviation, dtype=np.float64)
    each = -0.5 * (np.square(motion) / variance + np.log(2.0 * np.pi * variance))
    top = each.max(axis=0)
    density = top + np.log(np.mean(np.exp(each - top), axis=0))
    mean_error = np.where(seen, motion.mean(axis=0), 0.0)
    spread = np.where(seen, np.var(observed, axis=0), 0.0)
    return Score(
        coverage=coverage,
        coverage_by_channel=by_channel,
        log_score=float(density[seen].mean()),
        error=np.sqrt(np.square(mean_error).sum(axis=channels) / or_nan(counts)),
        spread=np.sqrt(spread.sum(axis=channels) / or_nan(counts)),
        seen=counts,
    )


def final_poses(
    target: MotionPosterior,
    position: Float[np.ndarray, "chains draws free"],
    segments: Segments,
) -> Float[np.ndarray, "chains draws segments ..."]:
    """What each draw says is observed at the end of each piece, without any noise.

    Functionals to judge chains by: the same for all labels that mean the same motion.
    """
    flat = position.reshape(-1, position.shape[-1])
    chunk = max(1, LANES // segments.count)
    parts = []
    for first in range(0, len(flat), chunk):
        rows = np.minimum(np.arange(first, first + chunk), len(flat) - 1)
        part = np.asarray(_final(target, jnp.asarray(flat[rows]), segments))
        parts.append(part[: len(flat) - first])
    found = np.concatenate(parts)
    return found.reshape(*position.shape[:2], *found.shape[1:])


@eqx.filter_jit
def _final(target: MotionPosterior, position: Array, segments: Segments) -> Array:
    return target.predicted(position, segments)[:, :, -1]


@eqx.filter_jit
def _predict(
    target: MotionPosterior, position: Array, segments: Segments, root: Array, keys: Array
) -> tuple[Array, Array, Array]:
    shape = segments.target.shape
    channels = shape[2:]

    def one(position: Array, key: PRNGKeyArray) -> tuple[Array, Array, Array]:
        pose, rate, growing, white = jax.random.split(key, 4)
        draw = lambda k, like: jax.random.normal(k, like.shape, like.dtype) * like  # noqa: E731
        begun = eqx.tree_at(
            lambda s: (s.pose, s.rate),
            segments,
            (
                segments.pose + draw(pose, segments.pose_deviation),
                segments.rate + draw(rate, segments.rate_deviation),
            ),
        )
        motion = from_start(target.model(position), begun)
        noise = target.noise(position).reshape(channels)
        growth = target.growth(position).reshape(channels)
        kicks = jax.random.normal(growing, shape, root.dtype)
        grown = jnp.einsum("kts,ws...k->wt...k", root, kicks)
        added = growth * grown + noise * jax.random.normal(white, shape, root.dtype)
        size = jnp.sum(jnp.square(root), axis=2).T
        size = size.reshape(len(size), *(1,) * (len(channels) - 1), channels[-1])
        deviation = jnp.sqrt(jnp.square(noise) + jnp.square(growth) * size)
        return motion, motion + added, jnp.broadcast_to(deviation, shape)

    return jax.vmap(one)(position, keys)
