"""What a run leaves for its report, and how it is read back.

`evidence.npz` lies beside `configuration.json`, `metrics.jsonl` and `result.json` in the run's
folder and holds plain arrays, named by what they are:

    motion.time          (frames,)            s
    motion.<label>       (frames, points, 3)  m; a chain of points, its last one is called the tip
    horizon.time         (times,)             s since the prediction began
    horizon.<label>      (times,)             root-mean-square error of the prediction
    horizon.<label>.low, horizon.<label>.high  (times,)  quantiles around it, both or neither
    prediction.time      (times,)             s since a prediction began
    prediction.<label>   (times, numbers, lines)  some numbers of an observation, one line or a fan

A family adds kinds of its own, `<kind>.time` and `<kind>.<label>`: each is a `Piece` that stands in
the table of families (`Family.evidence`) with the axes of its arrays.

Several motions stand side by side as `motion/<group>.time`, `motion/<group>.<label>`. NaN is a gap.
Errors are in the unit that "observation_unit" names in the settings of `result.json`, else in m,
and what the numbers of a prediction are called stands there as "predicted": ["angle (rad)"].
What else a report shows is read from the run's other files: figures from `result.json`, and from
its "parameters" rows {name, value, unit, about, fixed, shared, lower, upper, verdict, derived},
where value and 90 % interval are a number, a list of them or null, and what is derived follows from
others; the learning curve from `metrics.jsonl`.
"""

import io
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from palpate.errors import PalpateError
from palpate.family import places, resolve
from palpate.identification.verdicts import uninformed
from palpate.runs import Figure
from palpate.runs.run import CONFIGURATION, ENVIRONMENT, METRICS, RESULT, read_metrics
from palpate.runs.storage import DamagedFileError, read_json, write_bytes

EVIDENCE = "evidence.npz"
MAX_BYTES = 2**29  # when unpacked: far above what a page can show
_KEY = re.compile(r"(motion)(?:/([^./]+))?\.(.+)|([^./]+)\.(.+)")


@dataclass(frozen=True)
class Motion:
    """Point chains over time: `time` (frames,) in s, each of `chains` (frames, points, 3) in m."""

    group: str
    time: np.ndarray
    chains: dict[str, np.ndarray]


@dataclass(frozen=True)
class Curves:
    """Labelled quantities over `time` (times,) in s.

    `values` are (times,), or have the axes of their `Piece`; `bands` holds (low, high) of shape
    (times,) for those labels that have them.
    """

    time: np.ndarray
    values: dict[str, np.ndarray]
    bands: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


@dataclass(frozen=True)
class Piece:
    """A piece of evidence that a family adds to the page: a kind of curves, and their section.

    `axes` are those of each array, "times" one of them. `show` gives the section's caption and its
    Plotly figure from the curves and each label's index into `palpate.report.style.STYLES`.
    """

    heading: str
    axes: tuple[str, ...]
    show: Callable[[Curves, Mapping[str, int]], tuple[str, dict[str, Any]]]


def pieces() -> dict[str, Piece]:
    """The pieces of evidence of all families, by name."""
    return {name: resolve(place) for name, place in places("evidence").items()}


@dataclass(frozen=True)
class Parameter:
    """What was identified: `value` (elements,) in `unit` (empty: none), one if all share it.

    `lower` and `upper` (elements,) are the 90 % interval; NaN where there is none. `verdict` is a
    sentence about how far to trust it, or None. What is `derived` follows from other parameters.
    """

    name: str
    value: np.ndarray
    unit: str
    about: str
    fixed: bool
    shared: bool
    lower: np.ndarray
    upper: np.ndarray
    verdict: str | None
    derived: bool = False

    @property
    def uninformed(self) -> bool:
        """Whether the data left all of it where the prior had it."""
        return uninformed(self.verdict)


@dataclass(frozen=True)
class Evidence:
    """All that a run's folder holds for a report; what is not there is empty or None.

    `prediction` is one motion beside what was observed; `pieces` are
    the curves that families add, by name. `metrics` are the run's logged lines. `rendering` is a
    moving picture of the scene, `rendering.webp`, `.gif` or `.png`, where the machine could render
    one; `pictures` are all others that it drew, PNGs.
    """

    path: Path
    name: str
    motions: tuple[Motion, ...] = ()
    horizon: Curves | None = None
    prediction: Curves | None = None
    pieces: dict[str, Curves] = field(default_factory=dict)
    parameters: tuple[Parameter, ...] = ()
    metrics: tuple[dict[str, Any], ...] = ()
    figures: tuple[Figure, ...] = ()
    configuration: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, Any] = field(default_factory=dict)
    result: dict[str, Any] = field(default_factory=dict)
    rendering: Path | None = None
    pictures: tuple[Path, ...] = ()

    @property
    def settings(self) -> dict[str, Any]:
        """Those in the result; none where it has none."""
        settings = self.result.get("settings")
        return settings if isinstance(settings, dict) else {}

    @property
    def unit(self) -> str:
        """Of `horizon`."""
        return str(self.settings.get("observation_unit", "m"))


def write_evidence(run: str | Path, arrays: Mapping[str, ArrayLike]) -> Path:
    """Write `evidence.npz` into the folder of a run, in place of what it held; atomic.

    `arrays` are named as this module describes. They are kept as float32, times as float64. The
    same arrays give the same bytes.

    Raises `PalpateError` naming the array that has another name, shape or content.
    """
    path = Path(run) / EVIDENCE
    kept = {}
    for key, values in arrays.items():
        kind = np.float64 if key.endswith(".time") else np.float32
        try:
            kept[key] = np.asarray(values, dtype=kind)
        except (TypeError, ValueError) as error:
            raise PalpateError(f"'{key}' is not an array of numbers: {error}") from error
    _sort(kept)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **kept)  # type: ignore[arg-type]  # its stub wants bool keywords
    write_bytes(path, buffer.getvalue())
    return path


def read_evidence(run: str | Path) -> Evidence:
    """Everything in the folder of a run that a report shows; finished or not.

    Raises `PalpateError` when the folder holds no run, `DamagedFileError` when a file in it is
    truncated, corrupt or of another layout, naming the file.
    """
    run = Path(run)
    if not run.is_dir():
        raise PalpateError(f"there is no run {run}: expected the folder of one")
    known = (CONFIGURATION, RESULT, METRICS, EVIDENCE)
    if not any((run / name).exists() for name in known):
        raise PalpateError(f"{run} holds no run: expected {', '.join(known)} or some of them")
    motions, horizon, prediction, added = _arrays(run / EVIDENCE)
    result = _object(run / RESULT)
    renderings = (run / f"rendering{suffix}" for suffix in RENDERINGS)
    return Evidence(
        path=run,
        name=str(result.get("name") or run.resolve().name),
        motions=motions,
        horizon=horizon,
        prediction=prediction,
        pieces=added,
        parameters=tuple(_rows(run / RESULT, result, "parameters", parameter_of)),
        metrics=tuple(read_metrics(run)),
        figures=tuple(_rows(run / RESULT, result, "figures", _figure)),
        configuration=_object(run / CONFIGURATION),
        environment=_object(run / ENVIRONMENT),
        result=result,
        rendering=next((path for path in renderings if path.exists()), None),
        pictures=tuple(p for p in sorted(run.glob("*.png")) if p.stem != "rendering"),
    )


RENDERINGS = {".webp": "image/webp", ".gif": "image/gif", ".png": "image/png"}


# --- arrays -----------------------------------------------------------------------------------

_Sections = tuple[tuple[Motion, ...], Curves | None, Curves | None, dict[str, Curves]]
_OWN = {  # axes of what is no family's
    "motion": ("frames", "points", 3),
    "horizon": ("times",),
    "prediction": ("times", "numbers", "lines"),
}


def _arrays(path: Path) -> _Sections:
    if not path.exists():
        return (), None, None, {}
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_BYTES:
            limit = f"at most {MAX_BYTES / 2**20:g} are read"
            raise PalpateError(f"it unpacks to {size / 2**20:.0f} MiB, {limit}")
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: np.asarray(archive[key]) for key in archive.files}
    except PalpateError as error:
        raise PalpateError(f"{path}: {error}") from error
    except Exception as error:  # what zipfile and NumPy raise on wrong bytes has no end
        reason = str(error).partition("\n")[0]
        raise DamagedFileError(f"{path} is damaged or not NPZ ({reason})") from error
    try:
        return _sort(arrays)
    except PalpateError as error:
        raise DamagedFileError(f"{path}: {error}") from error


def _sort(arrays: Mapping[str, np.ndarray]) -> _Sections:
    """The arrays by section, once each was found to fit its name."""
    known = pieces()
    sections: dict[tuple[str, str], dict[str, np.ndarray]] = {}
    for key, values in arrays.items():
        match = _KEY.fullmatch(key)
        if match is None or (match[4] or "motion") not in {*_OWN, *known}:
            kinds = "motion", "motion/<group>", "horizon", "prediction", *known
            kinds = ", ".join(f"{kind}.<label>" for kind in kinds)
            raise PalpateError(f"unknown evidence '{key}': expected {kinds}, each beside its .time")
        kind, group, label = match[1] or match[4], match[2] or "", match[3] or match[5]
        if values.dtype.kind not in "fiu":
            raise PalpateError(f"'{key}' has the dtype {values.dtype}: expected real numbers")
        if values.size == 0 or np.isinf(values).any():
            raise PalpateError(f"'{key}' is empty or infinite: expected numbers, NaN for a gap")
        sections.setdefault((kind, group), {})[label] = values
    motions, horizon, prediction, added = [], None, None, {}
    for (kind, group), values in sections.items():
        where = f"{kind}/{group}" if group else kind
        time = values.pop("time", None)
        if time is None or not values:
            lacking = f"'{where}.time'" if time is None else f"anything beside '{where}.time'"
            raise PalpateError(f"the evidence lacks {lacking}")
        if time.ndim != 1 or not (np.isfinite(time).all() and (np.diff(time) > 0).all()):
            raise PalpateError(f"'{where}.time' has to be one axis of finite, increasing seconds")
        axes = _OWN[kind] if kind in _OWN else known[kind].axes
        _check_shapes(where, values, time, axes)
        if kind == "motion":
            motions.append(Motion(group, time, values))
        elif kind == "horizon":
            horizon = _bands_of(time, values)
        elif kind == "prediction":
            prediction = Curves(time, values)
        else:
            added[kind] = Curves(time, values)
    return tuple(motions), horizon, prediction, added


def _check_shapes(
    where: str, values: dict[str, np.ndarray], time: np.ndarray, shape: tuple[str | int, ...]
) -> None:
    along = "frames" if "frames" in shape else "times"
    for label, array in values.items():
        fits = array.ndim == len(shape) and array.shape[shape.index(along)] == len(time)
        if not fits or (shape[-1] == 3 and array.shape[-1] != 3):
            raise PalpateError(
                f"'{where}.{label}' has the shape {array.shape}: expected "
                f"({', '.join(map(str, shape))}) with {len(time)} {along} as in '{where}.time'"
            )


def _bands_of(time: np.ndarray, values: dict[str, np.ndarray]) -> Curves:
    edges = {label for label in values if label.endswith((".low", ".high"))}
    labels = [label for label in values if label not in edges]
    bands = {}
    for label in labels:
        pair = {f"{label}.low", f"{label}.high"}
        if pair <= edges:
            bands[label] = (values[f"{label}.low"], values[f"{label}.high"])
            edges -= pair
    if edges:
        raise PalpateError(
            f"'horizon.{min(edges)}' stands alone: expected <label>, <label>.low and <label>.high"
        )
    return Curves(time, {label: values[label] for label in labels}, bands)


# --- result.json ------------------------------------------------------------------------------


def _object(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    document = read_json(path)
    if not isinstance(document, dict):
        raise DamagedFileError(f"{path} holds a {type(document).__name__}: expected an object")
    return document


def _rows(path: Path, document: dict[str, Any], key: str, read: Any) -> list[Any]:
    rows = document.get(key) or []
    if not isinstance(rows, list):
        raise DamagedFileError(f"{path} has no list under '{key}'")
    found = []
    for index, row in enumerate(rows):
        try:
            found.append(read(row))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise DamagedFileError(f"{path}: {key}[{index}] cannot be read ({error})") from error
    return found


def _figure(row: dict[str, Any]) -> Figure:
    if not (isinstance(row["name"], str) and isinstance(row["unit"], str)):
        raise ValueError("'name' and 'unit' have to be texts")
    return Figure(**{item.name: row[item.name] for item in fields(Figure) if item.name in row})


def parameter_of(row: dict[str, Any]) -> Parameter:
    """A row of `result.json`; raises `ValueError` for an interval of other elements."""
    value = np.ravel(np.asarray(row["value"], dtype=float))
    edges = {}
    for name in ("lower", "upper"):
        edge = np.ravel(np.asarray(row.get(name), dtype=float))  # None becomes NaN
        if edge.size not in (1, value.size):
            raise ValueError(f"'{name}' has {edge.size} elements, 'value' {value.size}")
        edges[name] = np.broadcast_to(edge, value.shape)
    fixed, shared = bool(row.get("fixed", False)), bool(row.get("shared", False))
    if (fixed or shared) and value.size and np.ptp(value) == 0.0:  # one number, many times
        value, edges = value[:1], {name: edge[:1] for name, edge in edges.items()}
    verdict, unit = row.get("verdict"), str(row.get("unit", ""))
    return Parameter(
        name=str(row["name"]),
        value=value,
        unit="" if unit == "1" else unit,
        about=str(row.get("about", "")),
        fixed=fixed,
        shared=shared,
        verdict=None if verdict is None else str(verdict),
        derived=bool(row.get("derived", False)),
        **edges,
    )
