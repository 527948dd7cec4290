"""Two hinges, one on what the other carries, that a hand may have turned at once.

What a hand holds is a flat piece: the looks before and after show its normal, and the hand is known
to be at it. So if its carrier turned about a known line by a known angle, the other hinge is known
as well. As seen from the carrier it is across both normals, and it takes the hand from where it
began to where it ended. What is left open is the carrier's line, which is sought at the edges of
pieces, and its angle.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from palpate.identification.interactive.edges.pieces import Piece, edges_of, pieces_of
from palpate.identification.interactive.screws import NOWHERE, Pose, Screw, cross, rotation_about
from palpate.identification.interactive.two_joints import Linkage
from palpate.perception.clouds import Cloud

AT_HAND = 0.05  # m from a hand: pieces that it may hold
MOST_HELD = 3  # of them
TURNS = np.arange(-2.2, 2.21, 0.05)  # rad, of a carrier
LEAST_TURN, MOST_TURN = 0.1, 2.4  # rad, of a carrier, and of what it carries
PARALLEL = 0.97  # cosine between an edge and the axis that a hand's piece turns about, known better
ASIDE = 0.03  # m that a hand may seem to go along a hinge
TOUCHES = 0.06  # m from a carrier to the hinge on it
OFF = 0.03  # m that a pair may miss a hand on its way
# Shares of what a pair explains that are taken off for each rad that both hinges turn, and for each
# m from its hinge to the end of what is held, up to some m: truer ones were behind by up to .15.
COST, UNENDED, MOST_UNENDED = 0.08, 0.5, 0.15
ALONG = 15.0  # deg between an edge and a hinge that may be there

Vector = Float[np.ndarray, "3"]


class Grip(NamedTuple):
    """What a hand may hold: the normal and edges of a piece, and the place of the hand (m), in the
    looks before and after."""

    normals: tuple[Vector, Vector]
    edges: tuple[list[Screw], list[Screw]]
    places: tuple[Vector, Vector]


class HingePair(NamedTuple):
    """A carrier's hinge and the hinge on it, both as they were in the look before, and how far each
    has turned in the look after (rad)."""

    carrier: Screw
    turn: float
    carried: Screw
    carried_turn: float
    grip: Grip

    @property
    def motions(self) -> tuple[Pose, Pose]:
        """Of the carrier and of what it carries, from the look before to the one after."""
        carrier = self.carrier.pose(self.turn)
        return carrier, carrier @ self.carried.pose(self.carried_turn)

    @property
    def weight(self) -> float:
        """What counts of all that it explains: hinges turn no further than they have to, and what
        is held ends at its hinge in one of the looks."""
        hinges = self.carried, self.carried.moved(self.carrier.pose(self.turn))
        away = min(map(_distance_to_end, hinges, self.grip.edges, self.grip.places))
        turned = abs(self.turn) + abs(self.carried_turn)
        return 1.0 - COST * turned - UNENDED * min(away, MOST_UNENDED)

    def follows(self, way: Float[np.ndarray, "times 3"]) -> bool:
        """Whether it lets a hand go its way and turns as far as it has to: two positions of two
        hinges take a hand to most places."""
        linkage = Linkage(NOWHERE, (self.carrier, self.carried), way[:3].mean(axis=0)[None])
        return linkage.leads((0.0, 0.0), (self.turn, self.carried_turn), way, OFF)

    def with_carrier(self, carrier: Screw, turn: float) -> "HingePair | None":
        """The pair in which the carrier turned otherwise and what is held went as it does; None if
        it then hardly turns on its carrier, or goes along its hinge."""
        goes = carrier.pose(turn).inverse @ self.motions[1]
        cosine = 0.5 * (float(np.trace(goes.rotation)) - 1.0)
        angle = math.acos(min(max(cosine, -1.0), 1.0))
        if not LEAST_TURN < angle < MOST_TURN:
            return None
        skew = goes.rotation - goes.rotation.T
        axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / (2.0 * math.sin(angle))
        place = self.grip.places[0]
        point = _centre(axis, angle, place, goes.at(place[None])[0])
        if point is None:
            return None
        carried = Screw("revolute", axis, point)
        return HingePair(carrier, turn, carried, angle, self.grip)

    def near(self, turn: float, aside: float) -> "Iterator[HingePair]":
        """Pairs with a carrier that turned by so much more or less (rad), about lines so far (m)
        beside its own."""
        first, second = self.carrier.across
        for more, one, other in itertools.product((-1, 0, 1), repeat=3):
            point = self.carrier.point + aside * (one * first + other * second)
            line = dataclasses.replace(self.carrier, point=point)
            if (pair := self.with_carrier(line, self.turn + more * turn)) is not None:
                yield pair

    def is_beyond(self, points: Float[np.ndarray, "n 3"], *, after: bool) -> Bool[np.ndarray, " n"]:
        """Which points, as seen from the carrier, are on the hand's side of the hinge on it."""
        hinge, hand = self.carried, self.grip.places[0] - self.carried.point
        if after:
            hand = rotation_about(hinge.axis, self.carried_turn) @ hand
        carrier = self.carrier.near(hinge.point).point
        return hinge.is_beyond(points, hinge.point + hand, carrier)


def grips(looks: tuple[Cloud, Cloud], places: tuple[Vector, Vector]) -> list[Grip]:
    """What a hand may hold at its places before and after: either side may be seen after."""
    before, after = map(_pieces_at, looks, places)
    return [
        Grip(
            (first.surface.normal, side * second.surface.normal),
            (edges_of(first.surface), edges_of(second.surface)),
            places,
        )
        for first, second in itertools.product(before, after)
        for side in (1.0, -1.0)
    ]


def hinge_pairs(
    hinges: list[Screw], points: Float[np.ndarray, "n 3"], grip: Grip, *, after: bool
) -> Iterator[HingePair]:
    """Pairs with one of some hinges of a carrier, by all angles, if the other hinge is at points of
    the carrier. Both are as they were in the look before or `after`."""
    across = cross(*grip.normals)
    sine = float(np.linalg.norm(across))
    for edge in hinges:
        parallel = sine > LEAST_TURN and abs(edge.axis @ across) > PARALLEL * sine
        hinge = dataclasses.replace(edge, axis=across / sine) if parallel else edge
        for turn in TURNS[np.abs(TURNS) > LEAST_TURN].tolist():
            back = hinge.pose(turn).inverse
            if (carried := _hinge_on_carrier(back, grip)) is None:
                continue
            own = back.at(points) if after else points
            away = carried[0].radii(own)
            if away.min() < TOUCHES:
                yield HingePair(hinge, turn, *carried, grip)


def _pieces_at(cloud: Cloud, place: Vector) -> list[Piece]:
    """The pieces that a hand may hold at a place: at least the nearest one."""
    pieces = pieces_of(cloud)
    away = [
        float(np.linalg.norm(cloud.points[one.surface.members] - place, axis=1).min())
        for one in pieces
    ]
    order = np.argsort(away)[:MOST_HELD]
    return [pieces[one] for one in order if away[one] < max(AT_HAND, away[order[0]] + 0.01)]


def _hinge_on_carrier(back: Pose, grip: Grip) -> tuple[Screw, float] | None:
    """The hinge of what is held, on a carrier that comes `back` so from the look after, and how far
    it has turned (rad); None if none takes the hand where it went."""
    normal, there = back.rotation @ grip.normals[1], back.at(grip.places[1][None])[0]
    across = cross(grip.normals[0], normal)
    sine = float(np.linalg.norm(across))
    angle = math.atan2(sine, float(grip.normals[0] @ normal))
    if not LEAST_TURN < angle < MOST_TURN:
        return None
    axis = across / sine
    point = _centre(axis, angle, grip.places[0], there)
    return None if point is None else (Screw("revolute", axis, point), angle)


def _centre(axis: Vector, angle: float, start: Vector, end: Vector) -> Vector | None:
    """A point of the line about which a turn by an angle (rad) takes a place to another one; None
    if it also went along that line."""
    chord = end - start
    along = float(chord @ axis)
    if abs(along) > ASIDE:
        return None
    chord = chord - along * axis
    return start + 0.5 * chord + 0.5 / math.tan(0.5 * angle) * cross(axis, chord)


def _distance_to_end(hinge: Screw, edges: list[Screw], hand: Vector) -> float:
    """How far (m) a hinge is from the end of what is held: of the edges along the hinge, the one
    that is furthest from the hand."""
    along = [one for one in edges if one.distance_to(hinge)[0] < ALONG]
    if not along:
        return MOST_UNENDED
    end = max(along, key=lambda one: math.hypot(*cross(one.axis, hand - one.point)))
    return end.distance_to(hinge)[1]
