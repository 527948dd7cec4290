"""Recordings on disk: our NPZ, foreign NPZ of marker positions, motion-capture CSV, logs of robots.

Files come from anywhere, so nothing in them is believed: nothing is unpickled, sizes are checked
before memory is taken, and what is damaged or does not fit is refused with one sentence.
"""

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.errors import PalpateError
from palpate.recordings import npz
from palpate.recordings.alignment import MAX_BYTES
from palpate.recordings.channel import Role
from palpate.recordings.columns import read_channels
from palpate.recordings.csv import read_csv
from palpate.recordings.npz import write_recording
from palpate.recordings.recording import Recording
from palpate.recordings.rosbag.bag import read_bag
from palpate.recordings.rosbag.files import is_bag
from palpate.recordings.rosbag.numbers import read_numbers
from palpate.recordings.tables import METRES, Z_UP, MarkerTable, recording_of
from palpate.runs.run import RECORDING
from palpate.runs.storage import DamagedFileError

__all__ = ["read_recording", "write_recording"]


def read_recording(
    path: str | Path,
    *,
    rate: float | None = None,
    unit: str | None = None,
    up: str | None = None,
    topics: Sequence[str] = (),
    columns: Sequence[str] = (),
) -> Recording:
    """Read a recording from `.npz` (ours or foreign), `.csv` or a log, in SI units and z up.

    A foreign NPZ holds `positions` (trials, frames, markers, 3) or (frames, markers, 3) and maybe
    `time` (frames,) or (trials, frames) in seconds; frames at the end of a trial where nothing
    was seen are padding. CSV is described at `csv.read_csv`. Both become one observation channel
    "markers" in each trial. Logs are MCAP files, rosbag2 folders or databases and ROS 1 bags,
    described at `rosbag.bag.read_bag`; `topics` names which of their topics to take, and besides
    "markers" they may give a driven "gripper" and a "command". The folder of a run that recorded
    (`palpate record`) stands for its recording.

    A plain CSV that has `columns` by name, and no markers, becomes a channel for each, as
    `columns.read_channels` describes; in a log they are the places of numbers, as
    `rosbag.numbers.read_numbers` does.

    `rate` (Hz) is for files without time, `unit` ("m", "cm", "mm") for files that do not say, and
    `up` ("x", "y", "z") names the axis that points up, by default y in a Motive export and z
    elsewhere. What contradicts the file is refused.

    Raises `PalpateError` for anything that is missing, damaged, too large or implausible.
    """
    path = Path(path)
    if (path / RECORDING).is_file():
        path /= RECORDING
    for option, value, known in (("unit", unit, METRES), ("up", up, Z_UP)):
        if value is not None and value not in known:
            raise PalpateError(f"{option} has to be one of {', '.join(known)}, not '{value}'")
    if rate is not None and not (math.isfinite(rate) and rate > 0):
        raise PalpateError(f"the rate has to be a positive number of Hz, not {rate}")
    try:
        if topics and not is_bag(path):
            raise PalpateError("only logs have topics: leave topics out")
        if path.suffix.lower() == ".npz":
            found = _read_npz(path)
        elif path.suffix.lower() == ".csv":
            found = read_channels(path, columns, rate) if columns else [(path.stem, read_csv(path))]
        elif is_bag(path):
            found = read_numbers(path, columns) if columns else read_bag(path, topics)
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
            recording = recording_of(found, str(path), rate, unit, up)
        # Stamps of an observation may contradict the rate by no more than a tenth.
        for trial in recording.trials:
            for channel in trial.channels.values():
                own = 1 / channel.nominal_period
                if rate and channel.role is Role.OBSERVATION and abs(rate / own - 1) > 0.1:
                    raise PalpateError(
                        f"'{channel.name}' of trial '{trial.name}' has stamps at {own:.4g} Hz, "
                        f"not at {rate:.4g} Hz: leave the rate out"
                    )
    except PalpateError as error:
        raise type(error)(f"{path}: {error}") from error
    except OSError as error:
        raise PalpateError(f"cannot read {path}: {error.strerror or error}") from error
    return recording


def _read_npz(path: Path) -> Recording | list[tuple[str, MarkerTable]]:
    try:
        with zipfile.ZipFile(path) as archive:
            keys = [name[:-4] for name in archive.namelist() if name.endswith(".npy")]
            size = sum(entry.file_size for entry in archive.infolist())
            if size > MAX_BYTES:
                raise PalpateError(
                    f"the file unpacks to {size / 2**30:.3g} GiB; at most {MAX_BYTES / 2**30:.0f} "
                    "GiB are read: split it into several recordings"
                )
            if npz.ENTRY in keys:
                return npz.read(archive)
            if "positions" not in keys:
                there = f"it holds {', '.join(keys[:8])}" if keys else "it holds no arrays"
                raise PalpateError(f"expected an array 'positions', but {there}")
            positions = npz.load(archive, "positions")
            time = npz.load(archive, "time") if "time" in keys else None
    except (PalpateError, OSError):
        raise
    except Exception as error:  # what zipfile, NumPy and json raise on wrong bytes has no end
        reason = str(error).partition("\n")[0]
        raise DamagedFileError(f"the file is damaged or not NPZ ({reason})") from error
    ignored = [key for key in keys if key not in ("positions", "time")]
    notes = (f"arrays that are no markers were left out: {', '.join(ignored)}",) if ignored else ()
    return _foreign(path.stem, positions, time, notes)


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
