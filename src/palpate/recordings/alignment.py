"""Recordings on a uniform grid of control periods: interpolated, averaged, or looked up.

Algorithms do not work on channels but on `Aligned`, which `Recording.align` makes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from palpate.errors import PalpateError
from palpate.recordings.channel import Channel, Role
from palpate.recordings.trial import Trial

OBSERVATION_GAP = 3  # nominal periods over which an observation may be interpolated
DRIVEN_GAP = 10  # nominal periods over which a driven state may be interpolated
ON_STAMP = 1e-3  # control periods by which a frame may miss a stamp and still stand on it
MAX_BYTES = 4 * 2**30  # bytes; more is a mistake in a clock, a period or a file, not a recording

Names = str | Sequence[str] | None


@dataclass(frozen=True, eq=False)
class Aligned:
    """A recording on a uniform grid of `period` seconds, trials padded to the longest.

    `observation` (trials, frames, *shape) is NaN where nothing was seen and past a trial's end.
    `action` (trials, frames - 1, *shape) acts from frame t to t + 1; past a trial's end the last
    one is repeated. `length` (trials,) counts the frames of each trial.

    Of several channels the numbers of a frame stand side by side, (trials, frames, numbers), while
    `observations` and `actions` have each by its name and in its own shape. `events` (trials,
    frames) by name: the newest event's index, -1 before the first one and past a trial's end.
    """

    period: float
    observation: np.ndarray
    action: np.ndarray
    length: np.ndarray
    observations: Mapping[str, np.ndarray] = field(default_factory=dict)
    actions: Mapping[str, np.ndarray] = field(default_factory=dict)
    events: Mapping[str, np.ndarray] = field(default_factory=dict)


def align(
    trials: Sequence[Trial], period: float, observation: Names, action: Names, events: Sequence[str]
) -> Aligned:
    """See `Recording.align`."""
    if not (math.isfinite(period) and period > 0):
        raise PalpateError(
            f"the period has to be a positive number of seconds, not {period}: a channel of a "
            "single stamp has none"
        )
    observed = _pick(trials, observation, "observation", (Role.OBSERVATION,))
    acting = _pick(trials, action, "action", (Role.DRIVEN, Role.COMMAND))
    if not observed:
        raise PalpateError("no observation is named: expected at least one")
    spans = [_span(period, *each) for each in zip(trials, *observed, *acting, strict=True)]
    count, frames = len(trials), max(length for _, length in spans)
    numbers = sum(channels[0].values[0].size for channels in (*observed, *acting))
    if 8 * count * frames * numbers > MAX_BYTES:
        longest = next(t for t, (_, length) in zip(trials, spans, strict=True) if length == frames)
        raise PalpateError(
            f"{count} trials of up to {frames} frames of {period:.4g} s do not fit in memory: "
            f"trial '{longest.name}' is {longest.duration:.6g} s long, so check its time "
            "stamps or take a longer period"
        )
    observations = {of[0].name: _fill(of, frames, np.nan) for of in observed}
    actions = {of[0].name: _fill(of, frames - 1, 0.0) for of in acting}
    newest = {name: np.full((count, frames), -1) for name in events}
    slack = ON_STAMP * period
    for i, (trial, (start, length)) in enumerate(zip(trials, spans, strict=True)):
        grid = start + period * np.arange(length)
        for of, values in zip(observed, observations.values(), strict=True):
            values[i, :length] = _interpolate(of[i], grid, OBSERVATION_GAP, slack)
        for of, values in zip(acting, actions.values(), strict=True):
            values[i, : length - 1] = _actions(of[i], grid, trial, slack)
            values[i, length - 1 :] = values[i, length - 2]
        for name, index in newest.items():
            time = trial.event(name).time
            index[i, :length] = np.searchsorted(time, grid + slack, side="right") - 1
    aligned = Aligned(
        period=float(period),
        observation=_side_by_side(observations, np.empty((count, frames, 0))),
        action=_side_by_side(actions, np.empty((count, frames - 1, 0), np.float32)),
        length=np.array([length for _, length in spans]),
        observations=observations,
        actions=actions,
        events=newest,
    )
    by_name = (*observations.values(), *actions.values(), *newest.values())
    for array in (aligned.observation, aligned.action, aligned.length, *by_name):
        array.setflags(write=False)
    return aligned


def _pick(
    trials: Sequence[Trial], names: Names, what: str, roles: tuple[Role, ...]
) -> list[list[Channel]]:
    """Of each channel to align, that of each trial: those called `names`, or the only one."""
    wanted = [names] if names is None or isinstance(names, str) else list(names)
    if len(set(wanted)) < len(wanted):
        raise PalpateError(f"a channel is named twice as {what}: {', '.join(map(str, wanted))}")
    picked = [[_one(trial, name, what, roles) for trial in trials] for name in wanted]
    for first, trial, channel in (
        (of[0], *each) for of in picked for each in zip(trials, of, strict=True)
    ):
        for kind, there, here in (
            ("shape", first.values.shape[1:], channel.values.shape[1:]),
            ("role", first.role.value, channel.role.value),
            ("unit", first.unit, channel.unit),
            ("frame", first.frame, channel.frame),
            ("axes", first.axes, channel.axes),
        ):
            if there != here:
                raise PalpateError(
                    f"'{channel.name}' has the {kind} {here} in trial '{trial.name}' but {there} "
                    f"in trial '{trials[0].name}': trials have to agree"
                )
    return picked


def _one(trial: Trial, name: str | None, what: str, roles: tuple[Role, ...]) -> Channel:
    fitting = [c for c in trial.channels.values() if c.role in roles]
    if name is not None:
        fitting = [c for c in fitting if c is trial[name]]
    if len(fitting) != 1:
        kinds = " or ".join(role.value for role in roles)
        there = ", ".join(f"{c.name} ({c.role.value})" for c in trial.channels.values())
        raise PalpateError(
            f"trial '{trial.name}' needs one {kinds} channel as its {what}"
            + (f", which '{name}' is not" if name else "")
            + f"; it has: {there}; "
            + ("name one of them" if fitting else f"record one whose role is {kinds}")
        )
    return fitting[0]


def _span(period: float, trial: Trial, *channels: Channel) -> tuple[float, int]:
    """The time of the first frame and the number of frames that all channels cover."""
    start = max(float(channel.time[0]) for channel in channels)
    # An order outlives its stamp, a measured state does not.
    end = min(float(c.time[-1]) for c in channels if c.role is not Role.COMMAND)
    length = math.floor(min((end - start) / period + ON_STAMP, MAX_BYTES)) + 1
    if length < 2:
        names = " and ".join(f"'{channel.name}'" for channel in channels)
        raise PalpateError(
            f"{names} of trial '{trial.name}' overlap for "
            f"{max(end - start, 0.0):.4g} s, less than one period of {period:.4g} s"
        )
    return start, length


def _actions(channel: Channel, grid: np.ndarray, trial: Trial, slack: float) -> np.ndarray:
    """What acts from each frame of `grid` to the next, (len(grid) - 1, *shape)."""
    if channel.role is Role.COMMAND:
        return _mean_in_force(channel, grid, slack)
    actions = _interpolate(channel, grid[1:], DRIVEN_GAP, slack)
    unknown = np.isnan(actions).reshape(len(actions), -1).any(axis=1)
    if unknown.any():
        raise PalpateError(
            f"'{channel.name}' of trial '{trial.name}' has no stamps around "
            f"{grid[1:][unknown][0]:.4f} s for more than {DRIVEN_GAP} of its periods of "
            f"{channel.nominal_period:.4g} s: cut the trial there"
        )
    return actions


def _fill(channels: list[Channel], frames: int, value: float) -> np.ndarray:
    """(trials, frames, *shape) of `value`, for the values of one channel in each trial."""
    dtype = np.result_type(*(channel.values for channel in channels))
    return np.full((len(channels), frames, *channels[0].values.shape[1:]), value, dtype)


def _side_by_side(arrays: Mapping[str, np.ndarray], none: np.ndarray) -> np.ndarray:
    """The only array as it is, or the numbers of each frame of several; `none` without any."""
    if len(arrays) == 1:
        return next(iter(arrays.values()))
    flat = [array.reshape(*array.shape[:2], -1) for array in arrays.values()]
    return np.concatenate(flat, axis=2) if flat else none


def _interpolate(channel: Channel, grid: np.ndarray, gap: int, slack: float) -> np.ndarray:
    """Values (frames, *shape) at `grid`; NaN by a neighbour unseen or over `gap` periods away.

    A frame within `slack` seconds of a stamp stands on it and needs no other neighbour.
    """
    time, values = channel.time, channel.values
    right = np.clip(np.searchsorted(time, grid), 1, len(time) - 1)
    left = right - 1
    span = time[right] - time[left]
    weight = np.clip((grid - time[left]) / span, 0.0, 1.0)
    on_stamp = np.minimum(weight, 1 - weight) * span <= slack
    nearest = values[np.where(weight < 0.5, left, right)]

    def per_row(row: np.ndarray) -> np.ndarray:
        return row.reshape(-1, *(1,) * (values.ndim - 1))

    between = (1 - per_row(weight)) * values[left] + per_row(weight) * values[right]
    too_wide = span > gap * channel.nominal_period * (1 + ON_STAMP)
    between[too_wide & ~on_stamp] = np.nan
    return np.where(per_row(on_stamp) & np.isnan(between), nearest, between)


def _mean_in_force(channel: Channel, grid: np.ndarray, slack: float) -> np.ndarray:
    """The mean of orders from each frame of `grid` to the next, (len(grid) - 1, *shape).

    Each is in force until the next; a stamp within `slack` seconds of a frame is on it.
    """
    time, values = channel.time, channel.values
    first = np.searchsorted(time, grid[:-1] + slack, side="right") - 1
    last = np.searchsorted(time, grid[1:] - slack, side="right") - 1
    held = values[first]
    several = last > first
    if not several.any():
        return held
    # the integral is linear between the stamps, and beyond the last
    stamps = np.append(time, max(grid[-1], time[-1]))
    lasting = np.diff(stamps).reshape(-1, *(1,) * (values.ndim - 1))
    flat = (values * lasting).reshape(len(values), -1)
    integral = np.concatenate([np.zeros((1, flat.shape[1])), np.cumsum(flat, axis=0)])
    at = np.stack([np.interp(grid, stamps, column) for column in integral.T], axis=1)
    mean = np.diff(at, axis=0) / np.diff(grid)[:, None]
    held[several] = mean.reshape(held.shape)[several]
    return held
