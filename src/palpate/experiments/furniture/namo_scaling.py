"""`palpate reproduce namo-scaling`: planning time against how many objects there are.

Rooms in a square, joined by doors of which each is blocked by an object, and objects inside the
rooms; the way from one corner to the other leads through several doors. Planning is timed from the
map in memory to the plan; the exponent is the slope of a straight line through the logarithms of
objects and of planning times, all maps together. What a map holds is drawn by its seed.
"""

import math
import statistics
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from scipy.cluster.hierarchy import DisjointSet
from scipy.stats import linregress
from shapely.geometry import Polygon, box

from palpate.experiments.experiment import Experiment
from palpate.families.furniture.plan_picture import plan_picture
from palpate.planning.movable_obstacles.maps.map import Map, Movable, Robot, map_of
from palpate.planning.movable_obstacles.search.plan import Plan, planning_clock
from palpate.planning.movable_obstacles.search.planner import Planner
from palpate.planning.movable_obstacles.search.policy import NoWayError
from palpate.planning.movable_obstacles.search.verification import faults_of
from palpate.runs import Figure, Result

NAME = "namo-scaling"
EXPONENT_BAR, TIME_BAR = 1.1, 5.0
SIZES = {"full": (5, 10, 20, 40, 60, 80, 100), "quick": (5, 20, 100)}
MAPS = {"full": 8, "quick": 2}  # of each size
SEEDS = 940_000  # of maps, used by nothing else

# Written down before the first evaluation; m.
ROOM, WALL, DOOR = 4.0, 0.2, 1.3
BLOCKING, INSIDE = (0.75, 1.0), (0.4, 0.8)  # sides of objects in doors and in rooms
RADIUS, MARGIN, CELL = 0.25, 0.05, 0.1
OBJECTS_PER_ROOM = 2.5
EXTRA_DOORS = 0.4  # of the walls between rooms that are joined already


@dataclass(frozen=True)
class Timed:
    """One map planned; `plan` is None where no way was found."""

    objects: int
    seed: int
    plan: Plan | None
    planning_s: float
    fault: str | None


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Plan maps of every size; `quick` is fewer of them."""
    experiment, kind = Experiment(NAME, out, quick, seed), "quick" if quick else "full"
    sizes, maps = SIZES[kind], MAPS[kind]
    experiment.announce({f"{len(sizes)} sizes, {maps} maps each": 1 if quick else 3})
    first = SEEDS + 1000 * seed
    tried: list[Timed] = []
    with experiment.counted():
        Planner(seed=seed).plan(generated_map(5, SEEDS - 1))  # what is loaded once is not counted
        for objects in sizes:
            own = [plan_timed(objects, first + index, seed) for index in range(maps)]
            median = statistics.median(one.planning_s for one in own)
            print(f"{objects} objects: {median:.3f} s", flush=True)
            tried += own
    largest = [one for one in tried if one.objects == sizes[-1] and one.plan is not None]
    if largest:
        world = generated_map(largest[0].objects, largest[0].seed)
        plan_picture(out / "plan.png", world, largest[0].plan)
    return experiment.result(
        figures(tried),
        {
            "sizes": sizes,
            "maps": maps,
            "room_m": ROOM,
            "door_m": DOOR,
            "objects_per_room": OBJECTS_PER_ROOM,
            "robot_radius_m": RADIUS,
            "margin_m": MARGIN,
            "cell_m": CELL,
            "timed": "from the map in memory to the plan, or to the finding that there is none",
        },
        f"nothing is fitted; maps of seeds {first} on are evaluated",
        [seed, *range(first, first + maps)],
    )


def plan_timed(objects: int, map_seed: int, seed: int = 0) -> Timed:
    """Generate a map, plan it once from nothing, and check the plan."""
    world = generated_map(objects, map_seed)
    begin = planning_clock()
    try:
        plan = Planner(seed=seed).plan(world)
    except NoWayError as error:
        return Timed(objects, map_seed, None, planning_clock() - begin, str(error))
    faults = faults_of(plan, world)
    return Timed(objects, map_seed, plan, plan.planning_s, faults[0] if faults else None)


def figures(tried: list[Timed]) -> list[Figure]:
    """The exponent and the largest maps' time, then rows for every size."""
    sizes = sorted({one.objects for one in tried})
    slope, spread = exponent([(one.objects, one.planning_s) for one in tried])
    reached = sum(one.fault is None for one in tried) / len(tried)
    slowest = max(one.planning_s for one in tried if one.objects == sizes[-1])
    rows = [
        Figure(
            "exponent", slope, "", bar=EXPONENT_BAR, seed_document="typically linear", spread=spread
        ),
        Figure(f"planning_s_at_{sizes[-1]}", slowest, "s", bar=TIME_BAR),
        Figure("reached_rate", reached, "", better="higher"),
    ]
    for size in sizes:
        own = [one for one in tried if one.objects == size]
        plans = [one.plan for one in own if one.plan is not None]
        time = statistics.median(one.planning_s for one in own)
        rows.append(Figure(f"{size}.planning_s", time, "s"))
        for name in ("regions", "borders", "evaluations"):
            if plans:
                count = statistics.mean(plan.sizes[name] for plan in plans)
                rows.append(Figure(f"{size}.{name}", count, ""))
        if plans:
            rows.append(
                Figure(f"{size}.transfers", statistics.mean(p.transfers for p in plans), "")
            )
    return rows


def exponent(points: list[tuple[int, float]]) -> tuple[float, float]:
    """The slope of log time over log objects by least squares, and its 90 % half-width."""
    line = linregress(*np.log(np.array(points, float)).T)
    return float(line.slope), 1.645 * float(line.stderr)


# --- maps -------------------------------------------------------------------------------------


def generated_map(objects: int, seed: int) -> Map:
    """Rooms with `objects` movables, the same for the same seed.

    As many rooms as `OBJECTS_PER_ROOM` gives, in a square as nearly as may be; doors along a random
    spanning tree and a part of the other walls, each blocked by an object that leaves no room to
    pass; the remaining objects stand in rooms, clear of doors and of one another.
    """
    random = np.random.default_rng(seed)
    rooms = max(2, round(objects / OBJECTS_PER_ROOM))
    columns = math.ceil(math.sqrt(rooms))
    rows = math.ceil(rooms / columns)
    doors = _doors(rows, columns, random)[:objects]
    pitch = ROOM + WALL
    width, height = columns * pitch + WALL, rows * pitch + WALL
    solid = box(0, 0, width, height)
    inner = [
        box(WALL + c * pitch, WALL + r * pitch, WALL + c * pitch + ROOM, WALL + r * pitch + ROOM)
        for r in range(rows)
        for c in range(columns)
    ]
    openings, movables = [], []
    for index, (cell, other) in enumerate(doors):
        middle, across = _place_of_door(cell, other, pitch, random)
        half = np.array([WALL, DOOR / 2]) if across else np.array([DOOR / 2, WALL])
        openings.append(box(*(middle - half), *(middle + half)))
        side = random.uniform(*BLOCKING)
        shift = random.uniform(-0.5, 0.5) * (DOOR - side) * (half < DOOR / 2 - 1e-9)
        centre = middle + np.where(half < DOOR / 2 - 1e-9, 0.0, shift.max() * 0.5)
        movables.append(_square(f"door_{index}", centre, side, 0.0))
    walls = solid.difference(shapely.union_all([*inner, *openings]))
    start = np.array([WALL + 0.6, WALL + 0.6])
    goal = np.array([width - WALL - 0.6, height - WALL - 0.6])
    taken = [shapely.Point(*start).buffer(0.6), shapely.Point(*goal).buffer(0.6)]
    taken += [opening.buffer(1.1) for opening in openings]
    for index in range(objects - len(doors)):
        movables.append(_inside(f"object_{index}", rows, columns, pitch, taken, random))
    return map_of(
        f"rooms_{objects}_{seed}",
        walls=walls,
        movables=movables,
        robot=Robot(RADIUS),
        start=start,
        goals=[(*goal, 0.0)],
        bounds=(0.0, 0.0, width, height),
        cell_size=CELL,
        margin=MARGIN,
    )


def _doors(
    rows: int, columns: int, random: np.random.Generator
) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Pairs of neighbouring rooms: a random spanning tree first, then some of the others."""
    pairs = [((r, c), (r, c + 1)) for r in range(rows) for c in range(columns - 1)]
    pairs += [((r, c), (r + 1, c)) for r in range(rows - 1) for c in range(columns)]
    joined = DisjointSet((r, c) for r in range(rows) for c in range(columns))
    tree, others = [], []
    for index in random.permutation(len(pairs)):
        (tree if joined.merge(*pairs[index]) else others).append(pairs[index])
    return tree + others[: round(EXTRA_DOORS * len(others))]


def _place_of_door(
    cell: tuple[int, int], other: tuple[int, int], pitch: float, random: np.random.Generator
) -> tuple[np.ndarray, bool]:
    """The middle of a door, m, and whether it leads across a wall that stands upright."""
    along = random.uniform(0.3, 0.7) * ROOM
    across = cell[0] == other[0]
    if across:
        return np.array([other[1] * pitch + WALL / 2, WALL + cell[0] * pitch + along]), True
    return np.array([WALL + cell[1] * pitch + along, other[0] * pitch + WALL / 2]), False


def _square(name: str, centre: np.ndarray, side: float, angle: float) -> Movable:
    corners = side / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    movable = Movable.from_corners(name, corners)
    return movable.moved((centre[0], centre[1], angle))


def _inside(
    name: str,
    rows: int,
    columns: int,
    pitch: float,
    taken: list[Polygon],
    random: np.random.Generator,
) -> Movable:
    """An object in some room, clear of all that is taken; smaller after many attempts."""
    for attempt in range(400):
        side = random.uniform(*INSIDE) * (0.5 if attempt > 200 else 1.0)
        reach = 0.75 * side
        room = np.array([random.integers(columns), random.integers(rows)])
        centre = WALL + room * pitch + random.uniform(reach, ROOM - reach, 2)
        movable = _square(name, centre, side, random.uniform(0, math.pi / 2))
        if not any(movable.polygon.intersects(shape) for shape in taken):
            break
    taken.append(movable.polygon.buffer(0.1))
    return movable
