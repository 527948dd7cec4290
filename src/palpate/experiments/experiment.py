"""What every reproduction repeats: its announcement, its stages, its seeds and its result.

    experiment = Experiment("rope-bound", out, quick, seed)
    experiment.announce({"search": 4})
    with experiment.stage("search", {"rollouts": rollouts}) as stage:
        for trial, note in resumable(stage.run, trials, arrays, "searching"):
            arrays["time"][trial] = ...
            note(time=...)
    return experiment.result(figures, settings, split)

A stage is a run in a folder of its own: cut off, it resumes there; finished, it is only read.
"""

import concurrent.futures
import contextlib
import dataclasses
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np

from palpate.networks import Controller
from palpate.runs import Figure, Result, Run
from palpate.runs.progress import progress
from palpate.runs.result import two_standard_errors
from palpate.runs.run import RESULT
from palpate.runs.storage import read_json
from palpate.trials.trial import RecordType, Trial, evaluate_trials, wilson_interval


@dataclasses.dataclass
class Stage:
    """A stage at work: its run, and the `content` that its `result.json` is to have."""

    run: Run
    content: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def path(self) -> Path:
        """The folder of the run."""
        return self.run.path

    @property
    def finished(self) -> bool:
        """Whether it was finished before, and is only read now."""
        return self.run.finished


@dataclasses.dataclass
class Experiment:
    """One reproduction below the folder `out`, `quick` at a smaller size.

    `seconds` and `seeds` are those that it has spent and used so far, in earlier processes too.
    """

    name: str
    out: Path
    quick: bool
    seed: int
    seconds: float = 0.0
    seeds: list[int] = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        self.seeds = [self.seed]

    @property
    def command(self) -> str:
        """The command that repeats it."""
        return f"palpate reproduce {self.name} --seed {self.seed}{' --quick' * self.quick}"

    def announce(self, minutes: Mapping[str, int]) -> None:
        """Say how long it will take: `minutes` on two cores that do nothing else, by stage."""
        parts = ", ".join(f"{stage} {time}" for stage, time in minutes.items())
        total = sum(minutes.values())
        print(f"{self.name}: about {total} minutes on two idle cores ({parts})", flush=True)

    def uses(self, first: int, count: int = 1) -> int:
        """The seed `first` + `seed`, and so many from it on, noted for the result."""
        self.seeds += range(first + self.seed, first + self.seed + count)
        return first + self.seed

    @contextlib.contextmanager
    def stage(self, folder: str, configuration: Mapping[str, Any]) -> Iterator[Stage]:
        """Open a stage, finish it at the end of the block, and count the seconds that it took.

        Its name and the seed join the configuration. Raises `PalpateError` when the folder holds a
        stage of another one.
        """
        whole = {"stage": folder, "seed": self.seed, **configuration}
        with Run.open(self.out / folder, whole) as run:
            stage = Stage(run)
            yield stage
            if not run.finished:
                about = {"name": f"{self.name} {folder}", "wall_time_s": run.elapsed}
                run.finish(about | stage.content)
            self.seconds += read_json(run.path / RESULT).get("wall_time_s", 0.0)

    def found(
        self, folder: str, configuration: Mapping[str, Any], work: Callable[[], dict[str, Any]]
    ) -> dict[str, Any]:
        """What `work` found in a stage of its own, from the stage's `result.json`."""
        with self.stage(folder, configuration) as stage:
            if not stage.finished:
                stage.content = work()
        return read_json(stage.path / RESULT)

    def evaluated(
        self,
        folder: str,
        about: Mapping[str, Any],
        controllers: Mapping[str, Controller],
        trials: Sequence[Trial[RecordType]],
        show: Callable[[Run, Sequence[Any], dict[str, RecordType]], None] | None = None,
    ) -> tuple[dict[str, RecordType], dict[str, list[float]]]:
        """What each controller does in all trials, and how long planners take to decide.

        In a stage, of which `about` says what trials and controllers these are, and `show` leaves
        evidence. The times are median and 99th percentile, ms, of controllers that note what they
        have `spent`, s.
        """
        used = {"trials": len(trials), "controllers": list(controllers)}
        with self.stage(folder, used | dict(about)) as stage:
            found = evaluate_trials(controllers, trials, stage.run)
            if not stage.finished:
                if show is not None:
                    show(stage.run, trials, found)
                spent = {name: getattr(one, "spent", None) for name, one in controllers.items()}
                stage.content["decision_ms"] = {
                    name: (1e3 * np.quantile(times, (0.5, 0.99))).tolist()
                    for name, times in spent.items()
                    if times
                }
        return found, read_json(stage.path / RESULT)["decision_ms"]

    def on_every_core(
        self, work: Callable[..., Any], grid: Sequence[tuple[Any, ...]], doing: str
    ) -> None:
        """Call `work(experiment, *arguments)` for each of the arguments in as many processes as
        there are cores, each on one.

        `work` is a module's own function, whose stages are then read here. A process writes what it
        prints into a file that its arguments name. What one raises is raised here, when those that
        are under way are done.
        """
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        spawn = multiprocessing.get_context("spawn")
        processes = max(1, min(cores or 1, len(grid)))
        alone = Experiment(self.name, self.out, self.quick, self.seed)
        with concurrent.futures.ProcessPoolExecutor(processes, spawn, _start_worker) as pool:
            futures = []
            for arguments in grid:
                log = self.out / f"{'-'.join(map(str, arguments))}.log"
                futures.append(pool.submit(_into, log, work, alone, *arguments))
            try:
                done = concurrent.futures.as_completed(futures)
                for _ in progress(range(len(futures)), doing):
                    next(done).result()
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise

    @contextlib.contextmanager
    def counted(self) -> Iterator[None]:
        """Count the seconds of work that is no stage and is done anew in every process."""
        began = time.monotonic()
        yield
        self.seconds += time.monotonic() - began

    def result(
        self,
        figures: list[Figure],
        settings: Mapping[str, Any],
        split: str | dict[str, Any],
        seeds: Sequence[int] | None = None,
    ) -> Result:
        """The experiment's result; `seeds` are those noted, or the ones given."""
        seeds = list(dict.fromkeys(self.seeds if seeds is None else seeds))
        settings = {"quick": self.quick, **settings}
        return Result(self.name, figures, settings, seeds, split, self.seconds)


# --- processes beside each other --------------------------------------------------------------


def _start_worker() -> None:
    """Take one core, and end with the process that started this one, which may be killed.

    Before JAX starts: two processes whose threads compete are slower than one.
    """
    threading.Thread(target=_end_with, args=[multiprocessing.parent_process()], daemon=True).start()
    flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ[f"{library}_NUM_THREADS"] = "1"


def _end_with(parent: BaseProcess) -> None:
    """At once: a stage that is cut off resumes, while one that goes on alone would be in the way of
    the next attempt."""
    parent.join()
    os._exit(1)


def _into(log: Path, work: Callable[..., Any], *arguments: Any) -> None:
    log.parent.mkdir(parents=True, exist_ok=True)
    with (
        log.open("a", encoding="utf-8") as file,
        contextlib.redirect_stdout(file),
        contextlib.redirect_stderr(file),
    ):
        work(*arguments)


# --- figures ----------------------------------------------------------------------------------


def suffix(label: str) -> str:
    """What is said to a person, "MPPI 10 ms", as it stands in a figure's name: mppi_10_ms."""
    return label.lower().replace(", ", ".").replace(" ", "_")


def ratio(own: float | None, other: float | None) -> float | None:
    """Of two figures; None where one is not known."""
    return None if own is None or other is None else own / other


def mean_of(name: str, values: Iterable[SupportsFloat], unit: str = "", **held: Any) -> Figure:
    """The mean of independent values with two standard errors as its spread."""
    numbers = [float(value) for value in values]
    spread = two_standard_errors(numbers)
    return Figure(name, sum(numbers) / len(numbers), unit, spread=spread, **held)


def share_of(name: str, successes: int, count: int, **held: Any) -> Figure:
    """A success rate; its spread is the wider side of Wilson's 95 % interval. None of nothing."""
    held = {"better": "higher", **held}
    if not count:
        return Figure(name, None, "", **held)
    low, high = wilson_interval(successes, count)
    share = successes / count
    return Figure(name, share, "", spread=max(share - low, high - share), **held)


def decision_figures(times: Mapping[str, Sequence[float]]) -> list[Figure]:
    """Median and 99th percentile of how long planners take to decide, ms."""
    return [
        Figure(f"decision_ms_{kind}.{suffix(name)}", value, "ms")
        for name, both in times.items()
        for kind, value in zip(("median", "p99"), both, strict=True)
    ]
