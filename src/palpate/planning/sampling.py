"""Sampling MPC: at every decision many random plans are tried in a model, and the good ones kept.

A plan is a curve through a few knots x, interpolated linearly over the horizon, that becomes
commands within their limits as in `networks.CommandPolicy`:

    rate = rate_limit x / sqrt(1 + |x|^2),    command <- command + period rate, shortened to `limit`

or command = limit x / sqrt(1 + |x|^2) where the rate has no limit. The plan of the last decision,
moved on by one control period, is the middle of the next one's samples, and one of them.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.models.model import Model

StageLoss = Callable[[Any, Array, Any], Float[Array, " samples"]]

LEAST_SAMPLES = 16  # that `samples_within` starts from, and counts in
TIMED = 20  # decisions that it times


@runtime_checkable
class Rule(Protocol):
    """How samples are weighed, and whether the next iteration looks only where they were good."""

    narrows: bool

    def weights(self, losses: Float[Array, " samples"]) -> Float[Array, " samples"]:
        """Summing to 1; zero where a loss is infinite, unless all are."""
        ...


@dataclass(frozen=True)
class Mppi:
    """Weights exp(-loss / lambda), normalised (Williams et al. 2018, IEEE T-RO 34:1603-1622).

    lambda is `temperature` times the distance from the best loss to the median, so that it suits
    losses of any unit.
    """

    temperature: float = 0.1
    narrows = False

    def weights(self, losses: Float[Array, " samples"]) -> Float[Array, " samples"]:
        """See `Rule.weights`."""
        finite = jnp.isfinite(losses)
        above = losses - jnp.min(losses)
        middle = jnp.nanmedian(jnp.where(finite, above, jnp.nan))
        return jax.nn.softmax(jnp.where(finite, -above / (self.temperature * middle + 1e-12), -1e9))


@dataclass(frozen=True)
class Cem:
    """Equal weights for the best (cross-entropy method, Rubinstein 1999; Kobilarov 2012)."""

    elites: float = 0.1  # share of the samples
    narrows = True

    def weights(self, losses: Float[Array, " samples"]) -> Float[Array, " samples"]:
        """See `Rule.weights`."""
        count = max(2, round(self.elites * losses.shape[0]))
        _, best = jax.lax.top_k(-losses, count)
        return jnp.zeros_like(losses).at[best].set(1.0 / count)


class Plan(eqx.Module):
    """What a planner carries from one decision to the next."""

    knots: Float[Array, "knots *action"]
    command: Array  # in force, in the action's unit
    key: PRNGKeyArray


class SamplingPlanner(eqx.Module):
    """MPPI or CEM through any model: `init` once, then call it in every control period.

    `stage_loss(states, commands, goal)` gives the loss of one instant for each of many states,
    (samples,), after a control period with these commands. `goal` is what is asked for at that
    instant. Limits are as in `tasks.Task`.
    """

    model: Model
    stage_loss: StageLoss = eqx.field(static=True)
    rule: Rule = eqx.field(static=True)
    limit: float = eqx.field(static=True)
    rate_limit: float | None = eqx.field(static=True)
    samples: int = eqx.field(static=True, default=64)
    iterations: int = eqx.field(static=True, default=1)
    knots: int = eqx.field(static=True, default=8)
    spacing: int = eqx.field(static=True, default=10)  # control periods from knot to knot
    deviation: float = eqx.field(static=True, default=0.5)  # of a sampled knot from the plan

    def __check_init__(self) -> None:
        counts = self.samples, self.iterations, self.knots, self.spacing
        if min(counts) < 1 or self.samples < 2 or self.knots < 2:
            raise PalpateError(
                "a sampling planner needs at least two samples, one iteration, two knots and one "
                f"period between them, got {', '.join(map(str, counts))}"
            )

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
        knots = plan.knots
        deviation = jnp.full_like(knots, self.deviation)
        for iteration in range(self.iterations):
            noise = jax.random.normal(
                jax.random.fold_in(key, iteration), (self.samples, *knots.shape), knots.dtype
            )
            tried = knots + deviation * noise.at[0].set(0.0)
            losses = self._losses(tried, plan.command, state, goals)
            weights = self.rule.weights(jnp.where(jnp.isfinite(losses), losses, jnp.inf))
            knots = jnp.tensordot(weights, tried, axes=1)
            if self.rule.narrows:
                deviation = jnp.sqrt(jnp.tensordot(weights, (tried - knots) ** 2, axes=1))
        command = self._command(knots[0], plan.command)
        return Plan(self._curve(knots, 1.0), command, following), command

    def _losses(self, tried: Array, command: Array, state: Any, goals: Any) -> Array:
        """The summed stage losses of each sample."""

        def many(leaf: Array) -> Array:
            return jnp.broadcast_to(leaf, (self.samples, *leaf.shape))

        def advance(motion: tuple[Any, Array, Array], goal: tuple[Array, Any]):
            states, commands, total = motion
            place, asked = goal
            commands = self._command(_between(tried, place, axis=1), commands)
            states = self.model.step(states, commands)
            return (states, commands, total + self.stage_loss(states, commands, asked)), None

        start = jax.tree.map(many, state), many(command), jnp.zeros(self.samples, tried.dtype)
        places = jnp.arange(self.horizon) / self.spacing
        (_, _, total), _ = jax.lax.scan(advance, start, (places, goals))
        return total

    def _command(self, knot: Array, command: Array) -> Array:
        """The command after one control period; see the module."""
        squared = jnp.sum(knot**2, axis=-1, keepdims=True)
        direction = knot / jnp.sqrt(1.0 + squared)
        if self.rate_limit is None:
            return self.limit * direction
        command = command + self.model.control_period * self.rate_limit * direction
        length = jnp.sqrt(jnp.sum(command**2, axis=-1, keepdims=True))
        return command * (self.limit / jnp.maximum(length, self.limit))

    def _curve(self, knots: Array, periods: float) -> Array:
        """The same curve from that many control periods later on; its end is held."""
        places = jnp.arange(self.knots) + periods / self.spacing
        return jax.vmap(lambda place: _between(knots, place, axis=0))(places)


def _between(knots: Array, place: Array, axis: int) -> Array:
    """Knots interpolated at a `place` counted in knots."""
    last = knots.shape[axis] - 1
    before = jnp.clip(jnp.floor(place).astype(int), 0, last - 1)
    share = jnp.minimum(place - before, 1.0)
    first = jax.lax.dynamic_index_in_dim(knots, before, axis, keepdims=False)
    second = jax.lax.dynamic_index_in_dim(knots, before + 1, axis, keepdims=False)
    return (1.0 - share) * first + share * second


def samples_within(
    budget: float, decision: Callable[[int], Callable[[], Any]]
) -> tuple[int, float]:
    """How many samples fit into `budget` seconds a decision, and the seconds that those take.

    `decision(samples)` makes a function without arguments that takes one decision with so many.
    The number, a multiple of 16, is doubled and then narrowed down until the fastest quarter of
    some decisions is just within the budget: what else runs on a machine only adds.

    Raises `PalpateError` when not even 16 fit.
    """

    def takes(samples: int) -> float:
        decide = decision(samples)
        jax.block_until_ready(decide())  # compiles
        spent = []
        for _ in range(TIMED):
            began = time.perf_counter()
            jax.block_until_ready(decide())
            spent.append(time.perf_counter() - began)
        return float(np.quantile(spent, 0.25))

    units, took = 1, takes(LEAST_SAMPLES)
    if took > budget:
        raise PalpateError(
            f"{LEAST_SAMPLES} samples already take {1e3 * took:.1f} ms a decision, more than the "
            f"{1e3 * budget:.1f} ms allowed: shorten the horizon or simplify the model"
        )
    fits, beyond = (units, took), None
    while beyond is None or beyond - fits[0] > max(1, fits[0] // 8):
        units = 2 * fits[0] if beyond is None else (fits[0] + beyond) // 2
        took = takes(units * LEAST_SAMPLES)
        if took <= budget:
            fits = units, took
        else:
            beyond = units
    return fits[0] * LEAST_SAMPLES, fits[1]
