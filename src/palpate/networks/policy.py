"""A network that changes a command within the limits of its channels."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.networks.channels import Channel, count_of
from palpate.networks.controller import DeclaredController, load_controller


class CommandPolicy(DeclaredController):
    """A tanh network whose output moves a command: no faster than a rate, no farther than a limit.

    With the network's output x, one vector along the last axis of each channel of the action,

        rate = rate_limit x / sqrt(1 + |x|^2)
        command = previous + period rate,  shortened to the length `limit`

    or, where the rate has no limit (`rate_limit` None), command = limit x / sqrt(1 + |x|^2). The
    previous command is carried, and seen by the network, as a share of its limits, beside the
    normalised observation. A goal is seen only as far as the task's observation expresses it.
    """

    network: eqx.nn.MLP
    mean: Float[Array, " features"]
    scale: Float[Array, " features"]
    observations: tuple[Channel, ...] = eqx.field(static=True)
    actions: tuple[Channel, ...] = eqx.field(static=True)
    period: float = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        key: PRNGKeyArray,
        examples: Float[Array, "samples features"],
        actions: Channel | Sequence[Channel],
        *,
        period: float,
        observations: Sequence[Channel] = (),
        width: int = 256,
        depth: int = 2,
    ) -> "CommandPolicy":
        """An untrained policy that hardly acts, normalised by examples of what it will see.

        `observations` are the features' channels (default: one, called "features"), `period` is in
        s; `depth` layers of `width` units. A feature that does not vary is only centred.

        Raises `PalpateError` for an action without a limit, and channels that are not the features.
        """
        actions = (actions,) if isinstance(actions, Channel) else tuple(actions)
        features, commands = examples.shape[-1], count_of(actions)
        observations = tuple(observations) or (Channel("features", (features,)),)
        if count_of(observations) != features:
            raise PalpateError(
                f"the policy's observations are described as {count_of(observations)} features "
                f"and its network sees {features}: expected as many"
            )
        if not all(channel.bound > 0 for channel in actions):
            raise PalpateError("the limit of an action is greater than 0")
        deviation = jnp.std(examples, axis=0)
        network = eqx.nn.MLP(
            features + commands, commands, width, depth, activation=jnp.tanh, key=key
        )
        # Near zero at first: a random feedback would shake the object into states of no interest.
        network = eqx.tree_at(
            lambda net: (net.layers[-1].weight, net.layers[-1].bias),
            network,
            replace_fn=lambda leaf: 0.1 * leaf,
        )
        return cls(
            network=network,
            mean=jnp.mean(examples, axis=0),
            scale=jnp.where(deviation > 1e-6, deviation, 1.0),
            observations=observations,
            actions=actions,
            period=period,
        )

    @property
    def action_shape(self) -> tuple[int, ...]:
        """Of what a call gives: the channel's, or flat where the action has several."""
        return self.actions[0].shape if len(self.actions) == 1 else (count_of(self.actions),)

    def settings(self, folder: Path) -> dict[str, Any]:
        """See `DeclaredController.settings`: the network's width and depth."""
        return {"width": self.network.width_size, "depth": self.network.depth}

    @classmethod
    def from_settings(cls, folder: Path, **settings: Any) -> "CommandPolicy":
        features = count_of(settings["observations"])
        return cls.create(jax.random.key(0), jnp.zeros((2, features)), **settings)

    def initial_carry(self, command: Array) -> Array:
        """The command itself; see `Controller.initial_carry`."""
        return command

    def __call__(
        self,
        carry: Array,
        observation: Float[Array, "*batch features"],
        goal: Any = None,
        key: Key[Array, "*batch"] | None = None,
    ) -> tuple[Array, Array]:
        """The command, as the next carry and as the action: (*batch, *action_shape)."""
        command = self._move(carry, self._direction(carry, observation))
        return command, command

    def similar(
        self,
        carry: Array,
        observation: Float[Array, "*batch features"],
        size: Float[Array, "*batch"],
    ) -> tuple[Array, Array]:
        """As a call, for an object `size` times as large that moves by gravity and inertia.

        By Froude's similarity (1868) its lengths are `size` times as long, its times and velocities
        sqrt(size) times, and its accelerations the same. `observation` is what the original would
        show in its place: lengths over `size`, velocities over its root. The command is a velocity
        with a rate limit; carry, action and limits are those of the object itself.

        Raises `PalpateError` where the rate of the command has no limit.
        """
        if any(channel.rate_limit is None for channel in self.actions):
            raise PalpateError(
                "similarity needs a policy whose network moves the command by an acceleration; "
                "the command of this one has no rate limit"
            )
        root = jnp.sqrt(size).reshape(*size.shape, *(1,) * (carry.ndim - size.ndim))
        command = self._move(carry, self._direction(carry / root, observation))
        return command, command

    def shares(
        self, command: Array, observation: Float[Array, "*batch features"]
    ) -> Float[Array, "*batch commands"]:
        """The command as shares of its limits, flat, for as many as there are observations."""
        shares = self._each(lambda channel, own: own / channel.bound, command)
        return shares.reshape(*observation.shape[:-1], -1)

    def _direction(self, carry: Array, observation: Array) -> Array:
        """Where the network moves the command: in each channel vectors shorter than 1."""
        mean, scale = jax.lax.stop_gradient((self.mean, self.scale))
        seen = (observation - mean) / scale
        network = jax.vmap(self.network) if observation.ndim == 2 else self.network
        output = network(jnp.concatenate([seen, self.shares(carry, observation)], axis=-1))
        return self._each(
            lambda _, own: own / jnp.sqrt(1.0 + jnp.sum(own**2, axis=-1, keepdims=True)),
            output.reshape(carry.shape),
        )

    def _move(self, carry: Array, direction: Array) -> Array:
        def move(channel: Channel, carry: Array, direction: Array) -> Array:
            if channel.rate_limit is None:
                return channel.bound * direction
            change = self.period * channel.rate_limit * direction
            return shorten(carry + change, channel.bound)

        return self._each(move, carry, direction)

    def _each(self, change: Callable[..., Array], *commands: Array) -> Array:
        """`change(channel, its part of each command)` of every channel, put together again."""
        if len(self.actions) == 1:
            return change(self.actions[0], *commands)
        changed, first, batch = [], 0, commands[0].shape[:-1]
        for channel in self.actions:
            parts = [command[..., first : first + channel.count] for command in commands]
            parts = [part.reshape(*batch, *channel.shape) for part in parts]
            changed.append(change(channel, *parts).reshape(*batch, -1))
            first += channel.count
        return jnp.concatenate(changed, axis=-1)


def shorten(vector: Array, limit: float) -> Array:
    """The vector itself up to the length `limit`, else the one of that length beside it."""
    squared = jnp.sum(vector**2, axis=-1, keepdims=True)
    # The inner maximum keeps the root, and its derivative, finite where the vector vanishes.
    return vector * (limit / jnp.sqrt(jnp.maximum(squared, limit**2)))


def load_policy(path: str | Path) -> tuple[CommandPolicy, dict[str, Any]]:
    """The network that `save_controller` wrote, and its manifest.

    Raises `PalpateError` for a controller of another kind, and as `load_controller`.
    """
    policy, manifest = load_controller(path)
    if not isinstance(policy, CommandPolicy):
        raise PalpateError(
            f"{path} holds a {manifest['controller']['kind']}: expected a network, as "
            "`palpate train` writes it"
        )
    return policy, manifest
