"""A controller in worlds, judged by a task: the runner of closed loops of every family.

A trial is one world, how it begins, and what is asked for in it. Many run side by side, so that a
learned controller is asked once per control period for all of them. Nobody but the task is shown
the truth.
"""

import dataclasses
import functools
import math
import numbers
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, Generic, TypeVar

import jax
import numpy as np

from palpate.errors import PalpateError
from palpate.networks import Controller
from palpate.numerics import devices
from palpate.runs import Figure, Run
from palpate.runs.progress import interruptible, progress
from palpate.trials.controller import check_period
from palpate.worlds.world import DivergedError, World


class Record:
    """A dataclass of what happened in trials, once per control period from the start on.

    Fields that are arrays lead with (trials, times) and hold what the task measures; the one named
    `observed` leads with (drawn trials, times) and is that part of the observations, of the trials
    that are drawn. All are NaN after a trial's end and once its simulation has diverged; `failures`
    say by trial why it did.
    """

    observed: ClassVar[str]
    failures: dict[int, str]

    def part(self, chosen: Sequence[int]) -> Any:
        """The record of some of the trials, in this order; nothing is drawn of them."""
        kept = {
            name: array[:0] if name == self.observed else array[list(chosen)]
            for name, array in self.arrays().items()
        }
        places = [place for place, trial in enumerate(chosen) if trial in self.failures]
        failures = {place: self.failures[chosen[place]] for place in places}
        return dataclasses.replace(self, **kept, failures=failures)  # type: ignore[type-var]

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}


RecordType = TypeVar("RecordType", bound=Record)


class Trial(ABC, Generic[RecordType]):
    """One world, how it begins, what is asked for in it, and what is kept of it.

    `seed` draws the world's randomness; `steps` are the control periods that it lasts (None: as
    many as all). `side_by_side`: how many run at once; a run that was cut off repeats at most
    these.
    """

    side_by_side: ClassVar[int] = 20
    seed: int
    steps: int | None = None

    @property
    @abstractmethod
    def control_period(self) -> float:
        """Of its world, s."""

    @property
    @abstractmethod
    def group(self) -> str:
        """The row of a table that it belongs to; one trial of each group is drawn."""

    @property
    @abstractmethod
    def reset_options(self) -> Mapping[str, Any]:
        """Options of the world's `reset`."""

    @property
    @abstractmethod
    def command(self) -> np.ndarray:
        """The action in force before the first decision."""

    @abstractmethod
    def world(self) -> World:
        """The world, not yet reset."""

    @abstractmethod
    def measure(self, observation: Any, truth: Any) -> Mapping[str, Any]:
        """What the task measures at one instant: entries of the record's arrays."""

    @classmethod
    def goals(cls, trials: Sequence[Any]) -> Any:
        """What is asked for in trials that run side by side; None where nothing varies."""
        return None

    @classmethod
    @abstractmethod
    def record(cls, trials: Sequence[Any], steps: int, drawn: int) -> RecordType:
        """Of trials that have yet to be run, all NaN."""

    @classmethod
    @abstractmethod
    def figures(cls, trials: Sequence[Any], record: RecordType, suffix: str = "") -> list[Figure]:
        """What counts, in names that end in `suffix`; the first is shown while trials are run."""

    @classmethod
    def line(cls, name: str, trials: Sequence[Any], record: RecordType) -> str:
        """How the controller `name` did, as a row of a table."""
        values = [
            f"{figure.name.replace('_', ' ')} {figure.value:.3g} {figure.unit}".rstrip()
            for figure in cls.figures(trials, record)
            if figure.value is not None
        ]
        return f"{name:28s} {', '.join(values)}"


TrialType = TypeVar("TrialType", bound=Trial)


def run_trials(
    trials: Sequence[Trial[RecordType]],
    controller: Controller,
    steps: int | None = None,
    drawn: Sequence[int] = (),
    watch: Callable[[int, Sequence[World]], None] | None = None,
) -> RecordType:
    """Run all trials side by side for `steps` control periods, on as many threads as cores.

    Without `steps`, for as long as any of them lasts. The trials numbered in `drawn` are kept for
    drawing. A simulation that diverges ends its own trial and no other. `watch` is called at the
    start (0) and after every control period with its number and the worlds. Raises `PalpateError`
    when the controller decides in another period.
    """
    for period in {trial.control_period for trial in trials}:
        check_period(controller, period)
    if steps is None:
        steps = max(trial.steps or 0 for trial in trials)
    carry = controller.initial_carry(np.stack([trial.command for trial in trials]))
    goals = type(trials[0]).goals(trials)
    shares = np.array_split(np.arange(len(trials)), devices.cores())
    with ThreadPoolExecutor(devices.cores()) as threads:
        loop = _Loop(trials, steps, drawn, threads)
        for step in range(steps + 1):
            if step:
                carry, actions = controller(carry, stack_observations(loop.latest), goals, None)
                advance = functools.partial(loop.advance, step, actions)
                list(threads.map(advance, shares))  # MuJoCo lets the other threads run meanwhile
            if watch is not None:
                watch(step, loop.worlds)
    return loop.record


class _Loop(Generic[RecordType]):
    """Worlds, the last observation of each, and what is kept of them."""

    def __init__(
        self,
        trials: Sequence[Trial[RecordType]],
        steps: int,
        drawn: Sequence[int],
        threads: ThreadPoolExecutor,
    ):
        self._trials = trials
        self.worlds = [trial.world() for trial in trials]
        self._drawn = {trial: place for place, trial in enumerate(drawn)}
        self.record = type(trials[0]).record(trials, steps, len(drawn))
        self.latest = list(threads.map(self._reset, range(len(trials)), trials))
        for index in range(len(trials)):
            if index not in self.record.failures:
                self._keep(index, 0)

    def _reset(self, index: int, trial: Trial) -> Any:
        try:
            return self.worlds[index].reset(trial.seed, **trial.reset_options)
        except DivergedError as error:  # before it began, as a rope that is shaken
            self.record.failures[index] = str(error)
            return self.worlds[index].reset(trial.seed)  # something to see for who sees all worlds

    def advance(self, step: int, actions: Any, share: np.ndarray) -> None:
        for index in share.tolist():
            last = self._trials[index].steps
            if index in self.record.failures or (last is not None and step > last):
                continue
            try:
                self.latest[index] = self.worlds[index].step(actions[index])
                self._keep(index, step)
            except PalpateError as error:
                self.record.failures[index] = str(error)

    def _keep(self, index: int, step: int) -> None:
        observation = self.latest[index]
        measured = self._trials[index].measure(observation, self.worlds[index].truth())
        for name, value in measured.items():
            getattr(self.record, name)[index, step] = value
        if index in self._drawn:
            observed = self.record.observed
            array = getattr(self.record, observed)
            array[self._drawn[index], step] = getattr(observation, observed)


def stack_observations(observations: Sequence[Any]) -> Any:
    """The observations of several worlds as one, whose arrays lead with the worlds.

    The `time` is that of the newest.
    """
    first = observations[0]
    if isinstance(first, float):
        return max(observations)
    if not dataclasses.is_dataclass(first):
        return None if first is None else np.stack(observations)
    columns = {
        field.name: stack_observations([getattr(one, field.name) for one in observations])
        for field in dataclasses.fields(first)
    }
    return dataclasses.replace(first, **columns)  # type: ignore[type-var]


def first_of_each_group(trials: Sequence[Trial]) -> list[int]:
    """The trials that are drawn."""
    return [chosen[0] for chosen in groups(trials).values()]


def groups(trials: Sequence[Trial]) -> dict[str, list[int]]:
    """The trials of each group, in the order in which the groups come."""
    found: dict[str, list[int]] = {}
    for index, trial in enumerate(trials):
        found.setdefault(trial.group, []).append(index)
    return found


def evaluate_trials(
    controllers: Mapping[str, Controller],
    trials: Sequence[Trial[RecordType]],
    run: Run | None = None,
) -> dict[str, RecordType]:
    """What each controller does in all trials, for as long as each lasts.

    The first of each group is kept for drawing. With a `run`, finished trials are saved and logged
    there, and one that was cut off goes on. The caller opens the run and finishes it.

    Raises `PalpateError` when a controller decides in another period.
    """
    kind, drawn = type(trials[0]), first_of_each_group(trials)
    for controller in controllers.values():
        for period in {trial.control_period for trial in trials}:
            check_period(controller, period)
    longest = max(trial.steps or 0 for trial in trials)
    done = {name: kind.record(trials, longest, len(drawn)) for name in controllers}
    work = [
        (name, list(range(first, min(first + kind.side_by_side, len(trials)))))
        for name in controllers
        for first in range(0, len(trials), kind.side_by_side)
    ]
    arrays = {name: record.arrays() for name, record in done.items()}
    for (name, chosen), note in resumable(run, work, arrays, "trials"):
        some = [trials[index] for index in chosen]
        places = [place for place, index in enumerate(chosen) if index in drawn]
        part = run_trials(some, controllers[name], None, places)
        rows = [drawn.index(chosen[place]) for place in places]
        for field, values in part.arrays().items():
            whole = arrays[name][field]
            whole[rows if field == part.observed else chosen, : values.shape[1]] = values
        failures = {chosen[place]: why for place, why in part.failures.items()}
        done[name].failures.update(failures)
        reasons = {str(trial): why for trial, why in failures.items()}
        first, *_ = kind.figures(some, part)
        note(controller=name, failures=reasons, **{first.name: first.value})
    for line in run.metrics() if run is not None else ():  # those of earlier processes, too
        failures = {int(trial): why for trial, why in line["failures"].items()}
        done[line["controller"]].failures.update(failures)
    return done


def resumable(
    run: Run | None, items: Sequence[Any], arrays: Any, label: str
) -> Iterator[tuple[Any, Callable[..., None]]]:
    """Go through `items` from where the run was cut off; `arrays` are saved after each.

    `arrays` is a tree of NumPy arrays to be written on; what was saved is put into them first. With
    each item comes a function that notes values for it in the run's metrics, numbers beside the bar
    too. Without a run nothing is saved.
    """
    done, kept = (run and run.restore(arrays)) or (0, arrays)
    jax.tree.map(np.copyto, arrays, kept)
    bar = progress(items[done:], label, done=done)
    with interruptible() as stop:
        for step, item in enumerate(bar, done + 1):
            noted: dict[str, Any] = {}
            yield item, noted.update
            bar.show(**{n: v for n, v in noted.items() if isinstance(v, numbers.Real)})
            if run is not None:
                if noted:
                    run.log(step, **noted)
                run.save(step, arrays)
            if stop:
                break


def by_group(
    trials: Sequence[TrialType], record: RecordType
) -> dict[str, tuple[list[TrialType], RecordType]]:
    """The trials of each group, and their part of the record."""
    return {
        group: ([trials[index] for index in chosen], record.part(chosen))
        for group, chosen in groups(trials).items()
    }


def table(trials: Sequence[Trial[RecordType]], evaluated: Mapping[str, RecordType]) -> list[str]:
    """Lines for a person: every controller, over all trials and in each group."""
    line, lines = type(trials[0]).line, []
    for name, record in evaluated.items():
        lines.append(line(name, trials, record))
        if len(parts := by_group(trials, record)) > 1:
            lines += [line(f"  {group}", *part) for group, part in parts.items()]
        lines += [f"  trial {trial}: {why}" for trial, why in sorted(record.failures.items())]
    return lines


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """95 % interval of a success rate (Wilson 1927, J. Am. Stat. Assoc. 22:209-212)."""
    z = 1.959964
    rate = successes / count
    centre = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * math.sqrt(rate * (1 - rate) / count + (z / (2 * count)) ** 2)
    return max(0.0, centre - half), min(1.0, centre + half)
