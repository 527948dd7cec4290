"""`palpate reproduce maze-passive`: policies that draw little energy, behind a filter of it.

The two by two of passivity-centric safe RL (arXiv 2503.00287), in the maze: with a filter at
deployment or without, and with costs of energy in training or without. *Agnostic* is the
`no-recovery` of `palpate reproduce maze-safe`; *filtered* the same behind the filter; *aware*
learnt with both costs (`palpate train maze --method passive`); *ensured* is aware behind the
filter. With either cost alone, behind every other filter, and on the arm stand beside. All are
tried in the same episodes, so that what they draw is compared episode by episode. The same filter
stands before other robots as well (`palpate.experiments.contact.other_robots`).

An episode violates passivity if more energy was drawn than the tank held above its reserve; behind
a filter also if energy stored and tank rose by more than `GAIN`, by a meter of the simulator: that
much the engine's own steps make in the frame of a base that sways. Trainings stand beside each
other, one on each core; what is found of one is in a small folder `TRAINING-SEED-found`.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from palpate.commands import folders, train
from palpate.commands.in_world.episodes import at_its_best
from palpate.experiments.contact.maze_safe import FIRST
from palpate.experiments.contact.other_robots import of_other_robots
from palpate.experiments.experiment import Experiment, ratio, share_of
from palpate.families.contact.environments import TANK
from palpate.families.contact.episodes import GOAL
from palpate.families.contact.maze_options import EvaluateMaze, TrainMaze
from palpate.learning.off_policy import evaluate
from palpate.networks.guarded import load_actor
from palpate.runs import Figure, Result
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.filters import FILTERS, NONE
from palpate.trials.audit import EnergyWatch

NAME = "maze-passive"
TRIED = 600_000  # the seed of the episodes
SIDE_BY_SIDE = 20
GAIN = 1e-4  # J
OURS = "passivity"
RIVALS = tuple(name for name in FILTERS if name not in (NONE, OURS))
# Trainings: their method and, of a passive one, its costs.
TRAININGS: dict[str, dict[str, Any]] = {
    "no-recovery": {"method": "no-recovery"},
    "passive-eb-ef": {"method": "passive", "costs": ("eb", "ef")},
    "passive-eb": {"method": "passive", "costs": ("eb",)},
    "passive-ef": {"method": "passive", "costs": ("ef",)},
}
# Rows: of which training, behind which filter, on what.
ROWS: dict[str, tuple[str, str, str]] = {
    "agnostic": ("no-recovery", NONE, "tip"),
    "filtered": ("no-recovery", OURS, "tip"),
    "aware": ("passive-eb-ef", NONE, "tip"),
    "ensured": ("passive-eb-ef", OURS, "tip"),
    "eb": ("passive-eb", NONE, "tip"),
    "ef": ("passive-ef", NONE, "tip"),
    **{name: ("no-recovery", name, "tip") for name in RIVALS},
    "arm": ("passive-eb-ef", NONE, "arm"),
    "arm.filtered": ("passive-eb-ef", OURS, "arm"),
}
LEARNT = ("aware", "ensured", "eb", "ef")  # which are held against agnostic, episode by episode
MINUTES = {"trainings": 40, "episodes": 60, "other robots": 8}
SUCCESS, KEPT, LESS, CLOSE = 0.8, 0.9, 0.7, -0.05  # the bars

Episodes = Mapping[str, Sequence[Any]]  # of one row and seed: ends, energies in J


@dataclass(frozen=True)
class Size:
    """Seeds, decisions of a training, and episodes of each row, on the arm as well."""

    seeds: int
    steps: int
    episodes: int
    on_arm: int


FULL, QUICK = Size(3, 150_000, 300, 100), Size(1, 2_000, 8, 2)


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Train and evaluate below `out`; `quick` is one seed and hardly learns anything.

    Raises `PalpateError` when `out` holds other runs.
    """
    experiment, size = Experiment(NAME, out, quick, seed), QUICK if quick else FULL
    experiment.announce({of: 2 if quick else each for of, each in MINUTES.items()})
    first = experiment.uses(FIRST, size.seeds)
    seeds = range(first, first + size.seeds)
    grid = [(name, each) for each in seeds for name in TRAININGS]
    experiment.on_every_core(of_training, grid, "trainings")
    found: dict[str, list[Episodes]] = {row: [] for row in ROWS}
    for name, each in grid:
        for row, episodes in of_training(experiment, name, each)["rows"].items():
            found[row].append(episodes)
    listed = [*figures(found), *of_other_robots(experiment)]
    settings = {"size": dataclasses.asdict(size), "tank": TANK, "rows": ROWS}
    return experiment.result(listed, settings, f"the same new episodes for all, seed {TRIED}")


def of_training(experiment: Experiment, name: str, seed: int) -> dict[str, Any]:
    """Episodes of all rows that are of this training, by row."""
    size = QUICK if experiment.quick else FULL
    options = TrainMaze(
        **TRAININGS[name], steps=size.steps, seed=seed, out=experiment.out / f"maze-{name}-{seed}"
    )
    about = {
        "options": folders.configuration_of(options, "train maze"),
        "constants": options.constants(),
        "size": dataclasses.asdict(size),
        "tank": TANK,
    }

    def work() -> dict[str, Any]:
        policy = train.run(options)
        rows = {}
        for row, (training, which, world) in ROWS.items():
            if training == name:
                count = size.on_arm if world == "arm" else size.episodes
                rows[row] = evaluate_policy(policy, which, world, count, TRIED + experiment.seed)
        return {"rows": rows}

    return experiment.found(f"{name}-{seed}-found", about, work)


def evaluate_policy(folder: Path, which: str, world: str, episodes: int, seed: int) -> Episodes:
    """How episodes of a policy ended, and their energies, J."""
    policy, manifest = load_actor(folder / folders.POLICY)
    options = EvaluateMaze(policy=folder, filter=which, world=world)  # type: ignore[arg-type]
    environments = options.make(min(SIDE_BY_SIDE, episodes), manifest, policy)
    act: Any = at_its_best(policy)
    watched = which != NONE and world == "tip"  # what is stepped, and has a meter
    if watched:
        act = EnergyWatch(act, environments)
    try:
        ended = evaluate(environments, act, episodes, seed)
    finally:
        environments.close()
    kept = {name: ended[name].tolist() for name in ("end", "drawn", "flow", "length")}
    level = [None if value != value else value for value in ended["level"].tolist()]
    rise = act.rise(episodes).tolist() if watched else [0.0] * episodes
    return kept | {"level": level, "rise": rise}


def figures(found: Mapping[str, Sequence[Episodes]]) -> list[Figure]:
    """What counts, over the episodes of all seeds, and then every row's own."""
    reserve = EnergyTank(**TANK).reserve
    rows = {row: _Row.of(parts, reserve) for row, parts in found.items()}
    agnostic = rows["agnostic"]
    kept = {row: ratio(rows[row].success, agnostic.success or None) for row in rows}
    listed = [
        Figure(f"{row}.violations", float(rows[row].violations.sum()), "",
               0.0 if row in ("filtered", "ensured") else None)
        for row in ("filtered", "ensured", "agnostic", "aware")
    ]  # fmt: skip
    for row in ("filtered", "ensured"):
        listed += [
            Figure(f"{row}.success_ratio", kept[row], "", KEPT, better="higher"),
            share_of(f"{row}.success_rate", int(rows[row].goal.sum()), len(rows[row].goal),
                     bar=SUCCESS),
        ]  # fmt: skip
    for row in LEARNT:
        both = rows[row].goal & agnostic.goal
        less = ratio(float(rows[row].drawn[both].sum()), float(agnostic.drawn[both].sum()) or None)
        listed += [
            Figure(f"{row}.energy_ratio", less, "", LESS if row in LEARNT[:2] else None),
            Figure(f"{row}.success_difference", rows[row].success - agnostic.success, "",
                   CLOSE if row in LEARNT[:2] else None, better="higher"),
        ]  # fmt: skip
    arm = rows["arm.filtered"].success - rows["arm"].success
    listed.append(Figure("arm.success_difference", arm, "", CLOSE, better="higher"))
    for row, one in rows.items():
        listed += [
            share_of(f"detail.{row}.success_rate", int(one.goal.sum()), len(one.goal)),
            Figure(f"detail.{row}.violations", float(one.violations.sum()), ""),
            Figure(f"detail.{row}.drawn_J", float(np.median(one.drawn)), "J"),
            Figure(f"detail.{row}.greatest_power_W", float(np.median(one.flow)), "W"),
        ]
    return listed


@dataclass(frozen=True)
class _Row:
    """Episodes of all seeds, each array (episodes,)."""

    goal: np.ndarray  # bool
    drawn: np.ndarray  # J
    flow: np.ndarray  # W
    violations: np.ndarray  # bool

    @property
    def success(self) -> float:
        return float(self.goal.mean())

    @classmethod
    def of(cls, parts: Sequence[Episodes], reserve: float) -> "_Row":
        joined = functools.partial(_join, parts)
        level = joined("level")
        broken = (np.isfinite(level) & (level < reserve)) | (joined("rise") > GAIN)
        ends = np.concatenate([np.array(part["end"], object) for part in parts])
        return cls(ends == GOAL, joined("drawn"), joined("flow"), broken)


def _join(parts: Sequence[Episodes], name: str) -> np.ndarray:
    return np.concatenate([np.array(part[name], float) for part in parts])
