"""`palpate plan namo`: a map in; a plan among movable obstacles, its picture and animation out."""

import hashlib
import math
from pathlib import Path

import numpy as np

from palpate.commands import folders
from palpate.families.furniture.plan_options import PlanNamo
from palpate.families.furniture.plan_picture import plan_animation, plan_picture
from palpate.planning.movable_obstacles.maps.files import read_map
from palpate.planning.movable_obstacles.search.plan import TRANSFER, Plan, read_plan, write_plan
from palpate.planning.movable_obstacles.search.planner import Planner, unmoved
from palpate.planning.movable_obstacles.search.policy import NoWayError
from palpate.planning.movable_obstacles.search.verification import faults_of
from palpate.runs import Figure, Result

PLAN, PICTURE, ANIMATION = "plan.json", "plan.png", "rendering.gif"


def run(options: PlanNamo) -> Path:
    """Plan, say what is to be done, and return the path of the plan.

    Raises `PalpateError` for a map that cannot be read, an impossible start or goal, and when no
    plan was found: the sentence says what keeps closed.
    """
    world = read_map(options.map)
    world.check(options.goal)
    world.check_names(options.immovable)
    configuration = folders.told(options, "plan namo")
    # A map may lie in several files; what was read from them decides.
    objects = [(name, movable.pose) for name, movable in world.movables.items()]
    content = repr((unmoved(world), objects, world.start, world.goals)).encode()
    configuration["map"] = {"file": options.map.name, "sha256": hashlib.sha256(content).hexdigest()}
    with folders.open_run(options, "plan-namo", configuration, PLAN) as run:
        if run.finished:
            plan = read_plan(run.path / PLAN)
        else:
            plan = Planner(seed=options.seed).plan(world, options.goal, options.immovable)
            if wrong := faults_of(plan, world):
                raise NoWayError(
                    f"the best plan found on map '{world.name}' does not hold against the exact "
                    f"outlines ({wrong[0]}): expected one that does; smaller cells, a larger "
                    "margin or another --seed may give one"
                )
            write_plan(run.path / PLAN, plan)
            plan_picture(run.path / PICTURE, world, plan)
            plan_animation(run.path / ANIMATION, world, plan)
            result = Result(
                name="plan-namo",
                figures=[
                    Figure("planning_s", plan.planning_s, "s"),
                    Figure("distance", plan.distance, "m"),
                    Figure("carried", plan.carried, "m"),
                    Figure("transfers", plan.transfers, ""),
                    Figure("regions", plan.sizes["regions"], ""),
                    Figure("evaluations", plan.sizes["evaluations"], ""),
                ],
                settings=configuration,
                seeds=[options.seed],
                split=None,
                wall_time_s=run.elapsed,
            )
            run.finish(result.to_dict())
        print("\n".join(told(plan)))
        folders.hand_over(options, run, f"A plan on {world.name}", PLAN)
        print(f"picture: {run.path / PICTURE}")
        return folders.deliver(options, run, PLAN)


def told(plan: Plan) -> list[str]:
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
    turns = sum(_turned(segment.poses) for segment in plan.segments)
    lines.append(
        f"{plan.distance:.2f} m in all, {plan.carried:.2f} m of it carrying, "
        f"{plan.transfers} transfers, {turns:.0f} degrees of turning; "
        f"planned in {plan.planning_s:.3f} s"
    )
    return lines


def _turned(poses: np.ndarray) -> float:
    """Degrees that the robot turns in all."""
    change = np.diff(poses[:, 2])
    return float(np.degrees(np.abs(np.arctan2(np.sin(change), np.cos(change))).sum()))
