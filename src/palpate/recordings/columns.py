"""Tables of numbers over time as CSV, by the names in their header."""

import csv
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.errors import PalpateError, list_names
from palpate.family import check_name
from palpate.recordings.channel import Channel, Role
from palpate.recordings.csv import SECONDS, TIME, Lines
from palpate.recordings.recording import Recording
from palpate.recordings.trial import Trial

_HEADED = re.compile(r"(.*?)\s*(?:[\[(](.*)[\])])?")  # a name, and a unit in brackets
_SI = {  # what a unit is in SI units and radians; others are left as they are called
    **{name: (math.pi / 180, "rad") for name in ("deg", "degree", "degrees", "°")},
    **{name: (math.pi / 180, "rad/s") for name in ("deg/s", "°/s")},
    **{"rpm": (math.pi / 30, "rad/s"), "mm": (1e-3, "m"), "cm": (1e-2, "m")},
    **{"mm/s": (1e-3, "m/s"), "cm/s": (1e-2, "m/s"), "kN": (1e3, "N")},
    **{"mN": (1e-3, "N"), "Nm": (1.0, "N m"), "N mm": (1e-3, "N m"), "Nmm": (1e-3, "N m")},
}


def read_columns(path: Path, names: Sequence[str], text: str = "") -> tuple[np.ndarray, list[str]]:
    """The columns `names`, (rows, columns), the first of which increases; and a column of `text`.

    They may stand in any order and among others. Raises `PalpateError` for a file that cannot be
    read or lacks a column, and for a line that has no finite number in one of them.
    """
    rows: list[list[float]] = []
    texts: list[str] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            header = {(name or "").strip(): name for name in reader.fieldnames or []}
            wanted = [text, *names] if text else names
            if missing := [name for name in wanted if name not in header]:
                raise PalpateError(
                    f"{path} has no column {', '.join(missing)}: expected a header with "
                    f"{', '.join(wanted)}, in SI units"
                )
            for row in reader:
                where = f"{path}, line {reader.line_num}"
                try:
                    values = [float(row[header[name]] or "") for name in names]
                except ValueError:
                    values = [math.nan]
                if not all(map(math.isfinite, values)):
                    raise PalpateError(f"{where}: expected finite numbers for {', '.join(names)}")
                if rows and values[0] <= rows[-1][0]:
                    raise PalpateError(
                        f"{where}: the {names[0]} {values[0]:g} does not come after "
                        f"{rows[-1][0]:g}; sort the rows by {names[0]}"
                    )
                rows.append(values)
                texts.append(row[header[text]] or "" if text else "")
    except OSError as error:
        raise PalpateError(f"cannot read {path}: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise PalpateError(f"{path} is not a CSV file in UTF-8: {error}") from error
    return np.array(rows).reshape(len(rows), len(names)), texts


def read_channels(path: Path, names: Sequence[str], rate: float | None = None) -> Recording:
    """One trial from a CSV file with a header: a channel of one number for each of `names`.

    A header is a name and maybe a unit in brackets, `angle [deg]`; known ones become SI units and
    radians. Time is the column `time`, `t` or `timestamp`, in seconds unless it says ms, us or ns,
    or rows come at `rate` (Hz). A blank cell is NaN, which was not seen. The file does not say what
    is observed and what acts: all are observed.

    Raises `PalpateError` (the path is the caller's part) for a column or a time that is missing,
    and for a cell that is no number.
    """
    with open(path, newline="", encoding="utf-8-sig") as file:
        lines = Lines(file)
        try:
            return _channels(path, lines, names, rate)
        except UnicodeDecodeError as error:
            raise PalpateError(f"not UTF-8 text somewhere after line {lines.number}") from error
        except csv.Error as error:
            raise PalpateError(f"line {lines.number} is not CSV: {error}") from error


def _channels(path: Path, lines: Lines, names: Sequence[str], rate: float | None) -> Recording:
    header = next((cells for cells in lines if any(cells)), None)
    if header is None:
        raise PalpateError("the file is empty")
    clocks = {
        i: SECONDS[m[1].lower()] for i, name in enumerate(header) if (m := TIME.fullmatch(name))
    }
    headed = [match.groups() for name in header if (match := _HEADED.fullmatch(name))]
    there = [name for i, (name, _) in enumerate(headed) if name and i not in clocks]
    columns = {
        name: [own for own, _ in headed].index(check_name("column", name, there)) for name in names
    }
    if twice := [name for name in names if there.count(name) > 1]:
        raise PalpateError(f"two columns are called '{twice[0]}': expected different names")
    if not clocks and rate is None:
        raise PalpateError(
            f"no column is called time, t or timestamp, but {list_names(header)}: expected one, or "
            "the rate (--rate HZ)"
        )
    clock = next(iter(clocks), None)
    rows, time = [], []
    for cells in lines:
        if not any(cells):
            continue
        if len(cells) < len(header) or any(cells[len(header) :]):
            raise PalpateError(
                f"line {lines.number} has {len(cells)} cells, but the header has {len(header)}"
            )
        rows.append(
            [
                math.nan if cells[i].lower() in ("", "nan") else lines.value(cells[i], i)
                for i in columns.values()
            ]
        )
        if clock is not None:
            time.append(lines.value(cells[clock], clock) * clocks[clock])
    if not rows:
        raise PalpateError(f"there are no data after line {lines.number}")
    stamps = np.array(time) if clock is not None else np.arange(len(rows)) / (rate or math.nan)
    channels = {}
    for (name, column), values in zip(columns.items(), np.array(rows).T, strict=True):
        unit = (headed[column][1] or "").strip()
        size, standard = _SI.get(unit, (1.0, unit))
        notes = (f"was in {unit} and is in {standard}",) if size != 1.0 else ()
        channels[name] = Channel(
            name, Role.OBSERVATION, stamps, size * values[:, None], standard, notes=notes
        )
    return Recording((Trial(path.stem, channels),), {"source": f"CSV {path.name}"})
