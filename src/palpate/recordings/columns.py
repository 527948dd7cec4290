"""Tables of numbers over time as CSV, by the names in their header."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.errors import PalpateError


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
