"""Pieces of recordings with what is known of the state they begin in.

A camera shows poses with millimetres of noise, and the difference of two frames says nothing of a
velocity. Here each piece begins at a pose and a velocity from a local polynomial (Savitzky and
Golay, Analytical Chemistry 36, 1964), with their standard deviations.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from palpate.errors import PalpateError
from palpate.models.model import Model
from palpate.recordings import Aligned

REACH = 0.2  # s before and after a frame that its smoothed pose is taken from
ORDER = 3  # of the polynomial: a velocity that changes within the reach
STILL = 0.06  # s at the beginning of a trial at rest that its pose is averaged over


class Segments(eqx.Module):
    """Pieces of trials, the same length each; shorter ones are padded with frames not seen.

    `pose` and `rate` (per second) are the smoothed observation at the first frame and its time
    derivative, `pose_deviation` and `rate_deviation` their standard deviations, zero for what is
    known. `action` is one per control period after it; `target` what was observed after each
    action, zero where `seen` is false.
    """

    pose: Float[Array, "segments ..."]
    rate: Float[Array, "segments ..."]
    pose_deviation: Float[Array, "segments ..."]
    rate_deviation: Float[Array, "segments ..."]
    action: Float[Array, "segments time ..."]
    target: Float[Array, "segments time ..."]
    seen: Bool[Array, "segments time ..."]

    @property
    def count(self) -> int:
        """How many pieces there are."""
        return self.pose.shape[0]

    @property
    def horizon(self) -> int:
        """Control periods of each piece."""
        return self.action.shape[1]

    def take(self, indices: np.ndarray | list[int] | slice) -> "Segments":
        """Some of the pieces."""
        chosen = indices if isinstance(indices, slice) else np.asarray(indices)
        return jax.tree.map(lambda part: part[chosen], self)


def known_start(
    pose: Array, rate: Array, action: Array, target: Array, seen: Array | None = None
) -> Segments:
    """Pieces whose first state is known exactly, as in a simulation; shapes as in `Segments`."""
    nothing = jnp.zeros_like(pose)
    everything = jnp.isfinite(target) if seen is None else seen
    return Segments(
        pose, rate, nothing, nothing, action, jnp.where(everything, target, 0.0), everything
    )


def cut(
    aligned: Aligned, model: Model, seconds: float, at_rest: bool = False, count: int | None = None
) -> Segments:
    """Cut aligned trials into consecutive pieces of `seconds`, each beginning where one ended.

    `at_rest` says that every trial begins at rest, so that its first piece begins with a velocity
    that is known to be zero. What remains of a trial is a padded piece, unless it is shorter than
    `REACH`, from which little is learnt but where it begins. `count` pads the pieces with ones in
    which nothing is seen, so that recordings of different lengths have the same shape and compile
    once.

    Raises `PalpateError` when no piece can begin anywhere, or `count` is too small.
    """
    period = aligned.period
    horizon = max(1, round(seconds / period))
    shortest = min(horizon, max(1, round(REACH / period)))
    spread = noise_scale(aligned, model)
    pieces = []
    for trial, length in enumerate(aligned.length):
        observed = aligned.observation[trial, :length]
        for first in range(0, int(length) - 1, horizon):
            last = min(first + horizon, int(length) - 1)
            if last - first < min(shortest, int(length) - 1):
                continue
            still = at_rest and first == 0
            start = _smoothed(observed, model, first, period, spread, still)
            if start is None:
                continue  # nothing is seen around: the piece before it ends here
            pieces.append((*start, *_padded(observed, aligned.action[trial], first, last, horizon)))
    if not pieces:
        raise PalpateError(
            f"no piece of {seconds:.3g} s can begin anywhere: expected a few frames in a row in "
            "which everything is seen"
        )
    if count is not None and len(pieces) > count:
        raise PalpateError(f"{len(pieces)} pieces do not fit into {count}: expected a larger count")
    columns = [np.stack(column) for column in zip(*pieces, strict=True)]
    if count is not None and len(pieces) < count:
        missing = count - len(pieces)
        # A copy of the first piece in which nothing is seen: it can be computed and says nothing.
        columns = [
            np.concatenate([c, np.repeat(c[:1] & False if c.dtype == bool else c[:1], missing, 0)])
            for c in columns
        ]
    return Segments(
        *(jnp.asarray(c, bool if c.dtype == bool else jnp.zeros(()).dtype) for c in columns)
    )


def noise_scale(aligned: Aligned, model: Model) -> Float[np.ndarray, " last"]:
    """Standard deviation of the observation noise, for each entry of the last observation axis.

    From the third differences of consecutive frames, in which smooth motion all but vanishes and
    white noise has 20 times its variance; by their median, so that jerks do not count (Gasser,
    Sroka and Jennen-Steinmetz, Biometrika 73, 1986). Angles are differences of the model's.
    """
    last = model.observation_shape[-1]
    thirds = []
    for trial, length in enumerate(aligned.length):
        observed = np.asarray(aligned.observation[trial, :length], np.float64)
        if length < 4:
            continue
        change = difference(model, observed[1:], observed[:-1])
        thirds.append(np.diff(change, n=2, axis=0).reshape(-1, last))
    values = np.abs(np.concatenate(thirds)) if thirds else np.zeros((0, last))
    size = np.nanmax(np.abs(aligned.observation), initial=0.0)
    floor = 1e-5 * max(float(size), 1e-3)
    scale = np.full(last, floor)
    for index in range(last):
        found = values[np.isfinite(values[:, index]), index]
        if found.size:
            scale[index] = max(float(np.median(found)) / 0.6745 / np.sqrt(20.0), floor)
    return scale


def difference(model: Model, predicted: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """The model's difference of two arrays of observations, in float64."""
    return np.asarray(model.difference(jnp.asarray(predicted), jnp.asarray(observed)), np.float64)


def _smoothed(
    observed: np.ndarray, model: Model, first: int, period: float, spread: np.ndarray, still: bool
) -> tuple[np.ndarray, ...] | None:
    """Pose, rate and their deviations at a frame; None where too little is seen around it."""
    reach = max(ORDER, round(REACH / period))
    low = first if still else max(0, first - reach)
    high = min(len(observed), first + (max(1, round(STILL / period)) if still else reach + 1))
    around = np.asarray(observed[low:high], np.float64)
    complete = np.all(np.isfinite(around).reshape(len(around), -1), axis=1)
    if complete.sum() < (1 if still else ORDER + 2):
        return None
    frames = np.flatnonzero(complete)
    reference = around[frames[np.argmin(np.abs(frames + low - first))]]
    offset = difference(model, around[frames], np.broadcast_to(reference, around[frames].shape))
    time = (frames + low - first) * period
    powers = time[:, None] ** np.arange(1 if still else ORDER + 1)
    coefficients, *_ = np.linalg.lstsq(powers, offset.reshape(len(frames), -1), rcond=None)
    covariance = np.linalg.inv(powers.T @ powers)
    shape = observed.shape[1:]
    zero, noise = np.zeros(shape), np.broadcast_to(spread, shape)
    pose = reference + coefficients[0].reshape(shape)
    if still:
        return pose, zero, noise * np.sqrt(covariance[0, 0]), zero
    rate = coefficients[1].reshape(shape)
    return pose, rate, noise * np.sqrt(covariance[0, 0]), noise * np.sqrt(covariance[1, 1])


def _padded(
    observed: np.ndarray, action: np.ndarray, first: int, last: int, horizon: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Actions, targets and what was seen of the frames after `first`, to `last` at most."""
    frames = np.arange(first + 1, first + 1 + horizon)
    inside = np.minimum(frames, len(observed) - 1)
    target = observed[inside]
    past = (frames > last).reshape(-1, *(1,) * (target.ndim - 1))
    seen = np.isfinite(target) & ~past
    steps = np.minimum(frames - 1, len(action) - 1)
    return action[steps], np.where(seen, target, 0.0), seen
