"""What a command claims: figures with their bars, and on what they were measured.

`result.json` is the same for every command, so that the documentation's results page, the
comparison of a quick run with a kept one, and a stranger all read one schema.
"""

import dataclasses
import importlib.metadata
import math
import os
import platform
import re
import statistics
import subprocess
import sys
import types
import typing
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, SupportsFloat

from palpate.errors import PalpateError
from palpate.runs.storage import plain, read_json


@dataclass(frozen=True)
class Figure:
    """One measured number and what it is held against.

    `value` is None where there was nothing to measure (a rope that never came to rest); such a
    figure does not meet a bar. `bar` is inclusive; `better` is "lower" or "higher".
    `seed_document` and `rival` are a number in the same unit or a short text ("DEFORM 1.01 cm");
    None means not printed, or no rival. `spread` is the half-width around `value` in which a
    repetition with other seeds is expected.

    Raises `PalpateError` for NaN, infinity and another `better`.
    """

    name: str
    value: int | float | None
    unit: str
    bar: int | float | None = None
    better: str = "lower"
    seed_document: int | float | str | None = None
    rival: int | float | str | None = None
    spread: int | float | None = None

    def __post_init__(self) -> None:
        if self.better not in ("lower", "higher"):
            raise PalpateError(
                f"figure {self.name!r} has better={self.better!r}: expected 'lower' or 'higher'"
            )
        for name in ("value", "bar", "spread"):
            number = getattr(self, name)
            if number is not None and not math.isfinite(number):
                raise PalpateError(
                    f"figure {self.name!r} has {name} {number}: expected a finite number or None"
                )

    @property
    def met(self) -> bool | None:
        """Whether `value` reaches `bar`; None when there is no bar."""
        if self.bar is None:
            return None
        if self.value is None:
            return False
        return bool(self.value <= self.bar if self.better == "lower" else self.value >= self.bar)

    def to_dict(self) -> dict[str, Any]:
        """The figure as it stands in `result.json`."""
        fields = [item.name for item in dataclasses.fields(self)]
        fields.insert(fields.index("better") + 1, "met")
        return {name: plain(getattr(self, name), f"{self.name}.{name}") for name in fields}


def two_standard_errors(values: Iterable[SupportsFloat]) -> float | None:
    """Of the mean of independent values, for a `spread`; None of one, which says nothing of it."""
    numbers = [float(value) for value in values]
    if len(numbers) < 2:
        return None
    return 2.0 * statistics.stdev(numbers) / math.sqrt(len(numbers))


def machine() -> dict[str, Any]:
    """CPU model, cores this process may use, platform, and the device JAX computes on.

    The device is None while JAX is not loaded, because then nothing was computed on one.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    device = sys.modules["jax"].devices()[0].device_kind if "jax" in sys.modules else None
    return {
        "cpu": _cpu_model(),
        "cores": len(affinity(0)) if affinity else os.cpu_count(),
        "platform": f"{platform.system()} {platform.machine()}",
        "device": device,
    }


def versions() -> dict[str, str]:
    """Versions of Python, palpate and those of its dependencies that are installed.

    What only tests and documentation need is left out: it cannot change a figure.
    """
    found = {"python": platform.python_version()}
    try:
        requirements = importlib.metadata.requires("palpate") or []
        found["palpate"] = importlib.metadata.version("palpate")
    except importlib.metadata.PackageNotFoundError:
        return found  # a source tree on the path, not an installation
    for requirement in requirements:
        name = re.match(r"[\w.-]+", requirement)
        if name is None or re.search(r"extra == ['\"](test|docs)['\"]", requirement):
            continue
        try:
            found[name[0]] = importlib.metadata.version(name[0])
        except importlib.metadata.PackageNotFoundError:
            continue  # an extra that is not installed
    return found


def commit() -> str | None:
    """The git commit of the source that runs, with "-dirty" when files differ from it.

    None when palpate does not run from a checkout or git is missing.
    """
    source = Path(__file__).resolve().parents[1]
    root = source.parents[1]
    if not (root / ".git").exists():
        return None

    def git(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, check=False, capture_output=True, text=True, timeout=10)

    try:
        head = git("rev-parse", "--verify", "HEAD")
        changed = git("diff", "--quiet", "HEAD", "--", str(source))
    except (OSError, subprocess.TimeoutExpired):
        return None
    if head.returncode != 0:
        return None  # a repository without commits
    return head.stdout.strip() + ("-dirty" if changed.returncode == 1 else "")


@dataclass(frozen=True)
class Result:
    """Figures of one command and everything needed to judge and repeat them.

    `settings` are those that produced the figures, `seeds` all seeds used, `split` says which
    trials or objects were fitted, chosen on and evaluated, `wall_time_s` is in seconds. Machine,
    versions and commit are those of this process unless the result was read from a file.

    An identification has `parameters` too, rows as `palpate.report.evidence` describes them, and
    `warnings`, sentences about how far not to trust it; other results leave both keys out.
    """

    name: str
    figures: list[Figure]
    settings: dict[str, Any]
    seeds: list[int]
    split: str | dict[str, Any] | None
    wall_time_s: int | float
    machine: dict[str, Any] = field(default_factory=machine)
    versions: dict[str, str] = field(default_factory=versions)
    commit: str | None = field(default_factory=commit)
    parameters: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        names = [figure.name for figure in self.figures]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise PalpateError(f"result {self.name!r} has the figure {twice[0]!r} twice")

    def to_dict(self) -> dict[str, Any]:
        """The content of `result.json`.

        Raises `PalpateError` for what JSON cannot hold, NaN included, naming the key path.
        """
        document = {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}
        document["figures"] = [figure.to_dict() for figure in self.figures]
        for name in _OPTIONAL:
            if not document[name]:
                del document[name]
        return plain(document, self.name)

    def lines(self) -> list[str]:
        """One line for each figure: value and unit | bar | met or not | seed document | rival."""
        rows = [_cells(figure) for figure in self.figures]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        return [
            " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]


def read_result(path: str | Path) -> Result:
    """Read a `result.json` and check it against the schema.

    Raises `PalpateError` naming the file, the key and what was expected there.
    """
    try:
        document = _check(read_json(path), "the result", _RESULT)
        figures = []
        for index, item in enumerate(document["figures"]):
            where = f"figures[{index}]"
            entry = dict(_check(item, where, _FIGURE))
            met = entry.pop("met")
            figure = Figure(**entry)
            if met != figure.met:
                raise PalpateError(
                    f"{where}.met is {met}, but value {figure.value} against bar {figure.bar} "
                    f"({figure.better} is better) makes it {figure.met}"
                )
            figures.append(figure)
        return Result(**{**document, "figures": figures})
    except PalpateError as error:
        message = str(error)
        if str(path) not in message:
            message = f"{path} is not a result: {message}"
        raise type(error)(message) from error


def _kinds(annotations: dict[str, Any]) -> dict[str, tuple[type, ...]]:
    """What JSON may hold for each field of a class, by what its annotations say."""
    return {
        name: tuple(
            typing.get_origin(kind) or kind
            for kind in (typing.get_args(of) if isinstance(of, types.UnionType) else [of])
        )
        for name, of in annotations.items()
    }


_FIGURE = _kinds(Figure.__annotations__ | {"met": bool | None})
_RESULT = _kinds(Result.__annotations__)
_OPTIONAL = {"parameters", "warnings"}


def _check(document: Any, where: str, schema: dict[str, tuple[type, ...]]) -> dict[str, Any]:
    if not isinstance(document, dict):
        raise PalpateError(f"{where} is a {type(document).__name__}: expected a JSON object")
    for problem, names in (
        ("lacks", schema.keys() - document.keys() - _OPTIONAL),
        ("has the unknown key", document.keys() - schema.keys()),
    ):
        if names:
            raise PalpateError(f"{where} {problem} {', '.join(sorted(names))}")
    for name, value in document.items():
        # bool is an int to Python, but not a number to anyone else
        kinds = schema[name]
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            expected = " or ".join("null" if of is type(None) else of.__name__ for of in kinds)
            raise PalpateError(f"{where} has {name} {value!r}: expected {expected}")
    return document


def _cells(figure: Figure) -> list[str]:
    def shown(number: int | float | str | None, missing: str) -> str:
        if number is None:
            return missing
        return number if isinstance(number, str) else f"{number:.4g}"

    sign = "<=" if figure.better == "lower" else ">="
    value = shown(figure.value, "none")
    if figure.spread is not None:
        value += f" +- {figure.spread:.2g}"
    return [
        figure.name,
        value if figure.value is None else f"{value} {figure.unit}".rstrip(),
        "no bar" if figure.bar is None else f"bar {sign} {figure.bar:.4g}",
        {True: "met", False: "NOT met", None: "-"}[figure.met],
        f"seed {shown(figure.seed_document, 'not printed')}",
        f"rival {shown(figure.rival, 'none')}",
    ]


def _cpu_model() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            for line in file:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine()
