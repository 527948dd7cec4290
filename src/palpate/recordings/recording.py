"""What was observed: named channels, each with its own clock, in trials.

A `Channel` is one sensor or one input with its own time stamps; a `Trial` holds the channels of
one uninterrupted run; a `Recording` holds trials and says where they came from. Sensors miss
things, stamps jitter and rows arrive out of order: that is normal, is put right here where it can
be, and is written down in `Recording.notes`. What may not happen (NaN in an input, an infinite
value, a time that is not a number) is refused.

Algorithms do not work on channels but on `Recording.align`, which puts the observation and the
action of every trial on one uniform grid of control periods.
"""

from __future__ import annotations

import enum
import json
import math
import numbers
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from palpate.errors import PalpateError
from palpate.recordings.alignment import in_order, interpolate, mean_in_force

OBSERVATION_GAP = 3  # nominal periods over which an observation may be interpolated
DRIVEN_GAP = 10  # nominal periods over which a driven state may be interpolated
ON_STAMP = 1e-3  # control periods by which a frame may miss a stamp and still stand on it
LARGEST = 4 * 2**30  # bytes; more is a mistake in a clock, a period or a file, not a recording


class Role(enum.Enum):
    """What a channel is to the system that was recorded.

    `OBSERVATION` is what a sensor showed; NaN means not seen. `DRIVEN` is a measured state imposed
    on the system, such as the position of a gripped marker: it varies linearly between stamps.
    `COMMAND` is an order in force from its stamp until the next one, of which a model gets the mean
    over each of its periods: a force, a velocity, no switch and no angle. NaN is refused in both.
    """

    OBSERVATION = "observation"
    DRIVEN = "driven"
    COMMAND = "command"


@dataclass(frozen=True, eq=False)
class Channel:
    """One sensor or input: `values` (frames, *shape) in `unit` at `time` (frames,) in seconds.

    Rows out of order are sorted; of rows with the same stamp the later one wins; `notes` says how
    many. Values keep float32 and become float64 otherwise. The arrays are copies and read-only.

    Raises `PalpateError` if a stamp is not finite, a value is infinite, an input is NaN, there are
    no frames, or shapes or dtypes do not fit.
    """

    name: str
    role: Role
    time: np.ndarray
    values: np.ndarray
    unit: str
    frame: str = "world"
    axes: str = "x y z, z up"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        label = f"channel '{self.name}'"
        time = _floats(self.time, f"the time of {label}").astype(np.float64)
        values = _floats(self.values, label)
        if time.ndim != 1 or values.ndim < 1 or len(values) != len(time):
            raise PalpateError(
                f"{label} needs time (frames,) and values (frames, ...) of one length, "
                f"but time is {time.shape} and values are {values.shape}"
            )
        if values.size == 0:
            raise PalpateError(f"{label} is empty: its values have shape {values.shape}")
        if not np.isfinite(time).all():
            row = int(np.argmin(np.isfinite(time)))
            raise PalpateError(f"{label} has the time {time[row]} in row {row}: stamps are finite")
        if np.isinf(values).any():
            where = _first(np.isinf(values))
            raise PalpateError(f"{label} is infinite at {where}: write NaN for what was not seen")
        if self.role is not Role.OBSERVATION and np.isnan(values).any():
            where = _first(np.isnan(values))
            raise PalpateError(
                f"{label} is a {self.role.value} input but NaN at {where}: an input has to be "
                "known at each of its stamps, so fill short gaps and cut the trial at long ones"
            )
        time, values, notes = in_order(time, values)
        time.setflags(write=False)
        values.setflags(write=False)
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "notes", (*self.notes, *notes))

    @property
    def nominal_period(self) -> float:
        """The median difference of neighbouring stamps, s; NaN for a single frame."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else math.nan


@dataclass(frozen=True, eq=False)
class Trial:
    """One uninterrupted run: `channels` by name, all on one clock."""

    name: str
    channels: Mapping[str, Channel]

    def __post_init__(self) -> None:
        if not self.channels:
            raise PalpateError(f"trial '{self.name}' has no channels")
        for key, channel in self.channels.items():
            if key != channel.name:
                raise PalpateError(
                    f"trial '{self.name}' lists channel '{channel.name}' under the name '{key}'"
                )
        object.__setattr__(self, "channels", dict(self.channels))

    def __getitem__(self, name: str) -> Channel:
        """The channel called `name`; raises `PalpateError` that lists those there are."""
        if name not in self.channels:
            there = ", ".join(self.channels)
            raise PalpateError(f"trial '{self.name}' has no channel '{name}'; it has: {there}")
        return self.channels[name]

    @property
    def duration(self) -> float:
        """Seconds from the first stamp of any channel to the last of any."""
        channels = self.channels.values()
        return float(max(c.time[-1] for c in channels) - min(c.time[0] for c in channels))


@dataclass(frozen=True, eq=False)
class Aligned:
    """A recording on a uniform grid of `period` seconds, trials padded to the longest.

    `observation` (trials, frames, *shape) is NaN where nothing was seen and past a trial's end.
    `action` (trials, frames - 1, *shape) acts from frame t to t + 1; past a trial's end the last
    one is repeated. `length` (trials,) counts the frames of each trial.
    """

    period: float
    observation: np.ndarray
    action: np.ndarray
    length: np.ndarray


@dataclass(frozen=True, eq=False)
class Recording:
    """Trials with different names, and `provenance`: where they came from, as text and numbers."""

    trials: tuple[Trial, ...]
    provenance: Mapping[str, str | float | int]

    def __post_init__(self) -> None:
        trials = tuple(self.trials)
        if not trials:
            raise PalpateError("a recording needs at least one trial")
        names = [trial.name for trial in trials]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise PalpateError(f"two trials are called '{twice}': trials need different names")
        provenance = {str(key): _fact(str(key), value) for key, value in self.provenance.items()}
        object.__setattr__(self, "trials", trials)
        object.__setattr__(self, "provenance", provenance)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was put right or left out, one sentence each, for a person to read."""
        return tuple(
            f"trial '{trial.name}', {channel.name}: {note}"
            for trial in self.trials
            for channel in trial.channels.values()
            for note in channel.notes
        )

    def select(self, indices: Sequence[int]) -> Recording:
        """The trials at `indices`, in that order; negative ones count from the end."""
        chosen = resolve_indices(indices, len(self.trials), "trial")
        return replace(self, trials=tuple(self.trials[i] for i in chosen))

    def split(self, fraction: float, seed: int) -> tuple[Recording, Recording]:
        """(train, validation) by trial: `fraction` of the trials, drawn by `seed`, validate.

        At least one trial stands on each side; the order of the trials is kept.
        """
        if not 0 < fraction < 1:
            raise PalpateError(f"the fraction for validation lies between 0 and 1, not {fraction}")
        count = len(self.trials)
        if count < 2:
            raise PalpateError(
                f"the only trial, '{self.trials[0].name}', cannot be split: "
                "give another recording for validation"
            )
        held_out = min(max(round(fraction * count), 1), count - 1)
        order = np.random.default_rng(seed).permutation(count)
        return (
            self.select(sorted(order[held_out:].tolist())),
            self.select(sorted(order[:held_out].tolist())),
        )

    def align(
        self, period: float, observation: str | None = None, action: str | None = None
    ) -> Aligned:
        """Put one observation and one action channel on a uniform grid of `period` seconds.

        `observation` and `action` name the channels (default: the only one of that role). Each
        trial's grid starts at the later of their first stamps and ends with the observation, or
        with the driven state if that ends earlier.

        An observation is interpolated linearly between its two neighbouring stamps where both
        were seen and lie at most 3 nominal periods apart, and is NaN otherwise. The action at
        frame t is, for a driven channel, its interpolated value at frame t + 1 (where the driven
        thing has to be at the end of the period) and, for a command, the mean over the period of
        the orders in force: what a force adds to the momentum, however much faster it is told.

        Raises `PalpateError` if a channel is missing or ambiguous, differs in role, unit or shape
        between trials, if a driven state has a gap of more than 10 nominal periods, or if a trial
        does not last one period.
        """
        if not (math.isfinite(period) and period > 0):
            raise PalpateError(
                f"the period has to be a positive number of seconds, not {period}: a channel of a "
                "single stamp has none"
            )
        seen = self._pick(observation, "observation", (Role.OBSERVATION,))
        acted = self._pick(action, "action", (Role.DRIVEN, Role.COMMAND))
        spans = [
            _span(trial, sensor, source, period)
            for trial, sensor, source in zip(self.trials, seen, acted, strict=True)
        ]
        lengths = [length for _, length in spans]
        count, frames = len(lengths), max(lengths)
        if 8 * count * frames * (seen[0].values[0].size + acted[0].values[0].size) > LARGEST:
            longest = self.trials[int(np.argmax(lengths))]
            raise PalpateError(
                f"{count} trials of up to {frames} frames of {period:.4g} s do not fit in memory: "
                f"trial '{longest.name}' is {longest.duration:.6g} s long, so check its time "
                "stamps or take a longer period"
            )
        aligned = Aligned(
            period=float(period),
            observation=np.full(
                (count, frames, *seen[0].values.shape[1:]),
                np.nan,
                np.result_type(*(c.values for c in seen)),
            ),
            action=np.empty(
                (count, frames - 1, *acted[0].values.shape[1:]),
                np.result_type(*(c.values for c in acted)),
            ),
            length=np.array(lengths),
        )
        for i, (trial, (start, length)) in enumerate(zip(self.trials, spans, strict=True)):
            grid = start + period * np.arange(length)
            aligned.observation[i, :length] = _interpolated(
                seen[i], grid, OBSERVATION_GAP, ON_STAMP * period
            )
            actions = _actions(acted[i], grid, trial, period)
            aligned.action[i, : length - 1] = actions
            aligned.action[i, length - 1 :] = actions[-1]
        for array in (aligned.observation, aligned.action, aligned.length):
            array.setflags(write=False)
        return aligned

    def _pick(self, name: str | None, what: str, roles: tuple[Role, ...]) -> list[Channel]:
        """The channel to align in each trial: the one called `name`, or the only one there is."""
        picked: list[Channel] = []
        for trial in self.trials:
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
            channel = fitting[0]
            first = picked[0] if picked else channel
            for kind, there, here in (
                ("shape", first.values.shape[1:], channel.values.shape[1:]),
                ("role", first.role.value, channel.role.value),
                ("unit", first.unit, channel.unit),
                ("frame", first.frame, channel.frame),
                ("axes", first.axes, channel.axes),
            ):
                if there != here:
                    raise PalpateError(
                        f"'{channel.name}' has the {kind} {here} in trial '{trial.name}' but "
                        f"{there} in trial '{self.trials[0].name}': trials have to agree"
                    )
            picked.append(channel)
        return picked


def join(recordings: Sequence[Recording]) -> Recording:
    """All trials of `recordings` in one; of equal names the later ones get a number.

    Provenance that differs is joined as text.
    """
    trials: list[Trial] = []
    taken: set[str] = set()
    provenance: dict[str, str | float | int] = {}
    for recording in recordings:
        for trial in recording.trials:
            name, number = trial.name, 2
            while name in taken:
                name, number = f"{trial.name} ({number})", number + 1
            taken.add(name)
            trials.append(replace(trial, name=name))
        for key, value in recording.provenance.items():
            told = provenance.setdefault(key, value)
            if not _same_fact(told, value):
                provenance[key] = f"{told}; {value}"
    return Recording(tuple(trials), provenance)


def _same_fact(one: str | float | int, other: str | float | int) -> bool:
    """Whether two facts are the same; of lists and objects in JSON however they are written."""
    if one == other:
        return True
    try:
        first, second = (json.loads(str(fact)) for fact in (one, other))
    except (ValueError, RecursionError):
        return False
    return isinstance(first, dict | list) and bool(first == second)


def _span(trial: Trial, sensor: Channel, source: Channel, period: float) -> tuple[float, int]:
    """The time of the first frame and the number of frames that both channels cover."""
    start = float(max(sensor.time[0], source.time[0]))
    end = float(sensor.time[-1])
    if source.role is Role.DRIVEN:
        end = min(end, float(source.time[-1]))
    length = math.floor(min((end - start) / period + ON_STAMP, LARGEST)) + 1
    if length < 2:
        raise PalpateError(
            f"'{sensor.name}' and '{source.name}' of trial '{trial.name}' overlap for "
            f"{max(end - start, 0.0):.4g} s, less than one period of {period:.4g} s"
        )
    return start, length


def _interpolated(channel: Channel, grid: np.ndarray, gap: int, slack: float) -> np.ndarray:
    """See `interpolate`; `gap` is in nominal periods."""
    seconds = gap * channel.nominal_period * (1 + ON_STAMP)
    return interpolate(channel.time, channel.values, grid, seconds, slack)


def _actions(channel: Channel, grid: np.ndarray, trial: Trial, period: float) -> np.ndarray:
    """What acts from each frame of `grid` to the next, (len(grid) - 1, *shape)."""
    if channel.role is Role.COMMAND:
        return mean_in_force(channel.time, channel.values, grid, ON_STAMP * period)
    actions = _interpolated(channel, grid[1:], DRIVEN_GAP, ON_STAMP * period)
    unknown = np.isnan(actions).reshape(len(actions), -1).any(axis=1)
    if unknown.any():
        raise PalpateError(
            f"'{channel.name}' of trial '{trial.name}' has no stamps around "
            f"{grid[1:][unknown][0]:.4f} s for more than {DRIVEN_GAP} of its periods of "
            f"{channel.nominal_period:.4g} s: cut the trial there"
        )
    return actions


def _floats(array: np.ndarray, what: str) -> np.ndarray:
    """A native, contiguous copy as float32 or float64."""
    array = np.asarray(array)
    if array.dtype.kind not in "fiu":
        raise PalpateError(f"{what} has to be real numbers, but its dtype is {array.dtype}")
    single = array.dtype.kind == "f" and array.dtype.itemsize <= 4
    return np.array(array, dtype=np.float32 if single else np.float64, order="C")


def _first(flags: np.ndarray) -> str:
    where = np.unravel_index(int(np.argmax(flags)), flags.shape)
    return f"row {where[0]}" + (f", entry {tuple(map(int, where[1:]))}" if len(where) > 1 else "")


def resolve_indices(indices: Sequence[int], count: int, what: str) -> list[int]:
    """`indices` counted from the start; refuses what is out of range or named twice."""
    chosen = []
    for index in indices:
        if not -count <= index < count:
            raise PalpateError(
                f"there is no {what} {index}: there are {count}, 0 to {count - 1} or -{count} to -1"
            )
        if index % count in chosen:
            raise PalpateError(f"{what} {index} is named twice in {list(indices)}")
        chosen.append(int(index) % count)
    return chosen


def _fact(key: str, value: object) -> str | float | int:
    """A value of the provenance as plain text or a finite number, which a file can hold."""
    if isinstance(value, str):
        return value
    if isinstance(value, numbers.Integral):
        return int(value)
    if isinstance(value, numbers.Real) and math.isfinite(value):
        return float(value)
    raise PalpateError(f"provenance '{key}' has to be text or a finite number, not {value!r}")
