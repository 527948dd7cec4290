"""`palpate reproduce namo-online`: rooms that open where furniture gives way, and it hides how.

In the MuJoCo world a robot plans, tries, feels, and plans anew. First the named scenes of the
deck, then generated rooms whose goal lies in another free region than the start. The same rooms
are given to four planners that share search and execution (see `namo_episode`): ours, which learns
how each piece moves from the contacts; one that is told; one that takes everything to be movable
and never learns; and the thresholded movable flag of Levihn, Scholz and Stilman (ICRA 2013).
"""

import statistics
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from palpate.experiments.experiment import Experiment, share_of
from palpate.families.furniture.plan_picture import plan_picture, scene_animation
from palpate.planning.movable_obstacles.motion.primitives import Constraint
from palpate.runs import Figure, Result
from palpate.runs.run import read_metrics
from palpate.trials.furniture import rooms as namo_rooms
from palpate.trials.furniture.namo_episode import (
    ATTEMPTS,
    BUDGET,
    DRAWS,
    ERRS,
    MARGINS,
    MOVABLE,
    SEARCH,
    THRESHOLD,
    Episode,
    Flag,
    Learner,
    Opinion,
    episode,
    truth_of,
)
from palpate.trials.furniture.namo_execution import FORCE
from palpate.trials.furniture.rooms import Room, generated_room, scenes
from palpate.trials.trial import resumable

NAME = "namo-online"
SOLVED_BAR, ALL_MOVABLE_BAR = 0.95, 0.60
ROOMS = {"full": 100, "quick": 6}
SEEDS = 970_000  # of rooms, used by nothing else
OURS, INFORMED, ALL, FLAG = "ours", "told_truth", "all_movable", "flag"
PICTURED = 3  # rooms whose episode is drawn
FRAMES = 100  # of an animation, about
COUNTED = ("time", "distance", "carried", "attempts", "failures", "planning_s")
UNITS = {"time": "s", "distance": "m", "carried": "m", "planning_s": "s"}


def planners(room: Room) -> dict[str, Callable[[], Opinion]]:
    """What each planner takes the room's objects to be."""
    world = room.world()
    return {
        OURS: lambda: Learner(world.outlines, room.seed),
        INFORMED: lambda: Opinion(truth_of(room)),
        ALL: lambda: Opinion(dict.fromkeys(world.names, Constraint("free"))),
        FLAG: lambda: Flag(world.names),
    }


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Scenes, then rooms; `quick` is fewer rooms."""
    experiment, count = Experiment(NAME, out, quick, seed), ROOMS["quick" if quick else "full"]
    first = SEEDS + 1000 * seed
    experiment.announce({"scenes": 1, f"{count} rooms, 4 planners each": 1 if quick else 11})
    with experiment.counted():
        shown = {name: scene_outcome(out, name, room) for name, room in scenes().items()}
    settings = configuration(first, count)
    rows = outcomes(experiment, first, count, settings)
    return experiment.result(
        figures(rows, shown),
        settings,
        "nothing is fitted beforehand; every room's constants are drawn by its own seed, and "
        "development used rooms of seeds below 3000",
        range(first, first + count),
    )


def configuration(first: int, count: int) -> dict[str, Any]:
    """All that the outcome depends on."""
    constants = (
        *("WIDTH", "DEPTH", "DOOR", "DOORS", "LENGTHS", "DEPTHS", "CLUTTER", "TEMPTING", "SHORTER"),
        *("OTHERS", "REST", "CONSTRAINED_ONLY", "HEAVY", "LIGHT", "RUBBER", "FELT"),
        *("RADIUS", "MARGIN", "CELL"),
    )
    return {
        "first_seed": first,
        "rooms": count,
        "budget_s": BUDGET,
        "attempts": ATTEMPTS,
        "draws": DRAWS,
        "iterations": SEARCH.iterations,
        "margins_m": MARGINS,
        "hand_N": FORCE,
        "flag": {"prior": MOVABLE, "threshold": THRESHOLD, "errs": ERRS},
        "room": {name.lower(): getattr(namo_rooms, name) for name in constants},
    }


def outcomes(
    experiment: Experiment, first: int, count: int, settings: Mapping[str, Any]
) -> list[dict]:
    """One row for each room, done or read back."""
    with experiment.stage("rooms", settings) as stage:
        steps = () if stage.finished else range(1, count + 1)
        for step, note in resumable(stage.run, steps, np.zeros(1), "rooms"):
            note(**room_row(experiment.out, generated_room(first + step - 1), step))
    return read_metrics(stage.path)


def room_row(out: Path, room: Room, step: int) -> dict[str, Any]:
    """Every planner in one room."""
    row: dict[str, Any] = {"seed": room.seed, "constructions": list(room.constructions)}
    for name, opinion in planners(room).items():
        outcome = episode(room, opinion())
        row[name] = {"reached": outcome.reached, "reason": outcome.reason}
        row[name] |= {key: float(getattr(outcome, key)) for key in COUNTED}
        if name == OURS and step <= PICTURED:
            show(out / f"room-{step}", room, outcome)
    return row


def scene_outcome(out: Path, name: str, room: Room) -> dict[str, Any]:
    """Ours in one of the deck's scenes, with pictures."""
    outcome = episode(room, Learner(room.world().outlines, room.seed))
    tried = [(piece, round(float(share), 2)) for piece, share in outcome.tried]
    print(f"scene '{name}': {outcome.reason} after {outcome.time:.0f} s, tried {tried}", flush=True)
    show(out / name.replace(" ", "-"), room, outcome)
    return {
        "reached": outcome.reached,
        "time": outcome.time,
        "moved": [piece for piece, _ in tried],
        "failures": outcome.failures,
    }


def show(folder: Path, room: Room, outcome: Episode) -> None:
    """The plans one after the other with what was believed then, and the episode as it went."""
    folder.mkdir(parents=True, exist_ok=True)
    driven = np.array([frame.robot for frame in outcome.frames])
    for number, ((world, plan), (_, believed)) in enumerate(
        zip(outcome.plans, outcome.beliefs, strict=False)
    ):
        path = folder / f"plan-{number + 1}.png"
        plan_picture(path, world, plan, movability=believed, driven=driven)
    if not outcome.plans or not len(driven):
        return
    world = outcome.plans[0][0]
    every = max(1, len(outcome.frames) // FRAMES)
    frames = outcome.frames[::every]
    believed = []
    for frame in frames:
        earlier = [belief for time, belief in outcome.beliefs if time <= frame.time]
        believed.append(earlier[-1] if earlier else outcome.beliefs[0][1])
    scene_animation(
        folder / "episode.gif",
        world,
        room.goal,
        np.array([frame.robot for frame in frames]),
        np.array([frame.poses for frame in frames]),
        [frame.held for frame in frames],
        movability=believed,
    )


def figures(rows: list[dict], shown: Mapping[str, Mapping[str, Any]]) -> list[Figure]:
    """What is held against the bars, then what each planner needed, then the scenes."""
    solvable = [row for row in rows if row[INFORMED]["reached"]]
    ours = [row for row in solvable if row[OURS]["reached"]]
    flag = [row for row in solvable if row[FLAG]["reached"]]
    rates = {
        name: (sum(row[name]["reached"] for row in rows), len(rows))
        for name in (INFORMED, FLAG, OURS)
    }
    believing = sum(row[ALL]["reached"] for row in rows)
    found = [
        share_of(
            "success_of_solvable", len(ours), len(solvable), bar=SOLVED_BAR,
            rival=share_of("", len(flag), len(solvable)).value,
        ),
        share_of(
            "success_rate_all_movable", believing, len(rows), bar=ALL_MOVABLE_BAR, better="lower"
        ),
        *(share_of(f"success_rate_{name}", *rate) for name, rate in rates.items()),
    ]  # fmt: skip
    found.append(Figure("rooms", len(rows), "", better="higher"))
    for name in (OURS, INFORMED, ALL, FLAG):
        reached = [row[name] for row in rows if row[name]["reached"]]
        for key in COUNTED:
            value = statistics.mean(row[key] for row in reached) if reached else None
            found.append(Figure(f"{name}.{key}", value, UNITS.get(key, "")))
    for name, outcome in shown.items():
        key = f"scene.{name.replace(' ', '_')}"
        found.append(Figure(f"{key}.reached", float(outcome["reached"]), "", better="higher"))
        found.append(Figure(f"{key}.time", outcome["time"], "s"))
        found.append(Figure(f"{key}.failures", outcome["failures"], ""))
    return found
