"""Networks evaluated by NumPy: for a few rows at a control rate, without JAX.

That takes less than half as long as a compiled call, and waits for no other that is in flight.
"""

import numpy as np
from jaxtyping import Float

from palpate.networks.actor import DeterministicActor, GaussianActor, Perceptron
from palpate.networks.guarded import Guard


class ActorInNumpy:
    """What an actor does at its best; its weights are copied."""

    def __init__(self, actor: GaussianActor | DeterministicActor, actions: int):
        self._layers, self._actions = layers_of(actor.network), actions

    def __call__(self, features: Float[np.ndarray, "rows features"]) -> np.ndarray:
        """(rows, actions) in [-1, 1]; not finite where what it sees is not."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.tanh(values_of(self._layers, features)[:, : self._actions])


class GuardInNumpy:
    """What a guard says; its weights are copied."""

    def __init__(self, guard: Guard):
        self._seen = slice(None) if guard.seen is None else list(guard.seen)
        self._critic = layers_of(guard.critic.network)
        self._recovery = layers_of(guard.recovery.network)

    def risk(
        self,
        features: Float[np.ndarray, "rows features"],
        action: Float[np.ndarray, "rows actions"],
    ) -> np.ndarray:
        """(rows,), not finite where what it sees or does is not."""
        inputs = np.concatenate([features[:, self._seen], action.astype(np.float32)], axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            return (1.0 / (1.0 + np.exp(-values_of(self._critic, inputs)[..., 0]))).max(axis=0)

    def recover(self, features: Float[np.ndarray, "rows features"]) -> np.ndarray:
        """The recovery's actions (rows, actions)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.tanh(values_of(self._recovery, features[:, self._seen]))


Layers = list[tuple[np.ndarray, np.ndarray]]


def layers_of(network: Perceptron) -> Layers:
    """A network's weights, and its biases with an axis for rows; they are copied."""
    pairs = zip(network.weights, network.biases, strict=True)
    return [(np.array(weight), np.array(bias)[..., None, :]) for weight, bias in pairs]


def values_of(layers: Layers, inputs: np.ndarray) -> np.ndarray:
    """Outputs (..., rows, outputs) of inputs (rows, inputs), see `Perceptron.__call__`."""
    values = inputs
    for number, (weight, bias) in enumerate(layers):
        values = np.maximum(values, 0.0) if number else values
        values = values @ weight + bias
    return values
