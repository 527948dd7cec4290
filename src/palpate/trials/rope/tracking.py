"""Ropes, paths and controllers in MuJoCo: how far the tip is from where it should be."""

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from palpate.report.evidence import write_evidence
from palpate.report.style import STYLES
from palpate.runs import Figure, Run
from palpate.runs.progress import interruptible, progress
from palpate.runs.storage import write_bytes
from palpate.tasks.rope.paths import CURVES, named_path, read_path
from palpate.tasks.rope.tracking import PREVIEW
from palpate.trials.rope.trials import Controller, Trial, run_trials
from palpate.worlds.rope.rope import GRIPPER_START, RopeConfiguration, sample_configurations

# World constants, written down before the first evaluation.
SIZES, DURATIONS = (0.4, 0.8), (4.0, 6.0)  # m and s; about 1 to 2 m of path, as in the seed's code
TILTS = (0.0, math.pi / 6)  # rad, of a path's plane from the horizontal
DRAWN = SIZES, DURATIONS, TILTS
SIDE_BY_SIDE = 15  # trials; a run that was cut off repeats at most these

Follower = Callable[[np.ndarray], Controller]  # of paths (worlds, samples, 3): see `rope_followers`


@dataclass(frozen=True, eq=False)
class PathTrial:
    """One rope and one path: `path` (samples, 3) in m, world frame, from the hanging tip on.

    `steps` are the control periods that count. The path goes on beyond them.
    """

    trial: Trial
    name: str
    path: np.ndarray
    steps: int


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
            size, duration, tilt = (random.uniform(*between) for between in DRAWN)
            azimuth = random.uniform(0.0, 2 * math.pi)
            if name.endswith(".csv"):
                path = read_path(name, period, beyond)
            else:
                path = named_path(
                    name,
                    size=size,
                    duration=duration,
                    period=period,
                    azimuth=azimuth,
                    tilt=tilt,
                    beyond=beyond,
                )
            hanging = np.array(GRIPPER_START) - [0, 0, configuration.length]
            steps = len(path) - 1 - round(beyond / period)
            trial = Trial(configuration, "hanging", int(random.integers(2**31)))
            trials.append(PathTrial(trial, Path(name).stem, hanging + path, steps))
    return trials


@dataclass(frozen=True)
class Followed:
    """What the ropes of some trials did, sampled once per control period from the start on.

    `tips` (trials, times, 3) and, of the first trial on each path, `markers` (paths, times,
    markers, 3), in m as seen with the camera's noise; NaN after a trial's end and once its
    simulation has diverged. `failures` say why one did.
    """

    tips: np.ndarray
    markers: np.ndarray
    failures: dict[int, str]

    def errors(self, trials: Sequence[PathTrial]) -> np.ndarray:
        """Distance of each tip from where it should be, (trials, times) in m; NaN as above."""
        desired = np.full(self.tips.shape, np.nan)
        for index, trial in enumerate(trials):
            desired[index, 1 : trial.steps + 1] = trial.path[1 : trial.steps + 1]
        return np.linalg.norm(self.tips - desired, axis=-1)


def first_on_each_path(trials: Sequence[PathTrial]) -> list[int]:
    """The trials that are drawn."""
    names = [trial.name for trial in trials]
    return [names.index(name) for name in dict.fromkeys(names)]


def follow(
    followers: Mapping[str, Follower], trials: Sequence[PathTrial], run: Run | None = None
) -> dict[str, Followed]:
    """What each follower's ropes do in all trials.

    With a `run`, finished trials are saved and logged there, and one that was cut off goes on. The
    caller opens the run and finishes it.
    """
    times = max(trial.steps for trial in trials) + 1
    drawn = first_on_each_path(trials)
    tips = np.full((len(trials), times, 3), np.nan, np.float32)
    shape = len(drawn), times, trials[0].trial.configuration.markers, 3
    markers = np.full(shape, np.nan, np.float32)
    done = {name: Followed(tips.copy(), markers.copy(), {}) for name in followers}
    work = [
        (name, np.arange(first, min(first + SIDE_BY_SIDE, len(trials))))
        for name in followers
        for first in range(0, len(trials), SIDE_BY_SIDE)
    ]
    step = _restore(run, done)
    bar = progress(work[step:], "following", done=step)
    with interruptible() as stop:
        for name, chosen in bar:
            some, whole = [trials[index] for index in chosen], done[name]
            lasts = max(trial.steps for trial in some)
            ropes = [trial.trial for trial in some]
            follower = followers[name](_side_by_side(some))
            episodes = run_trials(ropes, follower, lasts, range(len(some)))
            for place, index in enumerate(chosen.tolist()):
                seen = episodes.markers[place, : trials[index].steps + 1]
                whole.tips[index, : len(seen)] = seen[:, -1]
                if index in drawn:
                    whole.markers[drawn.index(index), : len(seen)] = seen
            failures = {int(chosen[place]): why for place, why in episodes.failures.items()}
            whole.failures.update(failures)
            step += 1
            error = 100 * float(np.nanmean(whole.errors(trials)[chosen]))
            bar.show(error_cm=error)
            if run is not None:
                reasons = {str(trial): why for trial, why in failures.items()}
                run.log(step, controller=name, mean_tip_error_cm=error, failures=reasons)
                run.save(step, _arrays(done))
            if stop:
                break
    return done


def _side_by_side(trials: Sequence[PathTrial]) -> np.ndarray:
    """The paths of several trials, (trials, samples, 3); ends are held for as long as any lasts."""
    longest = max(len(trial.path) for trial in trials)
    return np.stack(
        [
            np.pad(trial.path, ((0, longest - len(trial.path)), (0, 0)), mode="edge")
            for trial in trials
        ]
    )


def _restore(run: Run | None, done: dict[str, Followed]) -> int:
    """Fill in what an earlier process did; the number of chunks of trials that it was."""
    restored = None if run is None else run.restore(_arrays(done))
    if run is None or restored is None:
        return 0
    step, arrays = restored
    for name, (tips, markers) in arrays.items():
        done[name].tips[:], done[name].markers[:] = tips, markers
    for line in run.metrics():
        failures = {int(trial): reason for trial, reason in line["failures"].items()}
        done[line["controller"]].failures.update(failures)
    return step


def _arrays(done: Mapping[str, Followed]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    return {name: (whole.tips, whole.markers) for name, whole in done.items()}


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


def summarise(
    trials: Sequence[PathTrial], followed: Followed, chosen: Sequence[int] | None = None
) -> Summary:
    """Of all trials, or of those `chosen`."""
    chosen = range(len(trials)) if chosen is None else chosen
    diverged = sum(index in followed.failures for index in chosen)
    if diverged:  # errors of what is no longer there would be left out of a mean
        return Summary(None, None, None, None, len(chosen), diverged)
    error = 100 * followed.errors(trials)[list(chosen)]
    mean = np.nanmean(error, axis=1)
    margin = 1.96 * mean.std(ddof=1) / math.sqrt(len(mean)) if len(mean) > 1 else None
    return Summary(
        mean=float(mean.mean()),
        rms=float(np.sqrt(np.nanmean(error**2, axis=1)).mean()),
        worst=float(np.nanmax(error)),
        margin=None if margin is None else float(margin),
        trials=len(chosen),
        diverged=0,
    )


def by_path(trials: Sequence[PathTrial]) -> dict[str, list[int]]:
    """The trials on each path."""
    names = dict.fromkeys(trial.name for trial in trials)
    return {name: [i for i, trial in enumerate(trials) if trial.name == name] for name in names}


def table(trials: Sequence[PathTrial], followed: Mapping[str, Followed]) -> list[str]:
    """Lines for a person: every controller, over all trials and on each path."""
    lines = []
    for name, whole in followed.items():
        lines.append(summarise(trials, whole).line(name))
        for path, chosen in by_path(trials).items():
            lines.append(summarise(trials, whole, chosen).line(f"  {path}"))
        lines += [f"  trial {trial}: {why}" for trial, why in sorted(whole.failures.items())]
    return lines


def figures(summary: Summary, suffix: str = "", bar: float | None = None) -> list[Figure]:
    """`mean_tip_error_cm`, `rms_tip_error_cm` and `worst_tip_error_cm`, ending in `suffix`.

    `bar` is that of the first.
    """
    spread = summary.margin
    return [
        Figure(f"mean_tip_error_cm{suffix}", summary.mean, "cm", bar=bar, spread=spread),
        Figure(f"rms_tip_error_cm{suffix}", summary.rms, "cm"),
        Figure(f"worst_tip_error_cm{suffix}", summary.worst, "cm"),
    ]


def write_path_evidence(
    run: Run, trials: Sequence[PathTrial], followed: Mapping[str, Followed], shown: str
) -> None:
    """Leave for the report how the rope of the follower `shown` moved on each path, and a picture.

    The picture, `tracking.png`, has the tips of all followers on it.
    """
    period, arrays = trials[0].trial.configuration.control_period, {}
    for place, index in enumerate(first_on_each_path(trials)):
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
    from matplotlib.figure import Figure as Canvas

    drawn = first_on_each_path(trials)
    canvas = Canvas(figsize=(4 * len(drawn), 7.5), layout="constrained")
    axes = canvas.subplots(2, len(drawn), squeeze=False)
    for index, above, below in zip(drawn, *axes, strict=True):
        trial = trials[index]
        path = trial.path[: trial.steps + 1]
        above.plot(path[:, 0], path[:, 1], color="black", linewidth=4, alpha=0.25, label="desired")
        time = np.arange(trial.steps + 1) * trial.trial.configuration.control_period
        for style, (name, whole) in zip(STYLES, followed.items(), strict=False):
            look = {"color": style.light, "linestyle": (0, style.dash), "linewidth": 1}
            tips = whole.tips[index, : trial.steps + 1]
            above.plot(tips[:, 0], tips[:, 1], label=name, **look)
            below.semilogy(time, 100 * np.linalg.norm(tips - path, axis=1), **look)
        above.set(title=trial.name, xlabel="x (m)", ylabel="y (m)", aspect="equal")
        below.set(xlabel="time (s)", ylabel="distance of the tip from the path (cm)")
    canvas.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=7,
                  fontsize=8, frameon=False)  # fmt: skip
    buffer = io.BytesIO()
    canvas.savefig(buffer, format="png", dpi=150)
    write_bytes(file, buffer.getvalue())
