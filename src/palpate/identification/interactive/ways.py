"""How well the way of a hand that holds a part fits a joint.

A hand creeps on its hold as a random walk, is known to itself but for white noise, and took hold
wherever it did: its errors are whitened by that.
"""

import math

import numpy as np
from jaxtyping import Float

from palpate.identification.interactive.screws import AXES, STEP, Screw

CREEP = 3e-3  # m by which a hand may have crept on its hold over `CREEP_TRAVEL`, as a random walk
CREEP_TRAVEL = 0.3  # m
HAND = 1e-3  # m, how well the hand is known to itself
END_ERROR = 4e-3  # m, of the end of a way in which what carries the part moved as well
MOMENTS = 25  # of a hand's way that count

# The look before a hand took hold of a part, which the one after it follows, and the way (m, times
# by 3) that it went.
Way = tuple[int, np.ndarray]


def whiten(screw: Screw, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes and residuals of a hand's way: a random walk, white noise, an offset not known."""
    way = way[np.unique(np.linspace(0, len(way) - 1, MOMENTS).astype(int))]
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    walk = CREEP**2 / CREEP_TRAVEL * np.minimum.outer(gone, gone)
    if is_of_two_ends(way):
        walk += END_ERROR**2 * np.minimum.outer(gone > 0.0, gone > 0.0)
    root = np.linalg.cholesky(walk + HAND**2 * np.eye(len(way)) + 1.0)
    base = screw.strays(way)
    varied = [screw.varied(STEP * one).strays(way) - base for one in np.eye(AXES)]
    white = np.linalg.solve(root, np.concatenate([base, *varied], axis=1))
    standard, *slopes = np.split(white, AXES + 1, axis=1)
    return np.stack([one.T.ravel() / STEP for one in slopes], axis=1), standard.T.ravel()


def is_of_two_ends(way: Float[np.ndarray, "times 3"]) -> bool:
    """Whether only the ends of a way are known, as what carries the part moved meanwhile."""
    way = np.round(way, 9)
    return bool(np.all(np.all(way == way[0], axis=1) | np.all(way == way[-1], axis=1)))


def misfit(screw: Screw, way: Float[np.ndarray, "times 3"]) -> float:
    """How far a way is from those of a joint, for errors of the hand alone: about .5."""
    standard = whiten(screw, way)[1]
    return float(standard @ standard) / len(standard)


def way_information(screw: Screw, way: Float[np.ndarray, "times 3"]) -> Float[np.ndarray, "4 4"]:
    """What one more way of a hand would say of a joint's four numbers (Fisher information)."""
    rows, _ = whiten(screw, way)
    return rows.T @ rows


def travel_deviation(way: Float[np.ndarray, "times 3"]) -> float:
    """How well (m, standard deviation) a way says how far its part has gone."""
    travel = float(np.linalg.norm(way[-1] - way[0]))
    carried = END_ERROR if is_of_two_ends(way) else 0.0
    return math.hypot(HAND, CREEP * math.sqrt(travel / CREEP_TRAVEL), carried)
