"""What decides: the contract of every policy, and a network that changes a command within limits.

A policy is a pure function of what it carries and what it sees, so the same object runs inside a
differentiated rollout, over a batch, and in a robot's control loop.
"""

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.runs.storage import load_arrays, read_manifest, save_arrays

_KIND = "command policy"


class Policy(eqx.Module):
    """The contract: `(carry, observation, goal, key) -> (carry, action)`, with or without a batch.

    `observation` is (*batch, features) as the task that the policy was trained for gives it,
    `goal` what the task asks for (None where nothing varies) and `key` randomness, for policies
    that use any (None otherwise). A batch is one leading axis of everything.
    """

    @abstractmethod
    def initial_carry(self, command: Array) -> Any:
        """What to carry into the first call.

        `command`, (*batch, *action_shape), is the action in force when the policy takes over:
        zero for a robot at rest.
        """

    @abstractmethod
    def __call__(
        self, carry: Any, observation: Array, goal: Any, key: Key[Array, "*batch"] | None
    ) -> tuple[Any, Array]:
        """The next carry, and the action to hold for one control period."""


class CommandPolicy(Policy):
    """A tanh network whose output moves a command: no faster than a rate, no farther than a limit.

    With the network's output x, one vector along the last axis of the action,

        rate = rate_limit x / sqrt(1 + |x|^2)
        command = previous + period rate,  shortened to the length `limit`

    or, where the rate has no limit (`rate_limit` None), command = limit x / sqrt(1 + |x|^2). The
    previous command is carried, and seen by the network beside the normalised observation. Limits
    hold for the Euclidean norm, in the action's unit and that per second. A goal is seen only as
    far as the task's observation expresses it.
    """

    network: eqx.nn.MLP
    mean: Float[Array, " features"]
    scale: Float[Array, " features"]
    action_shape: tuple[int, ...] = eqx.field(static=True)
    period: float = eqx.field(static=True)
    limit: float = eqx.field(static=True)
    rate_limit: float | None = eqx.field(static=True)

    @classmethod
    def create(
        cls,
        key: PRNGKeyArray,
        observations: Float[Array, "samples features"],
        action_shape: tuple[int, ...],
        *,
        period: float,
        limit: float,
        rate_limit: float | None = None,
        width: int = 256,
        depth: int = 2,
    ) -> "CommandPolicy":
        """An untrained policy that hardly acts, normalised by examples of what it will see.

        `period` is in s, `limit` in the action's unit and `rate_limit` in that per second; `depth`
        layers of `width` units. A feature that does not vary in the examples is only centred.
        """
        deviation = jnp.std(observations, axis=0)
        features = observations.shape[-1]
        commands = int(np.prod(action_shape))
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
            mean=jnp.mean(observations, axis=0),
            scale=jnp.where(deviation > 1e-6, deviation, 1.0),
            action_shape=tuple(action_shape),
            period=period,
            limit=limit,
            rate_limit=rate_limit,
        )

    def initial_carry(self, command: Array) -> Array:
        """The command itself; see `Policy.initial_carry`."""
        return command

    def __call__(
        self,
        carry: Array,
        observation: Float[Array, "*batch features"],
        goal: Any = None,
        key: Key[Array, "*batch"] | None = None,
    ) -> tuple[Array, Array]:
        """The command, as the next carry and as the action: (*batch, *action_shape)."""
        command = self._moved(carry, self._direction(carry, observation))
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
        if self.rate_limit is None:
            raise PalpateError(
                "similarity needs a policy whose network moves the command by an acceleration; "
                "the command of this one has no rate limit"
            )
        root = jnp.sqrt(size).reshape(*size.shape, *(1,) * (carry.ndim - size.ndim))
        command = self._moved(carry, self._direction(carry / root, observation))
        return command, command

    def _direction(self, carry: Array, observation: Array) -> Array:
        """Where the network moves the command: a vector shorter than 1."""
        mean, scale = jax.lax.stop_gradient((self.mean, self.scale))
        seen = (observation - mean) / scale
        previous = carry.reshape(*observation.shape[:-1], -1) / self.limit
        network = jax.vmap(self.network) if observation.ndim == 2 else self.network
        output = network(jnp.concatenate([seen, previous], axis=-1)).reshape(carry.shape)
        return output / jnp.sqrt(1.0 + jnp.sum(output**2, axis=-1, keepdims=True))

    def _moved(self, carry: Array, direction: Array) -> Array:
        if self.rate_limit is None:
            return self.limit * direction
        return _shorten(carry + self.period * self.rate_limit * direction, self.limit)


def _shorten(vector: Array, limit: float) -> Array:
    """The vector itself up to the length `limit`, else the one of that length beside it."""
    squared = jnp.sum(vector**2, axis=-1, keepdims=True)
    # The inner maximum keeps the root, and its derivative, finite where the vector vanishes.
    return vector * (limit / jnp.sqrt(jnp.maximum(squared, limit**2)))


def save_policy(path: str | Path, policy: CommandPolicy, manifest: Mapping[str, Any]) -> None:
    """Write a policy as safetensors; its sizes, rate and limits join the manifest in the header.

    `manifest` says what else a user must know: task, features, units, what it was trained on.
    """
    own = {
        "kind": _KIND,
        "features": policy.mean.shape[0],
        "width": policy.network.width_size,
        "depth": policy.network.depth,
        "action_shape": policy.action_shape,
        "period": policy.period,
        "limit": policy.limit,
        "rate_limit": policy.rate_limit,
    }
    save_arrays(path, policy, {**manifest, "policy": own})


def load_policy(path: str | Path) -> tuple[CommandPolicy, dict[str, Any]]:
    """The policy that `save_policy` wrote, and its manifest.

    Raises `PalpateError` when the file holds something else, `DamagedFileError` when it is
    damaged.
    """
    own = read_manifest(path).get("policy")
    if not isinstance(own, dict) or own.get("kind") != _KIND:
        raise PalpateError(
            f"{path} holds no policy: expected a file written by `palpate train` or `save_policy`"
        )
    try:
        like = eqx.filter_eval_shape(
            CommandPolicy.create,
            jax.random.key(0),
            jax.ShapeDtypeStruct((2, own["features"]), jnp.float32),
            action_shape=tuple(own["action_shape"]),
            period=own["period"],
            limit=own["limit"],
            rate_limit=own["rate_limit"],
            width=own["width"],
            depth=own["depth"],
        )
    except (KeyError, TypeError) as error:
        raise PalpateError(f"{path} does not say which network it holds: {error}") from error
    return load_arrays(path, like)
