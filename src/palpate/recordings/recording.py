"""What was observed: named channels, each with its own clock, in trials.

A `Channel` is one sensor or one input with its own time stamps, `Events` are clouds or images; a
`Trial` holds those of one uninterrupted run and the facts that hold during it; a `Recording` holds
trials and says where they came from. What was put right on the way is written down in
`Recording.notes`. Algorithms work on what `Recording.align` makes of it.
"""

import math
import numbers
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from palpate.errors import PalpateError
from palpate.recordings.alignment import Aligned, Names, align
from palpate.recordings.facts import Fact
from palpate.recordings.trial import Trial

Kind = TypeVar("Kind", bound=Fact)


@dataclass(frozen=True, eq=False)
class Recording:
    """Trials with different names, and `provenance`: where they came from, as text and numbers."""

    trials: tuple[Trial, ...]
    provenance: Mapping[str, str | float | int]

    def __post_init__(self) -> None:
        trials = tuple(self.trials)
        if not trials:
            raise PalpateError("a recording needs at least one trial")
        names = [trial.name for trial in trials]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise PalpateError(f"two trials are called '{twice}': trials need different names")
        provenance = {str(key): _plain(str(key), value) for key, value in self.provenance.items()}
        vars(self).update(trials=trials, provenance=provenance)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was put right or left out, one sentence each, for a person to read."""
        return tuple(
            f"trial '{trial.name}', {channel.name}: {note}"
            for trial in self.trials
            for channel in trial.parts
            for note in channel.notes
        )

    def select(self, indices: Sequence[int]) -> "Recording":
        """The trials at `indices`, in that order; negative ones count from the end."""
        chosen = resolve_indices(indices, len(self.trials), "trial")
        return replace(self, trials=tuple(self.trials[i] for i in chosen))

    def split(self, fraction: float, seed: int) -> "tuple[Recording, Recording]":
        """(train, validation) by trial: `fraction` of the trials, drawn by `seed`, validate.

        At least one trial stands on each side; the order of the trials is kept.
        """
        if not 0 < fraction < 1:
            raise PalpateError(f"the fraction for validation lies between 0 and 1, not {fraction}")
        count = len(self.trials)
        if count < 2:
            raise PalpateError(
                f"the only trial, '{self.trials[0].name}', cannot be split: "
                "give another recording for validation"
            )
        held_out = min(max(round(fraction * count), 1), count - 1)
        order = np.random.default_rng(seed).permutation(count)
        return (
            self.select(sorted(order[held_out:].tolist())),
            self.select(sorted(order[:held_out].tolist())),
        )

    def fact(self, name: str, kind: type[Kind]) -> Kind | None:
        """The fact called `name`, on which all trials that have one agree; None where none has.

        Raises `PalpateError` if trials differ in it, or if it is of another kind.
        """
        found = None
        for trial in self.trials:
            fact = trial.facts.get(name, found)
            if not isinstance(fact, kind | None):
                raise PalpateError(
                    f'the recording\'s "{name}" are {type(fact).__name__}: expected {kind.__name__}'
                )
            if found is not None and fact != found:
                raise PalpateError(
                    f'the trials say different things of "{name}": expected the same of all, '
                    f"but '{trial.name}' differs from those before"
                )
            found = fact
        return found

    def align(
        self,
        period: float,
        observation: Names = None,
        action: Names = None,
        events: Sequence[str] = (),
    ) -> Aligned:
        """Put observations and actions on a uniform grid of `period` seconds.

        `observation` and `action` name one channel or several (default: the only one of that
        role); `action=()` is none. Each trial's grid starts at the latest of their first stamps
        and ends where the first observation or driven state ends.

        An observation is interpolated linearly between its two neighbouring stamps where both
        were seen and lie at most 3 nominal periods apart, and is NaN otherwise. The action at
        frame t is, for a driven channel, its interpolated value at frame t + 1 (where the driven
        thing has to be at the end of the period) and, for a command, the mean over the period of
        the orders in force: what a force adds to the momentum, however fast its clock is. Of
        `events`, the index of the newest is given for each frame.

        Raises `PalpateError` if a channel is missing or ambiguous, differs in role, unit or shape
        between trials, if a driven state has a gap of more than 10 nominal periods, or if a trial
        does not last one period.
        """
        return align(self.trials, period, observation, action, events)


def join(recordings: Sequence[Recording]) -> Recording:
    """All trials of `recordings` in one; of equal names the later ones get a number.

    Provenance that differs is joined as text; facts are those of each trial.
    """
    trials: list[Trial] = []
    taken: set[str] = set()
    provenance: dict[str, str | float | int] = {}
    for recording in recordings:
        for trial in recording.trials:
            name, number = trial.name, 2
            while name in taken:
                name, number = f"{trial.name} ({number})", number + 1
            taken.add(name)
            trials.append(replace(trial, name=name))
        for key, value in recording.provenance.items():
            earlier = provenance.setdefault(key, value)
            if earlier != value:
                provenance[key] = f"{earlier}; {value}"
    return Recording(tuple(trials), provenance)


def resolve_indices(indices: Sequence[int], count: int, what: str) -> list[int]:
    """`indices` counted from the start; refuses what is out of range or named twice."""
    chosen = []
    for index in indices:
        if not -count <= index < count:
            raise PalpateError(
                f"there is no {what} {index}: there are {count}, 0 to {count - 1} or -{count} to -1"
            )
        if index % count in chosen:
            raise PalpateError(f"{what} {index} is named twice in {list(indices)}")
        chosen.append(int(index) % count)
    return chosen


def _plain(key: str, value: object) -> str | float | int:
    """A value of the provenance as plain text or a finite number, which a file can hold."""
    if isinstance(value, str):
        return value
    if isinstance(value, numbers.Integral):
        return int(value)
    if isinstance(value, numbers.Real) and math.isfinite(value):
        return float(value)
    raise PalpateError(f"provenance '{key}' has to be text or a finite number, not {value!r}")
