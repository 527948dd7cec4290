"""What `palpate identify` fits and scores: recordings read, repaired, split and aligned."""

import dataclasses
from pathlib import Path

import numpy as np

from palpate.errors import PalpateError
from palpate.families.options import Identify
from palpate.recordings import Aligned, Recording, join
from palpate.recordings.noise import measurement_noise

SHORTEST = 0.5  # s of recordings that a posterior needs, in all


@dataclasses.dataclass(frozen=True)
class Data:
    """What there is to fit and to score: aligned trials, the observation's unit and channels."""

    fitted: Recording
    validation: Recording | None
    fitted_aligned: Aligned
    validation_aligned: Aligned
    unit: str
    observed: tuple[str, ...]
    problems: tuple[str, ...]  # of the recording that is fitted, in sentences
    noise: float | None  # of what was recorded, a standard deviation in the unit

    @property
    def shown(self) -> list[Recording]:
        """All recordings, the fitted one first."""
        return [self.fitted] if self.validation is None else [self.fitted, self.validation]


def read(options: Identify) -> Data:
    """The recordings, prepared by the family, repaired where they are fitted, and split by trial.

    What is scored is scored as it was recorded: only what is fitted is repaired. Raises
    `PalpateError` for recordings that cannot be used.
    """
    if not options.recordings:
        raise PalpateError("no recording is named: expected at least one file or log")
    raw = _read(options.recordings, options)
    if options.validate:
        fitted, validation = raw, _read(options.validate, options)
    elif len(raw.trials) > 1 and options.held_out:
        fitted, validation = raw.split(options.held_out, options.seed)
    else:
        fitted, validation = raw, None
    fitted = _prepare(options.repair(fitted), options, "")
    observed, action = options.observed, options.action(fitted)
    if not options.fits:
        _check_duration(fitted, options)
    # The control period is that of the sensor, free of the last digits of its clock.
    periods = [trial[observed[0]].nominal_period for trial in fitted.trials]
    period = 1.0 / options.rate if options.rate else float(f"{np.median(periods):.5g}")
    aligned = scored = fitted.align(period, observed, action)
    if validation is not None:
        validation = _prepare(validation, options, "validation, ")
        scored = validation.align(period, observed, action)
    problems = tuple(options.problems(aligned))
    noise = measurement_noise(aligned.observation)
    aligned, scored = options.reduced(aligned, scored)
    unit = _unit(fitted, observed)
    return Data(fitted, validation, aligned, scored, unit, observed, problems, noise)


def _unit(recording: Recording, observed: tuple[str, ...]) -> str:
    """Of one channel as it says, of several that of each of their numbers: "m, m, rad"."""
    channels = [recording.trials[0][name] for name in observed]
    if len(channels) == 1:
        return channels[0].unit
    return ", ".join(c.unit for c in channels for _ in range(c.values[0].size))


def _read(paths: tuple[Path, ...], options: Identify) -> Recording:
    return join([options.read(path) for path in paths])


def _prepare(recording: Recording, options: Identify, where: str) -> Recording:
    """The recording as the family needs it; what was put right before and thereby is printed."""
    prepared = options.prepare(recording)
    for note in dict.fromkeys((*recording.notes, *prepared.notes)):
        print(f"note: {where}{note}")
    return prepared


def _check_duration(recording: Recording, options: Identify) -> None:
    lasting = sum(float(np.ptp(t[options.observed[0]].time)) for t in recording.trials)
    if lasting < SHORTEST:
        raise PalpateError(
            f"{' and '.join(map(str, options.recordings))} last {lasting:.3g} s in all: expected "
            f"at least {SHORTEST:g} s of motion"
        )
