"""What the README and the pages of the docs tell a reader to type is something palpate knows."""

import re
import shlex
from pathlib import Path

import pytest

from palpate.cli import COMMANDS
from palpate.commands import evaluate, identify, train
from palpate.commands.parsing import parse
from palpate.family import resolve

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
WORDS = {"NAME": "rope-model", "R": "0.9", "G": "0.5", "B": "0.2", "M": "0.005", "N": "3"}
WORDS |= {"X": "1", "Y": "1", "THETA": "0", "METRES": "0.005"}


def lines(page: Path) -> list[str]:
    """Every command line of a page: shown as code by itself, or after a prompt.

    What may be left out stands in [brackets], and is kept; dots say that there may be more.
    """
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    found = re.findall(r"^(?:    |\$ )(palpate [^#\n]*)", text, re.MULTILINE)
    return [line.translate(str.maketrans("", "", "[]")).replace("...", "") for line in found]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_line_of_a_page_can_be_given(page):
    for line in lines(page):
        name, *words = [WORDS.get(word, word) for word in shlex.split(line)[1:]]
        command, kind = COMMANDS[name], ""
        kinds = command.kinds(name)
        if command.subject and not (command.optional and not words):
            kind, *words = words
        place = kinds.get(kind or next(iter(kinds)))
        of = resolve(place) if place else resolve(command.own)(kind)
        assert parse(of, line, words) is not None, line


def test_the_pages_show_command_lines_at_all():
    assert len(lines(PAGES[0])) > 10
    assert sum(map(len, map(lines, PAGES))) > 45


def test_the_python_of_the_readme_hands_each_command_what_the_one_before_it_wrote(monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", PAGES[0].read_text(encoding="utf-8"), re.DOTALL)
    given = []
    for command in (identify, train, evaluate):
        out = Path(command.__name__)
        monkeypatch.setattr(command, "run", lambda options, out=out: given.append(options) or out)
    exec(code, {})
    identified, trained, evaluated = given
    assert identified.mass == 0.055
    assert trained.model == Path(identify.__name__)
    assert evaluated.policy == Path(train.__name__)
