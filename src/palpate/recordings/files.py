"""Recordings on disk: our NPZ, foreign NPZ of marker positions, motion-capture CSV, logs of robots.

Files come from anywhere, so nothing in them is believed: nothing is unpickled, sizes are checked
before memory is taken, and what is damaged or does not fit is refused with one sentence.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from palpate.errors import PalpateError
from palpate.recordings.csv import MarkerTable, read_csv
from palpate.recordings.recording import LARGEST, Channel, Recording, Role, Trial
from palpate.recordings.rosbag.bag import InputTable, read_bag
from palpate.recordings.rosbag.files import is_bag
from palpate.runs.storage import DamagedFileError, write_bytes

VERSION = 1
_ENTRY = "palpate.recording"
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_Z_UP = {"x": ([1, 2, 0], [1, 1, 1]), "y": ([0, 2, 1], [1, -1, 1]), "z": ([0, 1, 2], [1, 1, 1])}
_PLAUSIBLE = (0.01, 50.0)  # metres of a polyline through all markers


def read_recording(
    path: str | Path,
    *,
    rate: float | None = None,
    unit: str | None = None,
    up: str | None = None,
    topics: Sequence[str] = (),
) -> Recording:
    """Read a recording from `.npz` (ours or foreign), `.csv` or a log, in SI units and z up.

    A foreign NPZ holds `positions` (trials, frames, markers, 3) or (frames, markers, 3) and maybe
    `time` (frames,) or (trials, frames) in seconds; frames at the end of a trial where nothing
    was seen are padding. CSV is described at `csv.read_csv`. Both become one observation channel
    "markers" in each trial. Logs are MCAP files, rosbag2 folders or databases and ROS 1 bags,
    described at `rosbag.bag.read_bag`; `topics` names which of their topics to take, and besides
    "markers" they may give a driven "gripper" and a "command".

    `rate` (Hz) is for files without time, `unit` ("m", "cm", "mm") for files that do not say, and
    `up` ("x", "y", "z") names the axis that points up, by default y in a Motive export and z
    elsewhere. What contradicts the file is refused.

    Raises `PalpateError` for anything that is missing, damaged, too large or implausible.
    """
    path = Path(path)
    for option, value, known in (("unit", unit, _METRES), ("up", up, _Z_UP)):
        if value is not None and value not in known:
            raise PalpateError(f"{option} has to be one of {', '.join(known)}, not '{value}'")
    if rate is not None and not (math.isfinite(rate) and rate > 0):
        raise PalpateError(f"the rate has to be a positive number of Hz, not {rate}")
    inputs: list[tuple[InputTable, ...]] = []
    try:
        if topics and not is_bag(path):
            raise PalpateError("only logs have topics: leave topics out")
        if path.suffix.lower() == ".npz":
            found = _read_npz(path)
        elif path.suffix.lower() == ".csv":
            found = [(path.stem, read_csv(path))]
        elif is_bag(path):
            trials = read_bag(path, topics)
            found = [(name, table) for name, table, _ in trials]
            inputs = [driven for _, _, driven in trials]
        else:
            raise PalpateError(
                f"unknown kind of recording '{path.suffix}': known are .npz, .csv, .mcap, .db3, "
                ".bag and the folder of a rosbag2"
            )
        if isinstance(found, Recording):
            if unit not in (None, "m") or up not in (None, "z"):
                raise PalpateError("the file says its units and axes itself: leave unit and up out")
            recording = found
        else:
            recording = _from_tables(found, str(path), rate, unit, up)
            if any(inputs):
                recording = _with_inputs(recording, inputs, unit or "m", up or "z")
        _check_rate(recording, rate)
    except PalpateError as error:
        raise type(error)(f"{path}: {error}") from error
    except OSError as error:
        raise PalpateError(f"cannot read {path}: {error.strerror or error}") from error
    return recording


def write_recording(path: str | Path, recording: Recording) -> None:
    """Write `recording` to an NPZ file that `read_recording` restores exactly; atomic.

    The file holds plain arrays, `i.j.time` and `i.j.values` for channel j of trial i, and one JSON
    text, `palpate.recording`, with everything else. Raises `PalpateError` if it cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise PalpateError(f"{path}: recordings are written as .npz, not '{path.suffix}'")
    arrays: dict[str, np.ndarray] = {}
    trials = []
    for i, trial in enumerate(recording.trials):
        channels = []
        for j, channel in enumerate(trial.channels.values()):
            arrays[f"{i}.{j}.time"] = channel.time
            arrays[f"{i}.{j}.values"] = channel.values
            channels.append(
                {
                    "name": channel.name,
                    "role": channel.role.value,
                    "unit": channel.unit,
                    "frame": channel.frame,
                    "axes": channel.axes,
                    "notes": channel.notes,
                }
            )
        trials.append({"name": trial.name, "channels": channels})
    about = {"version": VERSION, "provenance": recording.provenance, "trials": trials}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{_ENTRY: np.array(json.dumps(about))}, **arrays)  # type: ignore
    write_bytes(path, buffer.getvalue())


def _read_npz(path: Path) -> Recording | list[tuple[str, MarkerTable]]:
    try:
        with zipfile.ZipFile(path) as archive:
            keys = [name[:-4] for name in archive.namelist() if name.endswith(".npy")]
            size = sum(entry.file_size for entry in archive.infolist())
            if size > LARGEST:
                raise PalpateError(
                    f"the file unpacks to {size / 2**30:.3g} GiB; at most {LARGEST / 2**30:.0f} "
                    "GiB are read: split it into several recordings"
                )
            if _ENTRY in keys:
                return _ours(archive)
            if "positions" not in keys:
                there = f"it holds {', '.join(keys[:8])}" if keys else "it holds no arrays"
                raise PalpateError(f"expected an array 'positions', but {there}")
            positions = _load(archive, "positions")
            time = _load(archive, "time") if "time" in keys else None
    except (PalpateError, OSError):
        raise
    except Exception as error:  # what zipfile, NumPy and json raise on wrong bytes has no end
        reason = str(error).partition("\n")[0]
        raise DamagedFileError(f"the file is damaged or not NPZ ({reason})") from error
    ignored = [key for key in keys if key not in ("positions", "time")]
    notes = (f"arrays that are no markers were left out: {', '.join(ignored)}",) if ignored else ()
    return _foreign(path.stem, positions, time, notes)


def _load(archive: zipfile.ZipFile, key: str) -> np.ndarray:
    """One array, after its header was found to agree with the room it takes in the file."""
    entry = archive.getinfo(f"{key}.npy")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise PalpateError(f"'{key}' is compressed in a way that NumPy does not write")
    with archive.open(entry) as stream:
        if npy.read_magic(stream) == (1, 0):
            shape, _, dtype = npy.read_array_header_1_0(stream)
        else:
            shape, _, dtype = npy.read_array_header_2_0(stream)
        if dtype.hasobject:
            raise PalpateError(f"'{key}' holds Python objects, which are never unpickled")
        if math.prod(shape) * dtype.itemsize != entry.file_size - stream.tell():
            raise DamagedFileError(
                f"'{key}' declares the shape {shape} of {dtype}, "
                f"but {entry.file_size - stream.tell()} bytes are there"
            )
    with archive.open(entry) as stream:
        return npy.read_array(stream, allow_pickle=False)


def _ours(archive: zipfile.ZipFile) -> Recording:
    text = _load(archive, _ENTRY)
    if text.dtype.kind != "U" or text.ndim:
        raise DamagedFileError(f"'{_ENTRY}' is not a text")
    about: Any = json.loads(str(text))
    if about["version"] != VERSION:
        raise PalpateError(
            f"the recording has version {about['version']}, but this palpate reads {VERSION}: "
            "read it with the palpate that wrote it"
        )
    trials = []
    for i, trial in enumerate(about["trials"]):
        channels = {}
        for j, channel in enumerate(trial["channels"]):
            texts = {key: str(channel[key]) for key in ("name", "unit", "frame", "axes")}
            channels[texts["name"]] = Channel(
                role=Role(channel["role"]),
                time=_load(archive, f"{i}.{j}.time"),
                values=_load(archive, f"{i}.{j}.values"),
                notes=tuple(str(note) for note in channel["notes"]),
                **texts,
            )
        trials.append(Trial(str(trial["name"]), channels))
    return Recording(tuple(trials), dict(about["provenance"]))


def _foreign(
    stem: str, positions: np.ndarray, time: np.ndarray | None, notes: tuple[str, ...]
) -> list[tuple[str, MarkerTable]]:
    if positions.dtype.kind not in "fiu":
        raise PalpateError(
            f"'positions' has to be real numbers, but its dtype is {positions.dtype}"
        )
    if positions.ndim not in (3, 4) or positions.shape[-1] != 3:
        raise PalpateError(
            "'positions' has to be (trials, frames, markers, 3) or (frames, markers, 3), "
            f"but is {positions.shape}"
        )
    if positions.size == 0:
        raise PalpateError(f"'positions' is empty: its shape is {positions.shape}")
    one = positions.ndim == 3
    positions = positions[None] if one else positions
    if time is not None:
        if time.dtype.kind not in "fiu":
            raise PalpateError(f"'time' has to be seconds, but its dtype is {time.dtype}")
        if time.shape not in (positions.shape[1:2], positions.shape[:2]):
            raise PalpateError(
                f"'time' has to be (frames,) or (trials, frames), {positions.shape[1:2]} or "
                f"{positions.shape[:2]}, but is {time.shape}"
            )
        time = np.broadcast_to(time, positions.shape[:2])
    return [
        (
            stem if one else f"{stem}/{i}",
            MarkerTable("NPZ", None if time is None else time[i], trial, notes=notes),
        )
        for i, trial in enumerate(positions)
    ]


def _from_tables(
    tables: list[tuple[str, MarkerTable]],
    source: str,
    rate: float | None,
    unit: str | None,
    up: str | None,
) -> Recording:
    """Markers in metres and z up from tables in the units and axes of one file."""
    table = tables[0][1]
    if unit and table.unit and unit != table.unit:
        raise PalpateError(f"the file says its unit is {table.unit}, not {unit}: leave unit out")
    if table.time is None and rate is None:
        raise PalpateError("the file has no time: give --rate, e.g. --rate 100")
    unit, up = unit or table.unit or "m", up or table.up or "z"
    trials = tuple(
        Trial(name, {"markers": _markers(name, table, rate, unit, up)}) for name, table in tables
    )
    _check_length(trials, unit)
    provenance: dict[str, str | float | int] = {
        "file": source,
        "format": table.format,
        "unit": unit,
        "up": up,
    }
    if table.markers:
        provenance["markers"] = ", ".join(table.markers)
    return Recording(trials, provenance)


def _markers(name: str, table: MarkerTable, rate: float | None, unit: str, up: str) -> Channel:
    positions = table.positions
    if np.isinf(positions).any():
        frame, marker, _ = (int(i) for i in np.argwhere(np.isinf(positions))[0])
        raise PalpateError(
            f"marker {marker} of trial '{name}' is infinite in frame {frame}: "
            "what was not seen has to be NaN"
        )
    seen = ~np.isnan(positions).any(axis=-1)
    rows = np.flatnonzero(seen.any(axis=-1))
    if not len(rows):
        raise PalpateError(f"no marker is seen in any frame of trial '{name}'")
    notes = list(table.notes)
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
    try:
        return Channel("markers", Role.OBSERVATION, time[kept], metres, "m", notes=tuple(notes))
    except PalpateError as error:
        raise PalpateError(f"trial '{name}': {error}") from error


def _in_metres(values: np.ndarray, unit: str, up: str) -> np.ndarray:
    """Positions or velocities (..., 3) in metres and z up, float64."""
    order, signs = _Z_UP[up]
    # In float64 and rounded once; -0.0 is not worth keeping.
    return values[..., order] * np.array(signs, np.float64) * _METRES[unit] + 0.0


def _with_inputs(
    recording: Recording, inputs: list[tuple[InputTable, ...]], unit: str, up: str
) -> Recording:
    """The recording with what drove each of its trials, in metres and z up."""
    trials = []
    for trial, tables in zip(recording.trials, inputs, strict=True):
        channels = dict(trial.channels)
        for table in tables:
            values = _in_metres(table.values, unit, up)
            si = "m/s" if table.role is Role.COMMAND else "m"
            try:
                channels[table.name] = Channel(table.name, table.role, table.time, values, si)
            except PalpateError as error:
                raise PalpateError(f"trial '{trial.name}': {error}") from error
        trials.append(replace(trial, channels=channels))
    return replace(recording, trials=tuple(trials))


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
        metres = length / _METRES[unit]
        likely = min(_METRES, key=lambda u: abs(math.log(metres * _METRES[u] + 1e-300)))
        fits = _PLAUSIBLE[0] <= metres * _METRES[likely] <= _PLAUSIBLE[1]
        advice = f"pass the right unit, e.g. --unit {likely}" if fits else "check the file"
        raise PalpateError(
            f"a line through all markers is {length:.3g} m long if the unit is {unit}, "
            f"which looks wrong: {advice}"
        )


def _check_rate(recording: Recording, rate: float | None) -> None:
    """Refuse a rate that the stamps of an observation contradict by more than a tenth."""
    if rate is None:
        return
    for trial in recording.trials:
        for channel in trial.channels.values():
            if channel.role is Role.OBSERVATION and abs(channel.nominal_period * rate - 1) > 0.1:
                raise PalpateError(
                    f"'{channel.name}' of trial '{trial.name}' has stamps at "
                    f"{1 / channel.nominal_period:.4g} Hz, not at {rate:.4g} Hz: leave the rate out"
                )
