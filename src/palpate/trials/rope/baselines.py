"""The textbook swing damper, which learned controllers of a rope are compared with."""

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.networks import Controller
from palpate.perception.velocity import VelocityEstimator
from palpate.runs.progress import progress
from palpate.trials.controller import FeedbackController, HeldStill
from palpate.trials.rope.stabilization import StabilizationTrial, settling_time
from palpate.trials.trial import run_trials
from palpate.worlds.rope.configuration import in_step
from palpate.worlds.rope.rope import (
    START_POSES,
    RopeConfiguration,
    RopeObservation,
    sample_configurations,
)

TUNING = 5.0  # s of each trial that gains of a rope of 1 m are tuned in


@dataclass(frozen=True)
class Gains:
    """Gripper acceleration for each quantity a `SwingDamper` feeds back, all positive."""

    offset: float  # 1/s^2, on the centre of the watched part relative to the gripper
    rate: float  # 1/s, on its velocity
    position: float  # 1/s^2, on the gripper's distance from where it started
    velocity: float  # 1/s, on the gripper's velocity
    part: float  # how much of the rope is watched, from the gripper on; 1 or more: all of it

    def alike(self, size: float) -> "Gains":
        """For a rope `size` times as long, whose swings last sqrt(size) times (Froude 1868)."""
        return dataclasses.replace(
            self,
            offset=self.offset / size,
            rate=self.rate / math.sqrt(size),
            position=self.position / size,
            velocity=self.velocity / math.sqrt(size),
        )


# Found by `python -m palpate.trials.rope.baselines` (seed 7000, which no evaluation uses).
TUNED = Gains(offset=1.58, rate=18.0, position=0.0245, velocity=1.18, part=0.197)


class SwingDamper(FeedbackController):
    """State feedback on the rope, taken for a pendulum whose pivot is moved.

    For the pivot's horizontal place x and the centre of the watched part at x + d,

        d'' = -(g / l) d - x'',    x'' = offset d + rate d' - position (x - x0) - velocity x'

    so `rate` damps the swing, `offset` makes it stiffer, and the rest brings the gripper back. The
    acceleration is limited as the gripper's is and integrated to the velocity that is commanded.
    What is carried: x0, the command in force, and a window of d.
    """

    def __init__(self, base: RopeConfiguration, gains: Gains = TUNED):
        self._gains, self.period = gains, base.control_period
        self._speed_limit, self._acceleration_limit = base.speed_limit, base.acceleration_limit
        self._estimator = VelocityEstimator(base.control_period)

    def start(self, command: np.ndarray, observation: RopeObservation, goal: None) -> Any:
        window = np.repeat(self._offset(observation)[None], self._estimator.frames, axis=0)
        return observation.gripper_position[:, :2], command[:, :2], window

    def decide(
        self, carry: Any, observation: RopeObservation, goal: None
    ) -> tuple[Any, np.ndarray]:
        home, command, window = carry
        gains, offset = self._gains, self._offset(observation)
        window = np.concatenate([window[1:], offset[None]])
        rate = np.tensordot(self._estimator.weights, window, axes=1)
        away = observation.gripper_position[:, :2] - home
        acceleration = (
            gains.offset * offset
            + gains.rate * rate
            - gains.position * away
            - gains.velocity * command
        )
        command = _shorten(
            command + self.period * _shorten(acceleration, self._acceleration_limit),
            self._speed_limit,
        )
        return (home, command, window), np.pad(command, ((0, 0), (0, 1)))

    def _offset(self, seen: RopeObservation) -> np.ndarray:
        """Centre of the watched markers relative to the gripper, horizontally: (worlds, 2) m."""
        last = max(1, round(min(1.0, self._gains.part) * (seen.markers.shape[1] - 1)))
        return (seen.markers[:, 1 : last + 1].mean(1) - seen.gripper_position)[:, :2]


def _shorten(vectors: np.ndarray, limit: float) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors * np.minimum(1.0, limit / np.maximum(length, 1e-12))


def baselines(base: RopeConfiguration, gains: Gains = TUNED) -> dict[str, Controller]:
    """What a controller that is to bring ropes like this one to rest is held against."""
    return {"held still": HeldStill(), "swing damper": SwingDamper(base, gains)}


@functools.cache
def tune_gains(base: RopeConfiguration) -> Gains:
    """Gains for ropes like this one: it takes a minute but for the rope that palpate records."""
    if base == RopeConfiguration():
        return TUNED
    return tune(coarse(base), TUNED.alike(base.length), ropes=2, candidates=40)


def coarse(base: RopeConfiguration) -> RopeConfiguration:
    """The same rope of 10 bodies, which is simulated thirty times as fast: to tune in.

    A joint of longer bodies bends more, so that the same damping of the rope is less of each.
    """
    bodies = 10
    constants = {field.name: getattr(base, field.name) for field in dataclasses.fields(base)}
    if base.marker_places is None:
        constants["markers"] = bodies + 1
    if not isinstance(base.mass_distribution, str):
        middles = (np.arange(bodies) + 0.5) / bodies * base.bodies - 0.5
        weights = np.interp(middles, np.arange(base.bodies), base.body_masses())
        constants["mass_distribution"] = tuple(weights.tolist())
    constants |= {"bodies": bodies, "joint_damping": base.joint_damping * bodies / base.bodies}
    del constants["time_step"]
    return in_step(constants.pop("control_period"), longest=1e-3, **constants)


def tune(
    base: RopeConfiguration, start: Gains, seed: int = 7000, ropes: int = 4, candidates: int = 80
) -> Gains:
    """The gains with the least mean settling time on sampled ropes from all start poses.

    A random walk on their logarithms that only keeps improvements, its steps growing after one
    and shrinking otherwise. A trial that never settles counts with its length.
    """
    random = np.random.default_rng(seed)
    lasting = TUNING * math.sqrt(base.length)
    steps = round(lasting / base.control_period)
    trials = [
        StabilizationTrial(configuration, pose, seed + index)
        for index, configuration in enumerate(sample_configurations(base, ropes, seed))
        for pose in START_POSES
    ]
    best, least, width = np.log(dataclasses.astuple(start)), np.inf, 0.5
    for index in progress(candidates, "tuning the swing damper"):
        point = best + width * random.standard_normal(len(best)) * (index > 0)
        gains = Gains(*np.exp(point).tolist())
        episodes = run_trials(trials, SwingDamper(base, gains), steps)
        time = settling_time(episodes.energy, episodes.gripper_speed, base.control_period)
        mean = float(np.nan_to_num(time, nan=lasting).mean())
        width *= 1.2 if mean < least else 0.96
        if mean < least:
            best, least = point, mean
    return Gains(*np.exp(best).tolist())


if __name__ == "__main__":  # it starts where an earlier such walk, from the whole rope, had ended
    start = Gains(offset=1.3, rate=18.5, position=0.023, velocity=1.2, part=0.19)
    print(tune(coarse(RopeConfiguration()), start))
