"""Docstrings are written as Markdown is, and Sphinx reads reStructuredText: from one to the other.

Code stands in `single quotes`, or indented by four after an empty line; examples of a command line
are numbered, with what they show before them. Stars and bars are those of mathematics, but for
*words* between two stars. Types are shown without what they say to the command line.
"""

import importlib
import re
import typing
from collections.abc import Iterable

from sphinx.ext.napoleon import Config, GoogleDocstring

from palpate.families.options import Options
from palpate.models.model import Model
from palpate.parameters import parameters_of

_EMPHASIS = re.compile(r"(?<![\w*])\*\w(?:[^*`]*[^\s*`])?\*(?!\w)")
_ITEM = re.compile(r"(?:-|\d+\.) ")


def setup(app: typing.Any) -> None:
    """Let Sphinx read docstrings as they are written."""

    def convert(
        app: typing.Any, what: str, name: str, of: object, options: object, lines: list[str]
    ) -> None:
        lines[:] = as_restructured(lines)
        if {"Args:", "Returns:"} & {line.strip() for line in lines}:
            lines[:] = GoogleDocstring(lines, Config(), app, what, name, of).lines()
        if isinstance(of, type) and issubclass(of, Model):
            lines += parameters(of)

    def shorten(app: typing.Any, what: str, name: str, *more: typing.Any) -> tuple[str, str]:
        *_, arguments, returned = more
        return short(arguments), short(returned)

    app.connect("autodoc-process-docstring", convert)
    app.connect("autodoc-process-signature", shorten)


def parameters(kind: type[Model]) -> list[str]:
    """A list of what a model is made of, each with its unit and meaning."""
    known = parameters_of(kind).items()
    return ["", *(f"- ``{name}`` ({of.unit}): {_escaped(of.about)}" for name, of in known), ""]


def short(signature: str | None) -> typing.Any:
    """A signature in which an array is called as in the source."""
    return signature and signature.replace("jaxlib._jax.Array", "Array")


def without_hints_for_the_command_line(modules: Iterable[str]) -> None:
    """Show fields of options as what they hold: not with what --help says of them."""
    for module in map(importlib.import_module, modules):
        for kind in vars(module).values():
            if isinstance(kind, type) and issubclass(kind, Options):
                types = typing.get_type_hints(kind)
                kind.__annotations__ = {name: types[name] for name in kind.__annotations__}
                kind.__init__.__annotations__ = types


def as_restructured(lines: list[str]) -> list[str]:
    """The lines of a docstring for Sphinx; a formula keeps its stars, an example its columns."""
    converted, literal, in_list = [], False, False
    for index, line in enumerate(lines):
        begins = index == 0 or not lines[index - 1].strip()
        if begins and line.strip():
            indented = line.startswith("    ")
            columns = re.match(r"\d+\. .*\S  ", line) is not None
            if literal := (indented and not in_list) or columns:
                converted += ["::", ""]
            in_list = bool(_ITEM.match(line)) or (in_list and line.startswith(" "))
        if literal:
            converted.append(f"    {line}" if line.strip() else "")
        else:
            converted.append(_prose(line))
    return converted


def _prose(line: str) -> str:
    pieces = line.split("`")
    if len(pieces) % 2 == 0:  # a quotation that goes on in the next line
        return line
    pieces[1::2] = (f"``{code}``" for code in pieces[1::2])
    pieces[::2] = map(_escaped, pieces[::2])
    return "".join(pieces)


def _escaped(text: str) -> str:
    kept = _EMPHASIS.findall(text)
    between = [re.sub(r"([*|]|(?<=\w)_(?!\w))", r"\\\1", part) for part in _EMPHASIS.split(text)]
    return "".join(part + mark for part, mark in zip(between, [*kept, ""], strict=True))
