"""What a policy of the maze knows where it matters: risk before force, and stiffness in a push.

The risk is put to the test as it is meant: what happens next if nothing is done about it?
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy.stats import spearmanr

from palpate.networks.guarded import ActorPolicy, GuardedPolicy
from palpate.runs import Figure
from palpate.worlds.gymnasium import GymnasiumWorlds
from palpate.worlds.maze.maze import STIFFNESS_RANGE

PROBES = 200
LATEST, AHEAD = 100, 10  # decisions: before a probe at most, and those that it looks ahead
PUSHED = 5e-4  # m in one decision, from which on the obstacle is being pushed


@dataclass(frozen=True)
class Probes:
    """Of one state of each world, and of all decisions that pushed the obstacle."""

    risk: Float[np.ndarray, " worlds"]  # of what the policy would do
    force: Float[np.ndarray, " worlds"]  # as a share of the limit, felt then
    greatest: Float[np.ndarray, " worlds"]  # N, true, in the decisions that follow, unguarded
    along: Float[np.ndarray, " pushes"]  # N/m, in the direction of the motion
    across: Float[np.ndarray, " pushes"]


def probe(policy: ActorPolicy, environments: GymnasiumWorlds, seed: int) -> Probes:
    """Each world is stopped once, at a random time: from there on nothing overrules the policy.

    Until then it acts under its guard, and pushes are noted.
    """
    count, random = environments.num_envs, np.random.default_rng(seed)
    when = random.integers(0, LATEST, count)
    worlds = environments.lockstep.worlds
    guarded = policy if isinstance(policy, GuardedPolicy) else None

    @jax.jit
    def decide(observation: jax.Array) -> tuple[jax.Array, ...]:
        proposed = policy.propose(observation)
        risk = observation[:, 0] if guarded is None else guarded.risk(observation, proposed)
        return proposed, policy(None, observation)[1], risk

    observation, _ = environments.reset(seed=seed)
    risk, force, greatest = np.zeros((3, count))
    over, pushes = np.zeros(count, bool), []
    for step in range(LATEST + AHEAD):
        proposed, executed, risky = map(np.asarray, decide(observation))
        now, ahead = when == step, (when <= step) & (step < when + AHEAD) & ~over
        risk[now], force[now] = risky[now], np.hypot(observation[now, 0], observation[now, 1])
        before = _displacements(worlds)
        action = np.where(ahead[:, None], proposed, executed)
        observation, _, terminated, truncated, info = environments.step(action)
        greatest[ahead] = np.maximum(greatest, info["force"])[ahead]
        ended = terminated | truncated
        over |= ended & ahead
        pushing = (step < when) & ~ended & (_displacements(worlds) - before > PUSHED)
        pushes.append(executed[pushing, 2:4])
    low, high = STIFFNESS_RANGE
    along, across = (low + (high - low) * (np.concatenate(pushes) + 1) / 2).T
    return Probes(risk, force, greatest, along, across)


def _displacements(worlds: Sequence[Any]) -> Float[np.ndarray, " worlds"]:
    """m by which each world's obstacle has been; 0 where none is known."""
    return np.array([getattr(world.truth(), "obstacle", 0.0) for world in worlds])


def figures(found: Probes, *, guarded: bool, free: bool) -> list[Figure]:
    """Of a `guarded` policy how well its risk orders the forces that follow, beside the present
    force; of one that is `free` to choose its stiffness how much stiffer it pushes along than
    across. Unknown (None) where nothing varies, or nothing was pushed."""
    listed = []
    if guarded:
        knows = rank_correlation(found.risk, found.greatest)
        felt = rank_correlation(found.force, found.greatest)
        gain = None if knows is None or felt is None else knows - felt
        listed += [
            Figure("risk_rank_correlation", knows, "", better="higher"),
            Figure("risk_gain_over_force", gain, "", better="higher"),
        ]
    if free:
        contrast = float(found.along.mean() / found.across.mean()) if len(found.along) else None
        listed.append(Figure("stiffness_contrast", contrast, "", better="higher"))
    return listed


def rank_correlation(one: Float[np.ndarray, " n"], other: Float[np.ndarray, " n"]) -> float | None:
    """Spearman's; None where one of them is always the same."""
    if np.ptp(one) == 0 or np.ptp(other) == 0:
        return None
    return float(spearmanr(one, other).statistic)
