"""The Shopping-Cart and Apartment tasks, in which agents learn online; made for MuJoCo furniture.

What the deck's curves were measured on is not printed: layout, reward and horizon are ours, written
down here before the first run.

*Shopping cart*: a cart (two fixed wheels, two free casters) in a room of 9 x 7 m is to be brought
to a pose in the middle. *Apartment*: in a room of 7 x 6 m a table with one locked caster, a couch
and a chair, all in the middle, are to be brought to their places at the walls, one after another.

A decision is held for 0.2 s: a wrench (two components of force, torque) on one piece, in the
piece's axes when the decision is taken, within a ball of the kind's hand force and of half of that
times its radius as torque. The table takes 120 N, and not the 50 N of somebody who wiggles it: its
locked caster holds with 20 to 90 N, and less could only turn the table about it, so that who knows
how it rolls could do no better than who does not. A cart is held at its handle, the middle of its
rear edge, so that a force across it turns it; the other pieces at their centroid. The piece that is
held is the first in order that is not yet within 0.15 m and 0.15 rad of its place, and is let go
for the next after 4 s at the latest.

The reward of a decision, given at its end, is minus the mean over the pieces of the distance from
the goal in metres plus half the error of heading in radians. An episode has 50 decisions in the
cart's task and 100 in the apartment's, whether or not the goal was reached; then the pieces stand
at rest at another start: the cart anywhere 1 to 2.5 m from its goal at any heading, the apartment's
pieces within 0.3 m and up to 54 (chair: 90) degrees of theirs, drawn again until they stand clear
of each other. Hidden parameters are drawn by the world's
seed and stay as they are for the 1,000 decisions.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely

from palpate.numerics.polygons import place_points
from palpate.worlds.furniture.furniture import FurnitureWorld
from palpate.worlds.furniture.pieces import KINDS, Piece

DECISION = 0.2  # s
HEADING_WEIGHT = 0.5  # m/rad
DONE = 0.15  # m or rad: a piece that is nearer is left alone
TURN = 20  # decisions for which a piece is held at a stretch
WALL = 0.2  # m thick
FORCES = {"table": 120.0}  # N, of kinds for which the hand force is too little; see above
CLEAR = 0.05  # m between pieces at a start


@dataclass(frozen=True)
class CartTask:
    """Pieces in a room, where they have to go, and where an episode begins.

    `goals` (bodies, 3) m, m, rad; `handles` (bodies, 2) m in the body frames; `start(random)`
    gives poses (bodies, 3).
    """

    name: str
    kinds: tuple[str, ...]
    room: tuple[float, float]
    goals: np.ndarray
    handles: np.ndarray
    start: Callable[[np.random.Generator], np.ndarray]
    episode: int  # decisions

    @property
    def walls(self) -> list[np.ndarray]:
        """Four boxes around the room, whose middle is the origin."""
        x, y = self.room[0] / 2, self.room[1] / 2
        out_x, out_y = x + WALL, y + WALL
        boxes = [(-out_x, -x, -out_y, out_y), (x, out_x, -out_y, out_y)]
        boxes += [(-x, x, -out_y, -y), (-x, x, y, out_y)]
        return [np.array([(a, c), (b, c), (b, d), (a, d)]) for a, b, c, d in boxes]

    @property
    def strength(self) -> np.ndarray:
        """(bodies, 3): greatest force along and across (N) and torque (N m)."""
        forces = np.array([FORCES.get(name, KINDS[name].hand_force) for name in self.kinds])
        radii = np.array([KINDS[name].radius for name in self.kinds])
        return np.stack([forces, forces, 0.5 * radii * forces], axis=1)

    @property
    def outlines(self) -> list[np.ndarray]:
        """(points, 2) m of each body, in its frame."""
        return [np.asarray(KINDS[name].outline) for name in self.kinds]

    def world(self) -> FurnitureWorld:
        """The room with the pieces at their goals; `reset` puts them elsewhere."""
        pieces = zip(self.kinds, self.goals, strict=True)
        return FurnitureWorld([Piece(kind, tuple(goal)) for kind, goal in pieces], self.walls)

    def errors(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance (m) and heading error (rad) of each body from its goal: (..., bodies) each."""
        off = np.asarray(poses) - self.goals
        heading = np.abs((off[..., 2] + np.pi) % (2 * np.pi) - np.pi)
        return np.linalg.norm(off[..., :2], axis=-1), heading

    def reward(self, poses: np.ndarray) -> np.ndarray:
        """Of each decision that ends at these poses (..., bodies, 3)."""
        distance, heading = self.errors(poses)
        return np.asarray(-(distance + HEADING_WEIGHT * heading).mean(-1))


def shopping_cart() -> CartTask:
    """See the module."""
    rear = KINDS["cart"].outline
    handle = np.min(np.asarray(rear)[:, 0]), 0.0

    def start(random: np.random.Generator) -> np.ndarray:
        angle, heading = random.uniform(-np.pi, np.pi, 2)
        distance = random.uniform(1.0, 2.5)
        return np.array([[distance * np.cos(angle), distance * np.sin(angle), heading]])

    return CartTask("cart", ("cart",), (9.0, 7.0), np.zeros((1, 3)), np.array([handle]), start, 50)


def apartment() -> CartTask:
    """See the module."""
    middle = np.array([[-1.4, 0.0, 0.0], [0.6, 0.9, 0.0], [0.8, -0.8, 0.0]])
    goals = np.array([[-2.6, -2.3, 0.0], [2.2, 2.3, 0.0], [2.7, -2.2, 0.0]])

    kinds = "table", "couch", "chair"

    def start(random: np.random.Generator) -> np.ndarray:
        while True:
            offset = random.uniform(-0.3, 0.3, (3, 2))
            turn = random.uniform(-np.pi / 2, np.pi / 2, (3, 1)) * [[0.6], [0.6], [1.0]]
            poses = middle + np.concatenate([offset, turn], axis=1)
            if clearance(kinds, poses) > CLEAR:
                return poses

    return CartTask("apartment", kinds, (7.0, 6.0), goals, np.zeros((3, 2)), start, 100)


def clearance(kinds: tuple[str, ...], poses: np.ndarray) -> float:
    """The least distance (m) between any two of the pieces at poses (bodies, 3)."""
    shapes = [
        shapely.Polygon(place_points(np.asarray(KINDS[kind].outline), pose))
        for kind, pose in zip(kinds, poses, strict=True)
    ]
    return min(one.distance(other) for one, other in itertools.combinations(shapes, 2))


class Turns:
    """Which piece is held in an episode: one after another; see the module."""

    def __init__(self, task: CartTask):
        self._task = task
        self._held, self._since = 0, 0

    def held(self, poses: np.ndarray) -> int:
        """The piece to hold now, given what is seen (bodies, 3)."""
        distance, heading = self._task.errors(poses)
        wanting = np.maximum(distance, heading) > DONE
        self._since += 1
        if not wanting.any() or (wanting[self._held] and self._since <= TURN):
            return self._held
        order = (self._held + 1 + np.arange(len(wanting))) % len(wanting)
        self._held, self._since = int(order[np.argmax(wanting[order])]), 1
        return self._held
