"""What `palpate identify` fits and scores: recordings read, repaired, split and aligned."""

import dataclasses
from pathlib import Path

import numpy as np

from palpate.errors import PalpateError
from palpate.families.options import Identify
from palpate.recordings import Aligned, Recording, join
from palpate.recordings.files import read_recording
from palpate.recordings.markers import repair_markers

HELD_OUT = 0.25  # of the trials, where no recording for validation is given


@dataclasses.dataclass(frozen=True)
class Data:
    """What there is to fit and to score: aligned trials, and the observation's unit."""

    fitted: Recording
    validation: Recording | None
    fitted_aligned: Aligned
    validation_aligned: Aligned
    unit: str


def read(options: Identify) -> Data:
    """The recordings, prepared by the family, repaired where they are fitted, and split by trial.

    What is scored is scored as it was recorded: only what is fitted is repaired.
    """
    if not options.recordings:
        raise PalpateError("no recording is named: expected at least one file or log")
    raw = _read(options.recordings, options)
    if options.validate:
        fitted, validation = raw, _read(options.validate, options)
    elif len(raw.trials) > 1:
        fitted, validation = raw.split(HELD_OUT, options.seed)
    else:
        fitted, validation = raw, None
    observation = options.observation
    if fitted.trials[0][observation].values.ndim == 3:
        fitted = repair_markers(fitted, observation)
    fitted = _prepared(fitted, options, "")
    action = options.action(fitted)
    period = _period(fitted, observation, options.rate)
    aligned = fitted.align(period, observation, action)
    if validation is None:
        scored = aligned
    else:
        validation = _prepared(validation, options, "validation, ")
        scored = validation.align(period, observation, action)
    unit = fitted.trials[0][observation].unit
    return Data(fitted, validation, aligned, scored, unit)


def _read(paths: tuple[Path, ...], options: Identify) -> Recording:
    return join(
        [
            read_recording(
                path,
                rate=options.rate,
                unit=options.unit,
                up=options.up,
                topics=options.topics or (),
            )
            for path in paths
        ]
    )


def _prepared(recording: Recording, options: Identify, where: str) -> Recording:
    """The recording as the family needs it; what was put right before and thereby is printed."""
    prepared = options.prepare(recording)
    for note in dict.fromkeys((*recording.notes, *prepared.notes)):
        print(f"note: {where}{note}")
    return prepared


def _period(recording: Recording, observation: str, rate: float | None) -> float:
    """The control period: that of the sensor, free of the last digits of its clock."""
    if rate is not None:
        return 1.0 / rate
    periods = [trial[observation].nominal_period for trial in recording.trials]
    return float(f"{np.median(periods):.5g}")
