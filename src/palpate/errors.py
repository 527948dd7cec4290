"""What palpate raises when the fault is in what it was given."""

from collections.abc import Iterable


class PalpateError(ValueError):
    """Bad input: one sentence that says what was expected, what came and what would work.

    The command line prints it and exits with status 2; a library user sees a `ValueError`.
    """


def listed(names: Iterable[str], most: int = 6) -> str:
    """The first of `names`, and how many more there are, for a sentence."""
    every = list(names)
    more = f" and {len(every) - most} more" if len(every) > most else ""
    return ", ".join(every[:most]) + more
