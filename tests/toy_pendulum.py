"""What a family of another package brings to the commands: a pendulum with a world of its own."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from palpate.families.options import Evaluate, Identify, Record, Train
from palpate.networks import Controller
from palpate.recordings import Aligned, Channel, Recording, Role
from palpate.recordings import Trial as RecordedTrial
from palpate.report import Curves, Piece, charts, write_evidence
from palpate.runs import Figure, Run
from palpate.trials import trial as trials
from palpate.trials.controller import FeedbackController, HeldStill
from palpate.worlds.world import World
from toys import Pendulum, PendulumDamping, PendulumState

ANGLE, ACCELERATION = "angle", "acceleration"
NOISE = 1e-4  # rad, standard deviation of the encoder


@dataclass(frozen=True)
class PendulumObservation:
    """The angle (1,) that an encoder shows, rad, at a `time` in s."""

    time: float
    angle: np.ndarray


@dataclass(frozen=True)
class PendulumTruth:
    """Angle in rad, its rate in rad/s, and the energy per mass in J/kg."""

    angle: float
    rate: float
    energy: float


class PendulumWorld(World):
    """A pendulum whose pivot is accelerated (m/s^2); it swings as its model says."""

    control_period = 0.02

    def __init__(self, length: float, damping: float):
        self._length, self._damping = length, damping

    def reset(self, seed: int, **options: Any) -> PendulumObservation:
        self._random = np.random.default_rng(seed)
        self._time, (self._angle, self._rate) = 0.0, self._random.uniform(-1.0, 1.0, 2)
        return self._observed()

    def step(self, action: Any) -> PendulumObservation:
        pull = 9.81 * math.sin(self._angle) + float(np.ravel(action)[0]) * math.cos(self._angle)
        acceleration = -pull / self._length - self._damping * self._rate
        self._rate += self.control_period * acceleration
        self._angle += self.control_period * self._rate
        self._time += self.control_period
        return self._observed()

    def _observed(self) -> PendulumObservation:
        noise = NOISE * self._random.normal(size=1)
        return PendulumObservation(self._time, self._angle + noise)

    def truth(self) -> PendulumTruth:
        height = self._length * (1.0 - math.cos(self._angle))
        energy = 9.81 * height + 0.5 * (self._length * self._rate) ** 2
        return PendulumTruth(self._angle, self._rate, energy)

    def render(self, width: int = 640, height: int = 480) -> np.ndarray:
        return np.zeros((height, width, 3), np.uint8)


@dataclass(frozen=True, kw_only=True)
class RecordPendulum(Record):
    """Record a pendulum whose pivot is shaken.

    1. One that is 70 cm long:          palpate record toy-pendulum --out R.npz
    """

    family: ClassVar[str] = "toy-pendulum"

    length: float = 0.7
    """Pivot to mass, m."""
    damping: float = 0.4
    """Rate at which air takes the swing, 1/s."""

    def record(self) -> Recording:
        recorded = []
        for number in range(self.trials):
            world, random = (
                PendulumWorld(self.length, self.damping),
                np.random.default_rng((self.seed, number)),
            )
            steps = round(self.duration / world.control_period)
            actions = np.repeat(random.normal(size=steps // 10 + 1), 10)[:steps, None]
            seen = [world.reset(number), *(world.step(action) for action in actions)]
            time = np.array([one.time for one in seen])
            angles = np.array([one.angle for one in seen])
            channels = (
                Channel(ANGLE, Role.OBSERVATION, time, angles, "rad"),
                Channel(ACCELERATION, Role.COMMAND, time[:-1], actions, "m/s^2"),
            )
            by_name = {channel.name: channel for channel in channels}
            recorded.append(RecordedTrial(f"shaken {number}", by_name))
        return Recording(tuple(recorded), {"source": "a pendulum of the tests"})


@dataclass(frozen=True, kw_only=True)
class IdentifyPendulum(Identify):
    """Identify a pendulum: its length and its damping.

    1. From a recording:                palpate identify toy-pendulum R.npz
    """

    family: ClassVar[str] = "toy-pendulum"
    observation: ClassVar[str] = ANGLE

    def prepare(self, recording: Recording) -> Recording:
        return recording

    def action(self, recording: Recording) -> str:
        return ACCELERATION

    def reference(self, recordings: Sequence[Recording], aligned: Aligned) -> Pendulum:
        return Pendulum(length=1.0, damping=0.2, control_period=aligned.period)


@dataclass(frozen=True, kw_only=True)
class TrainPendulumDamping(Train):
    """Train a controller that takes the swing out of a pendulum.

    1. After `palpate identify`:        palpate train pendulum-damping --model MODEL
    """

    task: ClassVar[str] = PendulumDamping.name

    def prepare(self, model: Pendulum) -> Pendulum:
        return model


class Damper(FeedbackController):
    """A policy, fed with the angle that is seen and its rate since the last."""

    def __init__(self, policy: Any):
        self.policy, self.period = policy, policy.period

    def start(self, command: Any, observation: PendulumObservation, goal: Any) -> Any:
        return self.policy.initial_carry(jnp.asarray(command, jnp.float32)), observation.angle

    def decide(self, carry: Any, observation: PendulumObservation, goal: Any) -> Any:
        memory, before = carry
        rate = (observation.angle - before) / self.period
        state = PendulumState(jnp.asarray(observation.angle), jnp.asarray(rate))
        features = PendulumDamping().features(state, None).astype(jnp.float32)
        memory, action = self.policy(memory, features, None, None)
        return (memory, observation.angle), np.asarray(action)


@dataclass(frozen=True)
class Swings(trials.Record):
    """Energies (trials, times) in J/kg, and the angles (drawn, times, 1) in rad that were seen."""

    observed: ClassVar[str] = "angle"
    energy: np.ndarray
    angle: np.ndarray
    failures: dict[int, str]


@dataclass(frozen=True)
class SwingTrial(trials.Trial[Swings]):
    """A pendulum of some length that is to come to rest."""

    seed: int
    length: float
    steps: int = 200
    group = "swing"
    control_period = PendulumWorld.control_period
    reset_options: ClassVar[Mapping[str, Any]] = {}
    command = np.zeros(1)

    def world(self) -> PendulumWorld:
        return PendulumWorld(self.length, 0.1)

    def measure(self, observation: PendulumObservation, truth: PendulumTruth) -> dict[str, Any]:
        return {"energy": truth.energy}

    @classmethod
    def record(cls, trials: Sequence[Any], steps: int, drawn: int) -> Swings:
        energy = np.full((len(trials), steps + 1), np.nan)
        return Swings(energy, np.full((drawn, steps + 1, 1), np.nan), {})

    @classmethod
    def figures(cls, trials: Sequence[Any], record: Swings, suffix: str = "") -> list[Figure]:
        rate = float(np.mean(record.energy[:, -1] < 0.02 * record.energy[:, 0]))
        return [Figure(f"success_rate{suffix}", rate, "", better="higher")]


@dataclass(frozen=True, kw_only=True)
class EvaluatePendulumDamping(Evaluate):
    """Try a controller in pendulums that it was not trained for.

    1. After `palpate train`:           palpate evaluate pendulum-damping --policy POLICY
    """

    task: ClassVar[str] = PendulumDamping.name

    pendulums: int = 10
    """Drawn around one of 70 cm."""

    def prepare(self, model: Pendulum) -> Pendulum:
        return model

    def trials(self, base: None) -> list[SwingTrial]:
        lengths = np.random.default_rng(self.seed).uniform(0.6, 0.8, self.pendulums)
        return [SwingTrial(seed, float(length)) for seed, length in enumerate(lengths)]

    def controllers(self, policy: Any, manifest: Any, base: None) -> dict[str, Controller]:
        return {"controlled": Damper(policy), "held still": HeldStill()}

    def show(self, run: Run, trials: Any, evaluated: Mapping[str, Swings]) -> None:
        some = next(iter(evaluated.values()))
        swings = {f"swing.{name}": record.angle[0, :, 0] for name, record in evaluated.items()}
        time = SwingTrial.control_period * np.arange(some.angle.shape[1])
        write_evidence(run.path, swings | {"swing.time": time})


def _swing(curves: Curves, looks: Mapping[str, int]) -> tuple[str, charts.Chart]:
    data = [
        charts.curve_line(label, looks, curves.time, values, "%{y:.2f} rad")
        for label, values in curves.values.items()
    ]
    return "The angle from hanging, in rad.", {"data": data, "layout": charts.empty_layout(300)}


SWING = Piece("Swing", ("times",), _swing)
