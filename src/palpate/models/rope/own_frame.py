"""What a network may see of a rope, and how it corrects one: in the rope's own frame.

The frame's horizontal axes point along and across the line from the first driven node to the far
end; the third is up. Positions enter only as differences, so that a correction is the same wherever
the rope is and whichever way it is turned about the vertical: the symmetries of the physics.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models.rope.parameters import RopeParameters, RopeState

# Share of the rope's length below which the ends are too close to say a direction: the axes fade,
# and horizontal corrections with them, because a frame that spins around is none.
FADE = 0.05


def features(
    rope: RopeParameters, state: RopeState, following: Float[Array, "*batch nodes 3"]
) -> Float[Array, "*batch nodes 11"]:
    """Of each node: its velocity, the next segment (none after the last), its place; and the ends.

    `following` is the velocity (m/s) that the driven nodes will have, the state's for the others.
    Lengths are relative to rest: the segment's to its own, the others to the whole rope's.
    """
    along = axes(rope, state.position)
    length = jnp.sum(rope.rest_length, axis=-1)[..., None, None]
    edge = jnp.diff(state.position, axis=-2) / rope.rest_length[..., None]
    edge = jnp.concatenate([edge, jnp.zeros_like(edge[..., :1, :])], axis=-2)
    place = (state.position - state.position[..., :1, :]) / length
    span = place[..., -1:, :]
    distance = jnp.sqrt(jnp.sum(jnp.square(span[..., :2]), axis=-1, keepdims=True) + 1e-12)
    ends = jnp.concatenate([distance, span[..., 2:]], axis=-1)
    local = [to_rope_frame(vectors, along) for vectors in (following, edge, place)]
    ends = jnp.broadcast_to(ends, (*local[0].shape[:-1], ends.shape[-1]))
    return jnp.concatenate([*local, ends], axis=-1)


def axes(
    rope: RopeParameters, position: Float[Array, "*batch nodes 3"]
) -> Float[Array, "*batch 2"]:
    """The horizontal direction from the first driven node to the far end; shorter where it fades.

    The far end is the last node, or the first for a rope that is driven at its last.
    """
    first = rope.driven[0]
    last = 0 if first == rope.nodes - 1 else rope.nodes - 1
    chord = position[..., last, :2] - position[..., first, :2]
    fade = FADE * jnp.sum(rope.rest_length, axis=-1)[..., None]
    return chord / jnp.sqrt(jnp.sum(jnp.square(chord), axis=-1, keepdims=True) + jnp.square(fade))


def to_rope_frame(vectors: Array, along: Array) -> Array:
    """(*batch, nodes, 3) world vectors along, across and up in the rope's frame."""
    x, y = along[..., None, 0], along[..., None, 1]
    a, b, c = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return jnp.stack([x * a + y * b, x * b - y * a, jnp.broadcast_to(c, (x * a).shape)], axis=-1)


def from_rope_frame(vectors: Array, along: Array) -> Array:
    """The inverse of `to_rope_frame` where the axes do not fade: world vectors."""
    x, y = along[..., None, 0], along[..., None, 1]
    a, b, c = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return jnp.stack([x * a - y * b, y * a + x * b, jnp.broadcast_to(c, (x * a).shape)], axis=-1)
