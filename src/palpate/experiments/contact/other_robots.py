"""The filter of `palpate reproduce maze-passive` before other robots, and how long a call takes.

It stands before the servos of the gripper that brings ropes to rest by the policy that ships with
palpate, and of the base that makes its way among furniture. Both are tried in the same episodes
with it and without; their tanks are written down in `ROPE_TANK` and `BASE_TANK`, of which the
second is about what the most laborious of the rooms that it was developed on took.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from palpate.experiments.experiment import Experiment, ratio
from palpate.experiments.rope import nominal
from palpate.families.contact.environments import TANK
from palpate.runs import Figure
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.passivity import PassivityFilter
from palpate.safety.port import Port
from palpate.tasks.rope import RopeStabilization
from palpate.trials.furniture.namo_episode import Learner, episode
from palpate.trials.furniture.rooms import base_filter, generated_room
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.stabilization import behind_filter, evaluation_trials, summarise
from palpate.trials.trial import run_trials

ROPES, ROPE_SEED, ROPE_TANK = 10, 600_000, 1.0  # each from four poses; J
ROOMS, ROOM_SEED, BASE_TANK = 40, 985_000, 30.0  # J
TOGETHER = 10  # rooms that are tried one after the other
CALLS = 20_000  # of the filter, timed
FAST = 0.1  # ms, the bar
ROPE_CLOSE, ROPE_SLOWER, BASE_CLOSE = -0.02, 1.02, -0.05  # the same


def of_other_robots(experiment: Experiment) -> list[Figure]:
    """Of ropes, base and the filter alone, each tried in a stage of its own."""
    quick = experiment.quick
    ropes, rooms, calls = (1, 1, 1_000) if quick else (ROPES, ROOMS, CALLS)
    grid = [(first, min(TOGETHER, rooms - first)) for first in range(0, rooms, TOGETHER)]
    experiment.on_every_core(of_rooms, grid, "rooms")
    tried = [one for part in grid for one in of_rooms(experiment, *part)["rooms"]]
    about = {"tank": ROPE_TANK, "ropes": ropes}
    of_rope = experiment.found("ropes", about, lambda: of_ropes(ropes))
    timed = experiment.found("filter", {"calls": calls}, lambda: filter_times(calls))
    return [
        *rope_figures(of_rope),
        *base_figures(tried),
        Figure("filter_p99_ms", timed["p99_ms"], "ms", FAST),
        Figure("detail.filter_median_ms", timed["median_ms"], "ms"),
    ]


def of_ropes(ropes: int) -> dict[str, Any]:
    """How ropes come to rest with a filter before the gripper's servos, and without."""
    policy, _ = nominal.shipped_policy()
    controller = LearnedController(policy, RopeStabilization())
    trials = evaluation_trials(nominal.BASE, ropes, ROPE_SEED)
    least, found = [], {}

    def watch(_: int, worlds: Sequence[Any]) -> None:
        least.append(min(world.drive.least for world in worlds))

    for name, those in (("bare", trials), ("filtered", behind_filter(trials, ROPE_TANK))):
        episodes = run_trials(those, controller, watch=watch if name == "filtered" else None)
        summary = summarise(those, episodes)
        found[name] = {"success": summary.success_rate, "time": summary.time}
    return found | {"least": min(least)}


def of_rooms(experiment: Experiment, first: int, count: int) -> dict[str, Any]:
    """Rooms one after the other: whether the base got to its goal with the filter and without."""

    def work() -> dict[str, Any]:
        return {"rooms": [of_room(ROOM_SEED + first + number) for number in range(count)]}

    return experiment.found(f"rooms-{first}", {"tank": BASE_TANK, "rooms": count}, work)


def of_room(seed: int) -> dict[str, Any]:
    """One of them; energies in J."""
    room = generated_room(seed)
    outlines, drive = room.world().outlines, base_filter(BASE_TANK)
    bare = episode(room, Learner(outlines, room.seed))
    filtered = episode(room, Learner(outlines, room.seed), drive)
    return {
        "bare": bare.reached,
        "filtered": filtered.reached,
        "drawn": drive.drawn,
        "least": drive.least,
    }


def rope_figures(found: Mapping[str, Any]) -> list[Figure]:
    """With the filter against without."""
    bare, filtered = found["bare"], found["filtered"]
    slower = ratio(filtered["time"], bare["time"])
    return [
        Figure("rope.success_difference", filtered["success"] - bare["success"], "", ROPE_CLOSE,
               better="higher"),
        Figure("rope.time_ratio", slower, "", ROPE_SLOWER),
        Figure("detail.rope.success_rate", filtered["success"], "", better="higher"),
        Figure("detail.rope.least_tank_level_J", found["least"], "J", better="higher"),
    ]  # fmt: skip


def base_figures(rooms: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """The same, of the base in rooms."""
    bare, filtered, drawn, least = (
        np.array([room[name] for room in rooms], float)
        for name in ("bare", "filtered", "drawn", "least")
    )
    more = float(filtered.sum() - bare.sum()) / len(rooms)  # 38 / 40 - 1 is less than -0.05
    return [
        Figure("base.success_difference", more, "", BASE_CLOSE, better="higher"),
        Figure("detail.base.success_rate", float(filtered.mean()), "", better="higher"),
        Figure("detail.base.drawn_J", float(np.median(drawn)), "J"),
        Figure("detail.base.least_tank_level_J", float(least.min()), "J", better="higher"),
        Figure("detail.base.median_of_least_levels_J", float(np.median(least)), "J",
               better="higher"),
    ]  # fmt: skip


def filter_times(calls: int) -> dict[str, float]:
    """Of one call for one robot, half of them with an empty tank."""
    tank, times = EnergyTank(**TANK), []
    one, still = PassivityFilter(tank=tank), np.zeros((1, 2))
    port = Port(still + 9.0, still + 1e-4, still + 0.3, np.eye(2)[None], np.full(1, 1e-3), 1e-3)
    for number in range(calls):
        state = np.full(1, tank.lower if number % 2 else tank.initial)
        began = time.perf_counter()
        one(state, port, still + 9.0)
        times.append(1e3 * (time.perf_counter() - began))
    return {"median_ms": float(np.median(times)), "p99_ms": float(np.quantile(times, 0.99))}
