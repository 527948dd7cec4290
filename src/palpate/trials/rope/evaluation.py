"""How often and how fast controllers bring MuJoCo ropes to rest: run, summed up and drawn."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from palpate.errors import PalpateError
from palpate.report.evidence import write_evidence
from palpate.runs import Figure, Run
from palpate.tasks.rope.stabilization import STABILISED, STAY
from palpate.trials.controller import Controller
from palpate.trials.rope.trials import Episodes, StabilizationTrial, settling_times
from palpate.trials.trial import evaluate_trials, first_of_each_group, groups, wilson_interval
from palpate.worlds.rope.rope import START_POSES, RopeConfiguration, sample_configurations

TRIAL_PERIODS = 4.0  # length of a trial, in first periods of the longest rope


def evaluation_trials(base: RopeConfiguration, ropes: int, seed: int) -> list[StabilizationTrial]:
    """Each of `ropes` sampled ropes from each start pose, sorted by pose; all drawn by `seed`."""
    configurations = sample_configurations(base, ropes, seed)
    seeds = np.random.default_rng((seed, 1)).integers(2**31, size=(len(START_POSES), ropes))
    return [
        StabilizationTrial(configuration, start, int(seeds[pose, rope]))
        for pose, start in enumerate(START_POSES)
        for rope, configuration in enumerate(configurations)
    ]


def evaluate(
    controllers: Mapping[str, Controller],
    trials: Sequence[StabilizationTrial],
    run: Run | None = None,
) -> dict[str, Episodes]:
    """`evaluate_trials` for four first periods of the longest rope.

    Raises `PalpateError` when the ropes' control periods or markers differ, or a controller decides
    in another period.
    """
    for name in ("control_period", "markers"):
        found = {getattr(trial.configuration, name) for trial in trials}
        if len(found) > 1:
            raise PalpateError(
                f"trials run side by side with one {name}, not {sorted(found)}: evaluate apart"
            )
    longest = max(trial.period for trial in trials)
    steps = math.ceil(TRIAL_PERIODS * longest / trials[0].control_period)
    return evaluate_trials(controllers, trials, run, steps)


@dataclass(frozen=True)
class Summary:
    """How often and how fast ropes came to rest.

    `time` (s) and `periods` (of each rope) are means over the successes, None without one;
    `periods_with_failures` counts a failure with the length of its trial. `interval`: of the
    success rate, 95 %. `margin` and `time_margin`: 95 % half-widths of `periods` and `time`.
    `at_rest_at_once`: successes whose gripper is at rest when the first second of low energy has
    passed. `final_speed`: of the gripper over the last second of all trials, mean, m/s; None if no
    simulation got there. `relapsed`: successes whose energy rose above 1 % again, or whose
    simulation ended, before the trial did. `diverged`: trials whose simulation ended early; they
    are failures unless the rope had come to rest before.
    """

    trials: int
    successes: int
    interval: tuple[float, float]
    time: float | None
    time_margin: float | None
    periods: float | None
    margin: float | None
    periods_with_failures: float
    at_rest_at_once: int
    final_speed: float | None
    relapsed: int
    diverged: int

    @property
    def success_rate(self) -> float:
        """Share of the trials."""
        return self.successes / self.trials

    def line(self, name: str) -> str:
        """One row of a table."""
        periods = "never" if self.periods is None else f"{self.periods:.3f} periods"
        time = "" if self.time is None else f" ({self.time:.2f} s)"
        low, high = self.interval
        speed = "" if self.final_speed is None else f", {self.final_speed:.3f} m/s in the end"
        return (
            f"{name:28s} {self.successes:4d} of {self.trials} at rest, 95 % interval "
            f"{low:.3f} to {high:.3f}; 1 % energy after {periods}{time}; failures counted as whole "
            f"trials: {self.periods_with_failures:.3f}; gripper at rest at once in "
            f"{self.at_rest_at_once}{speed}"
            + (f"; {self.relapsed} rose above 1 % again" if self.relapsed else "")
        )


def summarise(trials: Sequence[StabilizationTrial], episodes: Episodes) -> Summary:
    """Success rate and times of these trials."""
    time = settling_times(trials, episodes)
    period = np.array([trial.period for trial in trials])
    settled = np.isfinite(time)
    step = trials[0].control_period
    length = (episodes.energy.shape[1] - 1) * step
    successes = int(settled.sum())

    def mean(values: np.ndarray) -> tuple[float | None, float | None]:
        if not successes:
            return None, None
        deviation = values.std(ddof=1) if successes > 1 else math.nan
        margin = 1.96 * deviation / math.sqrt(successes)
        return float(values.mean()), float(margin) if math.isfinite(margin) else None

    final_speed = episodes.gripper_speed[:, -round(STAY / step) :]
    seconds, periods = mean(time[settled]), mean((time / period)[settled])
    return Summary(
        trials=len(trials),
        successes=successes,
        interval=wilson_interval(successes, len(trials)),
        time=seconds[0],
        time_margin=seconds[1],
        periods=periods[0],
        margin=periods[1],
        periods_with_failures=float((np.where(settled, time, length) / period).mean()),
        at_rest_at_once=int(np.isfinite(settling_times(trials, episodes, first=True)).sum()),
        final_speed=None if np.isnan(final_speed).all() else float(np.nanmean(final_speed)),
        relapsed=int((settled & (_last_above(trials, episodes) > time)).sum()),
        diverged=len(episodes.failures),
    )


def _last_above(trials: Sequence[StabilizationTrial], episodes: Episodes) -> np.ndarray:
    """The last instant (trials,) in s at which the energy is not below 1 % of the start's."""
    above = ~(episodes.energy < STABILISED * episodes.energy[:, :1])
    last = above.shape[1] - 1 - above[:, ::-1].argmax(1)
    return last * trials[0].control_period


def by_pose(trials: Sequence[StabilizationTrial], episodes: Episodes) -> dict[str, Summary]:
    """A summary for each start pose."""
    return {
        start: summarise([trials[index] for index in chosen], part_of(episodes, chosen))
        for start, chosen in groups(trials).items()
    }


def part_of(episodes: Episodes, chosen: Sequence[int]) -> Episodes:
    """Of some of the trials, in this order; without markers."""
    failures = {
        place: episodes.failures[trial]
        for place, trial in enumerate(chosen)
        if trial in episodes.failures
    }
    chosen = list(chosen)
    return Episodes(
        episodes.energy[chosen], episodes.gripper_speed[chosen], episodes.markers[:0], failures
    )


def table(trials: Sequence[StabilizationTrial], evaluated: Mapping[str, Episodes]) -> list[str]:
    """Lines for a person: every controller, over all trials and from each start pose."""
    lines = []
    for name, episodes in evaluated.items():
        lines.append(summarise(trials, episodes).line(name))
        lines += [part.line(f"  {start}") for start, part in by_pose(trials, episodes).items()]
        lines += [f"  trial {trial}: {why}" for trial, why in sorted(episodes.failures.items())]
    return lines


def figures(
    summary: Summary, suffix: str = "", bars: tuple[float | None, float | None] = (None, None)
) -> list[Figure]:
    """`success_rate`, `time_to_1pct_periods` and `time_to_1pct_s`, their names ending in `suffix`.

    `bars` are those of the first two.
    """
    success_bar, periods_bar = bars
    low, high = summary.interval
    return [
        Figure(
            f"success_rate{suffix}",
            summary.success_rate,
            "",
            bar=success_bar,
            better="higher",
            spread=max(summary.success_rate - low, high - summary.success_rate),
        ),
        Figure(
            f"time_to_1pct_periods{suffix}",
            summary.periods,
            "periods",
            bar=periods_bar,
            spread=summary.margin,
        ),
        Figure(f"time_to_1pct_s{suffix}", summary.time, "s", spread=summary.time_margin),
    ]


def write_trial_evidence(
    run: Run,
    trials: Sequence[StabilizationTrial],
    evaluated: Mapping[str, Episodes],
    shown: Sequence[str],
) -> None:
    """Leave for the report the energy of all trials and, of one for each pose, how the rope moved.

    `shown`: the controllers whose motion is drawn.
    """
    some = next(iter(evaluated.values()))
    time = np.arange(some.energy.shape[1]) * trials[0].control_period
    arrays = {"energy.time": time}
    for name, episodes in evaluated.items():
        arrays[f"energy.{name}"] = episodes.energy / episodes.energy[:, :1]
    for place, trial in enumerate(first_of_each_group(trials)):
        if trial in some.failures and np.isnan(some.markers[place]).all():
            continue  # it diverged while it was shaken: there is nothing to draw
        group = f"motion/{trials[trial].start}"
        arrays[f"{group}.time"] = time
        for name in shown:
            arrays[f"{group}.{name}"] = evaluated[name].markers[place]
    write_evidence(run.path, arrays)
