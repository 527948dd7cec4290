"""Regressions as models: iterated open loop, with features that use a symmetry, and walls."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.identification.regression.model import KINDS, Features, fit_regression
from palpate.models.model import rollout
from toys import Cart, CartState

CART = Cart(mass=jnp.asarray(1.5), friction=jnp.asarray(0.8))
WALL = 1.0  # m


def raw_inputs(state, action):
    return jnp.concatenate([state.position, state.velocity, action], axis=-1)[..., None, :]


def moving_inputs(state, action):
    """Where the cart is says nothing about how it moves on."""
    return jnp.concatenate([state.velocity, action], axis=-1)[..., None, :]


def change(state, following):
    rows = following.position - state.position, following.velocity - state.velocity
    return jnp.concatenate(rows, axis=-1)[..., None, :]


def apply(state, change):
    return CartState(state.position + change[..., 0, :1], state.velocity + change[..., 0, 1:])


def at_wall(state):
    return (state.position >= WALL - 1e-6)[..., None, :]


RAW, MOVING = (Features(inputs, change, apply, at_wall) for inputs in (raw_inputs, moving_inputs))


def transitions(count, model=CART, seed=0, spread=1.0):
    keys = jax.random.split(jax.random.key(seed), 3)
    draw = lambda key, size: size * jax.random.normal(key, (count, 1))  # noqa: E731
    states = CartState(draw(keys[0], spread), draw(keys[1], 1.0))
    actions = draw(keys[2], 2.0)
    return states, actions, model.step(states, actions)


@pytest.mark.parametrize("kind", KINDS)
def test_a_linear_system_is_predicted_open_loop(kind):
    model = fit_regression(CART, RAW, kind, *transitions(80))
    actions = jnp.sin(jnp.arange(40))[:, None]
    start = CartState(jnp.array([0.2]), jnp.array([-0.5]))
    found, truth = rollout(model, start, actions), rollout(CART, start, actions)
    np.testing.assert_allclose(model.observe(found), CART.observe(truth), atol=0.03)
    assert model.action_shape == (1,)
    assert model.observation_units == CART.observation_units
    np.testing.assert_array_equal(model.difference(found.position, found.position), 0)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf + 0.1]), start)
    both = rollout(model, batch, jnp.stack([actions, actions]))
    assert both.position.shape == (2, 40, 1)
    np.testing.assert_allclose(both.position[0], found.position, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_features_may_use_that_the_place_says_nothing(kind):
    """Data of one place are then as good everywhere, to the last digit."""
    model = fit_regression(CART, MOVING, kind, *transitions(60, spread=0.01))
    actions = jnp.ones((20, 1))
    here, there = (
        rollout(model, CartState(jnp.array([place]), jnp.zeros(1)), actions).position - place
        for place in (0.0, 64.0)
    )
    np.testing.assert_allclose(here, there, atol=1e-4)


class Walled(Cart):
    """A cart that a wall stops: the force it is pressed with has then no effect."""

    def step(self, state, action):
        moved = super().step(state, action)
        stopped = at_wall(state)[..., 0, :] & (action > 0)
        return CartState(
            jnp.where(stopped, state.position, moved.position),
            jnp.where(stopped, 0.0, moved.velocity),
        )


def test_conditions_tell_a_wall_and_none_does_not():
    walled = Walled(mass=jnp.asarray(1.5), friction=jnp.asarray(0.8))
    states, actions, _ = transitions(400)
    pressed = jnp.arange(400)[:, None] % 2 == 0
    states = CartState(
        jnp.where(pressed, WALL, states.position - 3), jnp.where(pressed, 0.0, states.velocity)
    )
    actions = jnp.where(pressed, jnp.abs(actions), actions)
    data = states, actions, walled.step(states, actions)
    start = CartState(jnp.array([WALL]), jnp.zeros(1))
    pushing = jnp.full((20, 1), 3.0)
    beyond = {
        kind: float(
            rollout(fit_regression(walled, MOVING, kind, *data), start, pushing).position[-1, 0]
        )
        for kind in ("lwr", "oo-lwr")
    }
    assert beyond["oo-lwr"] == pytest.approx(WALL, abs=1e-3)
    assert beyond["lwr"] > WALL + 0.05


def test_what_no_regression_is_is_said():
    with pytest.raises(PalpateError, match="unknown regression 'lstm'; there are: lwr, oo-lwr, gp"):
        fit_regression(CART, RAW, "lstm", *transitions(5))
    bare = Features(raw_inputs, change, apply)
    with pytest.raises(PalpateError, match="needs features with a condition"):
        fit_regression(CART, bare, "oo-lwr", *transitions(5))
