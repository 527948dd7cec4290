"""The command line: a thin face over `palpate.experiments`.

What computes is imported when a command runs, never before, so that help is instant.
"""

import importlib
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from palpate import __version__
from palpate.errors import PalpateError

INTERRUPTED = 130  # what a shell expects after Ctrl-C
BAD_INPUT = 2


@dataclass(frozen=True)
class Command:
    """One command: where its options and its work are found, as "module:name".

    Where a command works on one of several things, `options` gives those of each by its name and
    `what` says what they are. Options that name a `worker` have their work done there.
    """

    about: str
    run: str
    options: dict[str, str] = field(default_factory=dict)
    what: str = ""


COMMANDS = {
    "demo": Command(
        "record a rope, identify it, train a controller, try it, write a report",
        "palpate.experiments.demo:run",
        {"": "palpate.experiments.options:Demo"},
    ),
    "record": Command(
        "record a simulated object",
        "palpate.experiments.record:run",
        {
            "rope": "palpate.experiments.rope_options:RecordRope",
            "furniture": "palpate.experiments.furniture_options:RecordFurniture",
        },
        "family",
    ),
    "convert": Command(
        "turn a robot's log or any recording into another format",
        "palpate.experiments.convert:run",
        {"": "palpate.experiments.options:Convert"},
    ),
    "track": Command(
        "follow an object through a camera's pictures",
        "palpate.experiments.track:run",
        {"rope": "palpate.experiments.rope_options:TrackRope"},
        "family",
    ),
    "identify": Command(
        "find an object's physical parameters from recordings of it",
        "palpate.experiments.identify:run",
        {
            "rope": "palpate.experiments.rope_options:IdentifyRope",
            "furniture": "palpate.experiments.furniture_options:IdentifyFurniture",
        },
        "family",
    ),
    "plan": Command(
        "plan a robot's way, moving what stands in it",
        "palpate.experiments.plan_namo:run",
        {"namo": "palpate.experiments.namo_options:PlanNamo"},
        "problem",
    ),
    "train": Command(
        "train a controller through an identified model",
        "palpate.experiments.train:run",
        {
            "rope-stabilization": "palpate.experiments.rope_options:TrainRopeStabilization",
            "rope-tracking": "palpate.experiments.rope_options:TrainRopeTracking",
        },
        "task",
    ),
    "evaluate": Command(
        "try a controller in a world the model cannot see into",
        "palpate.experiments.evaluate:run",
        {
            "rope-stabilization": "palpate.experiments.rope_options:EvaluateRopeStabilization",
            "rope-tracking": "palpate.experiments.rope_options:EvaluateRopeTracking",
        },
        "task",
    ),
    "export": Command(
        "write a policy as ONNX, with a contract that says how to connect it",
        "palpate.experiments.export:run",
        {"": "palpate.experiments.options:Export"},
    ),
    "serve": Command(
        "run a policy in real time, and brake when its eyes fail",
        "palpate.experiments.serve:run",
        {"": "palpate.experiments.options:Serve"},
    ),
    "report": Command(
        "write the page of one or several runs",
        "palpate.experiments.page:run",
        {"": "palpate.experiments.options:Report"},
    ),
    "reproduce": Command(
        "repeat a headline experiment and hold its figures against their bars",
        "palpate.experiments.reproduce:run",
        dict.fromkeys(
            (
                "rope-model",
                "rope-stabilization",
                "rope-ablation",
                "rope-rivals",
                "rope-bound",
                "rope-generalization",
                "rope-tracking",
                "rope-dagger",
                "rope-residual",
                "rope-markerless",
                "namo-scenarios",
                "namo-scaling",
                "namo-online",
                "calibration",
                "one-shot",
                "cart-online",
            ),
            "palpate.experiments.options:Reproduce",
        ),
        "experiment",
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status.

    0: done; 2: bad input, one sentence on stderr; 130: interrupted by Ctrl-C.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _run(words)
    except PalpateError as error:
        return _refuse(str(error))
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
    from palpate.cli_parsing import parse
    from palpate.experiments.names import check_name

    name, *rest = words
    command = COMMANDS[check_name("command", name, COMMANDS)]
    kind, program = "", f"palpate {name}"
    if command.what:
        if not rest or rest[0].startswith("-"):
            if rest and rest[0] in ("-h", "--help"):
                print(_kinds(name, command))
                return 0
            kinds = ", ".join(command.options)
            raise PalpateError(f"{program} needs a {command.what} first; there are: {kinds}")
        kind, *rest = rest
        check_name(command.what, kind, command.options)
        program = f"{program} {kind}"
    kind_of_options = _found(command.options[kind])
    options = parse(kind_of_options, program, rest)
    if options is None:
        return 0
    work = getattr(kind_of_options, "worker", command.run)
    _found(work)(options, *([kind] if name == "reproduce" else []))
    return 0


def _refuse(sentence: str) -> int:
    print(f"palpate: {' '.join(sentence.split())}", file=sys.stderr)
    return BAD_INPUT


def _found(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [
        "usage: palpate COMMAND ...",
        "",
        "Find out an object's physics by handling it, and act through what was found.",
        "",
        *(f"  {name:{width}}  {command.about}" for name, command in COMMANDS.items()),
        "",
        "`palpate COMMAND --help` says more. A first look, in a few minutes: palpate demo",
    ]
    return "\n".join(lines)


def _kinds(name: str, command: Command) -> str:
    lines = [
        f"usage: palpate {name} {command.what.upper()} ...",
        "",
        f"{command.about[0].upper()}{command.about[1:]}. Each {command.what} has its own options:",
        "",
        *(f"  palpate {name} {kind} --help" for kind in command.options),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
