"""A policy in closed loop sees a goal that moves on with time."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from palpate.learning import simulate
from palpate.tasks.task import Start
from toys import Cart, CartState, CartToOrigin

CART = Cart(jnp.ones(3), jnp.full(3, 0.5))


class Follow(CartToOrigin):
    """The goal is a position for each control period."""

    def goal_at(self, goal, step):
        return goal[:, step][:, None]

    def features(self, state, goal):
        return goal


class Echo(eqx.Module):
    """What is seen, as it is: to see what that was."""

    period: ClassVar[None] = None
    unused: Array = eqx.field(default_factory=lambda: jnp.zeros(()))

    def initial_carry(self, command):
        return command

    def __call__(self, carry, observation, goal, key):
        np.testing.assert_array_equal(observation.shape, goal.shape)
        return carry, observation


def test_a_goal_moves_on() -> None:
    goals = jnp.arange(12.0).reshape(3, 4)
    start = Start(CartState(jnp.zeros((3, 1)), jnp.zeros((3, 1))), jnp.zeros((3, 1)), goals)
    _, actions = simulate(Follow(), CART, Echo(), start, 4)
    np.testing.assert_array_equal(actions[..., 0], goals)


def test_a_goal_stays_unless_a_task_says_otherwise() -> None:
    goal = jax.random.normal(jax.random.key(0), (3, 1))
    assert CartToOrigin().goal_at(goal, jnp.asarray(5)) is goal
