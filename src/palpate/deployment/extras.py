"""Libraries that only some users need: named when they are missing."""

import importlib
from typing import Any

from palpate.errors import PalpateError


def extra_module(name: str, extra: str) -> Any:
    """The module `name`; raises `PalpateError` that names the extra, if it is missing."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise PalpateError(
            f"this needs {name}, which is not installed: `pip install 'palpate[{extra}]'` brings it"
        ) from error
