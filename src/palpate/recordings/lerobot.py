"""Recordings as datasets of the LeRobot library, format v3.0, for those who learn from them.

The layout is that of `LeRobotDataset` with `codebase_version` "v3.0" (huggingface/lerobot,
`datasets/dataset_metadata.py` and `feature_utils.py`): frames of many episodes in Parquet files,
episodes and tasks as tables that point into them, and statistics for normalisation.
"""

import itertools
import json
import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import PalpateError, extra_module
from palpate.recordings.alignment import Aligned
from palpate.recordings.channel import Role
from palpate.recordings.facts import fact_to_json
from palpate.recordings.recording import Recording
from palpate.runs.storage import write_json

STATE, ACTION, SEEN = "observation.state", "action", "seen"
TASK = "handle the object"  # the format wants a task in words, which a recording does not have
FILE_SIZE = 100  # MB of a data file, after which another is begun
FILES_IN_CHUNK = 1000  # files of a folder
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
INFO = "meta/info.json"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)


@dataclass(frozen=True, eq=False)
class Feature:
    """A column of the dataset: `values` (frames, size) of all episodes one after another."""

    names: tuple[str, ...]
    values: np.ndarray


def write_lerobot(
    folder: str | Path, recording: Recording, *, fps: int | None = None, fresh: bool = False
) -> None:
    """Write `recording` as a LeRobotDataset v3.0 into a new `folder`, each trial an episode.

    `observation.state` is what was observed, flattened to names such as "markers_0.x"; `action` is
    what was ordered, or else the driven states at the next frame (the last is repeated at an
    episode's end); both float32 in the channels' own units, which `meta/palpate.json` tells. Frames
    are evenly spaced, `fps` to the second, by default those of the first sensor. The format has no
    value for what was not seen: it is interpolated from the frames around it, and a column `seen`
    says which points really were. Events are left out. `fresh` replaces a folder that is there.

    Raises `PalpateError` when the folder exists, when pyarrow is missing, when there is no
    observation, when something is never seen in an episode, or when `fps` is less than 1.
    """
    extra_module("pyarrow.parquet", "io", "pyarrow")
    folder = Path(folder)
    if folder.exists() and not fresh:
        raise PalpateError(f"{folder} exists: expected the name of a new folder")
    sensors: dict[Role, list[str]] = {role: [] for role in Role}
    for channel in recording.trials[0].channels.values():
        sensors[channel.role].append(channel.name)
    observed, acting = sensors[Role.OBSERVATION], sensors[Role.COMMAND] or sensors[Role.DRIVEN]
    if fps is None:
        periods = [trial[(observed or acting)[0]].nominal_period for trial in recording.trials]
        fps = max(1, round(1 / float(np.nanmedian(periods))))
    if fps < 1:
        raise PalpateError(f"a dataset has at least 1 frame per second, not {fps}")
    aligned = recording.align(1 / fps, observed, acting)
    features = _features(recording, aligned, fps)
    part = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    try:
        _write(part, features, aligned.length, recording, fps)
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(part, folder)
    except OSError as error:
        raise PalpateError(f"cannot write {folder}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


# --- columns ----------------------------------------------------------------------------------


def _features(recording: Recording, aligned: Aligned, fps: int) -> dict[str, Feature]:
    """The columns by name, in the order in which LeRobot has them."""
    trial, frame = np.nonzero(np.arange(aligned.length.max()) < aligned.length[:, None])
    names, observed = _columns(aligned.observations, trial, frame)
    state = np.concatenate([
        _fill(observed[trial == number], each.name, names)
        for number, each in enumerate(recording.trials)
    ])  # fmt: skip
    features = {STATE: Feature(names, state.astype(np.float32))}
    if aligned.actions:
        # The last frame has no action of its own: nobody knows what came after it.
        before_end = np.minimum(frame, aligned.length[trial] - 2)
        acting, acted = _columns(aligned.actions, trial, before_end)
        features[ACTION] = Feature(acting, acted.astype(np.float32))
    if not np.isfinite(observed).all():
        points = [name.partition(".")[0] for name in names]
        first = np.unique(points, return_index=True)[1]
        first.sort()
        unseen = np.logical_or.reduceat(np.isnan(observed), first, axis=1)
        features[SEEN] = Feature(tuple(points[index] for index in first), ~unseen)
    for name, values in (
        ("timestamp", (frame / fps).astype(np.float32)),
        ("frame_index", frame),
        ("episode_index", trial),
        ("index", np.arange(len(frame))),
        ("task_index", np.zeros_like(frame)),
    ):
        features[name] = Feature((), values[:, None])
    return features


def _columns(
    channels: Mapping[str, np.ndarray], trial: np.ndarray, frame: np.ndarray
) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of all numbers, and their values (frames, numbers) at `frame` of `trial`."""
    names = [name for key, array in channels.items() for name in _names(key, array.shape[2:])]
    values = [array[trial, frame].reshape(len(trial), -1) for array in channels.values()]
    return tuple(names), np.concatenate(values, axis=1)


def _names(channel: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    """One name for each number of a frame: "markers_0.x" of a point, "force_2" of others."""
    if shape and shape[-1] == 3:
        points = ["_".join([channel, *map(str, index)]) for index in np.ndindex(shape[:-1])]
        return tuple(f"{point}.{axis}" for point in points for axis in "xyz")
    return tuple("_".join([channel, *map(str, index)]) for index in np.ndindex(shape))


def _fill(values: np.ndarray, trial: str, names: tuple[str, ...]) -> np.ndarray:
    """`values` (frames, numbers) without NaN: linear in between, and as seen next at the ends."""
    frames = np.arange(len(values))
    filled = np.array(values, np.float64)
    for column, name in zip(filled.T, names, strict=True):
        known = np.isfinite(column)
        if not known.any():
            raise PalpateError(
                f"'{name}' is never seen in trial '{trial}', and LeRobot has no value for that: "
                "leave the trial out"
            )
        column[:] = np.interp(frames, frames[known], column[known])
    return filled


# --- files ------------------------------------------------------------------------------------


def _write(
    folder: Path,
    features: dict[str, Feature],
    lengths: np.ndarray,
    recording: Recording,
    fps: int,
) -> None:
    bounds = np.concatenate([[0], np.cumsum(lengths)])
    table = _table(features)
    size = max(1, math.ceil(FILE_SIZE * 2**20 / max(table.nbytes / len(table), 1)))  # frames
    # An episode goes where its first frame falls; files are numbered without gaps.
    _, number = np.unique(bounds[:-1] // size, return_inverse=True)
    files = [(n // FILES_IN_CHUNK, n % FILES_IN_CHUNK) for n in number.tolist()]
    _write_data(folder, table, bounds, files)
    total = len(lengths)
    write_json(
        folder / INFO,
        {
            "codebase_version": "v3.0",
            "robot_type": None,
            "total_episodes": total,
            "total_frames": len(table),
            "total_tasks": 1,
            "chunks_size": FILES_IN_CHUNK,
            "data_files_size_in_mb": FILE_SIZE,
            "video_files_size_in_mb": 200,
            "fps": fps,
            "splits": {"train": f"0:{total}"},
            "data_path": DATA,
            "video_path": None,
            "features": {
                name: {
                    "dtype": feature.values.dtype.name,
                    "shape": [feature.values.shape[1]],
                    "names": list(feature.names) or None,
                }
                for name, feature in features.items()
            },
        },
    )
    write_json(
        folder / "meta/stats.json",
        {name: _statistics(feature.values) for name, feature in features.items()},
    )
    _write_tasks(folder)
    _write_episodes(folder, features, bounds, files)
    write_json(
        folder / "meta/palpate.json",
        {
            "episodes": [trial.name for trial in recording.trials],
            "units": {c.name: c.unit for c in recording.trials[0].channels.values()},
            "provenance": recording.provenance,
            "facts": [
                {name: fact_to_json(fact) for name, fact in trial.facts.items()}
                for trial in recording.trials
            ],
            "notes": recording.notes,
        },
    )


def _table(features: dict[str, Feature]) -> Any:
    """All frames; numbers of features of one number stand alone, others in lists of fixed size."""
    import pyarrow

    columns = {}
    for name, feature in features.items():
        flat = pyarrow.array(feature.values.ravel())
        size = feature.values.shape[1]
        columns[name] = flat if size == 1 else pyarrow.FixedSizeListArray.from_arrays(flat, size)
    return pyarrow.table(columns)


def _write_data(folder: Path, table: Any, bounds: np.ndarray, files: list[tuple[int, int]]) -> None:
    """Each episode as one row group, so that a reader gets at it without reading the others."""
    from pyarrow import parquet

    for place in sorted(set(files)):
        path = folder / DATA.format(chunk_index=place[0], file_index=place[1])
        path.parent.mkdir(parents=True, exist_ok=True)
        with parquet.ParquetWriter(path, table.schema, compression="snappy") as writer:
            for episode, where in enumerate(files):
                if where == place:
                    start, stop = int(bounds[episode]), int(bounds[episode + 1])
                    writer.write_table(table.slice(start, stop - start))


def _write_tasks(folder: Path) -> None:
    """The table that pandas writes for a frame with the tasks as its index, named "task"."""
    import pyarrow
    from pyarrow import parquet

    kinds = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    columns = [
        dict(name=name, field_name=name, pandas_type=kind, numpy_type=storage, metadata=None)
        for name, kind, storage in kinds
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    pandas["pandas_version"] = "2.0.0"
    table = pyarrow.table({"task_index": pyarrow.array([0], pyarrow.int64()), "task": [TASK]})
    table = table.replace_schema_metadata({"pandas": json.dumps(pandas)})
    parquet.write_table(table, folder / "meta/tasks.parquet")


def _write_episodes(
    folder: Path,
    features: dict[str, Feature],
    bounds: np.ndarray,
    files: list[tuple[int, int]],
) -> None:
    """One row for each episode: where its frames are, and their statistics."""
    import pyarrow
    from pyarrow import parquet

    rows = []
    for episode, (start, stop) in enumerate(itertools.pairwise(bounds.tolist())):
        row = {
            "episode_index": episode,
            "tasks": [TASK],
            "length": stop - start,
            "data/chunk_index": files[episode][0],
            "data/file_index": files[episode][1],
            "dataset_from_index": start,
            "dataset_to_index": stop,
        }
        for name, feature in features.items():
            for key, values in _statistics(feature.values[start:stop]).items():
                row[f"stats/{name}/{key}"] = values.tolist()
        rows.append(row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
    path = folder / EPISODES
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pyarrow.Table.from_pylist(rows), path, compression="snappy")


def _statistics(values: np.ndarray) -> dict[str, np.ndarray]:
    """Over the frames of `values` (frames, size), each (size,); the number of frames as (1,)."""
    numbers = values.astype(np.float64)
    statistics = {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(values)]),
    }
    quantiles = np.quantile(numbers, QUANTILES, axis=0)
    return statistics | {
        f"q{round(100 * share):02d}": quantile
        for share, quantile in zip(QUANTILES, quantiles, strict=True)
    }
