"""What palpate raises when the fault is in what it was given."""


class PalpateError(ValueError):
    """Bad input: one sentence that says what was expected, what came and what would work.

    The command line prints the sentence and exits with status 2; a library user sees an
    ordinary `ValueError`.
    """
