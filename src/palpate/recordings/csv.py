"""Motion-capture tables as text: plain CSV, OptiTrack Motive, Vicon Nexus and Tracker.

One file is one trial. A reader finds the columns and the unit that the file declares; what a
marker's metres are and which way is up is settled in `palpate.recordings.tables`.
"""

import csv
import math
import re
from array import array
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from palpate.errors import PalpateError, list_names
from palpate.recordings.tables import MarkerTable

_UNITS = {"mm": "mm", "millimeters": "mm", "cm": "cm", "centimeters": "cm", "m": "m", "meters": "m"}
SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIME = re.compile(r"(?:time|t|timestamp)[\s_(\[]*(s|sec|seconds|ms|us|ns|)[)\]]?", re.IGNORECASE)
_COORDINATE = re.compile(r"(?:(.*)[_.:\s])?([xyz])", re.IGNORECASE)


def read_csv(path: str | Path) -> MarkerTable:
    """Read a table of marker positions; its first lines tell which program wrote it.

    - *Plain*: a header line with a time column (`time`, `t` or `timestamp`, in seconds unless the
      name ends in ms, us or ns; it may be missing) and three columns for each marker, `name_x`,
      `name.x`, `name:x` or `name x`. Names that differ in their last number are in its order,
      others in order of appearance; if some hold a number, the others are no markers.
    - *OptiTrack Motive*: columns of type Marker and kind Position; labelled ones if there are any.
      Length unit from the first line; y up.
    - *Vicon Nexus or Tracker*: the block Trajectories; frame numbers over its rate are the time.

    Blank cells are NaN. Raises `PalpateError` that names the line (the path is the caller's part).
    """
    with open(path, newline="", encoding="utf-8-sig") as file:
        lines = Lines(file)
        try:
            first = next((cells for cells in lines if any(cells)), None)
            if first is None:
                raise PalpateError("the file is empty")
            if first[0].lower() == "format version":
                return _motive(first, lines)
            if sum(map(bool, first)) == 1:
                return _vicon(first, lines)
            return _plain(first, lines)
        except UnicodeDecodeError as error:
            raise PalpateError(f"not UTF-8 text somewhere after line {lines.number}") from error
        except csv.Error as error:
            raise PalpateError(f"line {lines.number} is not CSV: {error}") from error


class Lines:
    """Lines of cells without surrounding blanks, and the number of the current line."""

    def __init__(self, file: Iterator[str]):
        self._reader = csv.reader(file)

    def __iter__(self) -> Iterator[list[str]]:
        return self

    def __next__(self) -> list[str]:
        return [cell.strip() for cell in next(self._reader)]

    @property
    def number(self) -> int:
        """Of the current line, from 1."""
        return self._reader.line_num

    def header(self, what: str) -> list[str]:
        """The next line, which has to be there."""
        cells = next(iter(self), None)
        if cells is None:
            raise PalpateError(f"the file ends after line {self.number}, before {what}")
        return cells or [""]

    def value(self, cell: str, column: int) -> float:
        """The finite number in a cell."""
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise PalpateError(
                f"line {self.number}, column {column + 1}: expected a finite number, got '{cell}'"
            )
        return value


def _plain(names: list[str], lines: Lines) -> MarkerTable:
    twice = next((name for name in names if name and names.count(name) > 1), None)
    if twice is not None:
        raise PalpateError(f"two columns are called '{twice}'")
    clocks = [
        (column, SECONDS[match[1].lower()])
        for column, name in enumerate(names)
        if (match := TIME.fullmatch(name))
    ]
    axes: dict[str, dict[str, int]] = {}
    for column, name in enumerate(names):
        if match := _COORDINATE.fullmatch(name):
            axes.setdefault(match[1] or "marker", {})[match[2].lower()] = column
    triples = {
        name: [found[axis] for axis in "xyz"] for name, found in axes.items() if len(found) == 3
    }
    numbered = {name: found for name, found in triples.items() if re.search(r"\d", name)}
    triples = numbered or triples
    if not triples:
        raise PalpateError(
            "no marker columns: expected three for each marker, such as m0_x, m0_y and m0_z, "
            f"but the header has {list_names(names)}"
        )
    markers = in_natural_order(list(triples))
    clock, second = clocks[0] if clocks else (None, 1.0)
    time, positions = _table(lines, len(names), clock, [triples[name] for name in markers])
    used = {clock, *chain.from_iterable(triples.values())}
    unused = [name for column, name in enumerate(names) if column not in used and name]
    notes = (f"columns that are no markers were left out: {list_names(unused)}",) if unused else ()
    return MarkerTable(
        "CSV", None if clock is None else time * second, positions, markers, notes=notes
    )


def _motive(first: list[str], lines: Lines) -> MarkerTable:
    facts = {key.lower(): value for key, value in zip(first[::2], first[1::2], strict=False)}
    rows: list[list[str]] = []
    while not (rows and rows[-1][0].lower() == "frame"):
        cells = lines.header("the line 'Frame,Time (Seconds),X,Y,Z,...'")
        if any(cells):
            rows.append(cells)
        if len(rows) > 16:
            raise PalpateError(f"no line 'Frame,Time (Seconds),X,Y,Z,...' before {lines.number}")
    width = len(rows[-1])
    if len(rows) < 4 or any(len(row) > width for row in rows):
        raise PalpateError(
            f"the header before line {lines.number} needs lines for type, name and kind of each "
            f"of its {width} columns, as Motive exports them"
        )
    kinds, names, *_, quantities, axes = [row + [""] * (width - len(row)) for row in rows]
    clock = next((i for i, name in enumerate(axes) if name.lower().startswith("time (")), None)
    if clock is None:
        raise PalpateError(f"line {lines.number} has no column 'Time (Seconds)'")
    triples = _columns_of_markers(
        names,
        [
            column
            for column in _xyz(axes)
            if kinds[column].lower() == "marker" and quantities[column].lower() == "position"
        ],
    )
    if not triples:
        there = list_names(sorted({kind for kind in kinds[2:] if kind and kind.lower() != "type"}))
        raise PalpateError(f"no columns of type Marker (there are: {there}): export the markers")
    labelled = {k: v for k, v in triples.items() if not k.lower().startswith("unlabeled")}
    notes = ()
    if labelled and len(labelled) < len(triples):
        notes = (f"{len(triples) - len(labelled)} unlabelled markers were left out",)
    triples = labelled or triples
    markers = in_natural_order(list(triples))
    time, positions = _table(lines, width, clock, [triples[name] for name in markers])
    unit = _unit(facts["length units"], 1) if "length units" in facts else None
    return MarkerTable("OptiTrack Motive CSV", time, positions, markers, unit, "y", notes)


def _vicon(first: list[str], lines: Lines) -> MarkerTable:
    while first[0].lower() != "trajectories":
        first = lines.header("a header with several columns or a block 'Trajectories'")
    rate = lines.value(lines.header("the rate")[0], 0)
    if not rate > 0:
        raise PalpateError(f"line {lines.number}: the rate has to be positive, not {rate}")
    names = lines.header("the names of the markers")
    axes = lines.header("the line 'Frame,Sub Frame,X,Y,Z,...'")
    if axes[0].lower() != "frame":
        raise PalpateError(f"line {lines.number}: expected 'Frame,Sub Frame,X,Y,Z,...'")
    units = lines.header("the units")
    width = len(axes)
    names, units = names + [""] * (width - len(names)), units + [""] * (width - len(units))
    triples = _columns_of_markers(names, _xyz(axes))
    if not triples:
        raise PalpateError(f"line {lines.number - 1} has no columns X, Y, Z")
    unit = {_unit(units[column], lines.number) for column in chain(*triples.values())}
    if len(unit) > 1:
        raise PalpateError(f"line {lines.number} mixes the units {list_names(sorted(unit))}")
    markers = in_natural_order(list(triples))
    frame, positions = _table(lines, width, 0, [triples[name] for name in markers], block=True)
    return MarkerTable("Vicon CSV", frame / rate, positions, markers, unit.pop())


def _table(
    lines: Lines, width: int, clock: int | None, triples: list[list[int]], block: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Column `clock` (frames,) and `triples` (frames, markers, 3) of the lines that remain.

    A blank line ends a `block` and is skipped elsewhere.
    """
    columns = list(chain.from_iterable(triples))
    numbers = array("d")
    for cells in lines:
        if not any(cells):
            if block:
                break
            continue
        if len(cells) < width or any(cells[width:]):
            raise PalpateError(
                f"line {lines.number} has {len(cells)} cells, but the header has {width} columns"
            )
        if clock is not None:
            numbers.append(lines.value(cells[clock], clock))
        numbers.extend(
            math.nan if cells[i].lower() in ("", "nan") else lines.value(cells[i], i)
            for i in columns
        )
    if not numbers:
        raise PalpateError(f"there are no data after line {lines.number}")
    table = np.frombuffer(numbers).reshape(-1, len(columns) + (clock is not None))
    return table[:, 0], table[:, -len(columns) :].reshape(-1, len(triples), 3)


def _xyz(axes: list[str]) -> list[int]:
    """The columns at which X, Y, Z stand in a row."""
    return [i for i in range(len(axes) - 2) if [a.upper() for a in axes[i : i + 3]] == [*"XYZ"]]


def _columns_of_markers(names: list[str], columns: list[int]) -> dict[str, list[int]]:
    """The three columns of each marker by its name, which stands above the first."""
    triples = {names[column]: list(range(column, column + 3)) for column in columns}
    if len(triples) < len(columns) or "" in triples:
        raise PalpateError("the markers need names that differ, above the X of each")
    return triples


def _unit(name: str, line: int) -> str:
    if name.lower() not in _UNITS:
        raise PalpateError(
            f"line {line}: unknown unit '{name}'; known are {list_names(list(_UNITS))}"
        )
    return _UNITS[name.lower()]


def in_natural_order(names: list[str]) -> tuple[str, ...]:
    """Names that differ in their last number are sorted by it; otherwise as they first appear."""
    parts = {name: re.fullmatch(r"(.*?)(\d*)(\D*)", name, re.DOTALL) for name in names}
    families: dict[tuple[str, str], list[tuple[int, str]]] = {}
    for name, part in parts.items():
        assert part is not None  # the pattern fits any text
        families.setdefault((part[1], part[3]), []).append((int(part[2] or -1), name))
    return tuple(name for family in families.values() for _, name in sorted(family))
