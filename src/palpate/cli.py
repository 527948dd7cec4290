"""The command line: a thin face over `palpate.commands`, and the table of families.

What computes is imported when a command runs, never before, so that help is instant.
"""

import codecs
import functools
import io
import re
import shlex
import sys
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from palpate import __version__
from palpate.errors import PalpateError, PalpateWarning
from palpate.family import check_name, families, options_of, places, resolve

INTERRUPTED = 130  # what a shell expects after Ctrl-C
PLAIN = "palpate.plain"  # an error handler of encodings
OWN = "FILE.py:CLASS"  # what a subject of somebody's own is called


@dataclass(frozen=True)
class Command:
    """One command, whose work is `run` of its module below `palpate.commands`.

    Where it works on one of several things, `subject` says what they are, and the families' tables
    give the options of each; `options`, of `palpate.commands.options`, then serve those that come
    without (experiments). With `optional` the subject may be left out: the first that there is
    stands for it. `own` is what gives the options for a subject of somebody's own, a class in a
    Python file: "file.py:Class".
    """

    about: str
    options: str = ""
    subject: str = ""
    optional: bool = False
    own: str = ""

    def kinds(self, name: str) -> dict[str, str]:
        """Where the options of each thing that the command `name` works on are: "module:name"."""
        own = f"palpate.commands.options:{self.options}"
        if not self.subject:
            return {"": own}
        return dict.fromkeys(places("experiments"), own) if self.options else options_of(name)


COMMANDS = {
    "demo": Command(
        "record an object, identify it, train a controller, try it, write a report",
        subject="family",
        optional=True,
    ),
    "record": Command("record a simulated object", subject="family"),
    "convert": Command("turn a robot's log or any recording into another format", "Convert"),
    "check": Command("say what is wrong with a file of links and joints, and mend it", "Check"),
    "interact": Command("handle something until its joints are known: its twin", "Interact"),
    "track": Command("follow an object through a camera's pictures", subject="family"),
    "identify": Command(
        "find an object's physical parameters from recordings of it",
        subject="family",
        own="palpate.families.own.options:identify_options",
    ),
    "plan": Command("plan a robot's way, moving what stands in it", subject="problem"),
    "train": Command(
        "train a controller through an identified model",
        subject="task",
        own="palpate.families.own.options:train_options",
    ),
    "evaluate": Command("try a controller in a world the model cannot see into", subject="task"),
    "audit": Command("say what energy a policy could draw, or a recording has drawn", "Audit"),
    "export": Command(
        "write a policy as ONNX, with a contract that says how to connect it", "Export"
    ),
    "serve": Command("run a policy in real time, and brake when its eyes fail", "Serve"),
    "report": Command("write the page of one or several runs", "Report"),
    "reproduce": Command(
        "repeat a headline experiment and hold its figures against their bars",
        "Reproduce",
        subject="experiment",
    ),
}


def _plain(error: UnicodeError) -> tuple[str, int]:
    """What an encoding lacks, in ASCII: "×10⁻⁴" is "x10^-4"."""
    assert isinstance(error, UnicodeEncodeError)
    lacking = error.object[error.start : error.end]
    plain = unicodedata.normalize("NFKD", lacking).translate({0x2212: "-", 0xD7: "x", 0xB1: "+-"})
    raised = "^" if unicodedata.decomposition(lacking[0]).startswith("<super>") else ""
    return raised + plain.encode("ascii", "replace").decode("ascii"), error.end


codecs.register_error(PLAIN, _plain)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status.

    0: done; 2: bad input, one sentence on stderr; 3: it was stopped, and 4: its result is not to be
    trusted, likewise; 130: interrupted by Ctrl-C.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # of a terminal that may not know "×10⁻⁴"
            stream.reconfigure(errors=PLAIN)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", PalpateWarning)
            warnings.showwarning = functools.partial(_note, warnings.showwarning)
            return _run(words)
    except PalpateError as error:
        return _refuse(str(error), error.status)
    except KeyboardInterrupt:
        again = shlex.join(["palpate", *words])
        print(f"\npalpate: interrupted; `{again}` goes on where it stopped", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output has left, as `head` does
        sys.stderr.close()
        return 0
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(f"{where}{error.strerror or error}")


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(_overview())
        return 0
    if words[0] == "--version":
        print(f"palpate {__version__}")
        return 0
    from palpate.commands.parsing import completion, parse

    if words[0] == "--completion":
        kinds = {name: command.kinds(name) for name, command in COMMANDS.items()}
        print(completion(" ".join(words[1:]), kinds))
        return 0

    name, *rest = words
    command = COMMANDS[check_name("command", name, COMMANDS)]
    kind, own, program = "", False, f"palpate {name}"
    kinds = command.kinds(name)
    if command.optional and (not rest or rest[0].startswith("-")):
        kind = next(iter(kinds))
    elif command.subject:
        known = [*kinds, *([OWN] if command.own else [])]
        if not rest or rest[0].startswith("-"):
            if rest and rest[0] in ("-h", "--help"):
                print(_subjects(name, command, known))
                return 0
            known = ", ".join(known)
            raise PalpateError(f"{program}: which {command.subject}? There are: {known}")
        kind, *rest = rest
        program = f"{program} {kind}"
        if not (own := bool(command.own and re.search(r"\.py(:|$)", kind))):
            check_name(command.subject, kind, known)
    of = resolve(command.own)(kind) if own else resolve(kinds[kind])
    options = parse(of, program, rest)
    if options is not None:
        run = resolve(f"palpate.commands.{name}:run")
        run(options, *([kind] if name == "reproduce" else []))
    return 0


def _note(show: Callable[..., None], message: Warning | str, *where: Any, **more: Any) -> None:
    if isinstance(message, PalpateWarning):
        print(f"note: {message}", file=sys.stderr)
    else:
        show(message, *where, **more)


def _refuse(sentence: str, status: int = PalpateError.status) -> int:
    print(f"palpate: {' '.join(sentence.split())}", file=sys.stderr)
    return status


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [
        "usage: palpate COMMAND ...",
        "",
        "Find out an object's physics by handling it, and act through what was found.",
        "",
        *(f"  {name:{width}}  {command.about}" for name, command in COMMANDS.items()),
        "",
        "Families of objects:",
        "",
        *(f"  {family.name:{width}}  {family.about}" for family in families().values()),
        "",
        "`palpate COMMAND --help` says more. A first look, in a few minutes: palpate demo",
        'The tab key completes all of it after: eval "$(palpate --completion bash)"',
    ]
    return "\n".join(lines)


def _subjects(name: str, command: Command, kinds: Iterable[str]) -> str:
    lines = [
        f"usage: palpate {name} {command.subject.upper()} ...",
        "",
        f"{command.about[0].upper()}{command.about[1:]}.",
        f"Each {command.subject} has its own options:",
        "",
        *(f"  palpate {name} {kind} --help" for kind in kinds),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
