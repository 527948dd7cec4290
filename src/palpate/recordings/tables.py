"""Tables of markers, as foreign files hold them, as recordings in metres and z up."""

import math
from dataclasses import dataclass

import numpy as np

from palpate.errors import PalpateError
from palpate.recordings.channel import Channel, Role
from palpate.recordings.recording import Recording
from palpate.recordings.trial import Trial

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
Z_UP = {"x": ([1, 2, 0], [1, 1, 1]), "y": ([0, 2, 1], [1, -1, 1]), "z": ([0, 1, 2], [1, 1, 1])}
_PLAUSIBLE = (0.01, 50.0)  # metres of a polyline through all markers


@dataclass(frozen=True, eq=False)
class InputTable:
    """What drove the object, in the file's own unit and axes: `values` (frames, 1, 3)."""

    name: str
    role: Role
    time: np.ndarray
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class MarkerTable:
    """What a file tells about one trial, in the file's own unit and axes.

    `positions` (frames, markers, 3) with NaN for what was not seen, `time` (frames,) in seconds or
    None, `unit` ("m", "cm", "mm") or None and `up` ("y" or None) where the format says so, and the
    `inputs` that drove the object.
    """

    format: str
    time: np.ndarray | None
    positions: np.ndarray
    markers: tuple[str, ...] = ()
    unit: str | None = None
    up: str | None = None
    notes: tuple[str, ...] = ()
    inputs: tuple[InputTable, ...] = ()


def recording_of(
    tables: list[tuple[str, MarkerTable]],
    source: str,
    rate: float | None,
    unit: str | None,
    up: str | None,
) -> Recording:
    """A recording of the trials of one file, by their names, with markers and what drove them.

    `rate`, `unit` and `up` as in `palpate.recordings.files.read_recording`; `source` is the file.
    """
    table = tables[0][1]
    if unit and table.unit and unit != table.unit:
        raise PalpateError(f"the file says its unit is {table.unit}, not {unit}: leave unit out")
    if table.time is None and rate is None:
        raise PalpateError("the file has no time: give --rate, e.g. --rate 100")
    unit, up = unit or table.unit or "m", up or table.up or "z"
    trials = tuple(_trial(name, table, rate, unit, up) for name, table in tables)
    _check_length(trials, unit)
    provenance = {"file": source, "format": table.format, "unit": unit, "up": up}
    if table.markers:
        provenance["markers"] = ", ".join(table.markers)
    return Recording(trials, provenance)


def _trial(name: str, table: MarkerTable, rate: float | None, unit: str, up: str) -> Trial:
    positions, notes = table.positions, list(table.notes)
    try:
        if np.isinf(positions).any():
            frame, marker, _ = (int(i) for i in np.argwhere(np.isinf(positions))[0])
            raise PalpateError(
                f"marker {marker} is infinite in frame {frame}: what was not seen has to be NaN"
            )
        seen = ~np.isnan(positions).any(axis=-1)
        rows = np.flatnonzero(seen.any(axis=-1))
        if not len(rows):
            raise PalpateError("no marker is seen in any frame")
        # Padding of a short trial, or a capture that ran before and after the markers were there.
        kept = slice(rows[0], rows[-1] + 1)
        if cut := len(positions) - (kept.stop - kept.start):
            notes.append(f"{cut} frames at the ends in which nothing was seen were left out")
        if never := [str(i) for i in np.flatnonzero(~seen.any(axis=0))]:
            notes.append(f"never seen: marker {', '.join(never)}")
        time = np.arange(len(positions)) / (rate or 1.0) if table.time is None else table.time
        metres = _in_metres(positions[kept], unit, up)
        if positions.dtype.kind == "f" and positions.dtype.itemsize <= 4:
            metres = metres.astype(np.float32)
        role = Role.OBSERVATION
        channels = [Channel("markers", role, time[kept], metres, "m", notes=tuple(notes))]
        for part in table.inputs:
            si = "m/s" if part.role is Role.COMMAND else "m"
            values = _in_metres(part.values, unit, up)
            channels.append(Channel(part.name, part.role, part.time, values, si))
    except PalpateError as error:
        raise PalpateError(f"trial '{name}': {error}") from error
    return Trial(name, {channel.name: channel for channel in channels})


def _in_metres(values: np.ndarray, unit: str, up: str) -> np.ndarray:
    """Positions or velocities (..., 3) in metres and z up, float64."""
    order, signs = Z_UP[up]
    # In float64 and rounded once; -0.0 is not worth keeping.
    return values[..., order] * np.array(signs, np.float64) * METRES[unit] + 0.0


def _check_length(trials: tuple[Trial, ...], unit: str) -> None:
    """Refuse a unit in which the markers are implausibly far apart or close together."""
    values = [trial["markers"].values for trial in trials]
    with np.errstate(over="ignore"):
        segments = np.concatenate(
            [np.linalg.norm(np.diff(markers, axis=1), axis=2) for markers in values]
        )
    segments = segments[:, ~np.isnan(segments).all(axis=0)]
    if not segments.size:
        return
    length = float(np.nanmedian(segments, axis=0).sum())
    if not _PLAUSIBLE[0] <= length <= _PLAUSIBLE[1]:
        metres = length / METRES[unit]
        likely = min(METRES, key=lambda u: abs(math.log(metres * METRES[u] + 1e-300)))
        fits = _PLAUSIBLE[0] <= metres * METRES[likely] <= _PLAUSIBLE[1]
        advice = f"pass the right unit, e.g. --unit {likely}" if fits else "check the file"
        raise PalpateError(
            f"a line through all markers is {length:.3g} m long if the unit is {unit}, "
            f"which looks wrong: {advice}"
        )
