"""Keeping the explicit integration of a rope stable, whatever its parameters.

Symplectic Euler of M x'' + C x' + K x = 0 is stable when every eigenvector's Rayleigh quotients
obey h^2 k/m + 2 h c/m < 4. The load of a node bounds them by its row sum of M^-1 (h^2 K + 2 h C)
(Gershgorin), element by element: an element of stiffness w on the combination a of node coordinates
adds w |a_i| sum |a_j| to row i.

    stretch    a = (-1, 1)
    bend       a = (1/l, -1/l - 1/l', 1/l')
    grip       a = (-1/l, 1/l) of the first segment
    twist      at most 4 k_t / TWIST_FADE on directions, with sum |a_j| <= 2/l for the shortest l

Stretch and bend add up because they share directions where the rope is bent. Driven nodes have
neither row nor column, since no force moves them; drag is implicit and only helps. The stability
limit in the literature, h^2 4 k/m + 2 h 4 c/m < 4, is this one without bending.
"""

from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models import rope_kernel

if TYPE_CHECKING:
    from palpate.models.rope import Rope

LIMIT = 3.6  # of 4: the rest is for stretched and folded ropes


def load(rope: "Rope") -> Float[Array, "*batch nodes"]:
    """How much of the stability limit each node uses: stable below 4."""
    h = rope.time_step
    stretch = h**2 * rope.stretch_stiffness + 2 * h * rope.stretch_damping
    bend = h**2 * rope.bend_stiffness + 2 * h * rope.bend_damping
    grip = h**2 * rope.grip_stiffness + 2 * h * rope.grip_damping
    twist = h**2 * 4.0 * rope.twist_stiffness / rope_kernel.TWIST_FADE
    per_length = 1.0 / rope.rest_length
    first, second = per_length[..., :-1], per_length[..., 1:]
    free = rope.free_nodes()
    ends = free[:-1] + free[1:]
    total = first * free[:-2] + (first + second) * free[1:-1] + second * free[2:]
    held = (grip * per_length[..., 0] ** 2)[..., None] * ends[:1]
    nearest = jnp.maximum(
        jnp.maximum(per_length[..., :-2], per_length[..., 1:-1]), per_length[..., 2:]
    )
    nodes = rope.nodes
    rows = (
        spread(stretch * ends, nodes, 0)
        + spread(stretch * ends, nodes, 1)
        + spread(bend * total * first, nodes, 0)
        + spread(bend * total * (first + second), nodes, 1)
        + spread(bend * total * second, nodes, 2)
        + spread(held, nodes, 0)
        + spread(held, nodes, 1)
        + sum(spread(twist * 2.0 * nearest**2, nodes, k) for k in range(4))
    )
    return rows * free / rope.node_mass


def soften(rope: "Rope") -> "Rope":
    """A stable rope: itself when the load stays below `LIMIT`.

    Every stiffness and damping that acts on a node is divided by what the load exceeds the limit
    by, so that no value an optimiser can reach is unstable.
    """
    excess = jnp.maximum(load(rope) / LIMIT, 1.0)
    # Beyond by rounding alone is legal: else a rope at the limit would not feel its gradient.
    factor = jnp.where(excess > 1.0001, 1.0 / excess, 1.0)

    def weakest(count: int) -> Array:
        """The smallest factor of the nodes that each of `count` elements acts on."""
        span = rope.nodes - count + 1
        reached = [factor[..., k : rope.nodes - span + 1 + k] for k in range(span)]
        return jnp.min(jnp.stack(reached), axis=0)

    names = (
        "stretch_stiffness",
        "stretch_damping",
        "bend_stiffness",
        "bend_damping",
        "twist_stiffness",
    )
    softened = {
        name: getattr(rope, name) * weakest(getattr(rope, name).shape[-1]) for name in names
    }
    at_grip = jnp.minimum(factor[..., 0], factor[..., 1])
    for name in ("grip_stiffness", "grip_damping"):
        softened[name] = getattr(rope, name) * at_grip
    return eqx.tree_at(
        lambda rope: [getattr(rope, name) for name in softened], rope, list(softened.values())
    )


def spread(values: Array, size: int, offset: int) -> Array:
    """Put element values `offset` places after the element's own, in an axis of `size` places."""
    padding = [(0, 0)] * (values.ndim - 1) + [(offset, size - values.shape[-1] - offset)]
    return jnp.pad(values, padding)
