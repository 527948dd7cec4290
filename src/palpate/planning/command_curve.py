"""What plans consist of: curves through a few knots that become commands within their limits.

A curve x is interpolated linearly between its knots over the horizon, and becomes commands as in
`networks.CommandPolicy`:

    rate = rate_limit x / sqrt(1 + |x|^2),    command <- command + period rate, shortened to `limit`

or command = limit x / sqrt(1 + |x|^2) where the rate has no limit. The plan of one decision, moved
on by one control period, is where the next decision starts.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.models.model import Model

StageLoss = Callable[[Any, Array, Any], Float[Array, " plans"]]


class Plan(eqx.Module):
    """What a planner carries from one decision to the next."""

    knots: Float[Array, "knots *action"]
    command: Array  # in force, in the action's unit
    key: PRNGKeyArray


class CurvePlanner(eqx.Module):
    """A planner through any model: `init` once, then call it in every control period.

    `stage_loss(states, commands, goal)` gives the losses (plans,) of many states after a control
    period with these commands; `goal` is what is asked for then. Limits are as in `tasks.Task`.
    """

    model: Model
    stage_loss: StageLoss = eqx.field(static=True)
    limit: float = eqx.field(static=True)
    rate_limit: float | None = eqx.field(static=True)
    knots: int = eqx.field(static=True, default=8)
    spacing: int = eqx.field(static=True, default=10)  # control periods from knot to knot

    @property
    def horizon(self) -> int:
        """Control periods that a plan looks ahead."""
        return (self.knots - 1) * self.spacing

    def init(self, command: Array, key: PRNGKeyArray) -> Plan:
        """Before the first decision: `command`, of the model's action shape, is in force."""
        return Plan(jnp.zeros((self.knots, *command.shape), command.dtype), command, key)

    @eqx.filter_jit
    def __call__(self, plan: Plan, state: Any, goals: Any) -> tuple[Plan, Array]:
        """The plan moved on by one control period, and the command to hold for that period.

        `state` is that of the model without a batch axis; each leaf of `goals` leads with an axis
        of `horizon` instants, the first of which is one control period from now (None: no goal).
        """
        key, following = jax.random.split(plan.key)
        knots = self._improve(plan, state, goals, key)
        command = self._command(knots[0], plan.command)
        return Plan(self._curve(knots, 1.0), command, following), command

    @abstractmethod
    def _improve(self, plan: Plan, state: Any, goals: Any, key: PRNGKeyArray) -> Array:
        """Better knots than those of the plan."""

    def _losses(self, tried: Array, command: Array, state: Any, goals: Any) -> Array:
        """The summed stage losses of each of many curves (plans, knots, *action)."""

        def advance(motion: tuple[Any, Array, Array], goal: tuple[Array, Any]):
            states, commands, total = motion
            place, asked = goal
            states, commands = self._move(states, commands, tried, place)
            return (states, commands, total + self.stage_loss(states, commands, asked)), None

        count = tried.shape[0]
        start = *many((state, command), count), jnp.zeros(count, tried.dtype)
        (_, _, total), _ = jax.lax.scan(advance, start, (self._places(), goals))
        return total

    def _move(self, states: Any, commands: Array, tried: Array, place: Array) -> tuple[Any, Array]:
        """States and commands one control period later, at a `place` on each curve."""
        commands = self._command(_between(tried, place, axis=1), commands)
        return self.model.step(states, commands), commands

    def _places(self) -> Array:
        """Where on the curve each control period of the horizon begins, counted in knots."""
        return jnp.arange(self.horizon) / self.spacing

    def _command(self, knot: Array, command: Array) -> Array:
        """The command after one control period; see the module."""
        squared = jnp.sum(knot**2, axis=-1, keepdims=True)
        direction = knot / jnp.sqrt(1.0 + squared)
        if self.rate_limit is None:
            return self.limit * direction
        command = command + self.model.control_period * self.rate_limit * direction
        squared = jnp.sum(command**2, axis=-1, keepdims=True)
        # The inner maximum keeps the root's derivative finite where the command vanishes.
        return command * (self.limit / jnp.sqrt(jnp.maximum(squared, self.limit**2)))

    def _curve(self, knots: Array, periods: float) -> Array:
        """The same curve from that many control periods later on; its end is held."""
        places = jnp.arange(self.knots) + periods / self.spacing
        return jax.vmap(lambda place: _between(knots, place, axis=0))(places)


def many(tree: Any, count: int) -> Any:
    """The same `count` times, along a leading batch axis of every leaf."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), tree)


def _between(knots: Array, place: Array, axis: int) -> Array:
    """Knots interpolated at a `place` counted in knots."""
    last = knots.shape[axis] - 1
    before = jnp.clip(jnp.floor(place).astype(int), 0, last - 1)
    share = jnp.minimum(place - before, 1.0)
    first = jax.lax.dynamic_index_in_dim(knots, before, axis, keepdims=False)
    second = jax.lax.dynamic_index_in_dim(knots, before + 1, axis, keepdims=False)
    return (1.0 - share) * first + share * second
