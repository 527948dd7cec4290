"""What learns from remembered transitions: the contract between the loop and its agents."""

from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.learning.off_policy.buffer import Transition


class Batch(eqx.Module):
    """What one update learns from; what an agent does not use costs nothing."""

    task: Transition  # lived through in this training
    risk: Transition  # of all there are, a fixed share of them violating
    risk_weight: Float[Array, " n"]  # of each of those, as if all had been drawn evenly; mean 1
    episode_cost: Float[Array, ""]  # mean of the last episodes' summed costs; NaN before any ended


@runtime_checkable
class Agent(Protocol):
    """A frozen object; all that changes is in the state, a pytree of arrays.

    Actions lie in [-1, 1]. All methods are pure, and are called inside compiled functions.
    """

    def init(self, key: PRNGKeyArray, observation: int, action: int) -> Any:
        """The state before any update, for so many numbers seen and done."""
        ...

    def propose(
        self, state: Any, observation: Float[Array, "n features"], key: PRNGKeyArray | None
    ) -> Float[Array, "n actions"]:
        """What the policy would do: exploring with a key, without one at its best."""
        ...

    def guard(
        self,
        state: Any,
        observation: Float[Array, "n features"],
        proposed: Float[Array, "n actions"],
    ) -> Float[Array, "n actions"]:
        """What is executed in place of what is proposed: the same, unless it is overruled."""
        ...

    def update(
        self, state: Any, batch: Batch, key: PRNGKeyArray
    ) -> tuple[Any, dict[str, Float[Array, ""]]]:
        """The state after one update, and figures to log.

        An agent that learns ahead of its training has a `pretrain` besides, which takes and gives
        the same and for which `batch.risk` alone counts. One that interrupts what is under way has
        a `reflex`, which gives the guard of a state and its threshold; `batch.risk` are `Motion`s.
        """
        ...


def adam(learning_rate: float) -> optax.GradientTransformation:
    """The optimiser of every network here."""
    return optax.adam(learning_rate)


def descend(
    optimiser: optax.GradientTransformation, gradient: Any, moments: optax.OptState, values: Any
) -> tuple[Any, optax.OptState]:
    """The values after one step against the gradient, and the optimiser's state."""
    change, moments = optimiser.update(gradient, moments)
    return optax.apply_updates(values, change), moments


def follow(target: Any, values: Any, rate: float) -> Any:
    """The target moved by a share `rate` of the way towards the values."""
    return jax.tree.map(lambda old, new: old + rate * (new - old), target, values)


@jax.jit
def copy_arrays(values: Any) -> Any:
    """The same arrays in memory of their own: compiled calls overwrite a state in place."""
    return jax.tree.map(jnp.copy, values)
