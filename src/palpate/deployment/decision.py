"""A trained policy in NumPy: positions in, command out, without JAX in the loop.

Of NumPy, ONNX Runtime and JAX, asked one decision at a time on a busy machine, NumPy has the
shortest tail; `python -m benchmarks.serve` measures it.
"""

from typing import Any

import numpy as np

from palpate.deployment.contract import Contract
from palpate.errors import PalpateError
from palpate.networks import CommandPolicy, count_of


class NetworkDecision:
    """`CommandPolicy.__call__` for one observation; float32 as in JAX, buffers made beforehand."""

    def __init__(self, policy: CommandPolicy):
        layers = [(np.asarray(one.weight), np.asarray(one.bias)) for one in policy.network.layers]
        self._layers = [(weight, bias, np.empty_like(bias)) for weight, bias in layers]
        self._mean = np.asarray(policy.mean)
        self._scale = np.asarray(policy.scale)
        self._input = np.empty(layers[0][0].shape[1], np.float32)
        self._shape = policy.action_shape
        self._action = np.empty(count_of(policy.actions), np.float32)
        self._channels, first = [], 0
        for channel in policy.actions:
            rate, part = channel.rate_limit, slice(first, first + channel.count)
            change = None if rate is None else np.float32(policy.period * rate)
            self._channels.append((part, channel.shape, np.float32(channel.bound), change))
            first += channel.count

    def __call__(self, features: np.ndarray, command: np.ndarray) -> np.ndarray:
        """The next command (action_shape) from features (features,) and the command in force."""
        seen = self._input[: len(features)]
        np.subtract(features, self._mean, out=seen)
        np.divide(seen, self._scale, out=seen)
        before, shares = command.reshape(-1), self._input[len(features) :]
        for part, _, limit, _ in self._channels:
            np.divide(before[part], limit, out=shares[part])
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
                moved = before[part].reshape(shape) + change * moved
                square = np.sum(moved**2, axis=-1, keepdims=True)
                moved *= limit / np.sqrt(np.maximum(square, limit**2))
            action[part] = moved.reshape(-1)
        return action.reshape(self._shape)


class RopeDecision:
    """A rope's policy, fed as in training: node positions relative to the gripper and velocities.

    The nodes are the markers, or every second of them, and so on; at the gripper its encoder is
    believed, not its marker. Velocities are the contract's weighted sums of the last frames.

    Args:
        policy: trained for `palpate.tasks.RopeStabilization`.
        contract: of that policy.
        markers: how many a state has.

    Raises:
        PalpateError: the nodes of the policy do not fall on so many markers.
    """

    def __init__(self, policy: CommandPolicy, contract: Contract, markers: int):
        nodes = contract.features[0].shape[0] + 1
        self._every, rest = divmod(markers - 1, nodes - 1)
        if rest or not self._every:
            raise PalpateError(
                f"a policy for {nodes} nodes needs a multiple of {nodes - 1} markers and one more, "
                f"not {markers}"
            )
        self._network = NetworkDecision(policy)
        self._weights = np.asarray(contract.velocity_weights, np.float32)
        self._window = np.zeros((len(self._weights), nodes, 3), np.float32)
        self._features = np.empty((2, nodes - 1, 3), np.float32)
        self._started = False

    def forget(self) -> None:
        """See `palpate.deployment.supervisor.Decision.forget`: velocities start from rest."""
        self._started = False

    def see(self, gripper: np.ndarray, markers: np.ndarray) -> None:
        """See `palpate.deployment.supervisor.Decision.see`."""
        window = self._window
        window[:-1] = window[1:]
        window[-1] = markers[:: self._every]
        window[-1, 0] = gripper
        if not self._started:
            window[:-1] = window[-1]
            self._started = True

    def decide(self, command: np.ndarray) -> np.ndarray:
        """See `palpate.deployment.supervisor.Decision.decide`."""
        window = self._window
        positions, velocities = self._features
        np.subtract(window[-1, 1:], window[-1, :1], out=positions)
        np.einsum("f,fnc->nc", self._weights, window[:, 1:], out=velocities)
        return self._network(self._features.reshape(-1), command[None])[0]


def segment_lengths(contract: Contract, markers: int) -> np.ndarray:
    """Rest length (markers - 1,) in m between markers of the rope that the policy was trained on.

    Raises `PalpateError` where the contract does not say.
    """
    rows: list[dict[str, Any]] = contract.trained.get("model", [])
    lengths = [row["value"] for row in rows if row.get("name") == "rest_length"]
    if not lengths:
        raise PalpateError(
            "the policy does not say how long its rope's segments are: expected one that "
            "`palpate train rope-stabilization` wrote"
        )
    own = np.asarray(lengths[0], float)
    every = (markers - 1) // len(own)
    return np.repeat(own / every, every)
