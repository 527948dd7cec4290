"""Where a command writes: one folder for its run, and one file if a file was asked for."""

import dataclasses
import hashlib
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from palpate.errors import PalpateError
from palpate.families.options import Options
from palpate.models.python_files import file_of
from palpate.report import build_report
from palpate.report.evidence import EVIDENCE, RENDERINGS
from palpate.runs import Figure, Result, Run
from palpate.runs.run import CONFIGURATION, ENVIRONMENT, RECORDING, RESULT
from palpate.runs.storage import check_writable, plain, read_json, write_bytes

RUNS = Path("runs")
MODEL, PLAN, POLICY, REPORT, TABLE = (
    "model.json",
    "plan.json",
    "policy.safetensors",
    "report.html",
    "table.txt",
)
SUMMARY = (
    "summary"  # in a result: what was found and how far to trust it, which its page opens with
)
DOUBTS = "doubts"  # in a result and in a model's file: why they are not to be trusted
_FOR_A_PERSON = (REPORT, EVIDENCE, TABLE, *(f"rendering{suffix}" for suffix in RENDERINGS))
_WHERE = ("out", "fresh")  # options that do not decide the outcome
_SUFFIXES = {Path(name).suffix for name in (RECORDING, MODEL, POLICY, REPORT)}


def begin(
    options: Options,
    words: str,
    inputs: Mapping[str, Path | Sequence[Path]] | None = None,
    product: str | None = None,
    **decided: Any,
) -> Run:
    """`open_run` of the command that `words` give ("train cart-to-origin").

    What decides its outcome: the options, the content of its `inputs` (files or folders, by name),
    and what else was `decided`.
    """
    files = {}
    for name, paths in (inputs or {}).items():
        one = isinstance(paths, Path)
        files[name] = fingerprint(paths) if one else [fingerprint(path) for path in paths]
    configuration = {**configuration_of(options, words), **files, **decided}
    return open_run(options, words.replace(" ", "-"), configuration, product)


def configuration_of(options: Options, words: str) -> dict[str, Any]:
    """What was said on a command's line, for its configuration: all but where to write."""
    given = {"command": words, **dataclasses.asdict(options)}
    return {
        name: value for name, value in given.items() if name not in _WHERE and value is not None
    }


def open_run(
    options: Options, name: str, configuration: Mapping[str, Any], product: str | None = None
) -> Run:
    """Begin the run of the command `name`, or take up the one that was cut off.

    With a folder as `out` the run is there. Otherwise it is a numbered one below `runs/`: the
    newest that has this configuration and was not finished, else a new one. `product` is the file
    in it that `deliver` copies if `out` is a file.

    Raises `PalpateError` for an `out` that is neither a folder nor a file of the product's kind, or
    that cannot be written, and as `Run.open`.
    """
    if options.out is not None and not _is_file(options.out, product):
        again = options.fresh and (options.out / CONFIGURATION).exists()
        run = Run.open(options.out, configuration, fresh=options.fresh)
        if again:
            _remove(run.path, (product, *_FOR_A_PERSON) if product else _FOR_A_PERSON)
        return run
    if options.out is not None:
        check_writable(options.out)
    numbered = sorted(_numbers_of(name))
    if not options.fresh:
        asked = plain(configuration, "configuration")
        for _, path in reversed(numbered):
            kept = path / CONFIGURATION
            if kept.exists() and not (path / RESULT).exists() and read_json(kept) == asked:
                return Run.open(path, configuration)
    number = numbered[-1][0] + 1 if numbered else 1
    return Run.open(RUNS / f"{name}-{number:03d}", configuration)


def finish(
    run: Run,
    figures: Sequence[Figure] = (),
    settings: Mapping[str, Any] | None = None,
    split: dict[str, Any] | None = None,
    **more: Any,
) -> Result:
    """Finish a run that `begin` began with its `result.json`.

    `settings` stand there beside the run's configuration; `more` are other fields of `Result`.
    """
    fields = {"wall_time_s": run.elapsed, "seeds": [run.configuration["seed"]], **more}
    result = Result(
        name=run.configuration["command"].replace(" ", "-"),
        figures=list(figures),
        settings={**run.configuration, **(settings or {})},
        split=split,
        **fields,
    )
    run.finish(result.to_dict())
    return result


def source_of(place: str) -> dict[str, Path]:
    """Among the inputs of a command, the Python file of a `file.py:Class`; none without a place."""
    return {"source": file_of(place)} if place else {}


def deliver(options: Options, run: Run, product: str) -> Path:
    """Where the run's `product` is for the one who asked: copied to `out` if that is a file."""
    path = run.path / product
    if options.out is None or not _is_file(options.out, product):
        return path
    write_bytes(options.out, path.read_bytes())
    return options.out


def hand_over(options: Options, run: Run, title: str, product: str | None = None) -> Path:
    """Deliver the product of a finished run, write its report, and print where both are.

    Returns the path of the product, or of the run where there is none.
    """
    path = run.path
    report = run.path / REPORT
    if not report.exists() or report.stat().st_mtime < (run.path / RESULT).stat().st_mtime:
        build_report([run.path], report, title)
    if product is not None:
        path = deliver(options, run, product)
        print(f"{Path(product).stem}: {path}")
    print(f"report: {report}")
    return path


def command(options: Options, words: str) -> str:
    """The command line that gives `words`, what to do, and all these options but where to."""
    said = ["palpate", *words.split()]
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name in _WHERE or (value == field.default and field.name != "seed"):
            continue
        said.append(f"--{field.name.replace('_', '-')}")
        if not isinstance(value, bool):
            said += map(str, value if isinstance(value, tuple) else (value,))
    return shlex.join(said)


def start_over(folder: Path, words: str) -> None:
    """Empty every run in `folder` and below, and remove what was written about them together.

    What commands do not write is not touched. Raises `PalpateError`, and removes nothing, when a
    run below was begun by another command than `words` ("reproduce rope-model").
    """
    configurations = sorted(folder.rglob(CONFIGURATION))
    for configuration in configurations:
        began = read_json(configuration.parent / ENVIRONMENT)["command"]
        if f" {words} " not in f" {began} ":
            raise PalpateError(
                f"{configuration.parent} holds a run of `{began}`, which --fresh would remove: "
                f"expected a folder with nothing but `palpate {words}` in it; give another --out"
            )
    for configuration in configurations:
        with Run.open(configuration.parent, read_json(configuration), fresh=True) as run:
            _remove(run.path, (RECORDING, MODEL, POLICY, *_FOR_A_PERSON))
            configuration.unlink()
        _remove(folder, (RESULT, REPORT, EVIDENCE))  # about all of them


def product_of(path: Path, product: str, command: str) -> Path:
    """The `product` of an earlier command, given as its file or as the folder of the run.

    Raises `PalpateError` when there is neither, or when that run is not finished.
    """
    suffix = Path(product).suffix
    folder = path if path.is_dir() else path.parent
    if (folder / CONFIGURATION).exists() and not (folder / RESULT).exists():
        began = read_json(folder / ENVIRONMENT).get("command")
        raise PalpateError(f"{folder} holds a run that is not finished: `{began}` goes on with it")
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
    """Name and content of an input, so that a run never goes on with another one.

    The content of a folder, such as that of a rosbag2, is that of the files in and below it.
    """
    try:
        if path.is_dir():
            files = [file for file in sorted(path.rglob("*")) if file.is_file()]
            inside = [(str(file.relative_to(path)), fingerprint(file)) for file in files]
            digest = hashlib.sha256(repr(inside).encode())
            return {"file": path.name, "sha256": digest.hexdigest()}
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


def _remove(folder: Path, names: Iterable[str]) -> None:
    for name in names:
        (folder / name).unlink(missing_ok=True)


def _numbers_of(name: str) -> Iterator[tuple[int, Path]]:
    for path in RUNS.glob(f"{name}-*"):
        match = re.fullmatch(r"\d+", path.name.removeprefix(f"{name}-"))
        if match and path.is_dir():
            yield int(match[0]), path
