"""What was lived through, kept for learning: a ring of transitions, all of it one pytree.

It is written and drawn from inside compiled calls, and saved with a run like any other state.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from palpate.numerics.arrays import as_array


class Transition(eqx.Module):
    """Decisions and what came of them, in arrays of JAX or NumPy; a batch is the leading axis.

    `action` is what the task's policy proposed, `executed` what was done in its place: the same,
    unless something overruled it. `cost` is 1 where a constraint was violated (or any cost >= 0).
    `terminated`: 1 where there is nothing after it; an episode that ran out of time has not ended
    so, and `next_observation` is its last.
    """

    observation: Float[Any, "*batch features"]
    action: Float[Any, "*batch actions"]
    executed: Float[Any, "*batch actions"]
    reward: Float[Any, "*batch"]
    cost: Float[Any, "*batch"]
    next_observation: Float[Any, "*batch features"]
    terminated: Float[Any, "*batch"]

    @property
    def whole(self) -> Any:
        """(*batch,) bool: which of them are to be counted as a decision."""
        return jnp.ones_like(self.cost, bool)


class Motion(Transition):
    """What came of decisions that could be interrupted, told from several moments within each.

    Each leads to where its action ends; `action` is `executed`, and the reward is not known.
    `duration` is a share of a whole decision; `holds` is 1 where the action was interrupted, `last`
    where no piece of the decision began later. See `palpate.worlds.motions.Motions`.
    """

    duration: Float[Any, "*batch"]
    holds: Float[Any, "*batch"]
    last: Float[Any, "*batch"]

    @property
    def whole(self) -> Any:
        """See `Transition.whole`: of each decision the last piece."""
        return self.last > 0


class ReplayBuffer(eqx.Module):
    """The last transitions, and apart from them the last ones that violated a constraint.

    The first `kept` stay for ever and are drawn only where the past of others counts too: what was
    collected before the training.
    """

    transitions: Transition  # (capacity, ...)
    violating: Transition  # (fewer, ...): copies, so that they outlast the ring
    kept: Int[Array, ""]
    added: Int[Array, ""]  # since the beginning, the kept ones included
    violated: Int[Array, ""]  # of those added

    @classmethod
    def create(
        cls,
        observation: int,
        action: int,
        capacity: int,
        violating: int = 20_000,
        kind: type[Transition] = Transition,
    ) -> "ReplayBuffer":
        """An empty one for so many numbers seen and done, so many transitions and violations.

        Of a `kind` of transition that may have more fields, of a number each.
        """
        more = len(dataclasses.fields(kind)) - len(dataclasses.fields(Transition))

        def empty(count: int) -> Transition:
            seen, done = np.zeros((count, observation)), np.zeros((count, action))
            one = np.zeros(count)
            # Buffers are donated to compiled calls: no array may stand in two places.
            return jax.tree.map(
                as_array, kind(seen, done, done, one, one, seen, one, *more * [one])
            )

        counts = (as_array(0, jnp.int32), as_array(0, jnp.int32), as_array(0, jnp.int32))
        return cls(empty(capacity), empty(min(violating, capacity)), *counts)

    @property
    def filled(self) -> Int[Array, ""]:
        """How many transitions there are to draw from."""
        return jnp.minimum(self.added, len(self.transitions.reward))

    def add(self, batch: Transition, count: Any = None) -> "ReplayBuffer":
        """With a batch (n, ...) more, in place of the oldest where there is no room.

        Only the first `count` of the batch, if it is given: a number that may be traced.
        """
        count, nth = len(batch.reward) if count is None else count, jnp.arange(len(batch.reward))
        ring = len(self.transitions.reward) - self.kept
        places = self.added - self.kept + nth
        places = self.kept + places % jnp.maximum(ring, 1)
        violates = (batch.cost > 0) & (nth < count)
        fits = places < len(self.transitions.reward)
        room = len(self.violating.reward)
        rare = self.violated + jnp.cumsum(violates) - 1
        return ReplayBuffer(
            _written(self.transitions, batch, places, fits & (nth < count)),
            _written(self.violating, batch, rare % room, violates),
            self.kept,
            self.added + count,
            self.violated + jnp.sum(violates),
        )

    def keep(self) -> "ReplayBuffer":
        """With all there is so far kept for ever."""
        return eqx.tree_at(lambda buffer: buffer.kept, self, jnp.array(self.filled))

    def sample(self, key: PRNGKeyArray, count: int) -> Transition:
        """`count` of the transitions after the kept ones, each as likely as any other."""
        chosen = jax.random.randint(key, (count,), self.kept, self.filled)
        return jax.tree.map(lambda leaf: leaf[chosen], self.transitions)

    def sample_violating(
        self, key: PRNGKeyArray, count: int, share: float
    ) -> tuple[Transition, Float[Array, " n"]]:
        """`count` of all transitions, of which the first `share` violate a constraint; weights.

        As long as none does, the whole is drawn from all. Recovery RL (arXiv 2010.15920) draws so
        where violations are rare, and so makes them seem likely. With the weights a sum over what
        is drawn expects what one over an even draw does.
        """
        violating = round(share * count)
        keys = jax.random.split(key, 2)
        chosen = jax.random.randint(keys[0], (count,), 0, self.filled)
        drawn = jax.tree.map(lambda leaf: leaf[chosen], self.transitions)
        there = jnp.minimum(self.violated, len(self.violating.reward))
        rare = jax.random.randint(keys[1], (violating,), 0, jnp.maximum(there, 1))

        def mixed(leaf: Array, own: Array) -> Array:
            first = jnp.where(there > 0, own[rare], leaf[:violating])
            return jnp.concatenate([first, leaf[violating:]])

        batch = jax.tree.map(mixed, drawn, self.violating)
        extra = jnp.where(there > 0, violating / count, 0.0)
        rate = self.violated / jnp.maximum(self.added, 1)
        of_violating = rate / jnp.maximum(extra + (1.0 - extra) * rate, 1e-9)
        return batch, jnp.where(batch.cost > 0, of_violating, 1.0 / (1.0 - extra))


def _written(
    ring: Transition, batch: Transition, places: Int[Array, " n"], which: Bool[Array, " n"]
) -> Transition:
    """The ring with those of the batch at their places that are to be written."""
    nowhere = len(ring.reward)
    places = jnp.where(which, places, nowhere)
    return jax.tree.map(lambda old, new: old.at[places].set(new, mode="drop"), ring, batch)
