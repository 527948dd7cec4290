"""How well a model predicts recordings: open-loop predictions of segments, and their errors."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.identification.data.segments import Segments, SegmentSource, difference
from palpate.models.model import Model, rollout
from palpate.recordings import Aligned

ROUNDS = 2  # in which a start at rest is relaxed


def motion(model: Model, segments: Segments) -> Any:
    """The states after each action, open loop from the start of each segment."""
    return rollout(model, initial_states(model, segments), segments.action)


def initial_states(model: Model, segments: Segments) -> Any:
    """The states that segments begin in, whose leaves lead with the segments.

    They are relaxed where segments begin at rest, if `Segments.relaxation` asks for it, under their
    first action, which has to hold the model where it is: a pose, and no velocity with noise.

    What is at rest is in balance, and a pose that is off by noise is not: by a fraction of a
    millimetre a stiff rope rings with more force than it weighs. So the model is let go for a
    while, in which what is stiff swings about its balance and what is slow hardly moves, and is
    stopped at its mean pose, twice (dynamic relaxation, after Barnes, Int. J. Space Struct. 14,
    1999). To stop it where it happens to be may add energy, step by step.
    """
    before = segments.pose - model.control_period * segments.rate
    state = model.initial_state(jnp.stack([before, segments.pose], axis=1))
    if not segments.relaxation:
        return state
    held = jnp.repeat(segments.action[:, :1], segments.relaxation, axis=1)
    rate = segments.rate_deviation

    def relax(state: Any, _: None) -> tuple[Any, None]:
        pose = model.observe(state)
        off = model.difference(model.observe(rollout(model, state, held)), pose[:, None])
        return model.initial_state((pose + jnp.mean(off, axis=1))[:, None]), None

    relaxed, _ = jax.lax.scan(relax, state, None, ROUNDS)
    at_rest = jnp.all(rate == 0.0, axis=tuple(range(1, rate.ndim)))

    def choose(relaxed: Array, seen: Array) -> Array:
        return jnp.where(at_rest.reshape(-1, *(1,) * (seen.ndim - 1)), relaxed, seen)

    return jax.tree.map(choose, relaxed, state)


def predict(model: Model, segments: Segments) -> Float[Array, "segments time ..."]:
    """Open-loop prediction of every segment's target from its start."""
    return model.observe(motion(model, segments))


def residuals(
    model: Model, predicted: Float[Array, "segments time ..."], segments: Segments
) -> Float[Array, "segments time ..."]:
    """Prediction minus observation, angles the short way round, zero where nothing was seen."""
    return jnp.where(segments.seen, model.difference(predicted, segments.target), 0.0)


@dataclasses.dataclass(frozen=True)
class PredictionError:
    """Open-loop errors over whole trials, in the observation's unit.

    `mean_absolute` is over all coordinates seen (the measure of DEFORM's table), `by_trial` the
    same for each trial; `horizon` (s), `by_time` (the same again) and `rmse` (of the distance, all
    seen points) run over time.
    NaN where nothing was seen: an error that is not known is not zero.
    """

    mean_absolute: float
    by_trial: np.ndarray
    horizon: np.ndarray
    rmse: np.ndarray
    prediction: np.ndarray
    segments: Segments
    by_time: np.ndarray

    def within(self, seconds: float) -> float:
        """The mean absolute error of so long: what motion does later may be chance, and is hard."""
        early = self.by_time[self.horizon <= seconds * (1 + 1e-6)]
        return float(np.nanmean(early)) if np.isfinite(early).any() else self.mean_absolute

    @property
    def last_seen(self) -> int:
        """Index into `horizon` of the last time at which anything was seen, of whatever trial."""
        seen = np.asarray(self.segments.seen)
        return int(np.flatnonzero(seen.any((0, *range(2, seen.ndim))))[-1])


_predict = eqx.filter_jit(predict)


def prediction_error(model: Model, aligned: Aligned) -> PredictionError:
    """Predict every trial open loop from its first two complete frames to its end.

    From these alone, although a smoothed start is a better one: it has seen what is to be
    predicted. Raises `PalpateError` when nothing is seen after those frames, in any trial.
    """
    segments = SegmentSource.of(aligned, model).whole(smoothed=False)
    prediction = np.asarray(_predict(model, segments))
    seen = np.asarray(segments.seen)
    if not seen.any():
        raise PalpateError(
            "nothing is seen after the first two complete frames of any trial, so there is nothing "
            "to hold a prediction against: expected trials with more frames that are seen"
        )
    error = np.where(seen, difference(model, prediction, np.asarray(segments.target)), 0.0)
    per_trial = tuple(range(1, error.ndim))
    per_time = (0, *range(2, error.ndim))
    axes = error.shape[-1] if error.ndim > 2 else 1
    return PredictionError(
        mean_absolute=float(np.abs(error).sum() / seen.sum()),
        by_trial=np.abs(error).sum(per_trial) / or_nan(seen.sum(per_trial)),
        horizon=aligned.period * np.arange(1, error.shape[1] + 1),
        rmse=np.sqrt(np.square(error).sum(per_time) / or_nan(seen.sum(per_time) / axes)),
        prediction=prediction,
        segments=segments,
        by_time=np.abs(error).sum(per_time) / or_nan(seen.sum(per_time)),
    )


def or_nan(count: np.ndarray | np.number) -> np.ndarray:
    """The count to divide by, NaN in place of zero."""
    return np.where(count > 0, count, np.nan)


def observation_scale(aligned: Aligned, model: Model) -> Float[np.ndarray, "#last"]:
    """Typical size of what is to be explained: how far observations move from their start.

    Root mean square over trials, frames and coordinates of the change since the first frame; of
    lengths and angles together, and of each other unit by itself, for each entry of the last
    observation axis.

    Raises `PalpateError` when nothing of some unit moves.
    """
    first = np.broadcast_to(aligned.observation[:, :1], aligned.observation.shape)
    off = difference(model, aligned.observation, first)
    units = ["m" if unit in ("m", "rad") else unit for unit in model.observation_units]
    kinds = np.unique(units, return_inverse=True)[1]
    own = [np.nanmean(np.square(off[..., kinds == kind])) for kind in range(kinds.max() + 1)]
    scale = np.sqrt(own)
    if not np.all(np.isfinite(scale) & (scale > 0)):
        raise PalpateError(
            "nothing moves in the recording: every observation equals the first of its trial, "
            "and there is nothing to identify from"
        )
    return scale[kinds] if len(scale) > 1 else scale
