"""A policy and a model in closed loop."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from palpate.models.model import Model
from palpate.networks import Controller
from palpate.perception.velocity import VelocityEstimator
from palpate.tasks.task import Start, Task


def simulate(
    task: Task,
    models: Model,
    policy: Controller,
    start: Start,
    steps: int,
    keys: Key[Array, " batch"] | None = None,
    noise: float = 0.0,
    lag: Float[Array, " batch"] | None = None,
) -> tuple[Any, Array]:
    """States after each of `steps` decisions in closed loop, and the actions: (batch, time, ...).

    Without noise the policy sees the state. With it, the policy sees what a robot would: noisy
    observations (standard deviation `noise`, in the observation's unit) and velocities estimated
    from them. `keys`: one of each episode, (batch,), so that its chance does not depend on the
    company it is in; a noisy episode needs one.

    With a `lag` (s), commands act through a first-order lag of that time constant, as through a
    robot's servo. The actions given back are the commands.
    """
    if keys is None:
        keys = jax.random.split(jax.random.key(0), jax.tree.leaves(start.state)[0].shape[0])
    estimator = VelocityEstimator(models.control_period)

    def perceive(window: Array, state: Any, keys: Key[Array, " batch"]) -> tuple[Array, Any]:
        observed = models.observe(state)
        observed = observed + noise * _normal(keys, observed.shape[1:], observed.dtype)
        window, velocity = estimator.update(window, observed)
        before = observed - models.control_period * velocity
        return window, models.initial_state(jnp.stack([before, observed], axis=1))

    def follow(applied: Array, action: Array) -> Array:
        if lag is None:
            return action
        left = jnp.exp(-models.control_period / jnp.maximum(lag, 1e-6))
        return action + left.reshape(-1, *(1,) * (action.ndim - 1)) * (applied - action)

    def advance(loop: tuple[Any, Any, Array | None, Array], index: Array) -> tuple[Any, Any]:
        state, memory, window, applied = loop
        for_noise, for_policy = jax.vmap(jax.random.split, out_axes=1)(_fold_in(keys, index))
        seen = state
        if window is not None:
            window, seen = perceive(window, state, for_noise)
        goal = task.goal_at(start.goal, index)
        memory, action = policy(memory, task.features(seen, goal), goal, for_policy)
        applied = follow(applied, action)
        state = models.step(state, applied)
        return (state, memory, window, applied), (state, action)

    window = None
    if noise:
        window = _past(models, start, estimator, noise, _fold_in(keys, steps))
    loop = start.state, policy.initial_carry(start.command), window, start.command
    _, (states, actions) = jax.lax.scan(advance, loop, jnp.arange(steps))
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), (states, actions))


def _past(
    models: Model,
    start: Start,
    estimator: VelocityEstimator,
    noise: float,
    keys: Key[Array, " batch"],
) -> Array:
    """What was seen before the first decision: the start's motion, continued backwards."""
    observed = models.observe(start.state)
    following = models.observe(models.step(start.state, start.command))
    back = jnp.arange(-estimator.frames, 0, dtype=observed.dtype)
    back = back.reshape(-1, *(1,) * observed.ndim)
    window = observed + back * (following - observed)
    shape = (len(window), *window.shape[2:])
    return window + noise * jnp.moveaxis(_normal(keys, shape, window.dtype), 0, 1)


_fold_in = jax.vmap(jax.random.fold_in, in_axes=(0, None))


def _normal(keys: Key[Array, " batch"], shape: tuple[int, ...], dtype: Any) -> Array:
    """Standard normal numbers, (batch, *shape), of each episode's own key."""
    return jax.vmap(lambda key: jax.random.normal(key, shape, dtype))(keys)
