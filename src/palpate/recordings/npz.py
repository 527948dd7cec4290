"""Our own recordings on disk: an NPZ file of plain arrays and one JSON text."""

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from palpate.errors import PalpateError
from palpate.recordings.channel import Channel, Events, Role
from palpate.recordings.facts import fact_from_json, fact_to_json, facts_in_provenance
from palpate.recordings.recording import Recording
from palpate.recordings.trial import Trial
from palpate.runs.storage import DamagedFileError, write_bytes

VERSION = 2  # the first had neither events nor facts
ENTRY = "palpate.recording"
_TEXTS = ("name", "unit", "frame", "axes")


def write_recording(path: str | Path, recording: Recording) -> None:
    """Write `recording` to an NPZ file that `read_recording` restores exactly; atomic.

    The file holds plain arrays, `i.j.time` and `i.j.values` for channel j of trial i, the arrays of
    events behind those of channels and one after the other with their `i.j.sizes`, and one JSON
    text, `palpate.recording`, with everything else. Raises `PalpateError` if it cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise PalpateError(f"{path}: recordings are written as .npz, not '{path.suffix}'")
    arrays: dict[str, np.ndarray] = {}
    trials = []
    for i, trial in enumerate(recording.trials):
        channels = []
        for j, channel in enumerate(trial.parts):
            about = {
                key: getattr(channel, key) for key in ("name", "unit", "frame", "axes", "notes")
            }
            arrays[f"{i}.{j}.time"] = channel.time
            if isinstance(channel, Channel):
                about["role"] = channel.role.value
                arrays[f"{i}.{j}.values"] = channel.values
            else:
                about["role"] = "event"
                arrays[f"{i}.{j}.values"] = np.concatenate(channel.values)
                arrays[f"{i}.{j}.sizes"] = np.array([len(array) for array in channel.values])
            channels.append(about)
        facts = {name: fact_to_json(fact) for name, fact in trial.facts.items()}
        trials.append({"name": trial.name, "channels": channels, "facts": facts})
    about = {"version": VERSION, "provenance": recording.provenance, "trials": trials}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{ENTRY: np.array(json.dumps(about))}, **arrays)  # type: ignore
    write_bytes(path, buffer.getvalue())


def read(archive: zipfile.ZipFile) -> Recording:
    """The recording in an archive; raises `PalpateError`, and what damaged bytes make it raise."""
    text = load(archive, ENTRY)
    if text.dtype.kind != "U" or text.ndim:
        raise DamagedFileError(f"'{ENTRY}' is not a text")
    about: Any = json.loads(str(text))
    if about["version"] not in range(1, VERSION + 1):
        raise PalpateError(
            f"the recording has version {about['version']}, but this palpate reads up to "
            f"{VERSION}: install a newer palpate"
        )
    earlier = facts_in_provenance(about["provenance"])
    provenance = {key: fact for key, fact in about["provenance"].items() if key not in earlier}
    trials = []
    for i, trial in enumerate(about["trials"]):
        parts = [_part(archive, f"{i}.{j}", part) for j, part in enumerate(trial["channels"])]
        facts = {name: fact_from_json(name, fact) for name, fact in trial.get("facts", {}).items()}
        channels = {part.name: part for part in parts if isinstance(part, Channel)}
        events = {part.name: part for part in parts if isinstance(part, Events)}
        trials.append(Trial(str(trial["name"]), channels, events, earlier | facts))
    return Recording(tuple(trials), provenance)


def _part(archive: zipfile.ZipFile, key: str, about: dict[str, Any]) -> Channel | Events:
    texts: dict[str, Any] = {key: str(about[key]) for key in _TEXTS}
    texts["notes"] = tuple(str(note) for note in about["notes"])
    time, values = load(archive, f"{key}.time"), load(archive, f"{key}.values")
    if about["role"] != "event":
        return Channel(role=Role(about["role"]), time=time, values=values, **texts)
    sizes = load(archive, f"{key}.sizes")
    if (
        sizes.dtype.kind not in "iu"
        or sizes.shape != time.shape
        or (sizes < 0).any()
        or sum(sizes.tolist()) != len(values)
    ):
        raise DamagedFileError(f"'{key}.sizes' do not divide the values of '{about['name']}'")
    arrays = np.split(values, np.cumsum(sizes)[:-1])
    return Events(time=time, values=arrays, **texts)


def load(archive: zipfile.ZipFile, key: str) -> np.ndarray:
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
