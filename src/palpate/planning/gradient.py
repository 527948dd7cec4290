"""Gradient MPC: at every decision the plan is improved along derivatives taken through the model.

Plans are curves as in `planning.command_curve`; z are all their knots. Along a plan the states and
commands y_t of every control period and their derivatives J_t = dy_t / dz are carried forward
together, and the summed stage losses l become a quadratic of which the minimum is sought:

    slope g = sum_t J_t^T dl/dy_t,    curvature G = sum_t J_t^T (d^2 l / dy_t^2) J_t
    step = -V (|Lambda| + damping)^-1 V^T g    with G = V Lambda V^T

This is the step of iLQR (Tassa, Erez, Todorov 2012, IROS), which leaves out the curvature of the
dynamics as well: Gauss-Newton through a shooting of the dynamics (Giftthaler et al. 2018, IROS,
arXiv 1711.11006). iLQR solves for every control period backwards in time, with the Jacobian in all
directions of the state; here only the directions of a few knots are needed, which is far less work
for a large state and a smooth plan. Limits are in the curve itself, so that no step leaves them.

Many dampings are tried in the model side by side (Marquardt 1963, with a parallel line search as in
Tassa et al.) and the best is taken, or the plan as it was: no iteration makes a plan worse. One
iteration for each decision is the real-time iteration of Diehl, Bock and Schloeder (2005, SIAM J.
Control Optim. 43:1714-1736).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.planning.command_curve import CurvePlanner, Plan, many
from palpate.planning.decision_time import most_within

# Of the largest curvature, apart from the plan as it was: sixteen plans are tried in all.
DAMPINGS = np.logspace(-6, 1, 15)


class GradientPlanner(CurvePlanner):
    """Gauss-Newton on a plan's knots, through any model and with any twice differentiable loss.

    See `CurvePlanner`; chance plays no part, so that the key of `init` makes no difference. What
    is not finite, in a state or in what comes of it, is no improvement: the plan is carried on.
    """

    iterations: int = eqx.field(static=True, default=1)

    def __check_init__(self) -> None:
        counts = self.iterations, self.knots, self.spacing
        if min(counts) < 1 or self.knots < 2:
            raise PalpateError(
                "a gradient planner needs at least one iteration, two knots and one period "
                f"between them, got {', '.join(map(str, counts))}"
            )

    def _improve(self, plan: Plan, state: Any, goals: Any, key: PRNGKeyArray) -> Array:
        """The best plan along the way."""

        def iterate(_, knots: Array) -> Array:
            slope, curvature = self._expansion(knots, plan.command, state, goals)
            tried = knots + _steps(slope, curvature).reshape(-1, *knots.shape)
            losses = self._losses(tried, plan.command, state, goals)
            return tried[jnp.argmin(jnp.where(jnp.isfinite(losses), losses, jnp.inf))]

        return jax.lax.fori_loop(0, self.iterations, iterate, plan.knots)

    def _expansion(
        self, knots: Array, command: Array, state: Any, goals: Any
    ) -> tuple[Float[Array, " z"], Float[Array, "z z"]]:
        """Slope and curvature of the summed stage losses; see the module.

        One copy of the plan for each number in its knots, all alike, carries the derivative to
        that number: a batch is what a model is fastest at.
        """
        size = knots.size
        towards = jnp.eye(size, dtype=knots.dtype).reshape(size, *knots.shape)
        copies = many(knots, size)

        def advance(motion, goal):
            reached, tangents, slope, curvature = motion
            place, asked = goal
            reached, tangents = jax.jvp(
                lambda states, commands, tried: self._move(states, commands, tried, place),
                (*reached, copies),
                (*tangents, towards),
            )

            def loss(states, commands):
                return jnp.sum(self.stage_loss(states, commands, asked))

            gradient, change = jax.jvp(jax.grad(loss, argnums=(0, 1)), reached, tangents)
            slope = slope + jnp.sum(_rows(tangents) * _rows(gradient), axis=1)
            curvature = curvature + _rows(tangents) @ _rows(change).T
            return (reached, tangents, slope, curvature), None

        start = many((state, command), size)
        still = jax.tree.map(jnp.zeros_like, start)
        slope = jnp.zeros(size, knots.dtype)
        curvature = jnp.zeros((size, size), knots.dtype)
        (_, _, slope, curvature), _ = jax.lax.scan(
            advance, (start, still, slope, curvature), (self._places(), goals)
        )
        return slope, curvature


def _steps(slope: Array, curvature: Array) -> Float[Array, "plans z"]:
    """No step, and one for each damping."""
    bends, directions = jnp.linalg.eigh(0.5 * (curvature + curvature.T))
    bends = jnp.abs(bends)  # a saddle is left along its downward slope, not climbed
    damped = bends + DAMPINGS[:, None].astype(slope.dtype) * (jnp.max(bends) + 1e-12)
    steps = -(slope @ directions / damped) @ directions.T
    return jnp.concatenate([jnp.zeros_like(steps[:1]), steps])


def _rows(tree: Any) -> Float[Array, "copies numbers"]:
    leaves = jax.tree.leaves(tree)
    return jnp.concatenate([leaf.reshape(leaf.shape[0], -1) for leaf in leaves], axis=1)


def iterations_within(
    budget: float, decision: Callable[[int], Callable[[], Any]]
) -> tuple[int, float]:
    """How many iterations fit into `budget` seconds a decision: `most_within`."""
    return most_within(budget, decision, "iteration")
