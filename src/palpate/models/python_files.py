"""Classes in a Python file that somebody names, `door.py:Door`: a model or a task, not registered.

Such a file is run when it is named, as any Python program is, and never because a saved model says
so: that one is found among the classes of files which were named before.
"""

import hashlib
import importlib.util
import re
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from palpate.errors import PalpateError
from palpate.family import check_name

Kind = TypeVar("Kind")

_PLACE = re.compile(r"(.+?\.py)(?::(.*))?")
_named: dict[Path, tuple[str, ModuleType]] = {}  # hash and module of each file, the latest last


def file_of(place: str) -> Path:
    """The file of `file.py:Class`; raises `PalpateError` for other words."""
    return _parts(place)[0]


def load_class(place: str, base: type[Kind]) -> type[Kind]:
    """The class at `file.py:Class`, which has to be one of `base`; the file is run for it, once.

    As for a script, modules beside the file can be imported by it. Raises `PalpateError` for a file
    that is not there or raises, and for a class that it lacks or that is no `base`.
    """
    path, name = _parts(place)
    module = _run(path)
    kinds = [key for key, value in vars(module).items() if _is_kind(value, base)]
    found = getattr(module, name, None)
    if found is not None and not _is_kind(found, base):
        what = "a class" if isinstance(found, type) else f"of type {type(found).__name__}"
        raise PalpateError(
            f"'{name}' in {path} is {what} but no {base.__name__}: expected a subclass of "
            f"{base.__module__}.{base.__name__}; there are: {', '.join(kinds) or 'none'}"
        )
    if not kinds:
        raise PalpateError(
            f"{path} has no {base.__name__}: expected a subclass of "
            f"{base.__module__}.{base.__name__} called '{name or 'NAME'}'"
        )
    if not name:
        raise PalpateError(f"{path} names no class: expected {path}:{kinds[0]} or the like")
    return getattr(module, check_name(f"{base.__name__.lower()} of {path}", name, kinds))


def source_of(kind: type) -> tuple[str, str] | None:
    """The `file.py:Class` of a class, without folders, and the SHA-256 of that file.

    None for a class that is not found by its name in a file: of a notebook, or inside a function.
    """
    module = sys.modules.get(kind.__module__)
    file = getattr(module, "__file__", None)
    if file is None or getattr(module, kind.__name__, None) is not kind:
        return None
    path = Path(file).resolve()
    digest, named = _named.get(path, ("", None))
    return f"{path.name}:{kind.__name__}", digest if named is module else _digest(path)


def named_class(place: str, base: type[Kind]) -> type[Kind] | None:
    """The class that a saved `file.py:Class` means, among files that were named; None if none was.

    It may be defined there or imported into there.
    """
    for _, module in reversed(_named.values()):
        for value in vars(module).values():
            if _is_kind(value, base) and (source_of(value) or ("",))[0] == place:
                return value
    return None


def blame(error: BaseException, file: str | Path) -> str:
    """What an error of somebody's own code says, and at which line of the `file`."""
    ours, here = Path(file).resolve(), Path.cwd()
    file = ours.relative_to(here) if ours.is_relative_to(here) else file
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if Path(frame.filename).resolve() == ours]
    if isinstance(error, SyntaxError) and error.filename and Path(error.filename).resolve() == ours:
        lines = [error.lineno]
    where = f", line {lines[-1]}" if lines else ""
    reason = str(error).strip().partition("\n")[0]
    return f"{file}{where}: {type(error).__name__}{f': {reason}' if reason else ''}"


def _parts(place: str) -> tuple[Path, str]:
    match = _PLACE.fullmatch(place)
    if match is None:
        raise PalpateError(f"'{place}' names no class: expected file.py:Class")
    return Path(match[1]), match[2] or ""


def _is_kind(value: Any, base: type) -> bool:
    return isinstance(value, type) and issubclass(value, base) and value is not base


def _run(path: Path) -> ModuleType:
    """The module of a file; run again if the file has changed since."""
    whole, digest = path.resolve(), _digest(path)
    if whole in _named and _named[whole][0] == digest:
        _named[whole] = _named.pop(whole)  # the latest last
        return _named[whole][1]
    name = f"palpate_file_{hashlib.sha256(str(whole).encode()).hexdigest()[:8]}_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, whole)
    assert spec is not None  # by the suffix
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    earlier = sys.modules.get(name)
    sys.modules[name] = module  # where dataclasses look for it
    sys.path.insert(0, str(whole.parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # a script may end itself
        sys.modules.pop(name)
        if earlier is not None:
            sys.modules[name] = earlier
        raise PalpateError(f"{path} cannot be loaded: {blame(error, path)}") from error
    finally:
        sys.path.remove(str(whole.parent))
    _named[whole] = digest, module
    return module


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except FileNotFoundError as error:
        raise PalpateError(
            f"there is no file {path}: expected the Python file of a class"
        ) from error
    except OSError as error:
        raise PalpateError(f"cannot read {path}: {error.strerror or error}") from error
