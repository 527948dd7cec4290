"""Surfaces of generated appliances of which is known whether they move: the judge looks them up."""

import numpy as np
from jaxtyping import Float

from palpate.errors import PalpateError
from palpate.perception.clouds import cloud_of
from palpate.perception.surface_features import FEATURES, features_of
from palpate.perception.surfaces import Surface, surfaces
from palpate.worlds.appliance.appliance import ApplianceWorld

Examples = tuple[Float[np.ndarray, "surfaces features"], Float[np.ndarray, " surfaces"]]


def examples_of(category: str, seed: int) -> Examples:
    """Features of the surfaces of a first look, and whether each moves, 1.0 or 0.0.

    As nobody knows any part yet, and once more as those are known that hang on what stands still:
    then whether what is on them moves on them. None where too little is seen.
    """
    world = ApplianceWorld(category, seed)
    world.reset(seed)
    try:
        cloud = cloud_of(world.look())
    except PalpateError:
        return np.empty((0, len(FEATURES))), np.empty(0)
    truth = world.truth()
    real = np.array([truth.labels[image][row, column] for image, row, column in cloud.source])
    carrier = np.arange(len(truth.parts))  # of each part, the one that hangs on what stands still
    for number, part in enumerate(truth.parts):
        carrier[number] = number if part.parent < 0 else carrier[part.parent]
    random = np.random.default_rng([seed, 13])
    known = np.where(real >= 0, carrier[np.maximum(real, 0)], -1)
    found = []
    for labels in (np.full(len(real), -1), known):
        every = surfaces(cloud, labels, random)
        moves = [_moves(one, real) for one in every]
        kept = [index for index, one in enumerate(every) if one.part >= 0 or labels is not known]
        found.append((features_of(cloud, every)[kept], np.array(moves, float)[kept]))
    return np.concatenate([one[0] for one in found]), np.concatenate([one[1] for one in found])


def _moves(surface: Surface, real: np.ndarray) -> bool:
    """Whether most of a surface's points are of a part that is not the known one they are on."""
    values, counts = np.unique(real[surface.members], return_counts=True)
    return bool(values[np.argmax(counts)] >= 0 and values[np.argmax(counts)] != surface.part)
