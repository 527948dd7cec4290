"""What tests of the deployment share: a rope's policy, and a robot that can be made to fail."""

import dataclasses
import functools

import equinox as eqx
import jax
import numpy as np

from palpate.deployment.intake import Intake
from palpate.deployment.messages import StateMessage, encode_state
from palpate.deployment.plausibility import Values
from palpate.deployment.supervisor import Limits, Order, Supervisor
from palpate.families.rope.chain_check import ChainCheck
from palpate.models.rope import Rope
from palpate.networks import Channel, CommandPolicy, GuardedPolicy, count_of, save_controller
from palpate.networks.actor import GaussianActor
from palpate.networks.guarded import untrained_guard
from palpate.tasks.rope import RopeStabilization
from small_rope import VELOCITY

PERIOD = 0.01
IMPEDANCE = (
    Channel("displacement", (3,), "m", 0.05, 0.4),
    Channel("stiffness", (3, 1), "N/m", 800.0, 4000.0),
    Channel("damping ratio", (1,), "", 2.0),
)
NODES, SPACING = 6, 0.1
SENSORS = Channel("gripper", (3,), "m"), Channel("markers", (NODES, 3), "m")
SPEED, ACCELERATION = 1.5, 10.0  # limits, m/s and m/s^2
CHANGE = ACCELERATION * PERIOD
LIMITS = Limits([VELOCITY], PERIOD)


def manifest(nodes: int = NODES) -> dict:
    """As `palpate train` writes it, shortened."""
    return {
        "task": "rope-stabilization",
        "command": "palpate train rope-stabilization",
        "seed": 0,
        "model": [{"name": "rest_length", "value": [SPACING] * (nodes - 1), "unit": "m"}],
    }


@functools.cache
def rope_policy(nodes: int = NODES, **changes) -> CommandPolicy:
    """A policy that acts at random, and not a little."""
    seen = jax.random.normal(jax.random.key(1), (32, 6 * (nodes - 1)))
    limits = {name: changes.pop(name) for name in ("limit", "rate_limit") if name in changes}
    policy = CommandPolicy.create(
        jax.random.key(0),
        0.3 * seen + 0.1,
        dataclasses.replace(VELOCITY, **limits),
        observations=RopeStabilization().feature_channels(Rope.uniform(nodes=nodes)),
        **{"period": PERIOD, "width": 16} | changes,
    )
    return dataclasses.replace(policy, network=scaled(policy.network, 4.0))


def impedance_policy(**changes) -> CommandPolicy:
    """What an impedance-controlled arm is told: displacement, and stiffness axis by axis."""
    seen = jax.random.normal(jax.random.key(2), (64, 7))
    settings = {"period": 0.02, "width": 64} | changes
    policy = CommandPolicy.create(jax.random.key(3), seen, IMPEDANCE, **settings)
    return dataclasses.replace(policy, network=scaled(policy.network, 4.0))


def actor_file(method: str = "srl-vic", energy=None, **changes) -> GuardedPolicy:
    """A guarded policy that acts at random, as `palpate train maze` keeps it; with an `energy` it
    sees a tank, too."""
    keys = jax.random.split(jax.random.key(0))
    observations = Channel("wrench", (6,)), Channel("position", (3,))
    if energy is not None:
        observations = *observations, Channel("tank", (1,))
    policy = GuardedPolicy(
        actor=GaussianActor.create(keys[0], count_of(observations), 4, 16, 2),
        guard=untrained_guard(keys[1], 6, 4, (16, 16), tuple(range(6))),
        threshold=0.5,
        observations=observations,
        actions=(Channel("displacement", (2,)), Channel("stiffness", (2,))),
        period=0.1,
    )
    constants = {"task.force_limit": 20.0, "task.reference_height": 0.05}
    constants |= {"task.position_scale": 0.3, "world.displacement_limit": 0.02}
    constants |= {"world.stiffness_range": [50.0, 1000.0]}
    constants |= {} if energy is None else {"energy": energy}
    told = {"task": "maze", "options": {"method": method}, "constants": constants}
    save_controller("actor.safetensors", policy, told | changes)
    return policy


def scaled(network, factor: float):
    """The network with all its weights multiplied."""
    return jax.tree.map(lambda leaf: factor * leaf if eqx.is_array(leaf) else leaf, network)


def shape(time: float, nodes: int = NODES) -> np.ndarray:
    """A chain (nodes, 3) that swings by a few centimetres under a gripper at rest."""
    along = SPACING * np.arange(nodes)
    swing = 0.1 * along * np.sin(5 * time)
    return np.stack([swing, 0 * along, 1.5 - along], axis=-1)


def state(sequence: int, time: float, session: int = 7, markers=None, gripper=None) -> bytes:
    """A message of that chain, unless it is told otherwise."""
    markers = shape(time) if markers is None else markers
    gripper = markers[0] if gripper is None else gripper
    values = {"gripper": single(gripper), "markers": single(markers)}
    return encode_state(StateMessage(session, sequence, time, values))


def single(values) -> np.ndarray:
    """As a camera's driver gives it."""
    return np.asarray(values, np.float32)


class Pusher:
    """A policy that always wants full speed ahead; remembers what it was shown."""

    def __init__(self, wanted=(3.0, 0.0, 0.0)):
        self.wanted = single(wanted)
        self.seen: list[np.ndarray] = []
        self.forgotten = 0

    def forget(self) -> None:
        self.forgotten += 1

    def see(self, values: Values) -> None:
        self.seen.append(values["markers"])

    def decide(self, command: np.ndarray) -> np.ndarray:
        return self.wanted


def supervisor(decision=None, limits: Limits = LIMITS, length: float = 0.5) -> Supervisor:
    """One for that chain, or one of another length (m)."""
    check = ChainCheck(np.full(NODES - 1, length / (NODES - 1)), limits.period)
    intake = Intake(check, SENSORS, limits.period)
    return Supervisor(intake, decision or Pusher(), limits)


class Bench:
    """A supervisor, its time, and a robot that sends `shape` unless a test does otherwise.

    Every order is kept; a tick comes 2 ms after a state does.
    """

    DELAY, OFFSET = 0.001, 100.0  # s; of messages, and between the clocks

    def __init__(self, supervised: Supervisor):
        self.supervised = supervised
        self.step = 0
        self.lag = 0.0  # s by which the ticks were held up for good
        self.orders: list[Order] = []
        self.times: list[float] = []

    def message(self, **changes) -> tuple[float, bytes]:
        """That of this step, as (arrival, bytes); `arrives` is a delay in s on top."""
        time = self.step * PERIOD
        arrives = changes.pop("arrives", 0.0)
        given = {"sequence": self.step + 1, "time": time} | changes
        return time + self.OFFSET + self.DELAY + arrives, state(**given)

    def tick(self, *messages: tuple[float, bytes], after: float = 0.0) -> Order:
        """One tick with these messages, held up by `after` s."""
        self.lag += after
        now = self.step * PERIOD + self.OFFSET + self.DELAY + 0.002 + self.lag
        self.orders.append(self.supervised.tick(now, messages))
        self.times.append(now)
        self.step += 1
        return self.orders[-1]

    def good(self, count: int) -> Order:
        """So many good states, one each tick."""
        for _ in range(count):
            order = self.tick(self.message())
        return order

    def silent(self, count: int) -> Order:
        """So many ticks without a state."""
        for _ in range(count):
            order = self.tick()
        return order

    @property
    def velocities(self) -> np.ndarray:
        """All orders, (ticks, 3) m/s."""
        return np.array([order.action for order in self.orders])

    def check_limits(self) -> None:
        """No order, whatever happened, is faster or changes faster than is allowed."""
        velocities = np.concatenate([np.zeros((1, 3)), self.velocities])
        assert np.isfinite(velocities).all()
        assert np.linalg.norm(velocities, axis=1).max() <= SPEED * (1 + 1e-6)
        changes = np.linalg.norm(np.diff(velocities, axis=0), axis=1)
        assert changes.max() <= CHANGE * (1 + 1e-5)
