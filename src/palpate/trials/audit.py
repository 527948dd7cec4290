"""What energy a controller can be made to draw, as a meter in the simulator counts it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from palpate.errors import PalpateError
from palpate.safety.filtered_law import FilteredLaw
from palpate.worlds.world import DivergedError, World, side_by_side

Actions = Float[np.ndarray, "worlds actions"]


@runtime_checkable
class Adversary(Protocol):
    """Who decides what the controller is asked to do."""

    def begin(self, worlds: int, random: np.random.Generator) -> None:
        """An episode of so many worlds begins."""
        ...

    def decide(self, observation: Any) -> tuple[Actions, Bool[np.ndarray, " worlds"]]:
        """Actions in [-1, 1] of this control period, and where they are new decisions."""
        ...


class Audit(NamedTuple):
    """What was found in each world, over all its episodes; energies in J."""

    rise: Float[np.ndarray, " worlds"]  # the greatest of what is stored and in the tank, above the
    # beginning and less the work from outside
    margin: Float[np.ndarray, " worlds"]  # the least level above the reserve; inf without a tank
    drawn: Float[np.ndarray, " worlds"]  # the most that actions gave to the robot in an episode
    braked: Float[np.ndarray, " worlds"]  # the least share of a braking force that passed
    touching: Float[np.ndarray, " worlds"]  # the share of periods in contact
    steps: int  # control periods, of all worlds together


def audit(
    worlds: Sequence[World],
    law: FilteredLaw,
    adversary: Adversary,
    *,
    periods: int,
    episodes: int,
    seed: int,
    touches: Callable[[Any], bool],
    reserve: float = 0.0,
) -> Audit:
    """Episodes of `periods` control periods in worlds side by side.

    Energy and tank are read at the samples, when the filter has booked what the last force drew:
    `World.meter` before the next is held. `touches` says of a truth whether the robot is in
    contact. A force brakes that is against the motion and does not turn it round in one period.
    Where a simulation diverges, the episode of all ends. Of worlds without a meter the rise is NaN.
    Raises `PalpateError` for fewer than one episode or period.
    """
    if min(periods, episodes) < 1:
        raise PalpateError("an audit takes at least one episode of one control period")
    random = np.random.default_rng([seed, 7])
    count, metered = len(worlds), type(worlds[0]).meter is not World.meter
    rise, margin, most = np.full((3, count), -np.inf) * [[1], [-1], [1]]
    braked, touching, steps = np.ones(count), np.zeros(count), 0
    for episode in range(episodes):
        first = seed + count * episode
        seen = [world.reset(first + number) for number, world in enumerate(worlds)]
        adversary.begin(count, random)
        begins, drawn = np.zeros((2, count))
        for period in range(periods + 1):
            observation = side_by_side(seen)
            action, new = adversary.decide(observation)
            if new.any():
                law.begin(observation, action, np.full(count, period == 0))
            force = law.command(observation)
            held = np.full(count, np.nan)
            if metered:
                meters = np.array([world.meter() for world in worlds])
                held = meters[:, 0] - meters[:, 1]
            if law.level is not None:
                held = held + law.level
                margin = np.minimum(margin, law.level - reserve)
            if period == 0:
                begins = held
            rise = np.maximum(rise, held - begins)
            if period == periods:
                break
            braked = np.minimum(braked, law.braked(observation))
            try:
                for number, world in enumerate(worlds):
                    seen[number] = world.step(force[number])
            except DivergedError:
                break  # of so much energy that the meter has shown it
            steps += count
            touching += [touches(world.truth()) for world in worlds]
            went = np.array([one.displacement[: law.axes] for one in seen])
            drawn += (law.applied * went).sum(axis=1)
            most = np.maximum(most, drawn)
    return Audit(rise, margin, most, braked, touching * count / max(steps, 1), steps)


class EnergyWatch:
    """What a policy decides, and beside it how energy and tank go, episode by episode.

    It is called as the policy is, with observations of `environments` that stand side by side, and
    reads the meters of their worlds at each decision: of worlds that are stepped, which are those
    behind a filter. What the last force drew and the filter has yet to book is taken off. `rise`
    has of each episode, in the order of `palpate.learning.off_policy.evaluate`, the greatest rise
    of what is stored and in the tank above its beginning, less the work from outside, J.
    """

    def __init__(self, act: Callable[[np.ndarray], np.ndarray], environments: Any):
        self._act, self._inside = act, environments.lockstep
        count = len(self._inside.worlds)
        self._episode, self._begins = np.full(count, -1), np.zeros(count)
        self._rises: dict[tuple[int, int], float] = {}

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The policy's actions."""
        inside = self._inside
        meters = np.array([world.meter() for world in inside.worlds])
        held, law = meters[:, 0] - meters[:, 1], inside.law
        fresh, full = inside.fresh, law.filter.level(law.filter.begin(len(meters)))
        if full is not None and fresh.all():
            held = held + full
        elif full is not None:
            seen = side_by_side(inside.observations)
            drawn = (law.applied * seen.displacement[:, : law.axes]).sum(axis=1)
            held = held + np.where(fresh, full, law.level - drawn)
        self._episode += fresh
        self._begins = np.where(fresh, held, self._begins)
        for number, rise in enumerate((held - self._begins).tolist()):
            key = int(self._episode[number]), number
            self._rises[key] = max(rise, self._rises.get(key, 0.0))
        return self._act(observation)

    def rise(self, episodes: int) -> Float[np.ndarray, " episodes"]:
        """Of so many episodes, J."""
        count = len(self._inside.worlds)
        return np.array([self._rises[divmod(number, count)] for number in range(episodes)])
