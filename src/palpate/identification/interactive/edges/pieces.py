"""Flat pieces of a look, and the hinges that may be at their edges."""

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Int

from palpate.identification.interactive.screws import Screw
from palpate.identification.interactive.tree import FEWEST
from palpate.perception.clouds import Cloud
from palpate.perception.surfaces import Surface, surfaces

STRANGE = 0.35  # share of a piece's points that no known motion explains
POINTS = 120  # of a piece, by which it is tried


class Piece(NamedTuple):
    """A flat piece of a cloud, and the points by which it is tried."""

    surface: Surface
    members: Int[np.ndarray, " n"]


_KNOWN: WeakKeyDictionary[Cloud, list[Piece]] = WeakKeyDictionary()


def pieces_of(cloud: Cloud) -> list[Piece]:
    """The flat pieces of a look, whatever they are of; sought once."""
    if cloud not in _KNOWN:
        whole = np.zeros(len(cloud.points), int)
        _KNOWN[cloud] = [
            Piece(one, one.members[:: max(1, len(one.members) // POINTS)])
            for one in surfaces(cloud, whole, np.random.default_rng(0))
            if len(one.members) >= FEWEST
        ]
    return _KNOWN[cloud]


def edges_of(surface: Surface) -> list[Screw]:
    """Hinges at the four edges of a piece."""
    middle, found = 0.5 * (surface.low + surface.high), []
    for side in (0, 1):
        for end in (surface.low[side], surface.high[side]):
            place = middle.copy()
            place[side] = end
            point = surface.centre + place @ surface.sides
            found.append(Screw("revolute", surface.sides[1 - side], point))
    return found
