"""Surfaces of generated appliances of which is known whether they move: the judge looks them up."""

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.identification.interactive.averaging import average
from palpate.identification.interactive.screws import NOWHERE
from palpate.perception.clouds import cloud_of
from palpate.perception.surface_features import FEATURES, features_of
from palpate.perception.surfaces import Surface, surfaces
from palpate.worlds.appliance.appliance import ApplianceWorld

SHARE = 0.4  # of a surface's points that move: a lid may fold in the middle
# Looks that are averaged, and the share of the parts that hang on what stands still which are known
# by then.
STAGES = (1, 0.0), (3, 0.6), (3, 1.0), (8, 0.6), (8, 1.0)

Examples = tuple[Float[np.ndarray, "surfaces features"], Float[np.ndarray, " surfaces"]]


def examples_of(category: str, seed: int) -> Examples:
    """Features of the surfaces of an appliance at rest, and whether each moves, 1.0 or 0.0.

    As nobody knows any part yet, in a first look; and as some or all are known that hang on what
    stands still, in the mean of a few looks and of some more, which shows other surfaces than one
    look does: then of those of the known parts whether what is on them moves on them. None where
    too little is seen.
    """
    world = ApplianceWorld(category, seed)
    world.reset(seed)
    try:
        looks = [cloud_of(world.look()) for _ in range(max(count for count, _ in STAGES))]
    except PalpateError:
        return np.empty((0, len(FEATURES))), np.empty(0)
    truth = world.truth()
    carrier = np.arange(len(truth.parts))  # of each part, the one that hangs on what stands still
    for number, part in enumerate(truth.parts):
        carrier[number] = number if part.parent < 0 else carrier[part.parent]
    carrier = np.append(carrier, -1)  # of what stands still
    real = [
        np.array([truth.labels[image][row, column] for image, row, column in look.source])
        for look in looks
    ]
    random, found = np.random.default_rng([seed, 13]), []
    for count, share in STAGES:
        known = random.random(len(carrier)) < share
        held = np.where((carrier >= 0) & known[carrier], carrier, -1)
        labels = [held[one] for one in real[:count]]
        still = [NOWHERE] * count
        cloud = average(looks[:count], labels, 0, dict.fromkeys(held.tolist(), still))
        every = surfaces(cloud, labels[0], random)
        moves = [_moves(one, real[0]) for one in every]
        found.append((features_of(cloud, every), np.array(moves, float)))
    return np.concatenate([one[0] for one in found]), np.concatenate([one[1] for one in found])


def _moves(surface: Surface, real: np.ndarray) -> bool:
    """Whether enough of a surface is of a part that is not the known one it is on."""
    own = real[surface.members]
    return bool(np.mean((own >= 0) & (own != surface.part)) > SHARE)
