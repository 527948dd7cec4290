"""Shapes and motions of ropes that several tests start from."""

import jax.numpy as jnp
import numpy as np

from palpate.models.rope import Rope, RopeState


def bent(rope: Rope, rng: np.random.Generator, bending: float, stretching: float = 0.0):
    """Random node positions (m) from the first node at 0, hanging on average.

    `bending` is the standard deviation of a direction (0: straight, 3: crumpled) and `stretching`
    that of a relative length.
    """
    direction = [0.0, 0.0, -1.0] + bending * rng.normal(size=(rope.nodes - 1, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = np.asarray(rope.rest_length) * (1 + stretching * rng.uniform(-1, 1, rope.nodes - 1))
    edges = direction * length[:, None]
    return jnp.asarray(np.concatenate([np.zeros((1, 3)), np.cumsum(edges, axis=0)]))


def hanging(rope: Rope) -> np.ndarray:
    """Node positions (m) at rest from the first node at 0: each spring carries what is below it."""
    mass, gravity = np.asarray(rope.node_mass), float(rope.gravity)
    tension = gravity * np.cumsum(mass[::-1])[::-1][1:]
    length = np.asarray(rope.rest_length) + tension / np.asarray(rope.stretch_stiffness)
    return np.concatenate([[0.0], -np.cumsum(length)])[:, None] * [0.0, 0.0, 1.0]


def at_rest(position) -> RopeState:
    position = jnp.asarray(position)
    return RopeState(position, jnp.zeros_like(position))


def still(rope: Rope, periods: int) -> jnp.ndarray:
    """Actions of a gripper that stays at rest (velocity or acceleration drive)."""
    return jnp.zeros((periods, *rope.action_shape))
