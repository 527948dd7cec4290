"""Between a robot's units and the numbers about 1 that an actor sees and gives."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from palpate.networks import Channel, DeclaredController, count_of


@dataclass(frozen=True, eq=False)
class Scaling:
    """Channels of an actor in a robot's units, and what makes them numbers about 1.

        features = measured / scale
        command = low + (high - low) (action + 1) / 2,  action in [-1, 1]

    A command is then shortened, vector by vector, to where it lies no farther from `rest` than its
    channel's limit. `rest` is the command of a robot that brakes. Scale (features,), the others
    (actions,); in the channels' units, in their order.
    """

    sensors: tuple[Channel, ...]
    actions: tuple[Channel, ...]
    scale: Float[np.ndarray, " features"]
    low: Float[np.ndarray, " actions"]
    high: Float[np.ndarray, " actions"]
    rest: Float[np.ndarray, " actions"]

    @classmethod
    def none(cls, policy: DeclaredController) -> "Scaling":
        """For a robot that speaks as the policy does; it rests at zeros."""
        features, one = np.ones(count_of(policy.observations)), np.ones(count_of(policy.actions))
        return cls(policy.observations, policy.actions, features, -one, one, 0 * one)

    def features(self, measured: Float[np.ndarray, "*batch features"]) -> np.ndarray:
        """What the policy sees of what was measured; float32."""
        return np.asarray(measured, np.float32) / self.scale.astype(np.float32)

    @property
    def stretch(self) -> tuple[np.ndarray, np.ndarray]:
        """How far an action of zeros lies from rest, and one of ones from that; (actions,) each."""
        return (self.low + self.high) / 2 - self.rest, (self.high - self.low) / 2

    def command(self, action: Float[np.ndarray, "*batch actions"]) -> np.ndarray:
        """What the robot is told, flat; float32."""
        middle, half = self.stretch
        away, first = middle + half * np.asarray(action, float), 0
        for channel in self.actions:
            part = slice(first, first + channel.count)
            if channel.limit is not None:
                vectors = away[..., part].reshape(-1, *channel.shape)
                length = np.sqrt(np.sum(vectors**2, axis=-1, keepdims=True))
                vectors = vectors * (channel.limit / np.maximum(length, channel.limit))
                away[..., part] = vectors.reshape(away[..., part].shape)
            first += channel.count
        return (self.rest + away).astype(np.float32)
