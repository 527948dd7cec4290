"""Particles that follow the data as they arrive: a belief that planners may draw models from.

    belief = begin(target, key, particles=256)
    belief, note = absorb(belief, piece, key)     # every second or so
    models = models_of(belief, 100, key)

A new piece of motion weighs the particles by its likelihood. Where few would be left it is let in
by degrees, and the particles are resampled and moved by Metropolis steps with all pieces so far
(resample and move: Gilks and Berzuini, J. R. Stat. Soc. B 63, 2001; Chopin 2002, with bridging by
temperature). When no particle explains a new piece, or steps are no longer accepted, all begin
anew from the prior and pass through all the pieces at once. What they cannot explain either, such
as an action that is not finite, is left out: a belief never dies.

The target has a fixed number of places for pieces, and computes them all: nothing is compiled
anew as data arrive. When they are full, the oldest piece is forgotten.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.identification.data.segments import Segments
from palpate.identification.posterior.likelihood import MotionPosterior, Scales, motion_posterior
from palpate.identification.samplers.tempered import (
    IMPOSSIBLE,
    KEPT,
    effective_share,
    finite,
    move,
    next_change,
    systematic,
    temper,
    weighted_covariance,
)
from palpate.models.model import Model

MOVES = 4  # Metropolis steps after a resampling
BRIDGES = 30  # temperatures that a piece may take
LOST = 0.02  # acceptance below which the particles are stuck


class Belief(eqx.Module):
    """Weighted particles of a posterior, `filled` pieces of data ever, and the steps' scale."""

    target: MotionPosterior
    position: Float[Array, "particles free"]
    log_weight: Float[Array, " particles"]
    scale: Float[Array, ""]
    filled: int = eqx.field(static=True)


def places(model: Model, scales: Scales, capacity: int, horizon: int) -> MotionPosterior:
    """A target without data that has room for `capacity` pieces of `horizon` control periods."""
    shape = model.observation_shape
    dtype = jnp.zeros(()).dtype
    none = jnp.zeros((capacity, *shape), dtype)
    target = jnp.zeros((capacity, horizon, *shape), dtype)
    action = jnp.zeros((capacity, horizon, *model.action_shape), dtype)
    # A deviation that is not zero, so that starts are taken as uncertain from the beginning.
    empty = Segments(none, none, none + 1e-6, none, action, target, target > 1.0)
    return motion_posterior(model, empty, scales)


def begin(target: MotionPosterior, key: PRNGKeyArray, particles: int = 256) -> Belief:
    """Equally weighted particles: of the prior, or of the posterior if the target has data.

    Raises as `temper`.
    """
    rotation = jnp.broadcast_to(  # a piece that comes may have its own
        target.rotation, (*target.counted.shape[:2], *target.rotation.shape[2:])
    )
    target = eqx.tree_at(lambda t: t.rotation, target, rotation)
    counted = np.asarray(target.counted).sum(axis=(1, 2)) > 0
    if counted.any():
        found = temper(target, key, particles)
        position, scale = found.position, found.scale
    else:
        position = jax.random.normal(key, (particles, target.dimension))
        scale = jnp.full((), 0.5, position.dtype)
    return Belief(target, position, jnp.zeros(particles, position.dtype), scale, int(counted.sum()))


def absorb(belief: Belief, piece: Segments, key: PRNGKeyArray) -> tuple[Belief, str | None]:
    """The belief after one more piece of motion, and a sentence when it had to begin anew.

    A piece that the prior explains no more than the particles do takes a place, and is not seen:
    the belief stays what it was, and the sentence says so.

    Raises `PalpateError` for a piece of another length, or more than one.
    """
    if piece.count != 1 or piece.horizon != belief.target.segments.horizon:
        raise PalpateError(
            f"expected one piece of {belief.target.segments.horizon} control periods, got "
            f"{piece.count} of {piece.horizon}: `cut` pads a shorter one"
        )
    place = belief.filled % belief.target.segments.count
    mean = _mean(belief)
    target = _placed(belief.target, piece, place, mean)
    moving, anew = jax.random.split(key)
    position, log_weight, scale, acceptance, reached = _absorb(
        target, belief.position, belief.log_weight, belief.scale, jnp.asarray(place), moving
    )
    note = None
    if float(reached) < 1.0 or float(acceptance) < LOST:
        lost = "no particle explained what was seen" if float(reached) < 1.0 else "particles stuck"
        try:
            found = temper(target, anew, len(belief.position))
            position, scale = found.position, found.scale
            log_weight = jnp.zeros_like(log_weight)
            note = f"{lost}, so the belief began anew from the prior"
        except PalpateError:
            # In the place of the oldest piece all the same: if it is the old ones that cannot be
            # explained together with what is seen now, they are forgotten one by one.
            target = _placed(belief.target, jax.tree.map(jnp.zeros_like, piece), place, mean)
            position, log_weight, scale = belief.position, belief.log_weight, belief.scale
            note = f"{lost}, and the prior explains no more: the piece was left out"
    return Belief(target, position, log_weight, scale, belief.filled + 1), note


def resampled(belief: Belief, key: PRNGKeyArray, count: int) -> Float[Array, "count free"]:
    """Equally weighted particles, as many as asked for."""
    return _resampled(belief.position, belief.log_weight, key, count)


def models_of(belief: Belief, count: int, key: PRNGKeyArray) -> Model:
    """Models drawn from the belief, as one whose free parameters lead with the draws."""
    return belief.target.models(resampled(belief, key, count))


@eqx.filter_jit
def _resampled(position: Array, log_weight: Array, key: PRNGKeyArray, count: int) -> Array:
    return position[systematic(key, log_weight, count)]


def _mean(belief: Belief) -> Float[Array, " free"]:
    """The belief's mean, the prior's where that is not finite."""
    return jnp.nan_to_num(jax.nn.softmax(belief.log_weight) @ belief.position)


def _placed(
    target: MotionPosterior, piece: Segments, place: int, position: Array
) -> MotionPosterior:
    """The target with a piece at a place, its start's errors propagated by the model there."""
    alone = motion_posterior(target.coordinates.reference, piece, target.scales)
    put = lambda whole, part: whole.at[place].set(part[0])  # noqa: E731
    target = eqx.tree_at(
        lambda t: (t.segments, t.rotation, t.spectrum, t.counted),
        target,
        (
            jax.tree.map(put, target.segments, piece),
            put(target.rotation, alone.rotation),
            put(target.spectrum, alone.spectrum),
            put(target.counted, alone.counted),
        ),
    )
    return target.linearised(position)


@eqx.filter_jit
def _absorb(
    target: MotionPosterior,
    position: Array,
    log_weight: Array,
    scale: Array,
    place: Array,
    key: PRNGKeyArray,
) -> tuple[Array, Array, Array, Array, Array]:
    """Positions, weights, scale of steps, acceptance, and how much of the piece was let in."""
    news = jnp.arange(target.segments.count) == place

    def alone(position: Array) -> Array:
        one = eqx.tree_at(
            lambda t: (t.segments, t.rotation, t.spectrum, t.counted, t.sensitivity),
            target,
            replace_fn=lambda part: jax.tree.map(
                lambda x: jax.lax.dynamic_slice_in_dim(x, place, 1), part
            ),
        )
        return finite(jnp.sum(one.by_segment(position)))

    news_of = jax.vmap(alone)(position)
    straight = log_weight + news_of
    enough = (effective_share(straight) >= KEPT) & (jnp.max(news_of) > IMPOSSIBLE)
    one = jnp.ones(())

    def keep(_):
        return position, straight - jnp.max(straight), scale, one, one

    def bridge(_):
        def unfinished(carry):
            index, _, _, news_of, *_, reached, _ = carry
            possible = jnp.max(news_of) > IMPOSSIBLE
            return (reached < 1.0) & (index < BRIDGES) & possible

        def let_in(carry):
            index, position, log_weight, news_of, scale, _, reached, key = carry
            key, choosing, moving = jax.random.split(key, 3)
            change = next_change(news_of, 1.0 - reached, log_weight)
            weight = log_weight + change * news_of
            reached = jnp.where(change >= 1.0 - reached, 1.0, reached + change)
            covariance = weighted_covariance(position, jax.nn.softmax(weight))
            chosen = systematic(choosing, weight)

            def partly(position: Array) -> Array:
                pieces = jax.vmap(target.by_segment)(position)
                return finite(pieces @ jnp.where(news, reached, 1.0))

            start = position[chosen]
            moved, _, scale, acceptance = move(
                partly, start, partly(start), one, covariance, scale, moving, MOVES
            )
            fresh = jax.vmap(alone)(moved)
            return (
                index + 1, moved, jnp.zeros_like(log_weight), fresh, scale, acceptance, reached, key
            )  # fmt: skip

        begun = 0, position, log_weight, news_of, scale, one, 0.0 * one, key
        found = jax.lax.while_loop(unfinished, let_in, begun)
        _, moved, weight, _, scale_now, acceptance, reached, _ = found
        return moved, weight, scale_now, acceptance, reached

    return jax.lax.cond(enough, keep, bridge, None)
