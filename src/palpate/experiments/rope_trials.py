"""Controllers in the MuJoCo rope, and whether they brought it to rest.

A trial is one rope, one start pose and one seed. Many run side by side, so that a learned policy is
asked once per control period for all of them.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from palpate import devices
from palpate.errors import PalpateError
from palpate.models.rope import RopeState
from palpate.networks import Policy
from palpate.perception.velocity import VelocityEstimator
from palpate.tasks.rope_stabilization import AT_REST, FIRST_ROOT, STABILISED, STAY
from palpate.tasks.task import Task
from palpate.worlds.rope import START_POSES, RopeConfiguration, RopeObservation, RopeWorld

TRIAL_PERIODS = 4.0  # length of a trial, in first periods of its rope


@dataclass(frozen=True)
class Trial:
    """One rope, how it starts, and the seed of its azimuth and its sensor noise."""

    configuration: RopeConfiguration
    start: str
    seed: int

    @property
    def period(self) -> float:
        """First period of the undamped limp rope in s: 2 pi / (1.2024 sqrt(g / L))."""
        frequency = FIRST_ROOT * math.sqrt(self.configuration.gravity / self.configuration.length)
        return 2 * math.pi / frequency


@dataclass(frozen=True)
class Seen:
    """What the sensors of several worlds showed, stacked: the newest observation of each."""

    markers: np.ndarray  # (worlds, markers, 3) m
    gripper_position: np.ndarray  # (worlds, 3) m
    gripper_velocity: np.ndarray  # (worlds, 3) m/s


class Controller(Protocol):
    """What moves the grippers of several worlds at once."""

    def begin(self, seen: Seen) -> None:
        """New episodes start, of which this is the first observation."""
        ...

    def command(self, seen: Seen) -> np.ndarray:
        """The gripper velocities (worlds, 3) in m/s to hold for one control period."""
        ...


@dataclass(frozen=True)
class Episodes:
    """What happened in trials, sampled once per control period from the start on.

    `energy` (trials, times) in J is the true one; NaN after a simulation diverged. `gripper_speed`
    (trials, times) in m/s. `markers` (trials, times, markers, 3) in m is empty along its second
    axis unless it was asked for. `failures`: why a simulation ended early, by trial.
    """

    control_period: float
    energy: np.ndarray
    gripper_speed: np.ndarray
    markers: np.ndarray
    failures: dict[int, str]


class LearnedController:
    """A policy, fed with what it was trained on: positions and velocities of a model's nodes.

    The nodes are the markers, or every second of them, and so on: `nodes` - 1 divides the number
    of markers less one. Where the gripper is, its encoder says better than its marker.
    """

    def __init__(self, policy: Policy, task: Task, nodes: int, control_period: float):
        estimator = VelocityEstimator(control_period)
        self._policy, self._nodes, self._estimator = policy, nodes, estimator

        @eqx.filter_jit
        def decide(policy, window, carry, positions):
            window, velocity = jax.vmap(estimator.update)(window, positions)
            features = task.features(RopeState(positions, velocity), None)
            carry, action = policy(carry, features, None, None)
            return window, carry, action

        self._decide = decide

    def begin(self, seen: Seen) -> None:
        """See `Controller.begin`."""
        positions = self._positions(seen)
        self._window = jax.vmap(self._estimator.init)(positions)
        self._carry = self._policy.initial_carry(jnp.zeros((len(positions), 1, 3)))

    def command(self, seen: Seen) -> np.ndarray:
        """See `Controller.command`."""
        self._window, self._carry, action = self._decide(
            self._policy, self._window, self._carry, self._positions(seen)
        )
        return np.asarray(action)[:, 0]

    def _positions(self, seen: Seen) -> jax.Array:
        markers = seen.markers.shape[1]
        every, rest = divmod(markers - 1, self._nodes - 1)
        if rest:
            raise PalpateError(
                f"a policy for {self._nodes} nodes needs a multiple of {self._nodes - 1} markers "
                f"and one more, not {markers}"
            )
        positions = seen.markers[:, ::every].copy()
        positions[:, 0] = seen.gripper_position
        return jnp.asarray(positions, jnp.float32)


def run_trials(
    trials: Sequence[Trial], controller: Controller, duration: float, keep_markers: bool = False
) -> Episodes:
    """Run all trials side by side for `duration` seconds, the worlds on as many threads as cores.

    A simulation that diverges ends its own trial and no other.
    """
    period = trials[0].configuration.control_period
    steps = round(duration / period)
    episodes = _Recorder(trials, steps, keep_markers, period)
    seen = episodes.seen
    controller.begin(seen)
    with ThreadPoolExecutor(devices.cores()) as threads:
        shares = np.array_split(np.arange(len(trials)), devices.cores())
        for step in range(1, steps + 1):
            commands = controller.command(seen)
            list(threads.map(lambda share: episodes.advance(share, step, commands), shares))  # noqa: B023
            seen = episodes.seen
    return episodes.episodes()


class _Recorder:
    """Worlds, the last observation of each, and what is kept of them."""

    def __init__(self, trials: Sequence[Trial], steps: int, keep_markers: bool, period: float):
        self._worlds = [RopeWorld(trial.configuration) for trial in trials]
        self._latest: list[RopeObservation] = [
            world.reset(trial.seed, start=trial.start)
            for world, trial in zip(self._worlds, trials, strict=True)
        ]
        self._period = period
        count, markers = len(trials), len(self._latest[0].markers)
        self._energy = np.full((count, steps + 1), np.nan, np.float32)
        self._speed = np.full((count, steps + 1), np.nan, np.float32)
        kept = steps + 1 if keep_markers else 0
        self._markers = np.full((count, kept, markers, 3), np.nan, np.float32)
        self._failures: dict[int, str] = {}
        for trial in range(count):
            self._keep(trial, 0)

    @property
    def seen(self) -> Seen:
        return Seen(
            np.stack([observation.markers for observation in self._latest]),
            np.stack([observation.gripper_position for observation in self._latest]),
            np.stack([observation.gripper_velocity for observation in self._latest]),
        )

    def advance(self, share: np.ndarray, step: int, commands: np.ndarray) -> None:
        for trial in share.tolist():
            if trial not in self._failures:
                try:
                    self._latest[trial] = self._worlds[trial].step(commands[trial])
                    self._keep(trial, step)
                except PalpateError as error:
                    self._failures[trial] = str(error)

    def _keep(self, trial: int, step: int) -> None:
        truth = self._worlds[trial].truth()
        self._energy[trial, step] = truth.energy
        self._speed[trial, step] = np.linalg.norm(truth.gripper_velocity)
        if self._markers.shape[1]:
            self._markers[trial, step] = self._latest[trial].markers

    def episodes(self) -> Episodes:
        return Episodes(
            self._period, self._energy, self._speed, self._markers, dict(self._failures)
        )


def settling_time(
    energy: np.ndarray, gripper_speed: np.ndarray, control_period: float
) -> np.ndarray:
    """When each rope was at rest (trials,) in s; NaN if it never was.

    The first instant from which on the energy stays below 1 % of its start for one second, at the
    end of which the gripper is at rest (slower than 0.02 m/s). Both arrays are (trials, times).
    """
    stay = round(STAY / control_period)
    above = ~(energy < STABILISED * energy[:, :1])  # NaN is above
    passed = np.cumsum(np.pad(above, ((0, 0), (1, 0))), axis=1)
    stays = passed[:, stay + 1 :] == passed[:, : -stay - 1]
    settled = stays & (gripper_speed[:, stay:] < AT_REST)
    return np.where(settled.any(1), settled.argmax(1) * control_period, np.nan)


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """95 % interval of a success rate (Wilson 1927, J. Am. Stat. Assoc. 22:209-212)."""
    z = 1.959964
    rate = successes / count
    centre = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * math.sqrt(rate * (1 - rate) / count + (z / (2 * count)) ** 2)
    return max(0.0, centre - half), min(1.0, centre + half)
