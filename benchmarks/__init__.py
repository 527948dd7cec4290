"""Timings, each with a rival in the same run."""

import argparse
from collections.abc import Callable
from pathlib import Path

from palpate.runs import Result
from palpate.runs.storage import write_json


def run(benchmark: Callable[[bool], Result], about: str) -> None:
    """Print what a benchmark finds, with `--quick` in fewer rounds, and write it with `--out`."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--quick", action="store_true", help="fewer rounds")
    options = parser.parse_args()
    result = benchmark(options.quick)
    print("\n".join(result.lines()))
    if options.out:
        write_json(options.out, result.to_dict())
