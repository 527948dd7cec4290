"""Trials of the MuJoCo rope, and when one counts as brought to rest."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from palpate.tasks.rope.stabilization import FIRST_ROOT, STABILISED, STAY, RopeStabilization
from palpate.trials.trial import Record, RecordType, Trial
from palpate.worlds.rope.rope import RopeConfiguration, RopeObservation, RopeTruth, RopeWorld

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

    @classmethod
    def empty(cls, trials: int, times: int, drawn: int, markers: int) -> "Episodes":
        """All NaN, to be filled."""
        energy, speed = np.full((2, trials, times), np.nan, np.float32)
        return cls(energy, speed, np.full((drawn, times, markers, 3), np.nan, np.float32), {})


@dataclass(frozen=True)
class RopeTrial(Trial[RecordType]):
    """One rope, how it starts, and the seed of its azimuth and its sensor noise."""

    configuration: RopeConfiguration
    start: str
    seed: int

    @property
    def period(self) -> float:
        """First period of the undamped limp rope in s: 2 pi / (1.2024 sqrt(g / L))."""
        frequency = FIRST_ROOT * math.sqrt(self.configuration.gravity / self.configuration.length)
        return 2 * math.pi / frequency

    @property
    def control_period(self) -> float:
        """See `Trial`."""
        return self.configuration.control_period

    @property
    def group(self) -> str:
        """See `Trial`: the start pose."""
        return self.start

    @property
    def reset_options(self) -> Mapping[str, Any]:
        """See `Trial`."""
        return {"start": self.start}

    @property
    def command(self) -> np.ndarray:
        """See `Trial`: a gripper at rest."""
        return np.zeros(3)

    def world(self) -> RopeWorld:
        """See `Trial`."""
        return RopeWorld(self.configuration)


class StabilizationTrial(RopeTrial[Episodes]):
    """One rope that is to come to rest."""

    def measure(self, observation: RopeObservation, truth: RopeTruth) -> Mapping[str, Any]:
        """See `Trial`."""
        return RopeStabilization.measure(observation, truth)

    @classmethod
    def record(cls, trials: Sequence["StabilizationTrial"], steps: int, drawn: int) -> Episodes:
        """See `Trial`."""
        return Episodes.empty(len(trials), steps + 1, drawn, trials[0].configuration.markers)

    @classmethod
    def score(cls, trials: Sequence["StabilizationTrial"], record: Episodes) -> dict[str, float]:
        """See `Trial`."""
        return {"success_rate": float(np.isfinite(settling_times(trials, record)).mean())}


def settling_time(
    energy: np.ndarray, gripper_speed: np.ndarray, control_period: float, first: bool = False
) -> np.ndarray:
    """When each rope was at rest (trials,) in s; NaN if it never was.

    The first instant from which on the energy stays below 1 % of its start for one second, at the
    end of which the gripper is at rest (slower than 0.02 m/s). Both arrays are (trials, times).

    A gripper that trembles about 0.02 m/s finds such an instant soon, and one that is at rest needs
    none: `first` only looks at the first second of low energy, and tells the two apart.
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


def settling_times(
    trials: Sequence[StabilizationTrial], episodes: Episodes, first: bool = False
) -> np.ndarray:
    """When each rope came to rest, (trials,) in s; see `settling_time`."""
    return settling_time(episodes.energy, episodes.gripper_speed, trials[0].control_period, first)
