"""What one sensor or one input gave, with its own time stamps: sampled values, or events.

Sensors miss things, stamps jitter and rows arrive out of order: that is normal, is put right here
where it can be, and is written down in `notes`. What may not happen (NaN in an input, an infinite
value, a time that is not a number) is refused.
"""

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpate.errors import PalpateError


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
        time = _stamps(self.time, label)
        values = _floats(self.values, label)
        if time.ndim != 1 or values.ndim < 1 or len(values) != len(time):
            raise PalpateError(
                f"{label} needs time (frames,) and values (frames, ...) of one length, "
                f"but time is {time.shape} and values are {values.shape}"
            )
        if values.size == 0:
            raise PalpateError(f"{label} is empty: its values have shape {values.shape}")
        _check_finite(values, label)
        if self.role is not Role.OBSERVATION and np.isnan(values).any():
            where = _first(np.isnan(values))
            raise PalpateError(
                f"{label} is a {self.role.value} input but NaN at {where}: an input has to be "
                "known at each of its stamps, so fill short gaps and cut the trial at long ones"
            )
        time, rows, notes = _in_order(time)
        values = values[rows]
        values.setflags(write=False)
        vars(self).update(time=time, values=values, notes=(*self.notes, *notes))

    @property
    def nominal_period(self) -> float:
        """The median difference of neighbouring stamps, s; NaN for a single frame."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else math.nan


@dataclass(frozen=True, eq=False)
class Events:
    """What is never interpolated, such as clouds and images: one array at each stamp.

    `values` are arrays (size, *shape), one for each of `time` (events,) in s. They have one dtype
    and one `shape`, and each a size of its own: clouds (points, 3) in m, where NaN is a point that
    was not seen, or images (rows, columns, 3). All else as in `Channel`, but dtypes are kept.

    Raises `PalpateError` if a stamp is not finite, a value is infinite, there are no events, or
    shapes or dtypes do not fit.
    """

    name: str
    time: np.ndarray
    values: Sequence[np.ndarray]
    unit: str
    frame: str = "world"
    axes: str = "x y z, z up"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        label = f"event channel '{self.name}'"
        time = _stamps(self.time, label)
        arrays = [np.asarray(array) for array in self.values]
        if not arrays or time.shape != (len(arrays),):
            raise PalpateError(
                f"{label} needs at least one stamp and an array for each, "
                f"but time is {time.shape} and there are {len(arrays)} arrays"
            )
        kinds = {(array.dtype, ("any", *array.shape[1:])) for array in arrays}
        if len(kinds) > 1 or arrays[0].dtype.kind not in "fiu" or not all(map(np.ndim, arrays)):
            raise PalpateError(
                f"{label} has arrays of {' and '.join(sorted(f'{d} {s}' for d, s in kinds))}: "
                "expected numbers of one dtype and one shape but for the first axis"
            )
        time, kept, notes = _in_order(time)
        arrays = [arrays[index] for index in kept]
        values = np.concatenate(arrays).astype(arrays[0].dtype.newbyteorder("="), copy=False)
        if values.dtype.kind == "f":
            _check_finite(values, label)
        values.setflags(write=False)
        ends = np.cumsum([len(array) for array in arrays])
        parts = tuple(np.split(values, ends[:-1]))
        vars(self).update(time=time, values=parts, notes=(*self.notes, *notes))


def _stamps(time: np.ndarray, label: str) -> np.ndarray:
    """A copy of the time stamps as finite float64."""
    time = _floats(time, f"the time of {label}").astype(np.float64)
    if not np.isfinite(time).all():
        where = np.unravel_index(int(np.argmin(np.isfinite(time))), time.shape)
        raise PalpateError(
            f"{label} has the time {time[where]} in row {where[0]}: stamps are finite"
        )
    return time


def _in_order(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Ascending read-only stamps, their rows (the last of equal stamps), and what was done."""
    notes = []
    rows = np.arange(len(time))
    behind = np.maximum.accumulate(time) - time
    if late := int((behind > 0).sum()):
        notes.append(
            f"{late} of {len(time)} rows were out of order, by up to {behind.max():.4g} s, "
            "and were sorted"
        )
        rows = np.argsort(time, kind="stable")
    last = np.append(np.diff(time[rows]) > 0, True)
    if repeated := int((~last).sum()):
        notes.append(f"{repeated} rows had the stamp of a later row and were dropped")
    rows = rows[last]
    time = time[rows]
    time.setflags(write=False)
    return time, rows, tuple(notes)


def _floats(array: np.ndarray, what: str) -> np.ndarray:
    """A native, contiguous copy as float32 or float64."""
    array = np.asarray(array)
    if array.dtype.kind not in "fiu":
        raise PalpateError(f"{what} has to be real numbers, but its dtype is {array.dtype}")
    single = array.dtype.kind == "f" and array.dtype.itemsize <= 4
    return np.array(array, dtype=np.float32 if single else np.float64, order="C")


def _check_finite(values: np.ndarray, label: str) -> None:
    if np.isinf(values).any():
        where = _first(np.isinf(values))
        raise PalpateError(f"{label} is infinite at {where}: write NaN for what was not seen")


def _first(flags: np.ndarray) -> str:
    where = np.unravel_index(int(np.argmax(flags)), flags.shape)
    return f"row {where[0]}" + (f", entry {tuple(map(int, where[1:]))}" if len(where) > 1 else "")
