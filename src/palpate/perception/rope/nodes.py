"""Where a model's nodes are among the markers that are seen of a rope."""

import functools

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError


def at_nodes(
    markers: Float[np.ndarray, "*batch markers 3"], nodes: int
) -> Float[np.ndarray, "*batch nodes 3"]:
    """Positions (m) of so many nodes, spread evenly over the markers from the first to the last.

    A node that falls on a marker is that marker to the last bit; others lie on the straight line
    between two, which leaves a curved rope by an eighth of its curvature times their squared
    distance. A node is NaN where a marker that it is made of was not seen.

    Raises `PalpateError` for fewer markers than nodes: they would leave the rope's shape open.
    """
    before, after, share = _places(markers.shape[-2], nodes)
    seen = markers[..., before, :]
    if not share.any():
        return seen
    return seen + share * (markers[..., after, :] - seen)


@functools.lru_cache
def _places(markers: int, nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The markers before and after each node, and how far it is between them: (nodes, 1)."""
    if not 2 <= nodes <= markers:
        raise PalpateError(f"{nodes} nodes need at least as many markers, not {markers}")
    before, rest = np.divmod(np.arange(nodes) * (markers - 1), nodes - 1)
    return before, before + (rest > 0), (rest / (nodes - 1))[:, None]
