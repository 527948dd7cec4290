"""Many trees side by side, a block of them at a time, so that a block stays in a core's cache."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

BLOCK = 64  # lanes; measured on seven and three links, 32 to 4,096

Result = TypeVar("Result")


def in_blocks(function: Callable[[Any, Any], Result], shared: Any, own: Any) -> Result:
    """`function(shared, own)` with all lanes, of which there are as many as in `own`, in blocks.

    Lanes are the last axis; leaves of `shared` without as many are the same for all. More lanes
    than a block has are more than a tree has links, so that no other axis is taken for them.
    """
    lanes = jax.tree.leaves(own)[0].shape[-1]
    if lanes <= BLOCK:
        return function(shared, own)
    blocks = -(-lanes // BLOCK)

    def cut(array: Array) -> Array:
        """The blocks' axis first; the last block is filled up with copies of the last lane."""
        widths = [(0, 0)] * (array.ndim - 1) + [(0, blocks * BLOCK - lanes)]
        filled = jnp.pad(array, widths, mode="edge")
        return jnp.moveaxis(filled.reshape(*array.shape[:-1], blocks, BLOCK), -2, 0)

    def joined(array: Array) -> Array:
        whole = jnp.moveaxis(array, 0, -2)
        return whole.reshape(*whole.shape[:-2], blocks * BLOCK)[..., :lanes]

    varies, same = eqx.partition(shared, lambda leaf: leaf.shape[-1:] == (lanes,))
    pieces = jax.tree.map(cut, (varies, own))
    found = jax.lax.map(lambda each: function(eqx.combine(each[0], same), each[1]), pieces)
    return jax.tree.map(joined, found)


def lanes_last(value: Array, axes: int) -> Array:
    """The batch axis last, of length one where there is none; `axes` are those of one tree."""
    return value[..., None] if value.ndim == axes else jnp.moveaxis(value, 0, -1)


def lanes_first(value: Array, single: bool) -> Array:
    """The batch axis first again, none of a single one."""
    return value[..., 0] if single else jnp.moveaxis(value, -1, 0)
