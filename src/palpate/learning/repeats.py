"""Pulls at a part that is known, by its joint: what one more way of a hand would tell of it.

In nats, or as the loss that SAGCI rewards (Eqn. 14); see `palpate.learning.active`.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from palpate.identification.interactive.discovery import TELLS
from palpate.identification.interactive.handling import Push
from palpate.identification.interactive.part import Part
from palpate.identification.interactive.screws import Screw
from palpate.identification.interactive.twin import Twin
from palpate.identification.interactive.ways import way_information

FORCES = 4.0  # nats that are worth masses and what resists one way, where no long way went there
LONG = 0.1  # m of a way that tells them
VAIN = 0.7  # of what is expected is left after each pull that way which told nothing
BESIDE = 0.05  # m from a part at which a hand was still on it
FEWEST = 10  # points of a part that a hand can be put to
REACH = 0.3  # m that a hand goes
UNKNOWN = 0.3  # of its reach that a hand is expected to take a part beyond where it was seen

Points = Float[np.ndarray, "n 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Repeat:
    """A pull that takes a part by its joint, as it is now, with a hand that begins at `point`.

    `felt` long ways of hands went the same way before. `points` are some of the part's, and `share`
    is its own of the cloud.
    """

    part: Part
    screw: Screw
    gone: float  # rad or m
    point: Float[np.ndarray, "3"]
    felt: int
    points: Points
    share: float

    @property
    def way(self) -> Float[np.ndarray, "25 3"]:
        """Of the hand, m."""
        gone = np.linspace(0.0, self.gone, 25)
        return np.array([self.screw.pose(one).at(self.point[None])[0] for one in gone])


def repeats(
    twin: Twin,
    look: int,
    random: np.random.Generator,
    worth: Callable[[Repeat], float],
    hidden: Mapping[tuple[int, float], float],
) -> list[tuple[float, Push]]:
    """Of every part that is known, the pulls either way that would tell of its joint and forces,
    and bring back what is hidden.

    `worth` is that of such a pull; to it comes what is `hidden` (by part and way, 1 or -1).
    """
    cloud, found = twin.looks[look], []
    for number, part in enumerate(twin.parts):
        members = np.flatnonzero(twin.labels[look] == number)
        if len(members) < FEWEST:
            continue
        screw = twin.screw(number, look)
        options = cloud.points[random.choice(members, min(len(members), 40), replace=False)]
        point, reach = options[0], REACH
        if screw.joint == "revolute":
            arms = np.linalg.norm(np.cross(options - screw.point, screw.axis), axis=1)
            furthest = np.argsort(arms)[int(0.85 * len(arms))]
            point, reach = options[furthest], REACH / max(float(arms[furthest]), 0.1)
        along, share = screw.velocity(point), len(members) / len(cloud.points)
        ways = [twin.way_from(part.parent, *way) for way in part.ways]
        gone = [
            float(part.screw.position_of(way[0], way[-1:])[0])
            for way in ways
            if math.dist(way[0], way[-1]) > LONG
        ]
        for sign in (-1.0, 1.0):
            go = sign * min(reach, room(twin, number, look, sign, reach))
            felt = sum(one * sign > 0.0 for one in gone)
            value = worth(Repeat(part, screw, go, point, felt, options, share))
            value += hidden.get((number, sign), 0.0)
            value *= VAIN ** count_vain_pulls(twin, number, sign)
            found.append((value, Push(point, sign * along / np.linalg.norm(along))))
    return found


def count_vain_pulls(twin: Twin, number: int, sign: float) -> int:
    """How often a hand at a part that pulled it one way took something a little, and nothing was
    found of it."""
    count = 0
    for one, (held, before) in zip(twin.handled, twin.held, strict=True):
        if held < 0 and one.moved and one.travel < TELLS:
            own = twin.pose(number, before).at(twin.parts[number].support[0])
            way = one.push.direction @ twin.screw(number, before).velocity(one.push.point)
            near = np.linalg.norm(own - one.push.point, axis=1).min() < BESIDE
            count += bool(near and sign * float(way) > 0.0)
    return count


def room(twin: Twin, number: int, look: int, sign: float, reach: float) -> float:
    """How far (rad or m) a part is expected to go one way: as far as it was seen, and some more
    where nobody has felt an end."""
    part = twin.parts[number]
    here = part.positions[look]
    seen = max(sign * (end - here) for end in part.range)
    for one, (held, before) in zip(twin.handled, twin.held, strict=True):
        if held != number or one.moved or not one.held:
            continue
        way = float(one.push.direction @ twin.screw(number, before).velocity(one.push.point))
        if way * sign > 0.0:
            return min(seen, max(sign * (part.positions[before] - here), 0.0))
    return seen + UNKNOWN * reach


def information_of_repeat(pull: Repeat) -> float:
    """Nats by which a joint's four numbers become more certain from one more way of a hand.

    To them comes what a long way tells of masses and of what resists, less each time.
    """
    way = pull.way
    before = np.linalg.inv(pull.part.estimate.covariance + 1e-10 * np.eye(4))
    more = way_information(pull.screw, way)
    gain = float(0.5 * (np.linalg.slogdet(before + more)[1] - np.linalg.slogdet(before)[1]))
    return gain + FORCES / (1.0 + pull.felt) ** 2 * (math.dist(way[0], way[-1]) > LONG)


def loss_of_repeat(pull: Repeat) -> float:
    """Mean square (m^2) by which the cloud is missed, as uncertain as the part's joint is."""
    there, step = pull.screw.pose(pull.gone).at(pull.points), 1e-5
    slopes = np.stack([
        (pull.screw.varied(one).pose(pull.gone).at(pull.points) - there) / step
        for one in step * np.eye(4)
    ])  # fmt: skip
    squares = np.einsum("ink,ij,jnk->n", slopes, pull.part.estimate.covariance, slopes)
    return pull.share * float(squares.mean())
