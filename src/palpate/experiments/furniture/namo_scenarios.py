"""`palpate reproduce namo-scenarios --maps FOLDER`: every map in a folder, planned and checked.

Maps that namosim's authors ship stand beside what their planner needed for them; of any other map
our own figures are given. A goal counts as reached when the plan passes an exact check with swept
polygons that shares little more than the outlines with the search. Planning is timed from the map
in memory to the plan, several times: the least counts, because whatever else the machine does only
adds to it. namosim's times are of one run.
"""

import dataclasses
import re
import statistics
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from palpate.errors import PalpateError
from palpate.experiments.experiment import Experiment
from palpate.families.furniture.plan_picture import plan_animation, plan_picture
from palpate.numerics.polygons import length_of
from palpate.planning.movable_obstacles.maps.files import maps_in, read_map
from palpate.planning.movable_obstacles.maps.map import Map
from palpate.planning.movable_obstacles.maps.occupancy import Space
from palpate.planning.movable_obstacles.search.paths import distances
from palpate.planning.movable_obstacles.search.plan import Plan, write_plan
from palpate.planning.movable_obstacles.search.planner import Planner
from palpate.planning.movable_obstacles.search.verification import faults_of
from palpate.runs import Figure, Result

NAME = "namo-scenarios"
REPEATS = 15  # plans of a map, each from nothing; the least time counts
SPEEDUP_BAR, RATIO_BAR = 20.0, 1.1
MOST_DRAWN = 3  # goals of a map of which there are pictures


@dataclass(frozen=True)
class Reference:
    """What namosim's planner after Stilman (2005) needed: s of planning in all, m, m, transfers."""

    planning_s: float
    distance: float
    carried: float
    transfers: int


# Measured with namosim bb857218 on two EPYC cores, Python 3.11, ROS stubbed; every goal reached.
NAMOSIM = {
    "minimal_stilman_2005": Reference(15.0, 1.86, 0.87, 1),
    "obstacle_on_goal": Reference(1.4, 0.87, 0.30, 1),
    "1_robot_2_rooms": Reference(20.8, 11.53, 2.30, 1),
    "1_robot_2_obstacles": Reference(22.0, 30.03, 6.30, 2),
    "namoros_demo_map": Reference(24.6, 14.29, 6.10, 1),
}


@dataclass(frozen=True)
class Trial:
    """A map tried, one goal after the other, each on the map as the plans before have left it.

    `plans` are those that passed the exact check, of `goals` that there are; `fault` is the first
    thing that went wrong. `planning_s` is of all plans, `efficiency` the mean of their
    paths', None where it is not known of any.
    """

    name: str
    goals: int
    plans: tuple[Plan, ...]
    planning_s: float
    efficiency: float | None
    fault: str | None

    @property
    def reached(self) -> float:
        """The share of the goals."""
        return len(self.plans) / self.goals

    def total(self, name: str) -> float:
        """Of a figure that every plan has: "distance", "carried", "object_distance" (m)."""
        return sum((getattr(plan, name) for plan in self.plans), 0.0)

    @property
    def transfers(self) -> int:
        """Of all plans."""
        return sum(plan.transfers for plan in self.plans)

    def line(self) -> str:
        """For the one who waits."""
        many = f"{len(self.plans)} of {self.goals} goals reached"
        reached = ("reached" if self.plans else "not reached") if self.goals == 1 else many
        why = "" if self.fault is None else f" ({self.fault})"
        return (
            f"{self.name}: {reached}{why}, {self.planning_s:.3f} s, {self.total('distance'):.2f} m,"
            f" of it {self.total('carried'):.2f} m carrying, {self.transfers} transfers"
        )


def reproduce(out: Path, *, quick: bool = False, seed: int = 0, maps: Path | None = None) -> Result:
    """Plan every map in the folder `maps`; `quick` times one plan of each instead of fifteen.

    Raises `PalpateError` when no folder is given, or when it holds no map.
    """
    if maps is None:
        raise PalpateError("namo-scenarios needs maps: give a folder with --maps")
    files = maps_in(maps)
    experiment, repeats = Experiment(NAME, out, quick, seed), 1 if quick else REPEATS
    experiment.announce({f"{len(files)} maps": 1})
    trials: list[Trial] = []
    with experiment.counted():
        for path in files:
            taken = {trial.name for trial in trials}
            trials.append(plan_map(path, out, repeats, seed, taken))
            print(trials[-1].line(), flush=True)
    return experiment.result(
        figures(trials),
        {
            "maps": [path.relative_to(maps).as_posix() for path in files],
            "margin": "each map's own",
            "timed": "from the map in memory to the plan, each from nothing; the least of them",
            "repeats": repeats,
            "carried": "what the robot drives while it carries, as namosim counts it",
            "goals": "one after the other, each on the map as the plans before left it",
            "rival": "namosim bb857218, Stilman 2005, planning of all replans in total, of one run",
        },
        "nothing is fitted; every map in the folder is evaluated",
    )


def plan_map(
    path: Path, out: Path, repeats: int, seed: int, taken: Collection[str] = frozenset()
) -> Trial:
    """Plan one map, check the plans, and write plan, picture and animation of each below `out`.

    Its name is the map's, or where that is `taken` already, the file's.
    """
    try:
        world = read_map(path)
        goals = world.goals or (world.check(),)
    except PalpateError as error:
        return Trial(_name_of(path.stem, path, taken), 1, (), 0.0, 0.0, str(error))
    own = _name_of(world.name, path, taken)
    plans, faults, efficiencies, planning_s = [], [], [], 0.0
    for number, goal in enumerate(goals, start=1):
        try:
            again = [Planner(seed=seed).plan(_anew(world), goal) for _ in range(repeats)]
        except PalpateError as error:
            faults.append(str(error))
            continue  # the robot stays where it is, and goes to the next one
        plan = again[-1]
        planning_s += min(one.planning_s for one in again)
        wrong = faults_of(plan, world)
        if wrong:
            faults.append(wrong[0])
            continue
        plans.append(plan)
        direct = direct_distance(world, plan)
        if direct is not None:
            efficiencies.append(plan.path_efficiency(direct))
        name = "plan" if len(goals) == 1 else f"plan-{number:03d}"
        write_plan(out / own / f"{name}.json", plan)
        if number <= MOST_DRAWN:
            plan_picture(out / own / f"{name}.png", world, plan)
            plan_animation(out / own / f"{name}.gif", world, plan)
        world = plan.leaves(world)
    efficiency = statistics.mean(efficiencies) if efficiencies else None
    fault = faults[0] if faults else None
    return Trial(own, len(goals), tuple(plans), planning_s, efficiency, fault)


def _name_of(name: str, path: Path, taken: Collection[str]) -> str:
    """A name that is a folder's, and that no other map of the study has."""
    stem, parts = re.sub(r"[^\w .-]", "_", name).strip(" .") or "map", path.with_suffix("").parts
    names = [stem, *("-".join(parts[-k:]) for k in range(2, len(parts))), path.name]
    names = [re.sub(r"[^\w .-]", "_", one) for one in names]
    free = (one for one in names if one not in taken)
    return next(free, f"{stem}-{len(taken)}")


def _anew(world: Map) -> Map:
    """The same map, of which nothing has been worked out."""
    movables = {name: dataclasses.replace(movable) for name, movable in world.movables.items()}
    return dataclasses.replace(world, movables=movables)


def direct_distance(world: Map, plan: Plan) -> float | None:
    """The robot's shortest way if there were no movables, m; None where the grid knows of none.

    A plan may pass where its rounding to cells leaves no way.
    """
    space = Space(dataclasses.replace(world, movables={}))
    whole = slice(0, space.shape[0]), slice(0, space.shape[1])
    way = distances(space, whole, np.array(world.start)).path_to(np.array(plan.goal))
    return None if way is None else length_of(way)


def figures(trials: list[Trial]) -> list[Figure]:
    """What is held against the bars, then a few rows for every map."""
    speedups, ratios, body_ratios = [], [], []
    rows: list[Figure] = []
    compared = any(trial.name in NAMOSIM for trial in trials)  # else there is nothing to reach
    for trial in trials:
        known = NAMOSIM.get(trial.name)
        if trial.reached == 1.0 and known is not None:  # the way to fewer goals is shorter
            speedups.append(known.planning_s / trial.planning_s)
            ratios.append(trial.total("distance") / known.distance)
            ratios.append(trial.total("carried") / known.carried)
            body_ratios.append(trial.total("object_distance") / known.carried)
        rows += _rows(trial, known)
    goals = sum(trial.goals for trial in trials)
    reached = sum(len(trial.plans) for trial in trials) / goals
    times = [trial.planning_s for trial in trials if trial.plans]
    slowest = [NAMOSIM[trial.name].planning_s for trial in trials if trial.name in NAMOSIM]
    speedup_bar, ratio_bar = (SPEEDUP_BAR, RATIO_BAR) if compared else (None, None)
    head = [
        Figure("reached_rate", reached, "", bar=1.0, better="higher", rival=1.0),
        Figure("speedup_min", min(speedups, default=None), "", speedup_bar, "higher", rival=1.0),
        Figure("distance_ratio_max", max(ratios, default=None), "", ratio_bar, rival=1.0),
        Figure("object_distance_ratio_max", max(body_ratios, default=None), "", rival=1.0),
        Figure("planning_s_max", max(times, default=None), "s", rival=max(slowest, default=None)),
    ]
    return head + rows


def _rows(trial: Trial, known: Reference | None) -> list[Figure]:
    reached = Figure(f"{trial.name}.reached", trial.reached, "", better="higher")
    if not trial.plans:
        return [reached]
    values: list[tuple[str, float, str, float | None]] = [
        ("planning_s", trial.planning_s, "s", known.planning_s if known else None),
        ("distance", trial.total("distance"), "m", known.distance if known else None),
        ("carried", trial.total("carried"), "m", known.carried if known else None),
        ("object_distance", trial.total("object_distance"), "m", None),
        ("transfers", trial.transfers, "", known.transfers if known else None),
    ]
    rows = [Figure(f"{trial.name}.{name}", v, unit, rival=other) for name, v, unit, other in values]
    efficiency = Figure(f"{trial.name}.path_efficiency", trial.efficiency, "", better="higher")
    return [reached, *rows, efficiency]
