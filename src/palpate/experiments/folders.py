"""Where a command writes: one folder for its run, and one file if a file was asked for."""

import dataclasses
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from palpate.errors import PalpateError
from palpate.experiments.options import Options
from palpate.report import build_report
from palpate.runs import CONFIGURATION, RESULT, Run
from palpate.storage import plain, read_json, write_bytes

RUNS = Path("runs")
RECORDING, MODEL, POLICY, REPORT = (
    "recording.npz",
    "model.json",
    "policy.safetensors",
    "report.html",
)
_SUFFIXES = {Path(name).suffix for name in (RECORDING, MODEL, POLICY, REPORT)}


def open_run(
    options: Options, name: str, configuration: Mapping[str, Any], product: str | None = None
) -> Run:
    """Begin the run of the command `name`, or take up the one that was cut off.

    With a folder as `out` the run is there. Otherwise it is a numbered one below `runs/`: the
    newest that has this configuration and was not finished, else a new one. `product` is the file
    in it that `deliver` copies if `out` is a file.

    Raises `PalpateError` for an `out` that is neither a folder nor a file of the product's kind,
    and as `Run.open`.
    """
    if options.out is not None and not _is_file(options.out, product):
        return Run.open(options.out, configuration, fresh=options.fresh)
    numbered = sorted(_numbered(name))
    if not options.fresh:
        asked = plain(configuration, "configuration")
        for _, path in reversed(numbered):
            kept = path / CONFIGURATION
            if kept.exists() and not (path / RESULT).exists() and read_json(kept) == asked:
                return Run.open(path, configuration)
    number = numbered[-1][0] + 1 if numbered else 1
    return Run.open(RUNS / f"{name}-{number:03d}", configuration)


def deliver(options: Options, run: Run, product: str) -> Path:
    """Where the run's `product` is for the one who asked: copied to `out` if that is a file."""
    path = run.path / product
    if options.out is None or not _is_file(options.out, product):
        return path
    write_bytes(options.out, path.read_bytes())
    return options.out


def hand_over(
    options: Options, run: Run, title: str, product: str | None = None, notes: Sequence[str] = ()
) -> None:
    """Deliver the product of a finished run, write its report, and print where both are."""
    report = run.path / REPORT
    if not report.exists() or report.stat().st_mtime < (run.path / RESULT).stat().st_mtime:
        build_report([run.path], report, title, notes)
    if product is not None:
        print(f"{Path(product).stem}: {deliver(options, run, product)}")
    print(f"report: {report}")


def told(options: Options, command: str) -> dict[str, Any]:
    """What decides a command's outcome, for its configuration: all that was said but where to."""
    given = {"command": command, **dataclasses.asdict(options)}
    return {
        name: value
        for name, value in given.items()
        if name not in ("out", "fresh") and value is not None
    }


def start_over(folder: Path) -> None:
    """Empty every run in `folder` and below; what else stands there is not touched."""
    for configuration in sorted(folder.rglob(CONFIGURATION)):
        Run.open(configuration.parent, read_json(configuration), fresh=True).close()
        configuration.unlink()


def product_of(path: Path, product: str, command: str) -> Path:
    """The `product` of an earlier command, given as its file or as the folder of the run.

    Raises `PalpateError` when there is neither.
    """
    suffix = Path(product).suffix
    if path.is_file() and path.suffix != suffix:
        raise PalpateError(
            f"{path} is no {Path(product).stem}: expected the folder that `palpate {command}` "
            f"wrote, or the {suffix} file in it"
        )
    if path.is_dir():
        path = path / product
    if not path.exists():
        raise PalpateError(f"there is no file {path}: expected what `palpate {command}` wrote")
    return path


def fingerprint(path: Path) -> dict[str, str]:
    """Name and content of an input file, so that a run never goes on with another one."""
    try:
        with path.open("rb") as file:
            return {"file": path.name, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}
    except FileNotFoundError as error:
        raise PalpateError(f"there is no file {path}") from error
    except OSError as error:
        raise PalpateError(f"cannot read {path}: {error.strerror or error}") from error


def _is_file(out: Path, product: str | None) -> bool:
    wanted = Path(product).suffix if product else None
    if out.suffix == wanted and not out.is_dir():
        return True
    if out.suffix in _SUFFIXES or out.is_file():
        file = f", or a file that ends in {wanted}" if wanted else ""
        raise PalpateError(f"--out {out} has to be a folder{file}")
    return False


def _numbered(name: str) -> Iterator[tuple[int, Path]]:
    for path in RUNS.glob(f"{name}-*"):
        match = re.fullmatch(r"\d+", path.name.removeprefix(f"{name}-"))
        if match and path.is_dir():
            yield int(match[0]), path
