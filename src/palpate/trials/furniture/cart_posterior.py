"""What handling has told an agent of one piece, in the Shopping-Cart and Apartment tasks.

The posterior of a planar model's parameters and scales, given the pieces of motion in which most
happened. As data arrive it is climbed for a few steps of Fisher scoring, from the last modes and
from others near the best; now and then it is searched all over, as that of a recording is.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from palpate.identification.data.segments import Segments, cut
from palpate.identification.posterior.laplace import climb, settle
from palpate.identification.posterior.likelihood import (
    MotionPosterior,
    inferred_scales,
    initial_position,
    motion_posterior,
)
from palpate.models.planar import Planar
from palpate.recordings import Aligned

PIECE = 0.6  # s, of what is seen that is compared at a time
MOST = 32  # pieces that are compared
STARTS, STEPS = 4, 5  # of the climb at each update
REDRAWN = 0.25  # of the coordinates of some starts
NOISE = np.array([1e-3, 1e-3, 2e-3])  # m, m, rad: of a tracker as agents expect it


class PiecePosterior:
    """What handling has told of one piece: its motion, cut to pieces, and the posterior's modes.

    The first climb begins at what is `believed` of it, if anything, or at the prior's centre.
    """

    def __init__(self, model: Planar, seed: int, believed: Planar | None = None):
        self.model = model
        self._believed = believed
        self._key = jax.random.key(seed)
        self._kept: list[Segments] = []
        self._modes: Array | None = None

    def keep(self, stretches: list[tuple[Aligned, bool]]) -> None:
        """Remember handling that is over."""
        self._kept += self._segments_of(stretches)

    def update(self, stretches: list[tuple[Aligned, bool]]) -> Planar | None:
        """The most probable model, given what is kept and handling that still goes on.

        None as long as nothing has been seen.
        """
        target = self._target(self._kept + self._segments_of(stretches))
        if target is None:
            return None
        self._key, draw, choose = jax.random.split(self._key, 3)
        start = jax.random.normal(draw, (STARTS, target.dimension)).at[0].set(0.0)
        if self._believed is not None:
            start = start.at[0].set(_position(target, self._believed))
        if self._modes is not None:
            target = target.linearised(self._modes[0])
            # The last modes, and the best with some coordinates drawn anew: where sliding sets in
            # the density has a kink at which a climb stays, and only that coordinate is wrong.
            redrawn = jax.random.bernoulli(choose, REDRAWN, start.shape)
            start = jnp.where(redrawn, start, self._modes[0])
            start = start.at[: STARTS // 2].set(self._modes[: STARTS // 2])
        return self._best(target, climb(target, start, STEPS).position)

    def search(self) -> Planar | None:
        """The same of what is kept, looked for all over the prior and from the modes known so far.

        None as long as nothing is kept.
        """
        target = self._target(self._kept)
        if target is None:
            return None
        self._key, key = jax.random.split(self._key)
        target, modes = settle(target, key)
        known = self._modes
        if known is None:
            believed = self.model if self._believed is None else self._believed
            known = _position(target, believed)[None]
        start = jnp.concatenate([modes.position[: STARTS // 2], known[: STARTS // 2]])
        return self._best(target, climb(target, start).position)

    def _target(self, parts: list[Segments]) -> MotionPosterior | None:
        if not parts:
            return None
        return motion_posterior(
            self.model, most_informative(parts), inferred_scales(self.model, NOISE)
        )

    def _best(self, target: MotionPosterior, modes: Float[Array, "modes free"]) -> Planar:
        self._modes = modes
        found = target.model(modes[0])
        assert isinstance(found, Planar)
        return found

    def _segments_of(self, stretches: list[tuple[Aligned, bool]]) -> list[Segments]:
        return [cut(aligned, self.model, PIECE, at_rest=rest) for aligned, rest in stretches]


def _position(target: MotionPosterior, model: Planar) -> Array:
    """Where a model is among the coordinates of a posterior, the scales at their medians."""
    return initial_position(motion_posterior(model, target.segments, target.scales))


def most_informative(parts: list[Segments]) -> Segments:
    """The `MOST` pieces in which most happened; padded by ones in which nothing is seen.

    Most of the time of who is good at it passes at the goal, where next to nothing moves, and a
    share of the pieces taken evenly would forget how the furniture rolls.
    """
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    way = np.where(whole.seen, np.abs(np.asarray(whole.target) - whole.pose[:, None]), 0.0)
    chosen = np.argsort(-way.max(axis=1).sum(axis=(1, 2)), kind="stable")[:MOST]
    index = np.concatenate([chosen, np.zeros(MOST - len(chosen), int)])
    picked = jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), whole)
    kept = jnp.arange(MOST) < len(chosen)
    seen = picked.seen & kept.reshape(-1, *(1,) * (picked.seen.ndim - 1))
    return dataclasses.replace(picked, seen=seen, target=jnp.where(seen, picked.target, 0.0))
