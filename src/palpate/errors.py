"""What palpate raises when the fault is in what it was given, or in what is installed."""

import importlib
import reprlib
from collections.abc import Iterable
from typing import Any, ClassVar

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 60


class PalpateError(ValueError):
    """Bad input: one sentence that says what was expected, what came and what would work.

    The command line prints it and exits with its `status`; a library user sees a `ValueError`.
    """

    status: ClassVar[int] = 2


class StoppedError(PalpateError):
    """Work that was done, and had to be stopped before its end: nothing was given wrongly."""

    status = 3


class DoubtfulResultError(PalpateError):
    """A result that was written, and is not to be trusted: the message says why."""

    status = 4


class PalpateWarning(UserWarning):
    """What somebody should know and nothing fails for; the command line prints it as a note."""


def quote(value: object) -> str:
    """What a file gave, for a sentence: as `repr`, but never longer than that sentence."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python prints no integers of thousands of digits
        return f"a huge {type(value).__name__}"


def list_names(names: Iterable[str], most: int = 6) -> str:
    """The first of `names`, and how many more there are, for a sentence."""
    every = list(names)
    more = f" and {len(every) - most} more" if len(every) > most else ""
    return (", ".join(every[:most]) or "none") + more


def extra_module(name: str, extra: str, package: str = "") -> Any:
    """The module `name`; raises `PalpateError` that names the extra, if its package is missing."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise PalpateError(
            f"this needs {package or name}, which is not installed: "
            f"`pip install 'palpate[{extra}]'` brings it"
        ) from error
