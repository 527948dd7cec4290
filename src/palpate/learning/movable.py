"""What is believed of a surface: whether it moves, about or along what, and how hard it goes.

A surface stands still, or all of it or a piece (two doors beside each other are one surface to a
camera) turns about one of the edges of its rectangle, or slides along its normal or a side of it.
How likely it is to move is guessed by how it stands in the scene (`movable_guess`); what a hand
found that pulled at it, and felt it stand still or go, weighs the joints anew (Bayes).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from palpate.perception.surfaces import Surface

# Shares of the joints: each of four, of one, and each of two.
HINGE, ALONG_NORMAL, ALONG_SIDE = 0.15, 0.24, 0.08
JOINTS = 7
# A hinge is as likely as this power of the lever that handles have about it. A constant is added,
# as what stands off may be no handle: knobs of a panel beside a door.
LEVER, LEAST_LEVER = 2.0, 0.1
# Pieces of a surface, from one share of a side of its rectangle to another, and how many parts are
# such a piece along either side; the others are all of their surface, 130 of 200 generated ones.
# The last is a leaf between its posts; how those below .5 share what is left is not measured.
SPANS = {(0.0, 0.5): 0.045, (0.5, 1.0): 0.045}
SPANS |= dict.fromkeys([(0.0, 0.25), (0.75, 1.0), (0.0, 0.75), (0.25, 1.0), (0.15, 0.85)], 0.018)
ALL = (0.0, 1.0)
PIECES = np.array([(ALL, ALL), *((one, ALL) for one in SPANS), *((ALL, one) for one in SPANS)])
SIZES = np.array([1.0 - 2.0 * sum(SPANS.values()), *SPANS.values(), *SPANS.values()])
# Of a side: so near the end of a piece within the surface a hand may be beside the piece, with this
# probability.
BORDER, BESIDE = 0.06, 0.5
# Share of what moves that goes both ways, only the way of the axis or only against it: along the
# normal that is outwards, as what is closed goes.
SENSES = 3
SENSES_OUT, SENSES_SIDE = (0.45, 0.5, 0.05), (0.3, 0.35, 0.35)
# Of a hand's force at the best place: least and most that moves a part. Its logarithm is uniform:
# most parts go easily, and a lid may need nearly all of it.
RESISTANCE = 0.03, 1.0
HEAVY = 0.01  # probability that none moves it: of 218 generated parts that were seen, of none
PLAYED = 0.0015  # m: a hand that got so far has felt something give
CATCH = 0.03  # m: a part that stops so far from where it was is as likely held there, by a latch
# or as it is too heavy, as it is at its end, which may be anywhere
STRAYED = 0.05  # probability that something else went with the hand
# Probability that a hand feels a little play where a part is held by a latch, by friction or by a
# soft stop at its end, and where all stands still: 32 of 178 pulls, and 1 of 467.
PLAY, PLAY_STILL = 0.2, 0.003
FELT = 0.05  # share of a hand's force along a joint that makes it play

Chances = Float[np.ndarray, " hypotheses"]


class Belief(NamedTuple):
    """What is believed of a surface: how likely each hypothesis is, that of standing still first,
    and the greatest share of a hand's force that each joint has withstood."""

    chances: Chances
    withstood: Chances

    @property
    def chance(self) -> float:
        """Probability that the surface moves."""
        return 1.0 - float(self.chances[0])


class Pull(NamedTuple):
    """Where a hand pulled and which way, and what came of it: how far it got, and whether something
    moved. Of its `force` no more than this share got there, as something else gave way."""

    point: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]
    moved: bool
    travel: float  # m
    ended: bool  # before the hand had gone as far as it would
    force: float = 1.0


def prior(chance: float, surface: Surface) -> Belief:
    """Of standing still, and of each piece's joints and senses, given the probability to move.

    A hinge is likely where handles have a long lever about it.
    """
    joints = np.array([HINGE] * 4 + [ALONG_NORMAL] + [ALONG_SIDE] * 2)
    senses = np.array([SENSES_OUT] * 5 + [SENSES_SIDE] * 2)
    hinges = joints * np.ones((len(PIECES), 1))
    if len(surface.handles):
        out = np.broadcast_to(surface.normal, surface.handles.shape)
        levers = _forces(surface, surface.handles, out).reshape(len(out), len(PIECES), JOINTS)
        share = LEAST_LEVER + (levers[..., :4] ** LEVER).mean(axis=0)
        hinges[:, :4] *= 4.0 * share / share.sum(axis=1, keepdims=True)
    moving = chance * (SIZES[:, None, None] * hinges[..., None] * senses).ravel()
    chances = np.concatenate([[1.0 - moving.sum()], moving])
    return Belief(chances, np.zeros(len(chances)))


def _forces(surface: Surface, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Share of each pull's force that turns or slides each piece by each of its joints, signed;
    (n, 7 * pieces)."""
    low, high = PIECES[..., 0], PIECES[..., 1]
    # of the way to the upper edges
    share = np.clip((_places(surface, points) - low) / (high - low), 0.0, 1.0)
    out = np.broadcast_to((directions @ surface.normal)[:, None, None], (*share.shape[:2], 1))
    sideways = np.broadcast_to((directions @ surface.sides.T)[:, None], share.shape)
    forces = [out * share, out * (1.0 - share), out, sideways]
    return np.concatenate(forces, axis=2).reshape(len(points), -1)


def _places(surface: Surface, points: np.ndarray) -> Float[np.ndarray, "n 1 2"]:
    """Where points are along the sides of a surface's rectangle, from 0 to 1."""
    extent = np.maximum(surface.high - surface.low, 1e-3)
    place = (points - surface.centre) @ surface.sides.T
    return np.clip((place - surface.low) / extent, 0.0, 1.0)[:, None]


def _chance_of_hold(surface: Surface, points: np.ndarray) -> Float[np.ndarray, "n hypotheses"]:
    """Probability that a hand at each point has hold of the piece of each hypothesis."""
    place, low, high = _places(surface, points), PIECES[..., 0], PIECES[..., 1]
    within = np.minimum(
        np.where(low > 0.0, place - low, 1.0), np.where(high < 1.0, high - place, 1.0)
    ).min(axis=2)
    held = np.where(within > BORDER, 1.0, np.where(within > -BORDER, 1.0 - BESIDE, 0.0))
    return np.pad(np.repeat(held, JOINTS * SENSES, axis=1), [(0, 0), (1, 0)], constant_values=1.0)


def _shares(
    surface: Surface, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n hypotheses"]:
    """Share of each pull's force that goes into the motion of each hypothesis; none of standing."""
    forces = _forces(surface, points, directions)
    ways = np.stack([np.abs(forces), forces, -forces], axis=2).reshape(len(points), -1)
    return np.pad(np.maximum(ways, 0.0), [(0, 0), (1, 0)])


def _goes(
    shares: Float[np.ndarray, "*n hypotheses"], withstood: Chances
) -> Float[np.ndarray, "*n hypotheses"]:
    """Probability that such shares of a hand's force move what has withstood others."""
    least, most = RESISTANCE

    def below(share: np.ndarray) -> np.ndarray:
        return (1.0 - HEAVY) * np.log(np.clip(share, least, most) / least) / np.log(most / least)

    known = below(withstood)
    return np.maximum(below(shares) - known, 0.0) / (1.0 - known)


def moves(
    belief: Belief,
    surface: Surface,
    points: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    force: Float[np.ndarray, " n"] | float = 1.0,
) -> Float[np.ndarray, " n"]:
    """Probability that each pull moves the surface, with a share of a hand's `force`."""
    shares = np.reshape(force, (-1, 1)) * _shares(surface, points, directions)
    goes = _goes(shares, belief.withstood)
    return (_chance_of_hold(surface, points) * goes) @ belief.chances


def posterior(belief: Belief, surface: Surface, pulls: Sequence[Pull]) -> Belief:
    """After pulls at the surface. What stopped early may be at its end, from where it goes back."""
    chances, withstood = belief
    for pull in pulls:
        point, direction = pull.point[None], pull.direction[None]
        shares, held = _shares(surface, point, direction)[0], _chance_of_hold(surface, point)[0]
        shares = pull.force * shares
        goes = held * _goes(shares, withstood)
        if pull.moved:
            goes[0] = STRAYED
            chances = chances * goes
        else:
            along = np.repeat(np.abs(_forces(surface, point, direction)[0]), SENSES)
            feels = held * (np.concatenate([[0.0], along]) > FELT)
            play = PLAY_STILL + feels * (PLAY - PLAY_STILL)
            chances = chances * (1.0 - goes) * (play if pull.travel > PLAYED else 1.0 - play)
        if pull.ended or not pull.moved:
            withstood = np.maximum(withstood, shares * (held == 1.0))
        if pull.moved and pull.ended:
            at_end = pull.travel / (pull.travel + CATCH)
            joints = chances[1:].reshape(-1, SENSES).sum(axis=1)
            ahead = _forces(surface, point, direction)[0] > 0.0
            back = np.stack([0.0 * joints, joints * ~ahead, joints * ahead], axis=1)
            chances[1:] = at_end * back.ravel() + (1.0 - at_end) * chances[1:]
        chances = chances / chances.sum()
    return Belief(chances, withstood)
