"""`palpate reproduce energy-audit`: what energy a controller can be made to create.

A tip in the maze is held by a variable impedance, whose set-point and stiffness an adversary
decides anew at any sample: at random, pressing on what is touched, and by weights that are searched
for the worst. Before the tip stands a filter, sampled at three rates. A meter that reads only the
simulator counts energy stored, work from outside and, beside them, what is in the filter's tank:
that never rises behind a passive controller. The base is at rest, as in a frame that accelerates
the engine's own step makes 1e-5 J. Rivals are tried by the same adversaries, a tenth as long; what
MuJoCo's springs of contacts store is not counted, to whose advantage that is.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from palpate.experiments.experiment import Experiment
from palpate.families.contact.environments import maze_law
from palpate.runs import Figure, Result
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.filtered_law import FilteredLaw
from palpate.safety.filters import FILTERS, WITH_TANK, filter_of
from palpate.trials.adversaries import RandomAdversary, SearchedAdversary
from palpate.trials.audit import Audit, audit
from palpate.worlds.maze.maze import BlindMaze
from palpate.worlds.maze.scene import TIP_MASS
from palpate.worlds.maze.tip import DRIVE_LIMIT

NAME = "energy-audit"
FIRST = 500_000  # seed of the episodes
TANK = {"initial": 1.0, "upper": 2.0}  # J
OURS, TEXTBOOK = "passivity", "textbook-valve"
RATES = {1000: 1000, 100: 300, 20: 100}  # Hz: samples of an episode
ACTIONS, WORLDS = 4, 20  # side by side
HOLD = 0.2  # s, for which a random adversary asks for the same, at most
PRESSES = 0.9  # share of motions of the pressing one that go against what it touches
SHARES = {"random": 0.2, "pressing": 0.4, "searched": 0.4}  # of the steps
MINUTES = {"our filter": 12, "rivals": 5}
NO_GAIN, TEXTBOOK_GAINS = 1e-6, 1.0  # J, the bars


@dataclass(frozen=True)
class Size:
    """Control steps of our filter at each rate, and of each rival."""

    ours: int
    rival: int


FULL, QUICK = Size(1_000_000, 100_000), Size(20_000, 6_000)


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Audit filters below `out`; `quick` is a fiftieth of the steps.

    Raises `PalpateError` when `out` holds other runs.
    """
    experiment = Experiment(NAME, out, quick, seed)
    experiment.announce({of: 1 if quick else each for of, each in MINUTES.items()})
    experiment.uses(FIRST)
    grid = [(name, rate) for rate in reversed(RATES) for name in FILTERS]
    experiment.on_every_core(of_filter, grid, "audits")
    found = {each: of_filter(experiment, *each) for each in grid}
    size = QUICK if quick else FULL
    settings = {"tank": TANK, "steps": {OURS: size.ours, "rivals": size.rival}, "shares": SHARES}
    return experiment.result(figures(found), settings, "episodes are drawn anew, and used once")


def of_filter(experiment: Experiment, name: str, rate: int) -> dict[str, Any]:
    """The worst of all adversaries: energies in J, steps, and shares of them."""
    size = QUICK if experiment.quick else FULL
    steps = size.ours if name == OURS else size.rival
    numbers = {"tank": TANK} if name in WITH_TANK else {}
    about = {"filter": name, "numbers": numbers, "rate": rate, "steps": steps, "shares": SHARES}

    def work() -> dict[str, Any]:
        period, seed = 1.0 / rate, FIRST + experiment.seed
        worlds = [BlindMaze(sway=0.0, scattered=True, control_period=period) for _ in range(WORLDS)]
        law = FilteredLaw(maze_law(), filter_of(name, numbers), TIP_MASS, period, DRIVE_LIMIT)
        reserve = EnergyTank(**TANK).reserve
        hold, each = max(1, round(HOLD * rate)), WORLDS * RATES[rate]
        found: list[tuple[str, Audit]] = []
        for kind, share in SHARES.items():
            episodes = max(1, round(steps * share / each))
            asked: dict[str, Any] = {
                "periods": RATES[rate], "touches": touches, "reserve": reserve,
            }  # fmt: skip
            if kind != "searched":
                adversary = RandomAdversary(ACTIONS, hold, PRESSES if kind == "pressing" else 0.0)
                asked |= {"episodes": episodes, "seed": seed}
                found.append((kind, audit(worlds, law, adversary, **asked)))
                continue
            searched = SearchedAdversary(ACTIONS, WORLDS, seed)
            for generation in range(episodes):
                one = audit(worlds, law, searched, episodes=1, seed=seed + generation, **asked)
                searched.improve(one.rise - np.where(np.isfinite(one.margin), one.margin, 0.0))
                found.append((kind, one))
        return worst(found)

    return experiment.found(f"{name}-{rate}-hz", about, work)


def touches(truth: Any) -> bool:
    """Whether the tip is in contact."""
    return truth.peak_force > 0.0


def worst(found: list[tuple[str, Audit]]) -> dict[str, Any]:
    """Of audits, by the kind of their adversary and of all."""
    steps = sum(one.steps for _, one in found)
    margin = min(float(one.margin.min()) for _, one in found)
    gains = {
        kind: max(float(one.rise.max()) for of, one in found if of == kind) for kind, _ in found
    }
    return {
        "gain": max(gains.values()),
        "gains": gains,
        "margin": margin if np.isfinite(margin) else None,
        "drawn": max(float(one.drawn.max()) for _, one in found),
        "braked": min(float(one.braked.min()) for _, one in found),
        "touching": sum(one.steps * float(one.touching.mean()) for _, one in found) / steps,
        "steps": steps,
    }


def figures(found: dict[tuple[str, int], dict[str, Any]]) -> list[Figure]:
    """Ours at its worst of all rates; then every filter at each."""
    ours = [found[OURS, rate] for rate in RATES]
    gains = {name: max(found[name, rate]["gain"] for rate in RATES) for name in FILTERS}
    rivals = ", ".join(f"{name} {gain:.2g}" for name, gain in gains.items() if name != OURS)
    listed = [
        Figure("worst_energy_gain_J", gains[OURS], "J", NO_GAIN, rival=rivals),
        Figure("tank_min_margin_J", min(one["margin"] for one in ours), "J", 0.0, better="higher"),
        Figure("least_braking_share", min(one["braked"] for one in ours), "", better="higher"),
        Figure("control_steps", float(sum(one["steps"] for one in ours)), "", better="higher"),
        Figure("touching", float(np.mean([one["touching"] for one in ours])), "", 0.5,
               better="higher"),
        Figure("textbook_100hz_gain_J", found[TEXTBOOK, 100]["gain"], "J", TEXTBOOK_GAINS,
               better="higher"),
    ]  # fmt: skip
    for (name, rate), one in found.items():
        of = f"detail.{name.replace('-', '_')}.{rate}_hz"
        listed += [
            Figure(f"{of}.gain_J", one["gain"], "J"),
            Figure(f"{of}.margin_J", one["margin"], "J", better="higher"),
            Figure(f"{of}.drawn_J", one["drawn"], "J"),
        ]
    return listed
