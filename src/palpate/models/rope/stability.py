"""Keeping the explicit integration of a rope stable, whatever its parameters.

Symplectic Euler of M x'' + C x' + K x = 0 is stable when every eigenvector's Rayleigh quotients
obey h^2 k/m + 2 h c/m < 4. The load of a node bounds them by its row sum of M^-1 (h^2 K + 2 h C)
(Gershgorin), element by element: an element of stiffness w on the combination a of node coordinates
adds w |a_i| sum |a_j| to row i.

    stretch    a = (-1, 1)
    bend       a = (1/l, -1/l - 1/l', 1/l')
    grip       a = (-1/l, 1/l) of the first segment
    twist      at most 4 k_t / TWIST_FADE on directions, with sum |a_j| <= 2/l for the shortest l

Driven nodes have neither row nor column, since no force moves them; drag is implicit and only
helps. The limit in the literature, h^2 4 k/m + 2 h 4 c/m < 4, is this one without bending.

The limit is for constant stiffness. That of a stretched segment turns with it: from about 0.4 rad
per time step on (30 m/s across a segment of 7 cm, at 1 ms) and loads above 2 it can pump energy
into the segment. Ropes as the prior expects them stay well below; a fine time step cures others.
"""

from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from palpate.models.rope import kernel
from palpate.models.rope.parameters import RopeParameters

SomeRope = TypeVar("SomeRope", bound=RopeParameters)

LIMIT = 3.6  # of 4: the rest is for stretched and folded ropes

# Who may use how much of what the ones before left of a node's limit. Stretching comes last: its
# stiffness only has to be large, while the others are what makes one rope differ from another.
SHARES = {
    "bend_stiffness": 0.5,
    "grip_stiffness": 0.5,
    "grip_damping": 0.5,
    "twist_stiffness": 0.5,
    "bend_damping": 0.5,
    "stretch_damping": 0.5,
    "stretch_stiffness": 1.0,
}


@eqx.filter_jit
def load(rope: RopeParameters) -> Float[Array, "*batch nodes"]:
    """How much of the stability limit each node uses: stable below 4."""
    return sum(_loads(rope).values(), start=jnp.zeros(()))


def heaviest(rope: RopeParameters) -> str:
    """The parameter whose elements load a node most, of one rope."""
    loads = {name: float(values.max()) for name, values in _loads(rope).items()}
    return max(loads, key=lambda name: loads[name])


def soften(rope: SomeRope) -> SomeRope:
    """A stable rope: itself when the load stays below `LIMIT`.

    Beyond it each kind of element may use its share of what is left, or what the kinds after it
    leave, if that is more; one that asks for more is scaled down alone, where it does. No value an
    optimiser can reach is unstable, and one parameter beyond its limit does not wear others down.
    """
    softened = _softened(rope)
    return eqx.tree_at(
        lambda rope: [getattr(rope, name) for name in softened], rope, list(softened.values())
    )


@eqx.filter_jit
def _softened(rope: RopeParameters) -> dict[str, Array]:
    loads = _loads(rope)
    left = jnp.asarray(LIMIT, rope.node_mass.dtype)
    softened = {}
    for name, share in SHARES.items():
        value = getattr(rope, name)
        asked = loads.pop(name)
        later = sum(loads.values(), start=jnp.zeros(()))
        allowed = jnp.maximum(share * left, left - later)
        excess = jnp.maximum(asked / allowed, 1.0)
        # Beyond by rounding alone is legal: else a rope at the limit would not feel its gradient.
        factor = jnp.where(excess > 1.0001, 1.0 / excess, 1.0)
        softened[name] = value * _weakest(factor, name, value)
        left = jnp.maximum(left - _load_of(rope, name, softened[name]), 1e-5)  # rounding
    return softened


@eqx.filter_jit
def _loads(rope: RopeParameters) -> dict[str, Array]:
    return {name: _load_of(rope, name, getattr(rope, name)) for name in SHARES}


def _load_of(rope: RopeParameters, name: str, value: Array) -> Float[Array, "*batch nodes"]:
    """What the elements of one kind add to the load of each node."""
    h, nodes, free = rope.time_step, rope.nodes, rope.free_nodes()
    weight = value * (2.0 * h if name.endswith("damping") else h**2)
    per_length = 1.0 / rope.rest_length
    first, second = per_length[..., :-1], per_length[..., 1:]
    ends = free[:-1] + free[1:]
    if name.startswith("stretch"):
        rows = spread(weight * ends, nodes, 0) + spread(weight * ends, nodes, 1)
    elif name.startswith("grip"):
        held = (weight * per_length[..., 0] ** 2)[..., None] * ends[:1]
        rows = spread(held, nodes, 0) + spread(held, nodes, 1)
    elif name.startswith("bend"):
        total = first * free[:-2] + (first + second) * free[1:-1] + second * free[2:]
        rows = (
            spread(weight * total * first, nodes, 0)
            + spread(weight * total * (first + second), nodes, 1)
            + spread(weight * total * second, nodes, 2)
        )
    else:
        nearest = jnp.maximum(jnp.maximum(first[..., :-1], first[..., 1:]), second[..., 1:])
        turn = weight * (8.0 / kernel.TWIST_FADE) * nearest**2
        rows = sum((spread(turn, nodes, k) for k in range(4)), start=jnp.zeros(()))
    return rows * free / rope.node_mass


def _weakest(factor: Array, name: str, value: Array) -> Array:
    """The smallest of the nodes' factors that each element of one kind acts on."""
    if name.startswith("grip"):
        return jnp.minimum(factor[..., 0], factor[..., 1])
    nodes, count = factor.shape[-1], value.shape[-1]
    span = nodes - count + 1
    reached = [factor[..., k : nodes - span + 1 + k] for k in range(span)]
    return jnp.min(jnp.stack(reached), axis=0)


def spread(values: Array, size: int, offset: int) -> Array:
    """Put element values `offset` places after the element's own, in an axis of `size` places."""
    padding = [(0, 0)] * (values.ndim - 1) + [(offset, size - values.shape[-1] - offset)]
    return jnp.pad(values, padding)
