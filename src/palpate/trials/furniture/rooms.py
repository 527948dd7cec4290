"""Rooms whose goal lies behind furniture that all looks alike: generated ones, and named scenes.

A wall with two or three doors divides a hall; before each door stands a piece that leaves no room
to pass. Its outline says nothing of what is under it: free casters, feet, two fixed wheels, one
locked caster, a hinge or bolts. The piece on the shortest way, the tempting one, is more often than
not one that does not come away.

Every constant here was written down before the first full run.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from shapely import box

from palpate.planning.movable_obstacles.maps.map import Map, Movable, map_of
from palpate.planning.movable_obstacles.maps.map import Robot as Disc
from palpate.planning.movable_obstacles.maps.occupancy import Space
from palpate.planning.movable_obstacles.maps.regions import regions_of
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.filtered_drive import FilteredDrive
from palpate.safety.passivity import PassivityFilter
from palpate.worlds.furniture.furniture import (
    FurnitureWorld,
    Piece,
    PieceKind,
    PieceParameters,
    Robot,
)
from palpate.worlds.furniture.pieces import Mount
from palpate.worlds.furniture.robot import BASE_SPEED, TURN_SPEED, base_inertia
from palpate.worlds.furniture.scene import TIME_STEP
from palpate.worlds.world import Drive

Construction = Literal["casters", "feet", "wheels", "locked", "hinged", "bolted"]
Pose = tuple[float, float, float]

# The hall, m.
WIDTH, DEPTH, WALL = (7.6, 8.6), (5.4, 6.4), 0.15
DOOR, DOORS = (1.3, 1.5), (2, 3)
LEAST_PIER = 0.35  # between doors
LENGTHS, DEPTHS = (0.95, 1.15), (0.42, 0.55)  # of pieces, wider than deep before a door
# How likely the tempting piece is what, and the others; then rooms in which only a piece that
# turns about a point or rolls along one line gives way.
TEMPTING = {
    "bolted": 0.6,
    "locked": 0.2,
    "hinged": 0.1,
    "wheels": 0.05,
    "casters": 0.03,
    "feet": 0.02,
}
SHORTER = 1.3  # m by which the way through the tempting door is the shortest, at least
OTHERS = {"casters": 0.5, "feet": 0.3, "wheels": 0.2}
REST = {"casters": 0.2, "feet": 0.1, "wheels": 0.2, "locked": 0.2, "hinged": 0.1, "bolted": 0.2}
CONSTRAINED_ONLY = 0.25
CLUTTER = (0, 2)  # pieces that stand about
# What is under a piece. Cabinets on casters are heavy, so that a locked caster holds against the
# robot's hand; those on feet are light, so that they slide.
HEAVY, LIGHT = 45.0, 10.0  # kg
RUBBER, FELT = (0.8, 0.95), (0.15, 0.25)  # friction on the floor
WHEEL, FOOT = 0.06, 0.02  # m, radii
INSET = 0.07  # m of mounts from the outline

# The robot as it is planned for, m. The world's base is a centimetre smaller.
RADIUS, MARGIN, CELL = 0.25, 0.05, 0.1
TIGHT = 0.02  # m, the margin that is enough to drive through what stands open
BASE_RADIUS = 0.24
POSTURE = (1.266, -2.532, 1.266)  # rad: the gripper 0.36 m ahead of the base's middle
REACH = 0.15  # m between the planned disc and the face that is held, in that posture


@dataclass(frozen=True)
class Room:
    """A hall with pieces, where the robot starts, and its goal; `seed` draws the hidden constants.

    `constructions` says what is under each piece, for experiments and tests alone.
    """

    name: str
    walls: tuple[np.ndarray, ...]
    pieces: tuple[Piece, ...]
    constructions: tuple[Construction, ...]
    start: Pose
    goal: Pose
    bounds: tuple[float, float, float, float]
    seed: int

    def world(self, drive: Drive | None = None) -> FurnitureWorld:
        """The MuJoCo world, not yet reset; `drive` stands before the servos of the base."""
        robot = Robot(self.start, radius=BASE_RADIUS, nominal=POSTURE)
        return FurnitureWorld(self.pieces, self.walls, robot, drive=drive)

    def map(
        self,
        outlines: Mapping[str, np.ndarray],
        poses: np.ndarray,
        start: Pose,
        margin: float = MARGIN,
    ) -> Map:
        """What the robot sees: outlines (points, 2) at `poses` (bodies, 3), itself at `start`."""
        movables = [
            Movable(name, np.asarray(outline, float), (float(x), float(y), float(theta)))
            for (name, outline), (x, y, theta) in zip(outlines.items(), poses, strict=True)
        ]
        return map_of(
            self.name,
            walls=shapely.union_all([shapely.Polygon(wall) for wall in self.walls]),
            movables=movables,
            robot=Disc(RADIUS, "holonomic", reach=REACH),
            start=start,
            goals=[self.goal],
            bounds=self.bounds,
            cell_size=CELL,
            margin=margin,
        )

    def closed(self) -> bool:
        """Whether start and goal lie in different free regions while nothing is moved."""
        world = self.world()
        seen = self.map(world.outlines, world.starts, self.start)
        ends = ends_of(seen)
        return min(ends) >= 0 and ends[0] != ends[1]


def base_filter(tank: float) -> FilteredDrive:
    """A passivity filter before the servos of a room's base, whose tank holds so many J.

    The filter knows of the robot's own mass alone, and of its greatest speed.
    """
    one = EnergyTank(initial=tank, upper=tank)
    robot = Robot(radius=BASE_RADIUS, nominal=POSTURE)
    fastest = math.hypot(BASE_SPEED, TURN_SPEED)
    return FilteredDrive(PassivityFilter(tank=one, fastest=fastest), base_inertia(robot), TIME_STEP)


def ends_of(world: Map) -> tuple[int, int]:
    """The free regions of a map that start and goal lie in, -1 for none."""
    space = Space(world)
    regions = regions_of(space)
    found = [regions.at(space, np.array(place[:2])) for place in (world.start, world.goals[0])]
    begin, end = (region if region < regions.free else -1 for region in found)
    return begin, end


def cabinet(construction: Construction, length: float, depth: float) -> PieceKind:
    """A piece `length` m long in x and `depth` m in y, standing on what it is said to."""
    x, y = length / 2, depth / 2
    outline = ((-x, -y), (x, -y), (x, y), (-x, y))
    corners = [(a * (x - INSET), b * (y - INSET)) for a in (1, -1) for b in (1, -1)]
    feet = construction == "feet"
    mounts = tuple(
        Mount(
            place,
            "foot" if feet else "fixed" if construction == "wheels" and place[0] < 0 else "caster",
            FOOT if feet else WHEEL,
        )
        for place in corners
    )
    return PieceKind(
        name="cabinet",
        outline=outline,
        mass=LIGHT if feet else HEAVY,
        mounts=() if construction == "bolted" else mounts,
        hand_force=60.0,
        friction=FELT if feet else RUBBER,
        locked_casters=int(construction == "locked"),
        hinge_edge=((-x, -y), (x, -y)) if construction == "hinged" else None,
        bolted=construction == "bolted",
        height=1.0,
    )


def generated_room(seed: int) -> Room:
    """The room of a seed: drawn again until start and goal are apart and nothing overlaps."""
    random = np.random.default_rng([seed, 17])
    while True:
        room = _draw(seed, random)
        if room is not None and room.closed():
            return room


def _draw(seed: int, random: np.random.Generator) -> Room | None:
    width, depth = random.uniform(*WIDTH), random.uniform(*DEPTH)
    count = int(random.integers(DOORS[0], DOORS[1] + 1))
    doors = _doors(depth, count, random)
    if doors is None:
        return None
    middle = width / 2 + random.uniform(-0.3, 0.3)
    start = (random.uniform(0.7, 1.4), random.uniform(0.7, depth - 0.7), 0.0)
    goal = (width - random.uniform(0.7, 1.4), random.uniform(0.7, depth - 0.7), 0.0)
    ways = [
        math.dist(start[:2], (middle, (low + high) / 2))
        + math.dist((middle, (low + high) / 2), goal[:2])
        for low, high in doors
    ]
    order = np.argsort(ways)
    if ways[order[1]] - ways[order[0]] < SHORTER:
        return None
    constructions = _constructions(count, order, random)
    pieces, shapes = [], []
    for (low, high), construction in zip(doors, constructions, strict=True):
        piece = _before(middle, low, high, construction, random)
        pieces.append(piece)
        shapes.append(_shape(piece))
    free = [shapely.Point(*place[:2]).buffer(0.6) for place in (start, goal)]
    free += [box(middle - 1.7, low - 0.2, middle + 1.2, high + 0.2) for low, high in doors]
    walls = _walls(width, depth, middle, doors)
    solid = shapely.union_all([shapely.Polygon(wall) for wall in walls])
    extra: list[Construction] = []
    for _ in range(int(random.integers(CLUTTER[0], CLUTTER[1] + 1))):
        construction = _choice(REST, random)
        length, deep = random.uniform(0.5, 0.7), random.uniform(*DEPTHS)
        place = (random.uniform(0.6, width - 0.6), random.uniform(0.6, depth - 0.6))
        piece = Piece(cabinet(construction, length, deep), (*place, random.uniform(0, math.pi)))
        shape = _shape(piece).buffer(0.1)
        inside = box(WALL, WALL, width - WALL, depth - WALL).contains(shape)
        inside &= not _shape(piece).intersects(solid)
        if inside and not any(shape.intersects(other) for other in [*free, *shapes]):
            pieces.append(piece)
            shapes.append(shape)
            extra.append(construction)
    return Room(
        f"room {seed}",
        walls,
        tuple(pieces),
        (*constructions, *extra),
        start,
        goal,
        (0.0, 0.0, width, depth),
        seed,
    )


def _constructions(
    count: int, order: np.ndarray, random: np.random.Generator
) -> tuple[Construction, ...]:
    """What stands before each door; `order` begins with the door on the shortest way."""
    found: list[Construction] = ["bolted"] * count
    if random.uniform() < CONSTRAINED_ONLY:
        constrained = _choice({"locked": 0.4, "hinged": 0.2, "wheels": 0.4}, random)
        found[int(random.integers(count))] = constrained
        return tuple(found)
    found[order[0]] = _choice(TEMPTING, random)
    found[order[1]] = _choice(OTHERS, random)
    for door in order[2:]:
        found[door] = _choice(REST, random)
    return tuple(found)


def _choice(shares: Mapping[str, float], random: np.random.Generator) -> Construction:
    names = list(shares)
    chosen: Construction = names[random.choice(len(names), p=list(shares.values()))]  # type: ignore
    return chosen


def _doors(
    depth: float, count: int, random: np.random.Generator
) -> list[tuple[float, float]] | None:
    """(low, high) of each door along the dividing wall, m; None if they do not fit."""
    widths = random.uniform(*DOOR, count)
    spare = depth - 2 * WALL - widths.sum() - (count + 1) * LEAST_PIER
    if spare < 0:
        return None
    gaps = LEAST_PIER + spare * random.dirichlet(np.ones(count + 1))
    lows = WALL + np.cumsum(gaps[:-1]) + np.concatenate([[0.0], np.cumsum(widths[:-1])])
    return [(float(low), float(low + wide)) for low, wide in zip(lows, widths, strict=True)]


def _before(
    middle: float, low: float, high: float, construction: Construction, random: np.random.Generator
) -> Piece:
    """A piece in a door: its long side across, its body frame turned any of four ways."""
    length, depth = random.uniform(*LENGTHS), random.uniform(*DEPTHS)
    quarter = int(random.integers(4))
    # The long side lies along y: of an odd quarter it is the body's own x.
    sizes = (length, depth) if quarter % 2 else (depth, length)
    spare = (high - low - length) / 2
    place = (
        middle - random.uniform(0.0, 0.25),
        (low + high) / 2 + 0.5 * random.uniform(-spare, spare),
    )
    angle = quarter * math.pi / 2 + random.uniform(-0.04, 0.04)
    return Piece(cabinet(construction, *sizes), (*place, angle))


def _shape(piece: Piece) -> shapely.Polygon:
    return Movable("piece", np.asarray(piece.made_as.outline), tuple(piece.pose)).polygon  # type: ignore


def _walls(
    width: float, depth: float, middle: float, doors: list[tuple[float, float]]
) -> tuple[np.ndarray, ...]:
    """Four outer walls and what is left of the dividing one."""
    parts = [
        (0.0, 0.0, width, WALL),
        (0.0, depth - WALL, width, depth),
        (0.0, WALL, WALL, depth - WALL),
        (width - WALL, WALL, width, depth - WALL),
    ]
    ends = [WALL, *(end for door in doors for end in door), depth - WALL]
    for low, high in zip(ends[::2], ends[1::2], strict=True):
        parts.append((middle - WALL / 2, low, middle + WALL / 2, high))
    return tuple(np.array([(a, b), (c, b), (c, d), (a, d)]) for a, b, c, d in parts)


# --- the deck's demonstrations ------------------------------------------------------------------


def scenes() -> dict[str, Room]:
    """The demonstrations of Scholz's deck, by name.

    The table that turns out stationary, then the couch; a static constraint beside a free piece; a
    constraint that is not static, where nothing else leads on; and a piece whose locked caster only
    a touch can tell.
    """
    width, depth, middle, doors = 8.0, 6.8, 4.0, [(0.8, 2.2), (4.8, 6.2)]
    table, couch = (0.5, 1.1), (0.55, 1.15)
    load, friction, rolling = (0.0, 0.0), 0.9, 0.01
    # Casters 0 and 1 are in front, 0 and 2 on the left; rad of the fork.
    hinged = PieceParameters(HEAVY, load, friction, rolling, (None,) * 4, (-0.25, -0.55))
    locked = PieceParameters(HEAVY, load, friction, rolling, (None, None, 1.0, None))
    made: dict[str, tuple[tuple[Construction, ...], tuple, tuple]] = {
        "table then couch": (("bolted", "feet"), (table, couch), (None, None)),
        "static constraint": (("bolted", "casters"), (table, table), (None, None)),
        "constraint not static": (("hinged", "bolted"), (table, table), (hinged, None)),
        "learning by contact": (("locked", "bolted"), (table, table), (locked, None)),
    }
    walls, bounds = _walls(width, depth, middle, doors), (0.0, 0.0, width, depth)
    start, goal = (1.0, 1.5, 0.0), (7.0, 1.5, 0.0)
    found = {}
    for name, (constructions, sizes, parameters) in made.items():
        pieces = tuple(
            Piece(cabinet(construction, *size), (middle - 0.1, (low + high) / 2, 0.0), given)
            for (low, high), construction, size, given in zip(
                doors, constructions, sizes, parameters, strict=True
            )
        )
        found[name] = Room(name, walls, pieces, constructions, start, goal, bounds, 1)
    return found
