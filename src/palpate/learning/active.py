"""Which pull tells the most about an appliance: where, and which way.

A surface that nobody has tried moves with some probability; if it does, a joint is found. A part
that is known is pulled where it makes its joint more certain. Both are worth information, in nats.
As a rival, both are worth the loss by which the twin would miss the next cloud, and which it loses
by explaining that cloud: the reward of SAGCI (Eqn. 14).
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float

from palpate.identification.interactive.handling import Push
from palpate.identification.interactive.screws import Screw
from palpate.identification.interactive.twin import Twin
from palpate.learning import movable
from palpate.learning.movable_guess import MovableGuess, load_guess
from palpate.learning.repeats import (
    BESIDE,
    REACH,
    VAIN,
    Repeat,
    count_vain_pulls,
    information_of_repeat,
    loss_of_repeat,
    repeats,
    room,
)
from palpate.perception.clouds import Cloud
from palpate.perception.surface_features import features_of
from palpate.perception.surfaces import STANDS_OFF, Surface, surfaces

# Nats that a joint is worth which was not known. Of 8 looked-at appliances with a part left over 4
# were found whole with this, and none with 15, as known parts were pulled once more instead.
JOINT = 25.0
MISSED = 0.7  # of what is expected is left after each time that a hand got no hold there
# What is left where a hand took something that no joint explained, within as many m.
TRIED_BEFORE, NEAR_IT = 0.4, 0.15
SAME_WAY = 0.8  # cosine between two ways of pulling: a slide that one moves the other may not
BEHIND = 0.03  # m
GRIPS = 0.12, 0.38, 0.5, 0.62, 0.88  # shares of a surface's sides at which a hand takes hold
ENDED = 0.8  # of the travel that was wanted: a hand that got less far was at an end
GIVES = 0.17  # share of a hand's force at which a part goes where its lever is longest, as a rule
BLOCKED = 0.05  # rad or m: with no more room a part stays where it is
TURNED = 0.3  # rad or m that a part has to go to hide what is on it
AT_HINGE, MOST = 0.06, 0.8  # m from an axis, and share of a surface's points that are so near it
LATER = 0.5  # what a try is worth that has to wait for another pull
ASIDE = 0.3  # how much to the side of the normal a hand also pulls, which tries two joints at once

Guessed = tuple[Cloud, list[Surface], Float[np.ndarray, " surfaces"]]
_GUESSED: WeakKeyDictionary[Cloud, tuple[MovableGuess, np.ndarray, Guessed]] = WeakKeyDictionary()

Choice = Callable[[Twin, np.random.Generator], Push]
Points = Float[np.ndarray, "n 3"]


@dataclasses.dataclass(frozen=True)
class Worth:
    """What a pull is expected to be worth.

    `of_try` is that of pulls at a surface of a cloud which move it with these probabilities, and
    `of_repeat` that of taking a part that is known.
    """

    of_try: Callable[[Float[np.ndarray, " n"], Surface, Cloud], Float[np.ndarray, " n"]]
    of_repeat: Callable[[Repeat], float]


def choose_best(
    twin: Twin, random: np.random.Generator, worth: Worth, guess: MovableGuess | None = None
) -> Push:
    """The push that is worth most; `guess` says which surfaces move, untouched, or the one that
    comes with palpate."""
    look = len(twin.looks) - 1
    guess = load_guess() if guess is None else guess
    tries = _tries(twin, look, random, guess, worth)
    hidden = _hidden_tries(twin, look, random, guess, worth)
    options = [*tries, *repeats(twin, look, random, worth.of_repeat, hidden)]
    if not options:  # nothing flat is large enough
        return at_random(twin, random)
    return max(options, key=lambda one: one[0])[1]


def at_random(twin: Twin, random: np.random.Generator) -> Push:
    """Any point that was seen, any way out of its surface or into it."""
    cloud = twin.looks[-1]
    index = int(random.integers(len(cloud.points)))
    aside = random.standard_normal(3)
    way = random.choice([-1.0, 1.0]) * cloud.normals[index] + 0.5 * aside / np.linalg.norm(aside)
    return Push(cloud.points[index], way / np.linalg.norm(way))


def _tries(
    twin: Twin,
    look: int,
    random: np.random.Generator,
    guess: MovableGuess,
    worth: Worth,
    part: int | None = None,
) -> list[tuple[float, Push]]:
    """Of every surface of a look, or those of a part, the pull that would show best whether it
    moves."""
    found: list[tuple[float, Push]] = []
    cloud, every, before = _guess_surfaces(twin, look, random, guess)
    tried = [_pulls_at(twin, surface, cloud, look) for surface in every]
    # a guess that was wrong of this appliance is trusted less in the rest of it
    after = [
        movable.posterior(movable.prior(float(chance), surface), surface, pulls).chance
        for surface, chance, (pulls, _) in zip(every, before, tried, strict=True)
    ]
    failed = np.maximum(before - after, 0.0)
    known = 1.0 + len(twin.parts)
    trust = known / (known + failed.sum() - failed)
    for surface, chance, (pulls, missed) in zip(every, trust * before, tried, strict=True):
        if part not in (None, surface.part) or _is_at_hinge(twin, surface, cloud, look):
            continue
        belief = movable.posterior(movable.prior(float(chance), surface), surface, pulls)
        points, directions = _grips(cloud, surface)
        # where they were seen, not where the mean of all looks has them
        points = twin.looks[look].points[cloud.tree.query(points)[1]]
        force = _force_before_carrier(twin, surface.part, look, points, directions)
        goes = movable.moves(belief, surface, points, directions, force)
        value = worth.of_try(goes, surface, cloud)
        for point in missed:
            value = value * MISSED ** (np.linalg.norm(points - point, axis=1) < BESIDE)
        for pull in pulls:
            if pull.moved:  # and nothing was found: it would be the same again
                away = np.linalg.norm(points - pull.point, axis=1)
                value = value * TRIED_BEFORE ** (away < NEAR_IT)
        for way in _vain_pulls_beside(twin, surface, cloud, look):
            value = value * TRIED_BEFORE ** (directions @ way > SAME_WAY)
        if surface.part >= 0:
            for sign in (-1.0, 1.0):
                along = sign * np.sum(
                    twin.screw(surface.part, look).velocity(points) * directions, axis=1
                )
                value = value * VAIN ** (count_vain_pulls(twin, surface.part, sign) * (along > 0.0))
        best = int(np.argmax(value))
        found.append((float(value[best]), Push(points[best], directions[best])))
    return found


def _guess_surfaces(
    twin: Twin, look: int, random: np.random.Generator, guess: MovableGuess
) -> Guessed:
    """A look in the mean of all, its surfaces, and how likely each is to move before it is tried.

    They are kept until what is known of the look changes.
    """
    labels, known = twin.labels[look], _GUESSED.get(twin.looks[look])
    if known is None or known[0] is not guess or not np.array_equal(known[1], labels):
        cloud = twin.averaged(look)
        every = surfaces(cloud, labels, random)
        known = guess, labels, (cloud, every, guess(features_of(cloud, every)))
        _GUESSED[twin.looks[look]] = known
    return known[2]


def _hidden_tries(
    twin: Twin, look: int, random: np.random.Generator, guess: MovableGuess, worth: Worth
) -> dict[tuple[int, float], float]:
    """What it is worth to take a part (its number) one way (1 or -1), back to where it was seen
    first: what is on it, and worth more than what is seen of it now, may be hidden."""
    found: dict[tuple[int, float], float] = {}
    for number, part in enumerate(twin.parts):
        places = np.array(part.positions)

        def best(at: int, number: int = number) -> float:
            tries = _tries(twin, at, random, guess, worth, number)
            return max([0.0, *(value for value, _ in tries)])

        for earlier in np.unique(np.round(places / TURNED), return_index=True)[1]:
            way = float(places[earlier] - places[look])
            if abs(way) > TURNED and (value := best(int(earlier))) > best(look):
                side = number, math.copysign(1.0, way)
                found[side] = max(LATER * value, found.get(side, 0.0))
    return found


def _is_at_hinge(twin: Twin, surface: Surface, cloud: Cloud, look: int) -> bool:
    """Whether a surface of no part is a strip along the hinge of one, where that hardly moves."""
    points = cloud.points[surface.members]
    for number in range(len(twin.parts)) if surface.part < 0 else ():
        screw = twin.screw(number, look)
        away = np.linalg.norm(np.cross(points - screw.point, screw.axis), axis=1)
        if screw.joint == "revolute" and np.mean(away < AT_HINGE) > MOST:
            own = twin.pose(number, look).at(twin.parts[number].support[0])
            along = (points - screw.point) @ screw.axis
            there = (own - screw.point) @ screw.axis
            if np.mean((along > there.min()) & (along < there.max())) > MOST:
                return True
    return False


def _force_before_carrier(
    twin: Twin, part: int, look: int, points: Points, directions: Points
) -> Float[np.ndarray, " n"]:
    """Share of a hand's force at which the part that it is put to goes itself, at each point.

    All of it where that has no room to go.
    """
    force = np.ones(len(points))
    if part < 0:
        return force
    screw = twin.screw(part, look)
    lever = _lever(screw, twin.pose(part, look).at(twin.parts[part].support[0]))
    along = np.sum(screw.velocity(points) * directions, axis=1) / lever
    for sign in (-1.0, 1.0):
        ahead = sign * along > GIVES
        if room(twin, part, look, sign, REACH / lever) > BLOCKED:
            force[ahead] = GIVES / np.abs(along[ahead])
    return force


def _lever(screw: Screw, points: Points) -> float:
    """How far a point of some goes at most for each rad or m of a joint, m or 1."""
    velocity = np.broadcast_to(screw.velocity(points), points.shape)
    return max(float(np.linalg.norm(velocity, axis=1).max()), 0.1)


def _grips(
    cloud: Cloud, surface: Surface
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Where a hand may take hold of a surface, and which way it may pull: all pairs of them."""
    shares = np.array([*itertools.product(GRIPS, GRIPS)])
    flat = surface.low + shares * (surface.high - surface.low)
    wanted = surface.centre + flat @ surface.sides
    own = cloud.points[surface.members]
    nearest = np.linalg.norm(own[None] - wanted[:, None], axis=2).argmin(axis=1)
    points = np.concatenate([surface.handles, own[nearest]])
    aside = (0.0, ASIDE, -ASIDE)
    sideways = [(0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
    ways = np.array([*itertools.product((1.0, -1.0), aside, aside), *sideways])
    directions = ways @ np.stack([surface.normal, *surface.sides])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.repeat(points, len(directions), axis=0), np.tile(directions, (len(points), 1))


def _pulls_at(
    twin: Twin, surface: Surface, cloud: Cloud, look: int
) -> tuple[list[movable.Pull], list[Float[np.ndarray, "3"]]]:
    """Pulls of hands at a surface, which may have been elsewhere then, and where others got no
    hold.

    What moved a part that is known says nothing of a surface beside it, and of one that it carries
    only that it did not go before its carrier.
    """
    pulls: list[movable.Pull] = []
    missed: list[np.ndarray] = []
    for one, (held, before) in zip(twin.handled, twin.held, strict=True):
        motion = twin.motion(surface.part, before, look)
        point = motion.at(one.push.point[None])[0]
        carried = one.moved and held == surface.part >= 0
        if not _at(point, surface, cloud) or (
            one.moved and not carried and (surface.part >= 0 or held >= 0)
        ):
            continue
        if not one.held:
            missed.append(point)
            continue
        pull = movable.Pull(
            point,
            motion.turned(one.push.direction[None])[0],
            moved=one.moved,
            travel=one.travel,
            ended=one.travel < ENDED * one.push.travel
            and not (one.moved and _has_left(one.points, surface)),
        )
        if carried:
            force = _force_before_carrier(
                twin, held, before, one.push.point[None], one.push.direction[None]
            )
            pull = pull._replace(moved=False, travel=0.0, ended=True, force=float(force[0]))
        pulls.append(pull)
    return pulls, missed


def _vain_pulls_beside(twin: Twin, surface: Surface, cloud: Cloud, look: int) -> list[np.ndarray]:
    """Which ways hands have pulled in vain within the rectangle of a surface, or nearly, but not at
    it: what is flat and noisy may be other surfaces in each look."""
    found: list[np.ndarray] = []
    for one, (held, before) in zip(twin.handled, twin.held, strict=True):
        motion = twin.motion(surface.part, before, look)
        point = motion.at(one.push.point[None])[0]
        flat = surface.sides @ (point - surface.centre)
        height = float((point - surface.centre) @ surface.normal)
        beyond = np.maximum(np.maximum(surface.low - flat, flat - surface.high), 0.0)
        if (
            one.held
            and not one.moved
            and held == surface.part
            and abs(height) < BEHIND
            and (beyond < NEAR_IT).all()
            and not _at(point, surface, cloud)
        ):
            found.append(motion.turned(one.push.direction[None])[0])
    return found


def _has_left(way: Float[np.ndarray, "times 3"], surface: Surface) -> bool:
    """Whether a hand took away what a surface is at: it is there again, and may go as it went."""
    return abs(float((way[-1] - way[0]) @ surface.normal)) > STANDS_OFF[1]


def _at(point: Float[np.ndarray, "3"], surface: Surface, cloud: Cloud) -> bool:
    """Whether a point is on a surface, or on what stands off it there.

    Of a cloud that is noisy or sparse some points of a surface may make another one.
    """
    height = float((point - surface.centre) @ surface.normal)
    if not -max(BEHIND, 2.0 * cloud.error) < height < max(STANDS_OFF[1], 2.0 * cloud.error):
        return False
    below = point - height * surface.normal
    spacing = math.sqrt(surface.area / len(surface.members))
    away = np.linalg.norm(cloud.points[surface.members] - below, axis=1).min()
    return bool(away < max(BESIDE, 1.55 * spacing))


def _information_of_try(goes: np.ndarray, surface: Surface, cloud: Cloud) -> np.ndarray:
    """Nats: of whether it moves, and of a joint if it does."""
    inner = np.clip(goes, 1e-9, 1.0 - 1e-9)
    return goes * JOINT - inner * np.log(inner) - (1.0 - inner) * np.log(1.0 - inner)


def _loss_of_try(goes: np.ndarray, surface: Surface, cloud: Cloud) -> np.ndarray:
    """Mean square (m^2) by which the cloud is missed by a model in which the surface stands."""
    return goes * len(surface.members) / len(cloud.points) * REACH**2


WORTHS = {
    "information": Worth(_information_of_try, information_of_repeat),
    "loss": Worth(_loss_of_try, loss_of_repeat),
}
CHOICES: dict[str, Choice] = {
    name: functools.partial(choose_best, worth=worth) for name, worth in WORTHS.items()
} | {"random": at_random}
