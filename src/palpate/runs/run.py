"""A run on disk: configuration, metrics and checkpoints of long work that resumes where it was cut.

    with Run.open(out, configuration, fresh=fresh) as run:
        if run.finished:
            return read_result(run.path / RESULT)
        step, state = run.restore(state) or (0, state)
        with interruptible() as stop:
            for step in progress(range(step + 1, steps + 1), "training", done=step):
                state, loss = update(state)
                run.log(step, loss=loss)
                if stop or step % 100 == 0 or step == steps:
                    run.save(step, state)
                if stop:
                    break
        run.finish(result.to_dict())

Log a step before saving it: what a checkpoint stands for is every line up to its own step. The same
state and the same seed then give the same weights and the same lines, however often the work was
killed in between. `interruptible` and `progress` are those of `palpate.runs.progress`.
"""

import contextlib
import json
import os
import re
import shlex
import sys
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TextIO

from palpate.errors import PalpateError
from palpate.runs import result as measured
from palpate.runs.storage import (
    DamagedFileError,
    load_arrays,
    parse_json,
    plain,
    read_json,
    save_arrays,
    write_json,
    write_text,
)

CONFIGURATION = "configuration.json"
ENVIRONMENT = "environment.json"
METRICS = "metrics.jsonl"
RESULT = "result.json"
RECORDING = "recording.npz"
CHECKPOINTS = "checkpoints"
_LOCK = ".lock"
_BEGUN = {CONFIGURATION, ENVIRONMENT}
_KEPT_CHECKPOINTS = 2


class Run:
    """One folder, one configuration, one process at a time; made by `Run.open`.

    The folder holds `configuration.json` (exactly what was asked), `environment.json` (where it
    began), `metrics.jsonl` (one line a step), `checkpoints/NNNNNNNN.safetensors` (the last two)
    and, once finished, `result.json`. Whatever else stands in it is not touched.
    """

    def __init__(
        self, path: Path, configuration: dict[str, Any], lock: TextIO, before: set[str] | None
    ):
        self.path = path
        self._made: list[Path] = []  # by this process: its lock, and folders, innermost first
        self.configuration = configuration
        self._lock = lock
        self._before = before  # names in the folder when this process began the run in it
        self._metrics: TextIO | None = None
        self._positioned = False  # whether metrics and checkpoints stop where the work goes on
        self._began = time.monotonic()

    @classmethod
    def open(
        cls,
        path: str | Path,
        configuration: Mapping[str, Any],
        command: str | None = None,
        fresh: bool = False,
    ) -> "Run":
        """Begin a run in the folder at `path`, or resume the one that is there.

        `configuration` is everything the outcome depends on, the seed included; what `plain`
        accepts. `command` is kept for the reader, by default the one this process was started
        with. `fresh` first removes what an earlier run wrote, and nothing else. As a context, a
        run that is refused by a `PalpateError` before it wrote anything leaves no trace.

        Raises `PalpateError` when the folder holds a run of another configuration (naming the
        keys that differ), when another process works in it, or when it cannot be used.
        """
        path = Path(path)
        asked = plain(configuration, "configuration")
        made = [one for one in (path / _LOCK, path, *path.parents) if not one.exists()]
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise PalpateError(
                f"cannot make the folder {path}: {error.strerror or error}"
            ) from error
        if not _is_run(path):
            for name in (METRICS, RESULT, CHECKPOINTS):
                if (path / name).exists():
                    raise PalpateError(
                        f"{path} holds {name} but no run that could go on: give another --out"
                    )
        lock = _locked(path)
        try:
            ours = [f".{name}.*.part" for name in (CONFIGURATION, ENVIRONMENT, METRICS, RESULT)]
            for unfinished in (*ours, f"{CHECKPOINTS}/.????????*.safetensors.*.part"):
                for part in path.glob(unfinished):
                    part.unlink()
            if fresh and _is_run(path):
                _remove_run(path)
            before = None
            if _is_run(path):
                if differences := _differences(read_json(path / CONFIGURATION), asked):
                    more = f" and {len(differences) - 3} more" if len(differences) > 3 else ""
                    raise PalpateError(
                        f"{path} holds a run of another configuration "
                        f"({'; '.join(differences[:3])}{more}): give another --out, or --fresh to "
                        "start over"
                    )
                _note_other_versions(path)
            else:
                before = _names(path)
                started = {
                    "command": shlex.join(sys.argv) if command is None else command,
                    "date": datetime.now(UTC).isoformat(timespec="seconds"),
                    "machine": measured.machine(),
                    "versions": measured.versions(),
                    "commit": measured.commit(),
                }
                write_json(path / ENVIRONMENT, started)
                write_json(path / CONFIGURATION, asked)  # last: it makes the folder a run
        except BaseException:
            lock.close()
            raise
        run = cls(path, asked, lock, before)
        run._made = made
        return run

    def __enter__(self) -> "Run":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        refused = kind is not None and issubclass(kind, PalpateError)
        if refused and self._before is not None and _names(self.path) <= self._before | _BEGUN:
            _remove_run(self.path)
            with contextlib.suppress(OSError):  # something of somebody else's is in it by now
                for one in self._made:
                    one.rmdir() if one.is_dir() else one.unlink()
        self.close()

    def close(self) -> None:
        """Let another process have the folder; also done by the end of this process."""
        if self._metrics is not None:
            self._metrics.close()
        self._lock.close()

    @property
    def finished(self) -> bool:
        """Whether `finish` was called, in this process or an earlier one."""
        return (self.path / RESULT).exists()

    @property
    def elapsed(self) -> float:
        """Seconds of work behind the present state, that of earlier processes included.

        Pauses do not count, nor work that was lost with a process that was killed.
        """
        return time.monotonic() - self._began

    def log(self, step: int, /, **metrics: Any) -> None:
        """Append {"step", "time", **metrics} to `metrics.jsonl`; time is `elapsed` in seconds.

        Raises `PalpateError` for NaN and infinity, naming the metric; None stands for no value.
        """
        self._continue()
        line = dict(step=int(step), time=round(self.elapsed, 3), **metrics)
        text = json.dumps(plain(line, f"step {step}"))
        if self._metrics is None:
            self._metrics = (self.path / METRICS).open("a", encoding="utf-8")
        self._metrics.write(text + "\n")
        self._metrics.flush()

    def save(self, step: int, tree: Any) -> None:
        """Write the pytree `tree` as the checkpoint of `step` and keep the last two.

        Raises `PalpateError` for leaves that cannot be stored; see `save_arrays`.
        """
        self._continue()
        if self._metrics is not None:
            os.fsync(self._metrics.fileno())  # no checkpoint may outlive the lines before it
        path = self.path / CHECKPOINTS / f"{step:08d}.safetensors"
        save_arrays(path, tree, {"step": int(step), "time": self.elapsed})
        for _, old in _checkpoints(self.path)[:-_KEPT_CHECKPOINTS]:
            old.unlink()

    def restore(self, like: Any) -> tuple[int, Any] | None:
        """The step and tree of the newest checkpoint that can be read; None when there is none.

        `like` is a tree of the same structure, for instance the state that a new run begins with.
        A damaged checkpoint is passed over with a note. Unless the run is finished, metrics after
        the restored step are dropped: their work will be done again.

        Raises `PalpateError` when no checkpoint can be read, or when `like` has other leaves.
        """
        checkpoints = _checkpoints(self.path)
        for step, path in reversed(checkpoints):
            try:
                tree, manifest = load_arrays(path, like)
            except DamagedFileError as error:
                print(f"{error}; going back to the checkpoint before it", file=sys.stderr)
                continue
            prepared = 0.0 if self._positioned else time.monotonic() - self._began
            self._go_back_to(step)
            self._began = time.monotonic() - prepared - manifest["time"]
            return step, tree
        if checkpoints:
            raise PalpateError(
                f"no checkpoint in {self.path / CHECKPOINTS} can be read: start over with --fresh"
            )
        self._go_back_to(-1)
        return None

    def metrics(self) -> list[dict[str, Any]]:
        """The lines of `metrics.jsonl`; see `read_metrics`."""
        return read_metrics(self.path)

    def finish(self, result: Mapping[str, Any]) -> None:
        """Write `result.json`, after which the run is finished and only read.

        Raises `PalpateError` for what JSON cannot hold, naming the key path.
        """
        write_json(self.path / RESULT, result)

    def _continue(self) -> None:
        if self.finished:
            raise PalpateError(
                f"{self.path} is finished: start over with --fresh or give another --out"
            )
        if not self._positioned and _checkpoints(self.path):
            raise RuntimeError("restore() comes before log() and save(), or it would be lost")
        if not self._positioned:
            self._go_back_to(-1)

    def _go_back_to(self, step: int) -> None:
        """Drop the metrics and checkpoints after `step`, and a line that was cut in writing."""
        if self.finished:
            return
        for later, path in _checkpoints(self.path):
            if later > step:
                path.unlink()
        if self._metrics is not None:
            self._metrics.close()
            self._metrics = None
        if (self.path / METRICS).exists():
            kept = [line for line in read_metrics(self.path) if line["step"] <= step]
            write_text(self.path / METRICS, "".join(json.dumps(line) + "\n" for line in kept))
        self._positioned = True


def read_metrics(path: str | Path) -> list[dict[str, Any]]:
    """The metrics of the run in the folder at `path`, in the order they were logged.

    Needs no lock, so a run may be watched while it works: a last line still being written is left
    out. Raises `DamagedFileError` naming the line when another one is damaged.
    """
    file = Path(path) / METRICS
    if not file.exists():
        return []
    *lines, _ = file.read_bytes().split(b"\n")  # what follows the last newline is not whole
    metrics = []
    for number, line in enumerate(lines, start=1):
        try:
            entry = parse_json(line)
            if not isinstance(entry, dict) or not isinstance(entry.get("step"), int):
                raise ValueError("expected an object with a step")
            metrics.append(entry)
        except ValueError as error:
            raise DamagedFileError(f"line {number} of {file} is damaged: {error}") from error
    return metrics


# --- the folder -------------------------------------------------------------------------------


def _is_run(path: Path) -> bool:
    return (path / CONFIGURATION).exists() and (path / ENVIRONMENT).exists()


def _names(path: Path) -> set[str]:
    return {one.name for one in path.iterdir()}


def _checkpoints(path: Path) -> list[tuple[int, Path]]:
    """Steps and files of the checkpoints, oldest first."""
    files = (path / CHECKPOINTS).glob("*.safetensors")
    return sorted((int(file.stem), file) for file in files if re.fullmatch(r"\d{8,}", file.stem))


def _locked(path: Path) -> TextIO:
    """The lock file, held until it is closed; the kernel lets go of it when the process dies."""
    try:
        lock = (path / _LOCK).open("a+", encoding="utf-8")
    except OSError as error:
        raise PalpateError(f"cannot write in {path}: {error.strerror or error}") from error
    try:
        import fcntl
    except ImportError:
        return lock  # no such locks on Windows
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        lock.seek(0)
        owner = lock.read().strip()
        lock.close()
        raise PalpateError(
            f"another process ({owner or 'just starting'}) works in {path}: "
            "wait for it or give another --out"
        ) from error
    except OSError:
        return lock  # a file system without locks
    lock.truncate(0)
    lock.write(f"pid {os.getpid()}")
    lock.flush()
    return lock


def _remove_run(path: Path) -> None:
    (path / RESULT).unlink(missing_ok=True)  # first: half a run must not look finished
    for _, checkpoint in _checkpoints(path):
        checkpoint.unlink()
    with contextlib.suppress(OSError):  # absent, or somebody keeps something of theirs in it
        (path / CHECKPOINTS).rmdir()
    for name in (METRICS, ENVIRONMENT, CONFIGURATION):
        (path / name).unlink(missing_ok=True)


def _differences(kept: Any, asked: Any, name: str = "") -> list[str]:
    if not isinstance(kept, dict) or not isinstance(asked, dict):
        same = kept == asked and isinstance(kept, bool) == isinstance(asked, bool)
        return [] if same else [f"{name} was {_short(kept)}, now {_short(asked)}"]
    found = []
    for key in dict.fromkeys([*asked, *kept]):
        where = f"{name}.{key}" if name else key
        if key not in asked:
            found.append(f"{where} was {_short(kept[key])}, now absent")
        elif key not in kept:
            found.append(f"{where} was absent, now {_short(asked[key])}")
        else:
            found += _differences(kept[key], asked[key], where)
    return found


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else text[:37] + "..."


def _note_other_versions(path: Path) -> None:
    began, now = read_json(path / ENVIRONMENT)["versions"], measured.versions()
    shared = [name for name in began if name in now]
    changed = [
        f"{name} {began[name]} -> {now[name]}" for name in shared if began[name] != now[name]
    ]
    if changed:
        print(
            f"{path} was begun with other versions ({', '.join(changed)}): "
            "the last digits of what follows may differ",
            file=sys.stderr,
        )
