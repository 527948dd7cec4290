"""Ropes, paths and controllers in MuJoCo: how far the tip is from where it should be."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from palpate.networks import Controller
from palpate.report.evidence import write_evidence
from palpate.report.picture import canvas_of, legend_of, save_picture
from palpate.report.style import STYLES, style_indices
from palpate.runs import Figure, Run
from palpate.tasks.rope import RopeTracking
from palpate.tasks.rope.paths import CURVES, DesiredPath, named_path, read_path
from palpate.tasks.rope.tracking import PREVIEW, grip_of_chain
from palpate.trials.controller import HeldStill, OpenLoop
from palpate.trials.rope.trials import RopeTrial
from palpate.trials.trial import Record, first_of_each_group
from palpate.worlds.rope.rope import (
    GRIPPER_START,
    RopeConfiguration,
    RopeObservation,
    RopeTruth,
    sample_configurations,
)

# World constants, written down before the first evaluation.
SIZES, DURATIONS = (0.4, 0.8), (4.0, 6.0)  # m and s; about 1 to 2 m of path, as in the seed's code
TILTS = (0.0, math.pi / 6)  # rad, of a path's plane from the horizontal
DRAWN = {"size": SIZES, "duration": DURATIONS, "tilt": TILTS, "azimuth": (0.0, 2 * math.pi)}


@dataclass(frozen=True)
class Followed(Record):
    """What the tips of ropes did in trials on paths; see `Record`.

    `tips` (trials, times, 3) and, of the first trial on each path, `markers` (paths, times,
    markers, 3), in m as seen with the camera's noise.
    """

    observed: ClassVar[str] = "markers"
    tips: np.ndarray
    markers: np.ndarray
    failures: dict[int, str]

    def errors(self, trials: Sequence["PathTrial"]) -> np.ndarray:
        """Distance of each tip from where it should be, (trials, times) in m; NaN as above."""
        desired = np.full(self.tips.shape, np.nan)
        for index, trial in enumerate(trials):
            path = trial.path[1 : min(trial.steps + 1, self.tips.shape[1])]
            desired[index, 1 : len(path) + 1] = path
        return np.linalg.norm(self.tips - desired, axis=-1)


@dataclass(frozen=True, eq=False)
class PathTrial(RopeTrial[Followed]):
    """One rope and one path: `path` (samples, 3) in m, world frame, from the hanging tip on.

    `steps` are the control periods that count. The path goes on beyond them.
    """

    side_by_side: ClassVar[int] = 15
    name: str
    path: np.ndarray
    steps: int

    @property
    def group(self) -> str:
        """See `Trial`: the path."""
        return self.name

    def measure(self, observation: RopeObservation, truth: RopeTruth) -> Mapping[str, Any]:
        return RopeTracking.measure(observation, truth)

    @classmethod
    def goals(cls, trials: Sequence["PathTrial"]) -> DesiredPath:
        """See `Trial`: the paths, whose ends are held for as long as any lasts."""
        longest = max(len(trial.path) for trial in trials)
        paths = [
            np.pad(trial.path, ((0, longest - len(trial.path)), (0, 0)), mode="edge")
            for trial in trials
        ]
        return DesiredPath(np.stack(paths), trials[0].control_period)

    @classmethod
    def record(cls, trials: Sequence["PathTrial"], steps: int, drawn: int) -> Followed:
        tips = np.full((len(trials), steps + 1, 3), np.nan, np.float32)
        markers = drawn, steps + 1, trials[0].configuration.markers, 3
        return Followed(tips, np.full(markers, np.nan, np.float32), {})

    @classmethod
    def figures(
        cls, trials: Sequence["PathTrial"], record: Followed, suffix: str = ""
    ) -> list[Figure]:
        return summarise(trials, record).figures(suffix)

    @classmethod
    def line(cls, name: str, trials: Sequence["PathTrial"], record: Followed) -> str:
        return summarise(trials, record).line(name)


class PathOpenLoop(OpenLoop):
    """The gripper moves as the path does, or as suits a limp chain; it looks at nothing.

    Moving as the path does, a rope's length above it, is right for a path that takes forever; how a
    chain of that `length` (m) without damping is led says `grip_of_chain`.
    """

    def __init__(self, period: float, length: float | None = None):
        self._length, self.period = length, period

    def start(
        self, command: np.ndarray, observation: RopeObservation, goal: DesiredPath
    ) -> tuple[np.ndarray, int]:
        gripper = np.asarray(goal.position)
        if self._length is not None:
            away = jnp.asarray(gripper - gripper[:, :1], jnp.float32)
            gripper = np.asarray(grip_of_chain(away, self._length, 9.81, goal.period))
        return np.diff(gripper, axis=1) / goal.period, 0


def blind_controllers(base: RopeConfiguration) -> dict[str, Controller]:
    """What needs no eyes, by name: nothing at all, and two ways of laying a motion down."""
    period = base.control_period
    return {
        "held still": HeldStill(),
        "as the path": PathOpenLoop(period),
        "as a chain": PathOpenLoop(period, base.length),
    }


def path_trials(
    base: RopeConfiguration, ropes: int, seed: int, names: Sequence[str] = tuple(CURVES)
) -> list[PathTrial]:
    """Each of `ropes` sampled ropes on each path, sorted by path; all drawn by `seed`.

    A name that ends in .csv is a file's, followed as it stands there. Named paths have random
    size, duration, tilt and direction, drawn anew for each trial.
    """
    configurations = sample_configurations(base, ropes, seed)
    period, beyond = base.control_period, PREVIEW[-1]
    random = np.random.default_rng((seed, 1))
    trials = []
    for name in names:
        for configuration in configurations:
            drawn = {what: random.uniform(*between) for what, between in DRAWN.items()}
            if name.endswith(".csv"):
                path = read_path(name, period, beyond)
            else:
                path = named_path(name, period=period, beyond=beyond, **drawn)
            hanging = np.array(GRIPPER_START) - [0, 0, configuration.length]
            steps = len(path) - 1 - round(beyond / period)
            own = int(random.integers(2**31))
            trials.append(
                PathTrial(configuration, "hanging", own, Path(name).stem, hanging + path, steps)
            )
    return trials


@dataclass(frozen=True)
class Summary:
    """Tip errors in cm over the trials of one controller; None where a simulation diverged.

    `mean` and `rms` are over all instants of a trial and then over the trials; `worst` is over all.
    `margin`: 95 % half-width of `mean`.
    """

    mean: float | None
    rms: float | None
    worst: float | None
    margin: float | None
    trials: int
    diverged: int

    def line(self, name: str) -> str:
        """One row of a table."""
        if self.mean is None:
            return f"{name:28s} {self.diverged} of {self.trials} simulations diverged"
        return (
            f"{name:28s} tip error: mean {self.mean:6.2f} cm, rms {self.rms:6.2f} cm, "
            f"worst {self.worst:6.2f} cm; {self.trials} trials"
        )

    def figures(self, suffix: str = "", bar: float | None = None) -> list[Figure]:
        """`mean_tip_error_cm`, `rms_tip_error_cm` and `worst_tip_error_cm`, ending in `suffix`.

        `bar` is that of the first.
        """
        return [
            Figure(f"mean_tip_error_cm{suffix}", self.mean, "cm", bar=bar, spread=self.margin),
            Figure(f"rms_tip_error_cm{suffix}", self.rms, "cm"),
            Figure(f"worst_tip_error_cm{suffix}", self.worst, "cm"),
        ]


def summarise(trials: Sequence[PathTrial], followed: Followed) -> Summary:
    """Tip errors of these trials."""
    if diverged := len(followed.failures):  # a mean would leave out what is no longer there
        return Summary(None, None, None, None, len(trials), diverged)
    error = 100 * followed.errors(trials)
    mean = np.nanmean(error, axis=1)
    margin = 1.96 * mean.std(ddof=1) / math.sqrt(len(mean)) if len(mean) > 1 else None
    return Summary(
        mean=float(mean.mean()),
        rms=float(np.sqrt(np.nanmean(error**2, axis=1)).mean()),
        worst=float(np.nanmax(error)),
        margin=None if margin is None else float(margin),
        trials=len(trials),
        diverged=0,
    )


def write_path_evidence(
    run: Run, trials: Sequence[PathTrial], followed: Mapping[str, Followed]
) -> None:
    """Leave for the report how the rope of the first follower moved on each path, and a picture.

    The picture, `tracking.png`, has the tips of all followers on it.
    """
    period, arrays, shown = trials[0].control_period, {}, next(iter(followed))
    for place, index in enumerate(first_of_each_group(trials)):
        trial, group = trials[index], f"motion/{trials[index].name}"
        arrays[f"{group}.time"] = np.arange(trial.steps + 1) * period
        arrays[f"{group}.{shown}"] = followed[shown].markers[place, : trial.steps + 1]
        arrays[f"{group}.desired tip"] = trial.path[: trial.steps + 1, None]
    write_evidence(run.path, arrays)
    draw(run.path / "tracking.png", trials, followed)


def draw(file: Path, trials: Sequence[PathTrial], followed: Mapping[str, Followed]) -> None:
    """A PNG of the first trial on each path.

    Where the tip should have been and was, from above; and how far from there it was over time.
    """
    drawn = first_of_each_group(trials)
    canvas = canvas_of(4 * len(drawn), 7.5)
    axes = canvas.subplots(2, len(drawn), squeeze=False)
    for index, above, below in zip(drawn, *axes, strict=True):
        trial = trials[index]
        path = trial.path[: trial.steps + 1]
        above.plot(path[:, 0], path[:, 1], color="black", linewidth=4, alpha=0.25, label="desired")
        time = np.arange(trial.steps + 1) * trial.control_period
        looks = {name: STYLES[index] for name, index in style_indices(followed).items()}
        for name, whole in followed.items():
            style = looks[name]
            look = {"color": style.light, "linestyle": (0, style.dash), "linewidth": 1}
            tips = whole.tips[index, : trial.steps + 1]
            above.plot(tips[:, 0], tips[:, 1], label=name, **look)
            below.semilogy(time, 100 * np.linalg.norm(tips - path, axis=1), **look)
        above.set(title=trial.name, xlabel="x (m)", ylabel="y (m)", aspect="equal")
        below.set(xlabel="time (s)", ylabel="distance of the tip from the path (cm)")
    legend_of(canvas, "lower center", fontsize=8)
    save_picture(file, canvas)
