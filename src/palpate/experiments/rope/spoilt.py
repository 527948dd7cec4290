"""Recordings of ropes, and the same with a mistake: which of them does `palpate identify` flag?"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands.identification.data import read
from palpate.errors import PalpateError
from palpate.experiments.experiment import Experiment, share_of
from palpate.experiments.rope.numpy_rope import draw_rope, record_rope
from palpate.families.rope.options import IdentifyRope
from palpate.recordings import Channel, Recording, Role, Trial
from palpate.recordings.files import write_recording
from palpate.runs import Figure
from palpate.runs.progress import progress

FIRST = 340_000  # seed of the first rope
MARKERS, RATES = (5, 60), (20.0, 240.0)  # that ropes are drawn with
TRIALS, LASTING = 3, 5.0  # of each recording, and s of each

Motion = np.ndarray  # (frames, markers, 3) m


@dataclasses.dataclass(frozen=True)
class Spoilt:
    """A mistake: what it makes of a trial's times and markers, and of the mass in kg."""

    cause: str  # how the sentence about it begins
    times: Callable[[np.ndarray], np.ndarray] = lambda times: times
    markers: Callable[[Motion, np.random.Generator], Motion] = lambda markers, _: markers
    mass: float = 1.0  # factor


def _jump(markers: Motion, random: np.random.Generator) -> Motion:
    """Two motions in one trial: the second is moved, and runs backwards."""
    cut = int(random.uniform(0.3, 0.7) * len(markers))
    after = markers[cut:][::-1] + np.array([0.6, 0.2, 0.0])
    return np.concatenate([markers[:cut], after])


KINDS = {
    "rate doubled": Spoilt("rate", times=lambda times: times / 2),
    "rate halved": Spoilt("rate", times=lambda times: times * 2),
    "axes": Spoilt("up axis", markers=lambda markers, _: markers[..., [0, 2, 1]]),
    "order": Spoilt(
        "order of the markers",
        markers=lambda m, _: m[:, np.random.default_rng(m.shape[1]).permutation(m.shape[1])],
    ),
    "unit": Spoilt("unit of length", markers=lambda markers, _: 1e3 * markers),
    "mass": Spoilt("unit of mass", mass=1e3),
    "discontinuity": Spoilt("discontinuity", markers=_jump),
}
WRONG_FILE = "wrong file"


@dataclasses.dataclass(frozen=True)
class Flagged:
    """Of `count` good recordings and as many spoilt ones: what was flagged falsely, and missed."""

    count: int
    false: list[str]
    missed: list[str]

    def figures(self) -> list[Figure]:
        """`flagged_rate` of the spoilt ones, by the right cause; `false_flags` of the good ones."""
        return [
            share_of("flagged_rate", self.count - len(self.missed), self.count, bar=1.0),
            Figure("false_flags", len(self.false), f"of {self.count}", 0),
        ]


def check_recordings(experiment: Experiment, count: int) -> Flagged:
    """Record `count` ropes; let `palpate identify` read each as it is, and spoilt."""
    first = experiment.uses(FIRST, count)
    found = experiment.found(
        "checked", {"ropes": count}, lambda: _check(experiment.out / "checked", first, count)
    )
    return Flagged(count, found["false"], found["missed"])


def _check(folder: Path, first: int, count: int) -> dict[str, Any]:
    false, missed, names = [], [], [*KINDS, WRONG_FILE]
    for index in progress(range(count), "recordings"):
        seed, name = first + index, names[index % len(names)]
        random = np.random.default_rng((seed, 2))
        markers = int(random.integers(MARKERS[0], MARKERS[1] + 1))
        rope = draw_rope(seed, markers, float(np.exp(random.uniform(*np.log(RATES)))))
        recording = record_rope(rope, seed, TRIALS, LASTING)
        kind = KINDS.get(name, Spoilt("no channel"))
        bad = furniture() if name == WRONG_FILE else spoil(recording, kind, random)
        good_file, bad_file = folder / f"{seed}.npz", folder / f"{seed}-spoilt.npz"
        write_recording(good_file, recording)
        write_recording(bad_file, bad)
        if said := problems(good_file, rope.mass):
            false.append(f"{seed}: {said[0]}")
        said = problems(bad_file, kind.mass * rope.mass)
        if not (said and kind.cause in said[0]):
            missed.append(f"{seed}, {name}: {said[0] if said else 'nothing was said'}")
    return {"false": false, "missed": missed}


def problems(file: Path, mass: float) -> list[str]:
    """What the command says of a recording before it fits; of a file that it refuses, why."""
    try:
        return list(read(IdentifyRope(recordings=(file,), mass=mass, uniform=True)).problems)
    except PalpateError as error:
        return [str(error)]


def spoil(recording: Recording, kind: Spoilt, random: Any) -> Recording:
    """The recording with the mistake in each trial."""
    trials = []
    for trial in recording.trials:
        seen = trial["markers"]
        values = kind.markers(seen.values, random)
        channel = dataclasses.replace(seen, time=kind.times(seen.time), values=values)
        trials.append(dataclasses.replace(trial, channels={"markers": channel}))
    return dataclasses.replace(recording, trials=tuple(trials))


def furniture() -> Recording:
    """Something else that was pushed: where it was, and how hard it was pushed."""
    times = np.arange(100) / 50
    pose = Channel("pose", Role.OBSERVATION, times, np.zeros((100, 3)), "m")
    wrench = Channel("wrench", Role.COMMAND, times, np.zeros((100, 3)), "N")
    return Recording((Trial("push", {"pose": pose, "wrench": wrench}),), {})
