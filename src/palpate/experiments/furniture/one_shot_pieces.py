"""One piece of furniture, handled for ten seconds: what it is, and what it does when pushed then.

Hands and pushes are those of `palpate.worlds.furniture.handling`; nobody looks at a push before it
is predicted.
"""

import dataclasses
import time
from collections.abc import Sequence

import numpy as np

from palpate.commands.identification.draws import LEVEL
from palpate.families.furniture.recording import POSE, WRENCH, prune_contacts, starting_furniture
from palpate.families.furniture.structures import structures
from palpate.identification.data.segments import Segments, cut, difference
from palpate.identification.posterior.comparison import PIECE, Comparison, compare, posterior_of
from palpate.identification.posterior.posterior import Posterior, sample
from palpate.identification.posterior.predictive import Predicted
from palpate.models.model import Model
from palpate.recordings import Recording
from palpate.worlds.furniture.furniture import FurnitureWorld
from palpate.worlds.furniture.handling import (
    Together,
    Wiggle,
    record,
    record_handling,
    record_pushes,
)
from palpate.worlds.furniture.pieces import KINDS, Piece

PERIOD = 0.02  # s
HANDLED = 10.0  # s
MOVABLE = ("table", "cart", "couch", "bookshelf", "chair", "hinged")
BOLTED = "bolted"
SCENE = ("table", "cart", "couch", "chair", "bookshelf")
SPACING = 4.0  # m between the pieces of the scene


@dataclasses.dataclass(frozen=True)
class Pushes:
    """What became of some pushes: errors of the median prediction after 2 s and ways gone.

    `inside` is the share of all poses seen that lay within the central 90 % of predictions, and
    `drift_m` the farthest from where it is seen first that a piece is predicted to be.
    """

    error_m: np.ndarray
    displacement_m: np.ndarray
    inside: float
    drift_m: float


def recordings(kind: str, seed: int, pushes: int) -> tuple[Recording, Recording]:
    """Ten seconds of handling of a piece, and pushes of the same piece."""
    world = FurnitureWorld([Piece(kind)])
    return record_handling(world, seed, HANDLED), record_pushes(world, seed, pushes, PIECE)


def scene(kinds: Sequence[str], seed: int, pushes: int) -> tuple[Recording, Recording]:
    """Pieces in a room, all handled for the same ten seconds; and pushes of each in turn."""
    places = [(SPACING * (i % 3), SPACING * (i // 3), 0.0) for i in range(len(kinds))]
    pieces = [Piece(kind, place) for kind, place in zip(kinds, places, strict=True)]
    world = FurnitureWorld(pieces)
    hands = Together([Wiggle(seed, body, HANDLED, body) for body in range(len(kinds))])
    handled = record(world, [hands], seed, ["handling of all"])
    return handled, record_pushes(world, seed, pushes * len(kinds), PIECE)


def fit(handled: Recording, draws: int, seed: int) -> tuple[Comparison, float]:
    """What a piece most probably is, on wheels or not, its posterior, and the seconds it took."""
    began = time.monotonic()
    aligned = handled.align(PERIOD, POSE, WRENCH)
    models = structures(handled, PERIOD)
    targets = {name: posterior_of(model, aligned) for name, model in models.items()}
    found = compare(targets, draws, seed=seed)
    return found, time.monotonic() - began


def fit_jointly(handled: Recording, draws: int, seed: int) -> Posterior:
    """The posterior of all pieces of a scene."""
    model = prune_contacts(starting_furniture(handled, PERIOD), handled)
    target = posterior_of(model, handled.align(PERIOD, POSE, WRENCH))
    return sample(target, draws=draws, seed=seed)


def judge(model: Model, predicted: Predicted, pieces: Segments) -> Pushes:
    """Hold predictions of pushes against what was seen, of those bodies that were pushed."""
    pushed = np.any(np.asarray(pieces.action) != 0.0, axis=(1, 3))  # (pieces, bodies)
    target, start = np.asarray(pieces.target), np.asarray(pieces.pose)
    # Not the mean: before anything is known of its weight, some draws fly a hundred metres.
    motion = np.median(np.asarray(predicted.motion), axis=0)
    off = difference(model, np.asarray(predicted.observed), target)
    tail = 0.5 - 0.5 * LEVEL
    low, high = np.quantile(off, (tail, 1.0 - tail), axis=0)
    within = (low <= 0.0) & (high >= 0.0)
    every = np.broadcast_to(pushed[:, None, :, None], within.shape) & np.asarray(pieces.seen)
    return Pushes(
        error_m=np.linalg.norm((motion - target)[:, -1, :, :2], axis=-1)[pushed],
        displacement_m=np.linalg.norm((target[:, -1] - start)[..., :2], axis=-1)[pushed],
        inside=float(within[every].mean()),
        drift_m=float(np.linalg.norm((motion[:, -1] - start)[..., :2], axis=-1).max()),
    )


def pushes_of(recording: Recording, model: Model) -> Segments:
    """Every push of a recording as one piece, from rest."""
    return cut(recording.align(PERIOD, POSE, WRENCH), model, PIECE, at_rest=True)


def error_share(error: np.ndarray, displacement: np.ndarray) -> float:
    """Sum of squared errors over that of squared displacements."""
    return float(np.sum(np.square(error)) / np.sum(np.square(displacement)))


assert set(MOVABLE) | {BOLTED} <= set(KINDS)
