"""Segments of recordings with what is known of the state they begin in: for every method.

A camera shows poses with millimetres of noise, and the difference of two frames says nothing of a
velocity. Here a segment begins at a pose and a velocity from a local polynomial (Savitzky and
Golay, Analytical Chemistry 36, 1964), with their standard deviations.
"""

import dataclasses
import math
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.stats import chi2

from palpate.errors import PalpateError
from palpate.models.model import Model
from palpate.numerics.arrays import as_array
from palpate.recordings import Aligned

REACH = 0.2  # s before and after a frame that its smoothed pose is taken from, at most
ORDER = 3  # of the polynomial: a velocity that changes within the reach
STILL = 0.06  # s at the beginning of a trial at rest that its pose is averaged over
RELAXATION = 0.15  # s that poses are averaged over where a model is relaxed, at least
MOVED = 4.0  # deviations of a mean of frames at rest, from those of another rest, at most
# A polynomial that misses the frames by more than noise does once in a thousand times is taken over
# half the reach: there the motion is too fast for it.
CHANCE = 1e-3
START_FRAMES = 2  # complete frames in a row that a segment starts after: a pose, and how it moves
# The smoothed start has seen the segment's own frames. By so much its deviation is widened where
# the start is inferred from them once more, so that the segment decides.
VAGUE = 3.0


class Segments(eqx.Module):
    """Parts of trials, the same length each; shorter ones are padded with frames not seen.

    `pose` and `rate` (per second) are the smoothed observation at the first frame and its time
    derivative, `pose_deviation` and `rate_deviation` their standard deviations, zero for what is
    known. `action` is one per control period after it; `target` what was observed after each
    action, zero where `seen` is false. Before a piece whose rate is known a model is relaxed by
    its mean over `relaxation` control periods, if there are any (`prediction.initial_states`).
    """

    pose: Float[Array, "segments ..."]
    rate: Float[Array, "segments ..."]
    pose_deviation: Float[Array, "segments ..."]
    rate_deviation: Float[Array, "segments ..."]
    action: Float[Array, "segments time ..."]
    target: Float[Array, "segments time ..."]
    seen: Bool[Array, "segments time ..."]
    relaxation: int = eqx.field(static=True, default=0)

    @property
    def count(self) -> int:
        """How many pieces there are."""
        return self.pose.shape[0]

    @property
    def horizon(self) -> int:
        """Control periods of each piece."""
        return self.action.shape[1]

    def moved(self, offset: Float[Array, "..."]) -> "Segments":
        """Pose and rate at the start moved by (segments, 2, *observation) vague deviations, or by
        (2, *observation), the same for all.
        """
        axis = -1 - len(self.pose.shape[1:])
        pose, rate = (VAGUE * jnp.take(offset, i, axis=axis) for i in range(2))
        begun = self.pose + pose * self.pose_deviation, self.rate + rate * self.rate_deviation
        return eqx.tree_at(lambda s: (s.pose, s.rate), self, begun)

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


@dataclasses.dataclass(frozen=True)
class SegmentSource:
    """Cuts segments out of aligned trials, and smooths the states that they start in.

    `starts`: the frames of each trial that end `START_FRAMES` in a row in which all is seen.
    """

    aligned: Aligned
    model: Model
    starts: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, aligned: Aligned, model: Model) -> "SegmentSource":
        """Find the frames a segment may start at.

        Raises `PalpateError` for a trial in which no two consecutive frames are complete.
        """
        starts = []
        for index, length in enumerate(aligned.length):
            flat = aligned.observation[index, :length].reshape(length, -1)
            complete: np.ndarray = np.all(np.isfinite(flat), axis=1)
            possible = 1 + np.flatnonzero(complete[: length - 2] & complete[1 : length - 1])
            if not possible.size:
                raise PalpateError(
                    f"trial {index} has no two consecutive frames in which everything is seen, so "
                    "no prediction can start there: repair or drop the trial"
                )
            starts.append(possible)
        return cls(aligned, model, tuple(starts))

    @property
    def longest(self) -> int:
        """The longest horizon, in control periods, that every trial offers from its first start."""
        return int(min(self.aligned.length - 1 - [possible[0] for possible in self.starts]))

    def whole(self, smoothed: bool = True) -> Segments:
        """One segment for each trial, from its first possible start to the end of the longest.

        Not `smoothed`, it starts as the first two frames alone say, and knows of none that follow.
        """
        horizon = int(max(self.aligned.length)) - START_FRAMES
        first = [possible[0] for possible in self.starts]
        return self.at(np.stack([np.arange(len(first)), first], axis=1), horizon, smoothed)

    def tiles(self, horizon: int) -> Int[np.ndarray, "tiles 2"]:
        """Trial and first frame of the segments of this horizon that are worth having at once.

        Those that overlap by more than half tell little more than one.
        """
        rows = []
        for trial, possible in enumerate(self.starts):
            last = max(int(self.aligned.length[trial]) - 1 - horizon, int(possible[0]))
            count = 1 + (last - int(possible[0])) // max(1, horizon // 2)
            wanted = np.linspace(possible[0], last, count).round()
            reached = possible[np.searchsorted(possible, wanted, side="right") - 1]
            rows += [(trial, frame) for frame in dict.fromkeys(reached)]
        return np.array(rows)

    def sample(self, rng: np.random.Generator, batch: int, horizon: int) -> Segments:
        """`batch` segments, or all that are worth having at once, at random starts.

        Trials are drawn evenly, and starts leave room for the horizon.
        """
        count, batch = len(self.starts), min(batch, len(self.tiles(horizon)))
        order = np.concatenate([rng.permutation(count) for _ in range(-(-batch // count))])[:batch]
        rows = []
        for trial in order:
            possible = self.starts[trial]
            last = max(int(self.aligned.length[trial]) - 1 - horizon, int(possible[0]))
            rows.append((trial, rng.choice(possible[possible <= last])))
        return self.at(np.array(rows), horizon)

    def at(
        self, rows: Int[np.ndarray, "segments 2"], horizon: int, smoothed: bool = True
    ) -> Segments:
        """Segments from these frames of these trials, over `horizon` control periods."""
        pieces = []
        for trial, first in np.asarray(rows).tolist():
            length = int(self.aligned.length[trial])
            observed, action = self.aligned.observation[trial, :length], self.aligned.action[trial]
            if (trial, first, smoothed) not in self._begun:
                start = _smooth(observed, self.model, first, self.aligned.period, self._noise)
                if start is None or not smoothed:
                    start = self._two_frames(observed, first)
                self._begun[trial, first, smoothed] = start
            piece = _pad(observed, action, first, length - 1, horizon)
            pieces.append((*self._begun[trial, first, smoothed], *piece))
        return _join(pieces)

    def _two_frames(self, observed: np.ndarray, first: int) -> tuple[np.ndarray, ...]:
        """Pose, rate and their deviations, from a frame and the one before."""
        period, noise = self.aligned.period, np.broadcast_to(self._noise, observed.shape[1:])
        rate = difference(self.model, observed[first], observed[first - 1]) / period
        return observed[first], rate, noise, noise * np.sqrt(2.0) / period

    @cached_property
    def _noise(self) -> np.ndarray:
        return noise_scale(self.aligned, self.model, fast=True)

    @cached_property
    def _begun(self) -> dict[tuple[int, int, bool], tuple[np.ndarray, ...]]:
        """Starts found so far."""
        return {}


def cut(
    aligned: Aligned,
    model: Model,
    seconds: float,
    at_rest: bool = False,
    count: int | None = None,
    ringing: bool = False,
) -> Segments:
    """Cut aligned trials into consecutive pieces of `seconds`, each beginning where one ended.

    `at_rest` says that every trial begins at rest, so that its first piece begins with a velocity
    that is known to be zero. What remains of a trial is a padded piece, unless it is shorter than
    `REACH`, from which little is learnt but where it begins. `count` pads the pieces with ones in
    which nothing is seen, so that recordings of different lengths have the same shape and compile
    once. `ringing` says that a start that is off by noise makes a model ring: a rest is averaged
    over as long as it lasts, and models are relaxed before it, unless forces are observed, which
    tell what no pose does.

    Raises `PalpateError` when no piece can begin anywhere, or `count` is too small.
    """
    period = aligned.period
    horizon = max(1, round(seconds / period))
    shortest = min(horizon, max(1, round(REACH / period)))
    spread = noise_scale(aligned, model)
    relaxed = at_rest and ringing and not np.any(model.observes_force)
    relaxation = math.ceil(RELAXATION / period) if relaxed else 0
    pieces = []
    for trial, length in enumerate(aligned.length):
        observed = aligned.observation[trial, :length]
        rest = _rest(observed, model, spread, period) if at_rest and ringing else 1
        for first in range(rest - 1, int(length) - 1, horizon):
            last = min(first + horizon, int(length) - 1)
            if last - first < min(shortest, int(length) - 1):
                continue
            if rest > 1 and first == rest - 1:
                start = _mean(observed, model, rest, period, spread)
            else:
                still = at_rest and first == 0
                start = _smooth(observed, model, first, period, spread, still, reaches=1)
            if start is None:
                continue  # nothing is seen around: the piece before it ends here
            pieces.append((*start, *_pad(observed, aligned.action[trial], first, last, horizon)))
    if not pieces:
        raise PalpateError(
            f"no piece of {seconds:.3g} s can begin anywhere: expected a few frames in a row in "
            "which everything is seen"
        )
    if count is not None and len(pieces) > count:
        raise PalpateError(f"{len(pieces)} pieces do not fit into {count}: expected a larger count")
    # Copies of the first piece in which nothing is seen: they can be computed and say nothing.
    blind = (*pieces[0][:-1], np.zeros_like(pieces[0][-1]))
    return _join(pieces + [blind] * ((count or 0) - len(pieces)), relaxation)


def _join(pieces: list[tuple[np.ndarray, ...]], relaxation: int = 0) -> Segments:
    columns = [np.stack(column) for column in zip(*pieces, strict=True)]
    return Segments(
        *(as_array(c, bool if c.dtype == bool else jnp.zeros(()).dtype) for c in columns),
        relaxation=relaxation,
    )


def noise_scale(aligned: Aligned, model: Model, fast: bool = False) -> Float[np.ndarray, " last"]:
    """Standard deviation of the observation noise, for each entry of the last observation axis.

    From the third differences of consecutive frames, in which smooth motion all but vanishes and
    white noise has 20 times its variance; by their median, so that jerks do not count (Gasser,
    Sroka and Jennen-Steinmetz, Biometrika 73, 1986). Of `fast` motion the sixth are asked too
    (924 times): where they show less than half as much, it was motion that the third ones showed.
    Angles are differences of the model's.
    """
    last = model.observation_shape[-1]
    floor = 1e-5 * max(float(np.nanmax(np.abs(aligned.observation), initial=0.0)), 1e-3)
    changes = [
        difference(model, observed[1:], observed[:-1])
        for trial, length in enumerate(aligned.length)
        for observed in [np.asarray(aligned.observation[trial, :length], np.float64)]
    ]

    def scale(order: int, growth: float) -> np.ndarray:
        found = [
            np.diff(change, n=order - 1, axis=0).reshape(-1, last)
            for change in changes
            if len(change) >= order
        ]
        values = np.abs(np.concatenate(found)) if found else np.zeros((0, last))
        seen = [values[np.isfinite(values[:, index]), index] for index in range(last)]
        medians = np.array([float(np.median(v)) if v.size else 0.0 for v in seen])
        return np.maximum(medians / 0.6745 / np.sqrt(growth), floor)

    third = scale(3, 20.0)
    if not fast:
        return third
    sixth = scale(6, 924.0)
    return np.where((sixth < 0.5 * third) & (sixth > floor), sixth, third)


def difference(model: Model, predicted: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """The model's difference of two arrays of observations, in float64.

    Of so many at a time as a power of two says, a thousand or more: trials and pieces have many
    lengths, and XLA would compile one subtraction for each.
    """
    pair = np.broadcast_arrays(predicted, observed)
    shape, each = pair[0].shape, model.observation_shape
    count = math.prod(shape[: len(shape) - len(each)])
    room = 1 << max(count - 1, 1023).bit_length()
    padded = np.zeros((2, room, *each), np.result_type(*pair))
    padded[:, :count] = np.reshape(pair, (2, count, *each))
    off = np.asarray(_difference(model, as_array(padded)), np.float64)
    return off[:count].reshape(shape)


@eqx.filter_jit
def _difference(model: Model, pair: Array) -> Array:
    return model.difference(pair[0], pair[1])


def stands_still(model: Model, early: np.ndarray, late: np.ndarray, noise: np.ndarray) -> bool:
    """Whether the means of frames early and late, equally many, differ no more than noise does.

    Forces count only where nothing else is observed: they change at rest, as their sensors drift.
    """
    moved = np.abs(difference(model, late.mean(axis=0), early.mean(axis=0)))
    still = moved <= MOVED * noise * np.sqrt(2.0 / len(early))
    moving = ~model.observes_force
    return bool(np.all(still[..., moving] if moving.any() else still))


def _rest(observed: np.ndarray, model: Model, spread: np.ndarray, period: float) -> int:
    """For how many frames of a trial that begins at rest nothing moves beyond the noise; or one.

    Only half of them count: what began to move slowly moved for a while before it was seen to. Nor
    does the second half of a trial: one that rests to its end shows something, too.
    """
    frames = max(2, round(STILL / period))
    first, rest = observed[:frames], frames
    while rest + frames <= len(observed):
        if not stands_still(model, first, observed[rest : rest + frames], spread):
            break
        rest += frames
    return max(1, min(rest, len(observed)) // 2)


def _mean(
    observed: np.ndarray, model: Model, rest: int, period: float, spread: np.ndarray
) -> tuple[np.ndarray, ...] | None:
    """Pose, rate and their deviations at the end of a rest of so many frames."""
    found = _fit_polynomial(observed, model, 0, slice(0, rest), 0, period)
    if found is None:
        return None
    noise = np.broadcast_to(spread, observed.shape[1:])
    # No piece sees these frames again: what `moved` widens is narrowed to what they say.
    return found[0][0], np.zeros_like(noise), noise * found[1][0] / VAGUE, np.zeros_like(noise)


def _smooth(
    observed: np.ndarray,
    model: Model,
    first: int,
    period: float,
    spread: np.ndarray,
    still: bool = False,
    reaches: int = 3,
) -> tuple[np.ndarray, ...] | None:
    """Pose, rate and their deviations at a frame; None where too little is seen around it.

    Of several `reaches`, each half the one before, each channel has the longest over which the
    polynomial misses it by no more than noise may; where it misses in all, the deviations grow by
    what it misses over the shortest. With one, the deviations are those of the noise alone.
    """
    noise = np.broadcast_to(spread, observed.shape[1:])
    if still:
        around = slice(first, first + max(1, round(STILL / period)))
        found = _fit_polynomial(observed, model, first, around, 0, period)
        if found is None:
            return None
        pose, deviation, *_ = found
        return pose[0], np.zeros_like(noise), noise * deviation[0], np.zeros_like(noise)
    best, reach = None, max(ORDER, round(REACH / period))
    for within in sorted({reach // 2**halved for halved in range(reaches)}):
        around = slice(max(0, first - within), first + within + 1)
        found = _fit_polynomial(observed, model, first, around, ORDER, period)
        if found is None:
            continue
        value, deviation, squares, freedom = found
        missed = squares / np.square(noise)
        start = (*value[:2], noise * deviation[0], noise * deviation[1])
        if reaches == 1:
            return start
        if best is None:
            grown = np.sqrt(np.maximum(1.0, missed / freedom))
            best = (*start[:2], grown * start[2], grown * start[3])
        good = missed <= chi2.isf(CHANCE, freedom)
        best = tuple(np.where(good, new, old) for new, old in zip(start, best, strict=True))
    return best


def _fit_polynomial(
    observed: np.ndarray, model: Model, first: int, around: slice, order: int, period: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int] | None:
    """A polynomial in time about a frame, by least squares; None where too little is seen.

    Its value and derivatives there, their deviations for noise of one, the sum of the squares that
    it misses by for each channel, and how many degrees of freedom those have.
    """
    near = np.asarray(observed[around], np.float64)
    frames = np.flatnonzero(np.all(np.isfinite(near).reshape(len(near), -1), axis=1))
    if len(frames) < (order + 2 if order else 1):
        return None
    after = frames + around.start - first
    reference = near[frames[np.argmin(np.abs(after))]]
    offset = difference(model, near[frames], np.broadcast_to(reference, near[frames].shape))
    powers = (after * period)[:, None] ** np.arange(order + 1)
    flat = offset.reshape(len(frames), -1)
    coefficients, *_ = np.linalg.lstsq(powers, flat, rcond=None)
    squares = np.square(flat - powers @ coefficients).sum(axis=0).reshape(reference.shape)
    value = coefficients.reshape(-1, *reference.shape)
    value[0] += reference
    deviation = np.sqrt(np.diag(np.linalg.inv(powers.T @ powers)))
    return value, deviation, squares, len(frames) - order - 1


def _pad(
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
