"""Networks of actors and critics: what acts within [-1, 1], and what values an action.

A perceptron is kept as plain arrays, inputs before outputs, and may lead with an axis of members:
two critics are one network whose weights have the shape (2, inputs, outputs).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

LOG_DEVIATIONS = (-20.0, 2.0)  # bounds of a Gaussian actor's: those of Haarnoja et al., 1812.05905


class Perceptron(eqx.Module):
    """Layers with ReLU between them: (*batch, inputs) to (*batch, outputs).

    With members, (batch, inputs) to (members, batch, outputs): each has weights of its own.
    """

    weights: tuple[Array, ...]  # each (*members, inputs, outputs)
    biases: tuple[Array, ...]  # each (*members, outputs)

    @classmethod
    def create(
        cls, key: PRNGKeyArray, sizes: Sequence[int], members: tuple[int, ...] = ()
    ) -> "Perceptron":
        """Random weights, uniform within one over the root of the inputs, and biases of 0."""
        keys = jax.random.split(key, len(sizes) - 1)
        weights = tuple(
            jax.random.uniform(one, (*members, inputs, outputs), jnp.float32, -1.0, 1.0)
            / inputs**0.5
            for one, inputs, outputs in zip(keys, sizes[:-1], sizes[1:], strict=True)
        )
        return cls(weights, tuple(jnp.zeros((*members, outputs)) for outputs in sizes[1:]))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Of the inputs, the layers between, and the outputs."""
        return (self.weights[0].shape[-2], *(weight.shape[-1] for weight in self.weights))

    def __call__(self, inputs: Array) -> Array:
        values = inputs
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = jax.nn.relu(values) if number else values
            values = values @ weight + (bias[..., None, :] if bias.ndim > 1 else bias)
        return values


class GaussianActor(eqx.Module):
    """A Gaussian squashed by tanh into [-1, 1] (soft actor-critic, Haarnoja et al., 1812.05905)."""

    network: Perceptron

    @classmethod
    def create(
        cls, key: PRNGKeyArray, observation: int, action: int, width: int, depth: int
    ) -> "GaussianActor":
        """Untrained, for so many numbers seen and done; `depth` layers of `width` units."""
        return cls(Perceptron.create(key, (observation, *(width,) * depth, 2 * action)))

    def mean(self, observation: Float[Array, "*batch features"]) -> Float[Array, "*batch actions"]:
        """What it does when it does not explore: the squashed mean."""
        return jnp.tanh(jnp.split(self.network(observation), 2, axis=-1)[0])

    def sample(
        self, observation: Float[Array, "*batch features"], key: PRNGKeyArray
    ) -> tuple[Float[Array, "*batch actions"], Float[Array, "*batch"]]:
        """A random action, and the logarithm of its density."""
        mean, log_deviation = jnp.split(self.network(observation), 2, axis=-1)
        log_deviation = jnp.clip(log_deviation, *LOG_DEVIATIONS)
        normal = jax.random.normal(key, mean.shape, mean.dtype)
        before = mean + jnp.exp(log_deviation) * normal
        # log (1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)), which does not lose its digits.
        squashed = 2.0 * (jnp.log(2.0) - before - jax.nn.softplus(-2.0 * before))
        density = -0.5 * normal**2 - log_deviation - 0.5 * jnp.log(2.0 * jnp.pi) - squashed
        return jnp.tanh(before), jnp.sum(density, axis=-1)


class DeterministicActor(eqx.Module):
    """One action for each observation, squashed by tanh into [-1, 1]."""

    network: Perceptron

    @classmethod
    def create(
        cls, key: PRNGKeyArray, observation: int, action: int, width: int, depth: int
    ) -> "DeterministicActor":
        """See `GaussianActor.create`."""
        return cls(Perceptron.create(key, (observation, *(width,) * depth, action)))

    def mean(self, observation: Float[Array, "*batch features"]) -> Float[Array, "*batch actions"]:
        """What it does."""
        return jnp.tanh(self.network(observation))


class Critic(eqx.Module):
    """Several values of an action in a situation, of networks with different starts."""

    network: Perceptron

    @classmethod
    def create(
        cls,
        key: PRNGKeyArray,
        observation: int,
        action: int,
        width: int,
        depth: int,
        members: int = 2,
    ) -> "Critic":
        """Untrained; see `GaussianActor.create`."""
        sizes = (observation + action, *(width,) * depth, 1)
        return cls(Perceptron.create(key, sizes, (members,)))

    def __call__(
        self, observation: Float[Array, "*batch features"], action: Float[Array, "*batch actions"]
    ) -> Float[Array, "members *batch"]:
        inputs = jnp.concatenate([observation, action], axis=-1)
        flat = self.network(inputs.reshape(-1, inputs.shape[-1]))
        return flat.reshape(flat.shape[0], *inputs.shape[:-1])
