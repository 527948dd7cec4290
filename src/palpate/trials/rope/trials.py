"""Controllers in the MuJoCo rope, and whether they brought it to rest.

A trial is one rope, one start pose and one seed. Many run side by side, so that a learned policy is
asked once per control period for all of them.
"""

import functools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from palpate.errors import PalpateError
from palpate.models.rope import RopeState
from palpate.networks import CommandPolicy
from palpate.numerics import devices
from palpate.perception.velocity import VelocityEstimator
from palpate.tasks.rope.stabilization import FIRST_ROOT, STABILISED, STAY, RopeStabilization
from palpate.worlds.rope.rope import RopeConfiguration, RopeObservation, RopeWorld
from palpate.worlds.world import DivergedError

# Here and not in the task: what a policy is judged by must not follow what it is trained for. That
# is why the task's `outcome`, which has a milder rule of its own (the gripper's mean speed, a least
# start energy), and `settling_time` are two.
GRIPPER_AT_REST = 0.02  # m/s, the gripper's true speed when the second of low energy has passed

SAME_PERIOD = 1e-3  # relative: that of a recording's clock is known no better


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
    """What the sensors of several worlds showed, stacked: the newest observation of each.

    `time`: s since reset at which that was measured; NaN where nobody says.
    """

    markers: np.ndarray  # (worlds, markers, 3) m
    gripper_position: np.ndarray  # (worlds, 3) m
    time: float = math.nan


@runtime_checkable
class Controller(Protocol):
    """What moves the grippers of several worlds at once.

    `period`: seconds from one decision to the next that it was made for; None: any.
    """

    @property
    def period(self) -> float | None: ...

    def begin(self, seen: Seen) -> None:
        """New episodes start, of which this is the first observation."""
        ...

    def command(self, seen: Seen) -> np.ndarray:
        """The gripper velocities (worlds, 3) in m/s to hold for one control period."""
        ...


@dataclass(frozen=True)
class Episodes:
    """What happened in trials, sampled once per control period from the start on.

    `energy` (trials, times) in J is the true one, `gripper_speed` (trials, times) in m/s; both NaN
    once a simulation has diverged. `markers` (kept trials, times, markers, 3) in m, as seen, of
    those trials that were asked for. `failures`: why a simulation ended early, by trial.
    """

    energy: np.ndarray
    gripper_speed: np.ndarray
    markers: np.ndarray
    failures: dict[int, str]

    @classmethod
    def empty(cls, trials: int, times: int, kept: int, markers: int) -> "Episodes":
        """All NaN, to be filled."""
        energy, speed = np.full((2, trials, times), np.nan, np.float32)
        return cls(energy, speed, np.full((kept, times, markers, 3), np.nan, np.float32), {})


class LearnedController:
    """A policy, fed with what it was trained on: positions and velocities of a model's nodes.

    The nodes are the markers, or every second of them, and so on, as the policy's features tell.
    Where the gripper is, its encoder says better than its marker.
    """

    def __init__(self, policy: CommandPolicy, task: RopeStabilization):
        self._policy = policy
        self._segments = policy.mean.shape[0] // 6  # 3 coordinates and 3 velocities of each node
        self._estimator = estimator = VelocityEstimator(policy.period)

        @eqx.filter_jit
        def decide(policy, window, carry, positions):
            window, velocity = jax.vmap(estimator.update)(window, positions)
            features = task.features(RopeState(positions, velocity), None)
            carry, action = policy(carry, features, None, None)
            return window, carry, action

        self._decide = decide

    @property
    def period(self) -> float:
        """See `Controller`; by it commands change, and velocities are estimated."""
        return self._policy.period

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
        every, rest = divmod(markers - 1, self._segments)
        if rest:
            raise PalpateError(
                f"a policy for {self._segments + 1} nodes needs a multiple of {self._segments} "
                f"markers and one more, not {markers}"
            )
        positions = seen.markers[:, ::every].copy()
        positions[:, 0] = seen.gripper_position
        return jnp.asarray(positions, jnp.float32)


def check_period(controller: Controller, trials: Sequence[Trial]) -> None:
    """Raise `PalpateError` if the controller was made for another control period than a trial's."""
    period = controller.period
    for own in {trial.configuration.control_period for trial in trials}:
        if period is not None and not math.isclose(period, own, rel_tol=SAME_PERIOD):
            raise PalpateError(
                f"a controller that decides every {period:g} s does not fit ropes with a control "
                f"period of {own:g} s: train it with a model of that period"
            )


def run_trials(
    trials: Sequence[Trial], controller: Controller, steps: int, kept: Sequence[int] = ()
) -> Episodes:
    """Run all trials side by side for `steps` control periods, on as many threads as cores.

    The markers of the trials numbered in `kept` are kept. A simulation that diverges ends its own
    trial and no other. Raises `PalpateError` when the controller decides in another period.
    """
    check_period(controller, trials)
    recorder = _Recorder(trials, steps, kept)
    controller.begin(recorder.seen)
    shares = np.array_split(np.arange(len(trials)), devices.cores())
    with ThreadPoolExecutor(devices.cores()) as threads:
        for step in range(1, steps + 1):
            commands = controller.command(recorder.seen)
            advance = functools.partial(recorder.advance, step, commands)
            list(threads.map(advance, shares))  # MuJoCo lets the other threads run meanwhile
    return recorder.episodes


class _Recorder:
    """Worlds, the last observation of each, and what is kept of them."""

    def __init__(self, trials: Sequence[Trial], steps: int, kept: Sequence[int]):
        self._worlds = [RopeWorld(trial.configuration) for trial in trials]
        self._kept = {trial: place for place, trial in enumerate(kept)}
        markers = trials[0].configuration.markers
        self.episodes = Episodes.empty(len(trials), steps + 1, len(kept), markers)
        self._latest = [self._start(index, trial) for index, trial in enumerate(trials)]
        for trial in range(len(trials)):
            if trial not in self.episodes.failures:
                self._keep(trial, 0)

    @property
    def seen(self) -> Seen:
        """The newest observations; of a world that diverged, its last one (or it hanging)."""
        return Seen(
            np.stack([observation.markers for observation in self._latest]),
            np.stack([observation.gripper_position for observation in self._latest]),
            max(observation.time for observation in self._latest),
        )

    def _start(self, index: int, trial: Trial) -> RopeObservation:
        world = self._worlds[index]
        try:
            return world.reset(trial.seed, start=trial.start)
        except DivergedError as error:  # while it was shaken
            self.episodes.failures[index] = str(error)
            return world.reset(trial.seed)  # hanging: something to see for who sees all worlds

    def advance(self, step: int, commands: np.ndarray, share: np.ndarray) -> None:
        failures = self.episodes.failures
        for trial in share.tolist():
            if trial not in failures:
                try:
                    self._latest[trial] = self._worlds[trial].step(commands[trial])
                    self._keep(trial, step)
                except PalpateError as error:
                    failures[trial] = str(error)

    def _keep(self, trial: int, step: int) -> None:
        truth = self._worlds[trial].truth()
        self.episodes.energy[trial, step] = truth.energy
        self.episodes.gripper_speed[trial, step] = np.linalg.norm(truth.gripper_velocity)
        if trial in self._kept:
            self.episodes.markers[self._kept[trial], step] = self._latest[trial].markers


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


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """95 % interval of a success rate (Wilson 1927, J. Am. Stat. Assoc. 22:209-212)."""
    z = 1.959964
    rate = successes / count
    centre = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * math.sqrt(rate * (1 - rate) / count + (z / (2 * count)) ** 2)
    return max(0.0, centre - half), min(1.0, centre + half)
