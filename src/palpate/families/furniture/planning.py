"""Planning among movable obstacles: a map as a problem; its plan, picture and animation."""

import hashlib
import math
from pathlib import Path

import numpy as np

from palpate.families.furniture.plan_picture import plan_animation, plan_picture
from palpate.families.options import Problem
from palpate.planning.movable_obstacles.maps.files import read_map
from palpate.planning.movable_obstacles.search.plan import TRANSFER, Plan, read_plan, write_plan
from palpate.planning.movable_obstacles.search.planner import Planner, static_map
from palpate.planning.movable_obstacles.search.policy import NoWayError
from palpate.planning.movable_obstacles.search.verification import faults_of
from palpate.runs import Figure, Run

PLAN, PICTURE, ANIMATION = "plan.json", "plan.png", "rendering.gif"


def read(
    file: Path, goal: tuple[float, float, float] | None, immovable: tuple[str, ...], seed: int
) -> Problem:
    """The problem of the map in `file`, to the map's own goal where none (m, m, rad) is given.

    Raises `PalpateError` for a map that cannot be read and an impossible start or goal; `solve`
    does when no plan was found: the sentence says what keeps closed.
    """
    world = read_map(file)
    world.check(goal)
    world.check_names(immovable)

    def solve(run: Run) -> list[Figure]:
        plan = Planner(seed=seed).plan(world, goal, immovable)
        if wrong := faults_of(plan, world):
            raise NoWayError(
                f"the best plan found on map '{world.name}' does not hold against the exact "
                f"outlines ({wrong[0]}): expected one that does; smaller cells, a larger "
                "margin or another --seed may give one"
            )
        write_plan(run.path / PLAN, plan)
        plan_picture(run.path / PICTURE, world, plan)
        plan_animation(run.path / ANIMATION, world, plan)
        return [
            Figure("planning_s", plan.planning_s, "s"),
            Figure("distance", plan.distance, "m"),
            Figure("carried", plan.carried, "m"),
            Figure("transfers", plan.transfers, ""),
            Figure("regions", plan.sizes["regions"], ""),
            Figure("evaluations", plan.sizes["evaluations"], ""),
        ]

    # A map may lie in several files; what was read from them decides.
    objects = [(name, movable.pose) for name, movable in world.movables.items()]
    content = repr((static_map(world), objects, world.start, world.goals)).encode()
    inputs = {"map": {"file": file.name, "sha256": hashlib.sha256(content).hexdigest()}}
    return Problem(f"A plan on {world.name}", inputs, solve, lambda path: steps(read_plan(path)))


def steps(plan: Plan) -> list[str]:
    """A sentence for every segment, and one for the whole."""
    lines = []
    for number, segment in enumerate(plan.segments, start=1):
        x, y, theta = segment.poses[-1]
        where = f"({x:.2f}, {y:.2f}) m, {math.degrees(theta):.0f} degrees"
        if segment.kind == TRANSFER:
            ways = " and ".join(segment.primitives)
            sure = "" if segment.probability == 1 else f", {segment.probability:.0%} sure"
            lines.append(
                f"{number}. hold '{segment.name}' and {ways} to {where}: "
                f"{segment.distance:.2f} m{sure}"
            )
        else:
            lines.append(f"{number}. drive to {where}: {segment.distance:.2f} m")
    turns = sum(_turning_of(segment.poses) for segment in plan.segments)
    lines.append(
        f"{plan.distance:.2f} m in all, {plan.carried:.2f} m of it carrying, "
        f"{plan.transfers} transfers, {turns:.0f} degrees of turning; "
        f"planned in {plan.planning_s:.3f} s"
    )
    return lines


def _turning_of(poses: np.ndarray) -> float:
    """Degrees that the robot turns in all."""
    change = np.diff(poses[:, 2])
    return float(np.degrees(np.abs(np.arctan2(np.sin(change), np.cos(change))).sum()))
