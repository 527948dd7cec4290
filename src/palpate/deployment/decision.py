"""Trained policies in NumPy: what sensors show in, command out, without JAX in the loop.

Of NumPy, ONNX Runtime and JAX, asked one decision at a time on a busy machine, NumPy has the
shortest tail; `python -m benchmarks.serve` measures it.
"""

from collections.abc import Sequence

import numpy as np

from palpate.deployment.plausibility import Values
from palpate.deployment.scaling import Scaling
from palpate.networks import ActorPolicy, Channel, CommandPolicy, GuardedPolicy, count_of
from palpate.networks.in_numpy import ActorInNumpy, GuardInNumpy


class NetworkDecision:
    """`CommandPolicy.__call__` for one observation; float32 as in JAX, buffers made beforehand."""

    def __init__(self, policy: CommandPolicy):
        layers = [(np.asarray(one.weight), np.asarray(one.bias)) for one in policy.network.layers]
        self._layers = [(weight, bias, np.empty_like(bias)) for weight, bias in layers]
        self._mean = np.asarray(policy.mean)
        self._scale = np.asarray(policy.scale)
        self._input = np.empty(layers[0][0].shape[1], np.float32)
        self._action = np.empty(count_of(policy.actions), np.float32)
        self._channels, first = [], 0
        for channel in policy.actions:
            rate, part = channel.rate_limit, slice(first, first + channel.count)
            change = None if rate is None else np.float32(policy.period * rate)
            self._channels.append((part, channel.shape, np.float32(channel.bound), change))
            first += channel.count

    def __call__(self, features: np.ndarray, command: np.ndarray) -> np.ndarray:
        """The next command from features (features,) and the command in force; both flat."""
        seen = self._input[: len(features)]
        np.subtract(features, self._mean, out=seen)
        np.divide(seen, self._scale, out=seen)
        shares = self._input[len(features) :]
        for part, _, limit, _ in self._channels:
            np.divide(command[part], limit, out=shares[part])
        values = self._input
        for number, (weight, bias, output) in enumerate(self._layers):
            if number:
                np.tanh(values, out=values)
            # Not a BLAS product: that would wait for a thread of its own on a busy core.
            np.einsum("ij,j->i", weight, values, out=output)
            values = np.add(output, bias, out=output)
        action = np.empty_like(self._action)
        for part, shape, limit, change in self._channels:
            vector = values[part].reshape(shape)
            moved = vector / np.sqrt(1 + np.sum(vector**2, axis=-1, keepdims=True))
            if change is None:
                moved *= limit
            else:
                moved = command[part].reshape(shape) + change * moved
                square = np.sum(moved**2, axis=-1, keepdims=True)
                moved *= limit / np.sqrt(np.maximum(square, limit**2))
            action[part] = moved.reshape(-1)
        return action


class ChannelDecision:
    """A policy that is shown exactly what it observes, channel by channel."""

    def __init__(self, policy: CommandPolicy):
        self._network, self._observed = NetworkDecision(policy), policy.observations
        self._features = np.zeros(count_of(policy.observations), np.float32)

    def forget(self) -> None:
        """See `palpate.deployment.supervisor.Decision.forget`: nothing is remembered."""

    def see(self, values: Values) -> None:
        """See `palpate.deployment.supervisor.Decision.see`."""
        _fill(self._features, self._observed, values)

    def decide(self, command: np.ndarray) -> np.ndarray:
        """See `palpate.deployment.supervisor.Decision.decide`."""
        return self._network(self._features, command)


class ActorDecision:
    """An actor, under its guard if it has one, that decides on every state as the policy does.

    What is not finite becomes a command that is not, at which a supervisor brakes.
    """

    def __init__(self, policy: ActorPolicy, scaling: Scaling):
        self._actor = ActorInNumpy(policy.actor, count_of(policy.actions))
        self._guard, self._threshold = None, 1.0
        if isinstance(policy, GuardedPolicy):
            self._guard, self._threshold = GuardInNumpy(policy.guard), policy.threshold
        self._scaling = scaling
        self._measured = np.zeros(count_of(scaling.sensors), np.float32)

    def forget(self) -> None:
        """See `palpate.deployment.supervisor.Decision.forget`: nothing is remembered."""

    def see(self, values: Values) -> None:
        """See `palpate.deployment.supervisor.Decision.see`."""
        _fill(self._measured, self._scaling.sensors, values)

    def decide(self, command: np.ndarray) -> np.ndarray:
        """See `palpate.deployment.supervisor.Decision.decide`."""
        features = self._scaling.features(self._measured[None])
        return self._scaling.command(self._guarded(features, self._actor(features))[0])[0]

    def _guarded(self, features: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, bool]:
        """The action (1, actions) in [-1, 1], the recovery's where it is risky, NaN where something
        is not finite; and whether it is another than the one given."""
        guard = self._guard
        risky = guard is not None and not guard.risk(features, action) <= self._threshold
        if guard is not None and risky:
            action = guard.recover(features)
        lost = not (np.isfinite(features).all() and np.isfinite(action).all())
        return (np.full_like(action, np.nan), True) if lost else (action, risky)


class ReflexDecision(ActorDecision):
    """An actor that decides at every `every`th state; at each its guard may interrupt the motion.

    As `palpate.safety.reflex.Reflex` asked as often as it may interrupt. `holds`: whether the last
    command is that of the motion that was under way.
    """

    def __init__(self, policy: ActorPolicy, scaling: Scaling, every: int):
        super().__init__(policy, scaling)
        self._every, self.holds = every, False
        self.forget()

    def forget(self) -> None:
        """See `palpate.deployment.supervisor.Decision.forget`: the next state is decided on."""
        self._left = 0

    def decide(self, command: np.ndarray) -> np.ndarray:
        """See `palpate.deployment.supervisor.Decision.decide`."""
        features, begins = self._scaling.features(self._measured[None]), self._left == 0
        if begins:
            self._left, self._under_way = self._every, self._actor(features)
        self._left -= 1
        self._under_way, interrupted = self._guarded(features, self._under_way)
        self.holds = not (begins or interrupted)
        return self._scaling.command(self._under_way)[0]


def _fill(flat: np.ndarray, channels: Sequence[Channel], values: Values) -> None:
    """The numbers of these channels, one after the other."""
    first = 0
    for channel in channels:
        value = values[channel.name]
        flat[first : first + value.size] = value.reshape(-1)
        first += value.size
