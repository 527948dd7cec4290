"""Words on a command line become a dataclass, or one sentence that says why they cannot.

And what completes them in a shell.
"""

import contextlib
import io
import itertools
import re
from collections.abc import Mapping
from dataclasses import make_dataclass
from typing import Annotated, Any, TypeVar, Union

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, OmitSubcommandPrefixes, subcommand

from palpate.errors import PalpateError
from palpate.family import Places, check_name, resolve

Options = TypeVar("Options")
_TAKES = {
    "INT": "a whole number",
    "N": "a whole number",
    "N ...": "whole numbers",
    "FLOAT": "a number",
    "NUMBER": "a number",
}


def parse(kind: type[Options], program: str, words: list[str]) -> Options | None:
    """The options that `words` give; None when they asked for help, which is then printed.

    Raises `PalpateError` for words that do not fit.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(kind, prog=program, args=words, config=(FlagCreatePairsOff,))
    except SystemExit as left:
        if not left.code:
            return None
        raise PalpateError(sentence(said.getvalue(), program, words)) from left


def completion(shell: str, kinds: Mapping[str, Places]) -> str:
    """A script by which a shell completes commands, what they work on, and options.

    `kinds` of each command, as of `palpate.cli.Command`. Raises `PalpateError` for another shell
    than bash or zsh.
    """
    check_name("shell", shell, ("bash", "zsh"))
    commands = {
        name: resolve(of[""])
        if "" in of
        else make_dataclass(name, [("of", _one_of({n: resolve(place) for n, place in of.items()}))])
        for name, of in kinds.items()
    }
    said, words = io.StringIO(), ["--tyro-print-completion", shell]
    how = (FlagCreatePairsOff, OmitArgPrefixes, OmitSubcommandPrefixes)
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        tyro.cli(_one_of(commands), prog="palpate", args=words, config=how)
    # What is no word of ours may be a file's name.
    return said.getvalue().replace("complete -F", "complete -o default -F")


def _one_of(kinds: Mapping[str, Any]) -> Any:
    """A choice among them by name; of a single one there is none, so that help stands beside it."""
    named = [Annotated[kind, subcommand(name)] for name, kind in kinds.items()]
    return Union[(*named, Annotated[None, subcommand("--help")])]


def sentence(box: str, program: str, words: list[str]) -> str:
    """What tyro says in a box of several lines about `words`, as one sentence."""
    lines = [line.strip("│╭╮╰╯─ ") for line in box.splitlines()]
    _, *inside = [line for line in lines if line.strip("-")]  # a title, and rules between parts
    text = " ".join(" ".join(inside).split())
    for pattern, answer in (
        (r"Error parsing (--\S+): .* Argument helptext: \1 (.*?) [A-Z][a-z]", _wrong_value),
        (r"Error parsing [A-Z]\w+: (.*?) For full helptext", "{0}"),
        (
            r"Unrecognized options: ([^ ,]+)(?:.*? Perhaps you meant.*?: (--\S+))?",
            _sentence_of_unknown,
        ),
        (r"invalid choice '(.*)' for argument '(--\S+)'. Expected one of \((.*?)\)", _no_choice),
        (r"Missing value for argument '(--\S+)'", "{0} needs a value"),
        (r"Missing from .*?: (--\S+ \S+)", "{0} is missing"),
    ):
        if match := re.match(pattern, text):
            given = isinstance(answer, str)
            wrong = answer.format(*match.groups()) if given else answer(match, words)
            return f"{wrong}; `{program} --help` says what there is"
    return text  # of another release of tyro: as it stands


def _wrong_value(match: re.Match[str], words: list[str]) -> str:
    option, takes = match.groups()
    at = next(index for index, word in enumerate(words) if word.partition("=")[0] == option)
    _, joined, value = words[at].partition("=")
    following = itertools.takewhile(lambda word: not word.startswith("--"), words[at + 1 :])
    given = [value] if joined else following
    return f"{option} takes {_TAKES.get(takes, takes)}, not '{' '.join(given)}'"


def _sentence_of_unknown(match: re.Match[str], words: list[str]) -> str:
    what = "option" if match[1].startswith("-") else "word"
    return f"unknown {what} '{match[1]}'" + (f", did you mean '{match[2]}'?" if match[2] else "")


def _no_choice(match: re.Match[str], words: list[str]) -> str:
    choices = sorted(set(re.findall(r"'(.*?)'", match[3])) - {"None"})
    return f"{match[2]} takes {', '.join(choices[:-1])} or {choices[-1]}, not '{match[1]}'"
