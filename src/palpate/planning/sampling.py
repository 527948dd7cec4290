"""Sampling MPC: at every decision many random plans are tried in a model, and the good ones kept.

Plans are curves as in `planning.command_curve`. That of the last decision, moved on by one control
period, is the middle of the next one's samples, and one of them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.planning.command_curve import CurvePlanner, Plan
from palpate.planning.decision_time import most_within

LEAST_SAMPLES = 16  # that `samples_within` starts from, and counts in


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


class SamplingPlanner(CurvePlanner):
    """MPPI or CEM through any model; see `CurvePlanner`.

    `shares` say, in turn, about how much of the plan samples are drawn: a plan would else keep what
    achieves nothing, such as parts of a wrench that cancel, and limited commands leave no room for
    what is needed. Samples of share 0 forget the plan and are one command each, the same at all
    knots: what sticks is loosened by one long push, which independent knots hardly ever make.
    """

    rule: Rule = eqx.field(static=True, kw_only=True)
    samples: int = eqx.field(static=True, default=64)
    iterations: int = eqx.field(static=True, default=1)
    deviation: float = eqx.field(static=True, default=0.5)  # of a sampled knot from the plan
    shares: tuple[float, ...] = eqx.field(static=True, default=(1.0,))  # the first is 1

    def __check_init__(self) -> None:
        counts = self.samples, self.iterations, self.knots, self.spacing
        if min(counts) < 1 or self.samples < 2 or self.knots < 2:
            raise PalpateError(
                "a sampling planner needs at least two samples, one iteration, two knots and one "
                f"period between them, got {', '.join(map(str, counts))}"
            )
        if self.shares[:1] != (1.0,):
            raise PalpateError(f"the first of the shares of a plan is 1, not {self.shares}")

    def _improve(self, plan: Plan, state: Any, goals: Any, key: PRNGKeyArray) -> Array:
        """The samples' weighted mean."""
        knots = plan.knots
        deviation = jnp.full_like(knots, self.deviation)
        share = jnp.resize(jnp.asarray(self.shares, knots.dtype), (self.samples,))
        share = share.reshape(-1, *(1,) * knots.ndim)
        for iteration in range(self.iterations):
            noise = jax.random.normal(
                jax.random.fold_in(key, iteration), (self.samples, *knots.shape), knots.dtype
            )
            noise = jnp.where(share == 0, noise[:, :1], noise).at[0].set(0.0)
            tried = share * knots + deviation * noise
            losses = self._losses(tried, plan.command, state, goals)
            weights = self.rule.weights(jnp.where(jnp.isfinite(losses), losses, jnp.inf))
            knots = jnp.tensordot(weights, tried, axes=1)
            if self.rule.narrows:
                deviation = jnp.sqrt(jnp.tensordot(weights, (tried - knots) ** 2, axes=1))
        return knots


def samples_within(
    budget: float, decision: Callable[[int], Callable[[], Any]]
) -> tuple[int, float]:
    """How many samples, a multiple of 16, fit into `budget` seconds a decision: `most_within`."""
    return most_within(budget, decision, "sample", LEAST_SAMPLES)
