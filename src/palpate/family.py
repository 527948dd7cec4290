"""The table of families: what each brings to every stage, named here and imported when needed.

A family is a folder below `palpate/families` whose package has a `FAMILY`, or another package's
entry point in the group `palpate.families` that names one. Everything that has to know what there
is (saving, loading, the command line, reports, serving, `reproduce`) reads this table, so that a
new family touches its own folders and nothing else.
"""

import difflib
import functools
import importlib
import pkgutil
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any

from palpate.errors import PalpateError

GROUP = "palpate.families"  # of entry points, and the package that holds ours

Places = Mapping[str, str]  # a name, and where the thing of that name is: "module:name"


@dataclass(frozen=True)
class Family:
    """What one family of objects hands over. Every value of a table is a place, "module:name".

    `about` says in a few words what objects these are. `models`, `tasks`, `controllers`: classes by
    the name that files and the command line use. `deployments`: how the policies of a task are
    connected to a robot. `evidence`: pieces (`palpate.report.Piece`) that the family adds to a
    run's page. `options`: for each command the options of each thing that it works on (a family, a
    task, a problem), as `palpate.families.options` describes. `experiments`: what `palpate
    reproduce` can repeat.
    """

    name: str
    about: str
    models: Places = field(default_factory=dict)
    tasks: Places = field(default_factory=dict)
    controllers: Places = field(default_factory=dict)
    deployments: Places = field(default_factory=dict)
    evidence: Places = field(default_factory=dict)
    options: Mapping[str, Places] = field(default_factory=dict)
    experiments: Places = field(default_factory=dict)


@functools.cache
def families() -> dict[str, Family]:
    """All families there are, ours first, by name.

    Raises `PalpateError` for an entry point that is no `Family`, and for a name that is taken.
    """
    ours = importlib.import_module(GROUP)
    found = [
        importlib.import_module(f"{GROUP}.{module.name}").FAMILY
        for module in pkgutil.iter_modules(ours.__path__)
        if module.ispkg
    ]
    for point in entry_points(group=GROUP):
        family = point.load()
        if not isinstance(family, Family):
            raise PalpateError(
                f"the entry point '{point.name}' of {GROUP} gives {type(family).__name__}: "
                "expected a palpate.family.Family"
            )
        found.append(family)
    table: dict[str, Family] = {}
    for family in found:
        if family.name in table:
            raise PalpateError(f"two families are called '{family.name}': expected different names")
        table[family.name] = family
    return table


def places(what: str) -> dict[str, str]:
    """The places of all families' `what`: "models", "tasks", "experiments", ..."""
    return {
        name: place
        for family in families().values()
        for name, place in getattr(family, what).items()
    }


def options_of(command: str) -> dict[str, str]:
    """What a command works on, by name, and where the options of each are."""
    return {
        name: place
        for family in families().values()
        for name, place in family.options.get(command, {}).items()
    }


def find(what: str, name: str) -> Any:
    """What is called `name` among all families' `what`; raises `PalpateError` if nothing is."""
    known = places(what)
    return resolve(known[check_name(what.removesuffix("s"), name, known)])


def name_of(kind: type, known: Places) -> str | None:
    """What a class is called in a table of places; None where it is not in it.

    A place that is not loaded yet cannot be that of a class which is here.
    """
    for name, place in known.items():
        module, _, attribute = place.partition(":")
        if getattr(sys.modules.get(module), attribute, None) is kind:
            return name
    return None


def resolve(place: str) -> Any:
    """What is at "module:name"."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


def check_name(what: str, name: str, names: Iterable[str]) -> str:
    """The `name` itself; raises `PalpateError` that lists all and guesses which one was meant."""
    names = list(names)
    if name in names:
        return name
    meant = difflib.get_close_matches(name, names, 1)
    guess = f"did you mean '{meant[0]}'? " if meant else ""
    raise PalpateError(f"unknown {what} '{name}'; {guess}there are: {', '.join(names)}")
