"""Trials in which MuJoCo ropes are to come to rest: when one has, how often and how fast."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from palpate.errors import PalpateError
from palpate.report.evidence import write_evidence
from palpate.runs import Figure, Run
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.filtered_drive import FilteredDrive
from palpate.safety.passivity import PassivityFilter
from palpate.tasks.rope.stabilization import STABILISED, STAY, RopeStabilization
from palpate.trials.rope.trials import RopeTrial
from palpate.trials.trial import Record, first_of_each_group, wilson_interval
from palpate.worlds.rope.rope import (
    GRIPPER_MASS,
    START_POSES,
    RopeConfiguration,
    RopeObservation,
    RopeTruth,
    RopeWorld,
    sample_configurations,
)
from palpate.worlds.world import Drive

TRIAL_PERIODS = 4.0  # length of a trial, in first periods of the longest rope
# Here and not in the task: what a policy is judged by must not follow what it is trained for. That
# is why the task's `outcome`, which has a milder rule of its own (the gripper's mean speed, a least
# start energy), and `settling_time` are two.
GRIPPER_AT_REST = 0.02  # m/s, the gripper's true speed when the second of low energy has passed


@dataclass(frozen=True)
class Episodes(Record):
    """What happened in trials of stabilization; see `Record`.

    `energy` (trials, times) in J is the true one and `gripper_speed` (trials, times) in m/s.
    `markers` (drawn trials, times, markers, 3) in m, as seen.
    """

    observed: ClassVar[str] = "markers"
    energy: np.ndarray
    gripper_speed: np.ndarray
    markers: np.ndarray
    failures: dict[int, str]

    def after(self, step: int) -> "Episodes":
        """The same trials from a control period on, whose energy then counts as the start's."""
        energy, speed = self.energy[:, step:], self.gripper_speed[:, step:]
        return dataclasses.replace(self, energy=energy, gripper_speed=speed)


@dataclass(frozen=True)
class StabilizationTrial(RopeTrial[Episodes]):
    """One rope that is to come to rest."""

    steps: int | None = None
    drive: Callable[[RopeConfiguration], Drive] | None = None  # makes what is before the servo

    def world(self) -> RopeWorld:
        """See `RopeTrial.world`."""
        if self.drive is None:
            return super().world()
        return RopeWorld(self.configuration, self.drive(self.configuration))

    def measure(self, observation: RopeObservation, truth: RopeTruth) -> Mapping[str, Any]:
        return RopeStabilization.measure(observation, truth)

    @classmethod
    def record(cls, trials: Sequence["StabilizationTrial"], steps: int, drawn: int) -> Episodes:
        energy, speed = np.full((2, len(trials), steps + 1), np.nan, np.float32)
        markers = drawn, steps + 1, trials[0].configuration.markers, 3
        return Episodes(energy, speed, np.full(markers, np.nan, np.float32), {})

    @classmethod
    def figures(
        cls, trials: Sequence["StabilizationTrial"], record: Episodes, suffix: str = ""
    ) -> list[Figure]:
        return summarise(trials, record).figures(suffix)

    @classmethod
    def line(cls, name: str, trials: Sequence["StabilizationTrial"], record: Episodes) -> str:
        return summarise(trials, record).line(name)


def evaluation_trials(base: RopeConfiguration, ropes: int, seed: int) -> list[StabilizationTrial]:
    """Each of `ropes` sampled ropes from each start pose, sorted by pose; all drawn by `seed`."""
    configurations = sample_configurations(base, ropes, seed)
    seeds = np.random.default_rng((seed, 1)).integers(2**31, size=(len(START_POSES), ropes))
    return lasting([
        StabilizationTrial(configuration, start, int(seeds[pose, rope]))
        for pose, start in enumerate(START_POSES)
        for rope, configuration in enumerate(configurations)
    ])  # fmt: skip


def behind_filter(trials: Sequence[StabilizationTrial], tank: float) -> list[StabilizationTrial]:
    """The trials with a passivity filter before each gripper's servos, whose tank holds so many J.

    The filter knows of the gripper's own mass alone, and that its speed is limited.
    """
    one = EnergyTank(initial=tank, upper=tank)

    def drive(configuration: RopeConfiguration) -> FilteredDrive:
        passes = PassivityFilter(tank=one, fastest=configuration.speed_limit)
        return FilteredDrive(passes, GRIPPER_MASS * np.eye(3), configuration.time_step)

    return [dataclasses.replace(trial, drive=drive) for trial in trials]


def lasting(trials: Sequence[StabilizationTrial]) -> list[StabilizationTrial]:
    """The trials, all for four first periods of the longest rope.

    Raises `PalpateError` when the ropes' control periods or markers differ.
    """
    for name in ("control_period", "markers"):
        found = {getattr(trial.configuration, name) for trial in trials}
        if len(found) > 1:
            raise PalpateError(
                f"trials run side by side with one {name}, not {sorted(found)}: evaluate them one "
                "after the other"
            )
    longest = max(trial.period for trial in trials)
    steps = math.ceil(TRIAL_PERIODS * longest / trials[0].control_period)
    return [dataclasses.replace(trial, steps=steps) for trial in trials]


def settling_time(
    energy: np.ndarray, gripper_speed: np.ndarray, control_period: float, first: bool = False
) -> np.ndarray:
    """When each rope was at rest (trials,) in s; NaN if it never was.

    The first instant from which on the energy stays below 1 % of its start for one second, at the
    end of which the gripper is at rest (slower than 0.02 m/s). Both arrays are (trials, times).

    A gripper that trembles about 0.02 m/s finds such an instant soon, and one that is at rest needs
    none: `first` only looks at the first second of low energy, and distinguishes the two.
    """
    stay = round(STAY / control_period)
    above = ~(energy < STABILISED * energy[:, :1])  # NaN is above
    passed = np.cumsum(np.pad(above, ((0, 0), (1, 0))), axis=1)
    stays = passed[:, stay + 1 :] == passed[:, : -stay - 1]
    if first:
        stays &= np.cumsum(stays, axis=1) == 1
    settled = stays & (gripper_speed[:, stay:] < GRIPPER_AT_REST)
    settled = np.pad(settled, ((0, 0), (0, 1)))  # a trial may be shorter than that second
    return np.where(settled.any(1), settled.argmax(1) * control_period, np.nan)


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

    def figures(
        self, suffix: str = "", bars: tuple[float | None, float | None] = (None, None)
    ) -> list[Figure]:
        """`success_rate`, `time_to_1pct_periods` and `time_to_1pct_s`, names ending in `suffix`.

        `bars` are those of the first two.
        """
        rate, (low, high) = self.success_rate, self.interval
        spread = max(rate - low, high - rate)
        of_rate: dict[str, Any] = {"bar": bars[0], "better": "higher", "spread": spread}
        of_periods: dict[str, Any] = {"bar": bars[1], "spread": self.margin}
        return [
            Figure(f"success_rate{suffix}", rate, "", **of_rate),
            Figure(f"time_to_1pct_periods{suffix}", self.periods, "periods", **of_periods),
            Figure(f"time_to_1pct_s{suffix}", self.time, "s", spread=self.time_margin),
        ]


def summarise(trials: Sequence[StabilizationTrial], episodes: Episodes) -> Summary:
    """Success rate and times of these trials."""
    step, energy = trials[0].control_period, episodes.energy
    time, at_once = (
        settling_time(energy, episodes.gripper_speed, step, first) for first in (False, True)
    )
    period = np.array([trial.period for trial in trials])
    settled = np.isfinite(time)
    successes = int(settled.sum())

    def mean(values: np.ndarray) -> tuple[float | None, float | None]:
        if not successes:
            return None, None
        margin = 1.96 * values.std(ddof=1) / math.sqrt(successes) if successes > 1 else None
        return float(values.mean()), None if margin is None else float(margin)

    above = ~(energy < STABILISED * energy[:, :1])
    last_above = (above.shape[1] - 1 - above[:, ::-1].argmax(1)) * step
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
        periods_with_failures=float(
            (np.where(settled, time, (energy.shape[1] - 1) * step) / period).mean()
        ),
        at_rest_at_once=int(np.isfinite(at_once).sum()),
        final_speed=None if np.isnan(final_speed).all() else float(np.nanmean(final_speed)),
        relapsed=int((settled & (last_above > time)).sum()),
        diverged=len(episodes.failures),
    )


def write_trial_evidence(
    run: Run,
    trials: Sequence[StabilizationTrial],
    evaluated: Mapping[str, Episodes],
    shown: Sequence[str] | None = None,
) -> None:
    """Leave for the report the energy of all trials and, of one for each pose, how the rope moved.

    `shown`: the controllers whose motion is drawn (None: all).
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
        for name in evaluated if shown is None else shown:
            arrays[f"{group}.{name}"] = evaluated[name].markers[place]
    write_evidence(run.path, arrays)
