"""The reference of the docs, made of docstrings: whole, and nothing in it without words."""

import importlib
import importlib.util
import inspect
import operator
import re
from pathlib import Path

import pytest

from palpate.family import resolve

PAGES = Path(__file__).parents[1] / "docs" / "reference_pages.py"


def reference():
    spec = importlib.util.spec_from_file_location("reference_pages", PAGES)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


REFERENCE = reference()
MODULES = [f"palpate.{name}" for names in REFERENCE.STAGES.values() for name in names]
FACES = ("recordings", "models", "learning", "networks", "tasks", "runs", "report", "tasks.rope")


def public(of):
    """What is shown of a module or a class: its own functions, classes and properties."""
    own = getattr(of, "__module__", of.__name__)
    for name, member in vars(of).items():
        function = getattr(member, "__func__", member)  # of a class or static method
        asked = isinstance(function, type | property) or inspect.isfunction(function)
        if asked and not name.startswith("_") and getattr(function, "__module__", own) == own:
            yield name, function


def said(of, name):
    words = inspect.getdoc(getattr(of, name)) or ""
    return "" if words.startswith(f"{name}(") else words  # what dataclasses write themselves


@pytest.mark.parametrize("name", MODULES)
def test_a_module_of_the_reference_says_what_all_of_it_is(name):
    module = importlib.import_module(name)
    shown = dict(public(module))
    assert module.__doc__
    assert shown, "there is nothing to show"
    silent = [name for name in shown if not said(module, name)]
    for kind in filter(inspect.isclass, shown.values()):
        silent += [f"{kind.__name__}.{name}" for name, _ in public(kind) if not said(kind, name)]
    assert not silent


def test_every_command_is_one_call_that_the_reference_explains():
    calls = REFERENCE.calls()
    assert len(calls) > 15
    for words, name, place in calls:
        assert resolve(f"palpate.commands.{name}:run").__doc__, words
        assert resolve(place).__doc__, words
        assert place.partition(":")[0] in MODULES, f"{words}: {place} is on no page"


def test_what_the_pages_of_the_docs_point_at_is_explained():
    pages = [page.read_text(encoding="utf-8") for page in PAGES.parent.glob("*.md")]
    roles = [role for page in pages for role in re.findall(r"\{(\w+)\}`(palpate[\w.]+)`", page)]
    assert len(roles) > 15
    for role, target in roles:
        home = max((name for name in MODULES if f"{target}.".startswith(f"{name}.")), default="")
        assert home, f"{target} is on no page"
        assert (role == "mod") == (home == target)
        operator.attrgetter(target.removeprefix(home).lstrip(".") or "__doc__")(
            importlib.import_module(home)
        )


@pytest.mark.parametrize("face", FACES)
def test_what_a_stage_hands_out_is_explained(face):
    package = importlib.import_module(f"palpate.{face}")
    members = [member for name, member in vars(package).items() if not name.startswith("_")]
    homes = {member.__module__ for member in members if hasattr(member, "__module__")}
    assert homes
    assert homes <= set(MODULES)
