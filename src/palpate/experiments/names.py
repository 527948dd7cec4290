"""Names that a person may type, and what to say when one is not among those that exist."""

import difflib
from collections.abc import Iterable

from palpate.errors import PalpateError


def check_name(what: str, name: str, names: Iterable[str]) -> str:
    """The `name` itself; raises `PalpateError` that lists all and guesses which one was meant."""
    names = list(names)
    if name in names:
        return name
    meant = difflib.get_close_matches(name, names, 1)
    guess = f"did you mean '{meant[0]}'? " if meant else ""
    raise PalpateError(f"unknown {what} '{name}'; {guess}there are: {', '.join(names)}")


def suffix(label: str) -> str:
    """What is said to a person, "MPPI 10 ms", as it stands in a figure's name: mppi_10_ms."""
    return label.lower().replace(" ", "_")
