"""Recordings of the rope model itself: what is found of them can be held against the truth."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from palpate.families.rope.recording import GRIPPER, MARKERS
from palpate.models.model import rollout
from palpate.models.rope import Rope
from palpate.recordings import Channel, Recording, Role, Trial


def simulate(
    rope: Rope,
    start: Float[np.ndarray, "nodes 3"],
    actions: Float[np.ndarray, "trials steps 3"],
    noise: float,
    seed: int,
) -> Recording:
    """A trial for each sequence of actions of the first node, from rest at `start` (m).

    Markers are seen with white `noise` (m), the gripper's position without.
    """
    trials, steps = actions.shape[:2]
    begun = np.broadcast_to(np.asarray(start, np.float32), (trials, 1, *start.shape))
    states = jax.jit(rollout)(
        rope, rope.initial_state(jnp.asarray(begun)), jnp.asarray(actions[:, :, None], jnp.float32)
    )
    position = np.concatenate([begun, np.asarray(states.position)], axis=1)
    seen = position + noise * np.random.default_rng(seed).standard_normal(position.shape)
    frames = np.arange(steps + 1) * rope.control_period
    recorded = []
    for index in range(trials):
        channels = (
            Channel(MARKERS, Role.OBSERVATION, frames, seen[index], "m"),
            Channel(GRIPPER, Role.DRIVEN, frames, position[index, :, :1], "m"),
        )
        recorded.append(Trial(f"seed {seed + index}", {c.name: c for c in channels}))
    return Recording(tuple(recorded), {"source": "the rope model itself"})
