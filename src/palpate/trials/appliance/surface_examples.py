"""Surfaces of generated appliances of which is known whether they move: the judge looks them up."""

import numpy as np
from jaxtyping import Float, Int

from palpate.errors import PalpateError
from palpate.identification.interactive.averaging import average
from palpate.identification.interactive.screws import NOWHERE
from palpate.perception.clouds import Cloud, cloud_of
from palpate.perception.surface_features import FEATURES, features_of
from palpate.perception.surfaces import Surface, surfaces
from palpate.worlds.appliance.appliance import ApplianceWorld

SHARE = 0.4  # of a surface's points that move: a lid may fold in the middle
AT_END = 0.4  # share of the known parts that hands have left at an end
# Looks that are averaged, of so many from one place; the share of the parts that hang on what
# stands still which are known by then; and whether hands have moved these.
STAGES = (
    (1, (1,), 0.0, False),
    (3, (3,), 0.6, False),
    (5, (2, 5), 0.6, True),
    (5, (2, 5), 1.0, True),
)

Examples = tuple[Float[np.ndarray, "surfaces features"], Float[np.ndarray, " surfaces"]]


def examples_of(category: str, seed: int) -> Examples:
    """Features of the surfaces of an appliance, and whether each moves, 1.0 or 0.0.

    As nobody knows any part yet, in a first look; and as some or all are known that hang on what
    stands still, where they were or where hands have left them, in the mean of some looks, which
    shows other surfaces than one look does: then of those of the known parts whether what is on
    them moves on them. None where too little is seen.
    """
    world = ApplianceWorld(category, seed)
    world.reset(seed)
    parts, rest, random = world.parts, world.truth().position, np.random.default_rng([seed, 13])
    carrier = np.arange(len(parts))  # of each part, the one that hangs on what stands still
    for number, part in enumerate(parts):
        carrier[number] = number if part.parent < 0 else carrier[part.parent]
    found = [(np.empty((0, len(FEATURES))), np.empty(0))]
    for count, averaged, share, moved in STAGES:
        known = random.random(len(parts)) < share
        known &= carrier == np.arange(len(parts))
        if moved:
            place = random.uniform(-AT_END, 1.0 + AT_END, len(parts)).clip(0.0, 1.0)
            there = world.scene.closed + place * world.scene.travel
            world.reset(seed, position=np.where(known, there, rest))
        try:
            looks, real = _look_at(world, count)
        except PalpateError:
            continue
        held = np.append(np.where(known[carrier], carrier, -1), -1)  # the last of what stands still
        labels = [held[one] for one in real]
        for used in averaged:
            still = dict.fromkeys(held.tolist(), [NOWHERE] * used)
            cloud = average(looks[:used], labels[:used], 0, still)
            every = surfaces(cloud, labels[0], random)
            moves = [_moves(one, real[0]) for one in every]
            found.append((features_of(cloud, every), np.array(moves, float)))
    return np.concatenate([one[0] for one in found]), np.concatenate([one[1] for one in found])


def _look_at(world: ApplianceWorld, count: int) -> tuple[list[Cloud], list[Int[np.ndarray, " _"]]]:
    """Clouds of an appliance, and the part of which each of their points really is."""
    looks, real = [], []
    for _ in range(count):
        cloud = cloud_of(world.look())
        labels = world.truth().labels
        looks.append(cloud)
        real.append(np.array([labels[image][row, column] for image, row, column in cloud.source]))
    return looks, real


def _moves(surface: Surface, real: np.ndarray) -> bool:
    """Whether enough of a surface is of a part that is not the known one it is on."""
    own = real[surface.members]
    return bool(np.mean((own >= 0) & (own != surface.part)) > SHARE)
