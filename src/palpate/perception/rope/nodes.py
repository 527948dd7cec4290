"""Where a model's nodes are among the markers that are seen of a rope, and how far apart."""

import functools
import math

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError

SMOOTHED = 0.25  # s, over which the lengths of segments are smoothed
TINY = 1e-9  # m, of a segment that has no direction


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


def smooth_lengths(
    before: Float[np.ndarray, "*batch nodes 3"],
    positions: Float[np.ndarray, "*batch nodes 3"],
    period: float,
) -> Float[np.ndarray, "*batch nodes 3"]:
    """The positions (m), their segments no longer or shorter than they have been for a while.

    A rope that is pulled bounces on its own stretch about ten times a second and hardly damped. In
    markers that is less than their noise, so no recording tells it; a policy that answers it, late
    by a control period and the gripper's lag, makes it grow. So segments keep the directions in
    which they are seen, and their lengths follow with a first-order lag of `SMOOTHED` s: from those
    of `before`, which is what this function gave one `period` (s) ago. The first node stays.
    """
    share = -math.expm1(-period / SMOOTHED)
    segments = np.diff(positions, axis=-2)
    length = np.linalg.norm(segments, axis=-1, keepdims=True)
    held = np.linalg.norm(np.diff(before, axis=-2), axis=-1, keepdims=True)
    segments *= (held + share * (length - held)) / np.maximum(length, TINY)
    first = positions[..., :1, :]
    return np.concatenate([first, first + np.cumsum(segments, axis=-2)], axis=-2)


@functools.lru_cache
def _places(markers: int, nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The markers before and after each node, and how far it is between them: (nodes, 1)."""
    if not 2 <= nodes <= markers:
        raise PalpateError(f"{nodes} nodes need at least as many markers, not {markers}")
    before, rest = np.divmod(np.arange(nodes) * (markers - 1), nodes - 1)
    return before, before + (rest > 0), (rest / (nodes - 1))[:, None]
