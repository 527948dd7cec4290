"""How well a model predicts recordings: windows of them, open-loop predictions and their errors."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from palpate.errors import PalpateError
from palpate.models.model import Model, rollout
from palpate.recordings import Aligned

START_FRAMES = 2  # a position and the one before it: where it is and how fast it moves


class Windows(eqx.Module):
    """Pieces of trials, the same length each.

    `start`: the first frames, which fix the initial state; `action`: one per control period after
    them; `target`: what was observed after each action, zero where `seen` is false.
    """

    start: Float[Array, "batch start ..."]
    action: Float[Array, "batch time ..."]
    target: Float[Array, "batch time ..."]
    seen: Bool[Array, "batch time ..."]


@dataclasses.dataclass(frozen=True)
class WindowSource:
    """Cuts windows out of aligned trials; frames that a window starts from must be all seen."""

    aligned: Aligned
    starts: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, aligned: Aligned) -> "WindowSource":
        """Find the frames a window may start at.

        Raises `PalpateError` for a trial in which no two consecutive frames are complete.
        """
        starts = []
        for index, length in enumerate(aligned.length):
            flat = aligned.observation[index, :length].reshape(length, -1)
            complete: np.ndarray = np.all(np.isfinite(flat), axis=1)
            possible = np.flatnonzero(complete[: length - START_FRAMES] & complete[1 : length - 1])
            if not possible.size:
                raise PalpateError(
                    f"trial {index} has no two consecutive frames in which everything is seen, so "
                    "no prediction can start there: repair or drop the trial"
                )
            starts.append(possible)
        return cls(aligned, tuple(starts))

    @property
    def longest(self) -> int:
        """The longest horizon, in control periods, that every trial offers from its first start."""
        return int(
            min(
                length - START_FRAMES - possible[0]
                for length, possible in zip(self.aligned.length, self.starts, strict=True)
            )
        )

    def whole(self, horizon: int | None = None) -> Windows:
        """One window for each trial, from its first possible start, over `horizon` periods.

        By default as long as the longest trial; frames past a trial's end are not seen.
        """
        if horizon is None:
            horizon = int(max(self.aligned.length)) - START_FRAMES
        trials = np.arange(len(self.aligned.length))
        return self._cut(trials, np.array([s[0] for s in self.starts]), horizon)

    def distinct(self, horizon: int) -> int:
        """How many windows of this horizon are worth having at once: no two alike.

        Windows that overlap by more than half tell little more than one.
        """
        stride = max(1, horizon // 2)
        return sum(
            1 + max(0, int(length - START_FRAMES - horizon - possible[0]) // stride)
            for length, possible in zip(self.aligned.length, self.starts, strict=True)
        )

    def sample(self, rng: np.random.Generator, batch: int, horizon: int) -> Windows:
        """Windows at random starts that leave room for the horizon, trials drawn evenly."""
        count = len(self.aligned.length)
        order = np.concatenate([rng.permutation(count) for _ in range(-(-batch // count))])[:batch]
        first = []
        for trial in order:
            last = self.aligned.length[trial] - START_FRAMES - horizon
            possible = self.starts[trial]
            possible = possible[possible <= max(last, possible[0])]
            first.append(rng.choice(possible))
        return self._cut(order, np.array(first), horizon)

    def _cut(self, trials: np.ndarray, first: np.ndarray, horizon: int) -> Windows:
        observation, action = self.aligned.observation, self.aligned.action
        frames = first[:, None] + START_FRAMES + np.arange(horizon)
        inside = np.minimum(frames, observation.shape[1] - 1)
        target = observation[trials[:, None], inside]
        past = frames >= self.aligned.length[trials][:, None]
        seen = np.isfinite(target) & ~past.reshape(past.shape + (1,) * (target.ndim - 2))
        start = observation[trials[:, None], first[:, None] + np.arange(START_FRAMES)]
        steps = np.minimum(frames - 1, action.shape[1] - 1)
        as_array = lambda x: jnp.asarray(x, jnp.zeros(()).dtype)  # noqa: E731
        return Windows(
            start=as_array(start),
            action=as_array(action[trials[:, None], steps]),
            target=as_array(np.where(seen, target, 0.0)),
            seen=jnp.asarray(seen),
        )


def predict(model: Model, windows: Windows) -> Float[Array, "batch time ..."]:
    """Open-loop prediction of every window's target."""
    return model.observe(rollout(model, model.initial_state(windows.start), windows.action))


def residuals(model: Model, windows: Windows) -> Float[Array, "batch time ..."]:
    """Prediction minus observation, zero where nothing was seen."""
    return jnp.where(windows.seen, predict(model, windows) - windows.target, 0.0)


@dataclasses.dataclass(frozen=True)
class PredictionError:
    """Open-loop errors over whole trials, in the observation's unit.

    `mean_absolute` is over all coordinates seen (the measure of DEFORM's table), `by_trial` the
    same for each trial; `horizon` (s) and `rmse` (of the distance, all seen points) run over time.
    NaN where nothing was seen: an error that is not known is not zero.
    """

    mean_absolute: float
    by_trial: np.ndarray
    horizon: np.ndarray
    rmse: np.ndarray
    prediction: np.ndarray
    windows: Windows

    @property
    def last_seen(self) -> int:
        """Index into `horizon` of the last time at which anything was seen, of whatever trial."""
        seen = np.asarray(self.windows.seen)
        return int(np.flatnonzero(seen.any((0, *range(2, seen.ndim))))[-1])


@eqx.filter_jit
def _predict(model: Model, windows: Windows) -> Array:
    return predict(model, windows)


def prediction_error(model: Model, aligned: Aligned) -> PredictionError:
    """Predict every trial open loop from its first two complete frames to its end.

    Raises `PalpateError` when nothing is seen after those frames, in any trial.
    """
    windows = WindowSource.of(aligned).whole()
    prediction = np.asarray(_predict(model, windows))
    seen = np.asarray(windows.seen)
    if not seen.any():
        raise PalpateError(
            "nothing is seen after the first two complete frames of any trial, so there is nothing "
            "to hold a prediction against: expected trials with more frames that are seen"
        )
    error = np.where(seen, prediction - np.asarray(windows.target), 0.0)
    per_trial = tuple(range(1, error.ndim))
    per_time = (0, *range(2, error.ndim))
    axes = error.shape[-1] if error.ndim > 2 else 1
    return PredictionError(
        mean_absolute=float(np.abs(error).sum() / seen.sum()),
        by_trial=np.abs(error).sum(per_trial) / or_nan(seen.sum(per_trial)),
        horizon=aligned.period * np.arange(1, error.shape[1] + 1),
        rmse=np.sqrt(np.square(error).sum(per_time) / or_nan(seen.sum(per_time) / axes)),
        prediction=prediction,
        windows=windows,
    )


def or_nan(count: np.ndarray) -> np.ndarray:
    """The count to divide by, NaN in place of zero."""
    return np.where(count > 0, count, np.nan)


def observation_scale(aligned: Aligned) -> float:
    """Typical size of what is to be explained: how far observations move from their start.

    Root mean square over trials, frames and coordinates of the change since the first frame.
    """
    change = aligned.observation - aligned.observation[:, :1]
    scale: Any = np.sqrt(np.nanmean(np.square(change)))
    if not np.isfinite(scale) or scale <= 0:
        raise PalpateError(
            "nothing moves in the recording: every observation equals the first of its trial, "
            "and there is nothing to identify from"
        )
    return float(scale)
