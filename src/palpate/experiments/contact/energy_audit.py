"""`palpate reproduce energy-audit`: what energy a controller can be made to create.

A tip in the maze and a seven-axis arm are held by a variable impedance, whose set-point and
stiffness an adversary decides anew at any sample: at random, pressing on what is touched, and by
weights that are searched for the worst. Before the robot stands a filter, sampled at three rates:
of the force on the tip, of the arm's joint torques. A meter that reads only the simulator counts
energy stored, work from outside and, beside them, what is in the filter's tank: that never rises
behind a passive controller.

The tip's base is at rest, as in a frame that accelerates the engine's own step makes 1e-5 J. Of the
arm nothing is taken off for what the engine's steps gain without torque. What MuJoCo stores in its
contacts is not counted. Rivals are tried by the same adversaries, a tenth as long.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from palpate.experiments.experiment import Experiment
from palpate.families.contact.environments import maze_law
from palpate.runs import Figure, Result
from palpate.safety.energy_tank import EnergyTank
from palpate.safety.filtered_law import FilteredLaw
from palpate.safety.filters import FILTERS, NONE, WITH_TANK, filter_of
from palpate.safety.joint_impedance import JointImpedance
from palpate.safety.port import Filter
from palpate.trials.adversaries import RandomAdversary, SearchedAdversary
from palpate.trials.audit import Audit, audit
from palpate.worlds.arm.joints import JointArm
from palpate.worlds.arm.panda import TORQUE_LIMITS
from palpate.worlds.maze.maze import BlindMaze
from palpate.worlds.maze.scene import TIP_MASS
from palpate.worlds.maze.tip import DRIVE_LIMIT
from palpate.worlds.world import World, side_by_side

NAME = "energy-audit"
FIRST = 500_000  # seed of the episodes
OURS, TEXTBOOK = "passivity", "textbook-valve"
AUDITED = tuple(name for name in FILTERS if name != NONE)
TIP, ARM = "tip", "arm"
RATES = {1000: 1000, 100: 300, 20: 100}  # Hz: samples of an episode
HOLD = 0.2  # s, for which a random adversary asks for the same, at most
PRESSES = 0.9  # share of motions of the pressing one that go against what it touches
JOINTS = {"displacement_limit": 0.3, "stiffness_range": (10.0, 400.0)}  # rad, N m/rad
SPEED, FORCE = 0.3, 20.0  # m/s or rad/s, and N: about 1 to an adversary that searches
MINUTES = {"our filter": 18, "rivals": 6}
NO_GAIN, TEXTBOOK_GAINS = 1e-6, 1.0  # J, the bars


@dataclass(frozen=True)
class Robot:
    """What is audited: worlds side by side, what its tank holds, and how many steps at a rate."""

    tank: dict[str, float]  # J
    speed: dict[str, float]  # that our filter is told
    actions: int
    worlds: int  # side by side
    steps: int  # of our filter, of all worlds together
    shares: dict[str, float]  # of the steps, by adversary
    make: Callable[[float], World]  # of a control period in s
    law: Callable[[Filter, float], FilteredLaw]
    sees: Callable[[Any], np.ndarray]  # what a searched adversary does
    touches: Callable[[Any], bool]  # of a truth


def _tip_sees(seen: Any) -> np.ndarray:
    return np.concatenate([seen.velocity[:, :2] / SPEED, seen.wrench[:, :2] / FORCE], axis=1)


ROBOTS = {
    TIP: Robot(
        tank={"initial": 1.0, "upper": 2.0}, speed={"fastest": 1.0}, actions=4, worlds=20,
        steps=1_000_000, shares={"random": 0.2, "pressing": 0.4, "searched": 0.4},
        make=lambda period: BlindMaze(sway=0.0, scattered=True, control_period=period),
        law=lambda one, period: FilteredLaw(maze_law(), one, TIP_MASS, period, DRIVE_LIMIT),
        sees=_tip_sees, touches=lambda truth: truth.peak_force > 0.0,
    ),
    ARM: Robot(
        tank={"initial": 5.0, "upper": 10.0}, speed={"fastest": 2.0}, actions=14, worlds=10,
        steps=100_000, shares={"random": 0.5, "searched": 0.5},
        make=JointArm,
        law=lambda one, period: FilteredLaw(
            JointImpedance(**JOINTS), one, None, period, TORQUE_LIMITS, len(TORQUE_LIMITS)
        ),
        sees=lambda seen: seen.velocity / SPEED, touches=lambda truth: truth.touching,
    ),
}  # fmt: skip


def reproduce(out: Path, *, quick: bool = False, seed: int = 0) -> Result:
    """Audit filters below `out`; `quick` is a fiftieth of the steps.

    Raises `PalpateError` when `out` holds other runs.
    """
    experiment = Experiment(NAME, out, quick, seed)
    experiment.announce({of: 1 if quick else each for of, each in MINUTES.items()})
    experiment.uses(FIRST)
    grid = [(TIP, name, rate) for rate in reversed(RATES) for name in AUDITED]
    grid += [(ARM, name, rate) for rate in reversed(RATES) for name in (OURS, TEXTBOOK)]
    experiment.on_every_core(of_filter, grid, "audits")
    found = {each: of_filter(experiment, *each) for each in grid}
    settings = {"tanks": {name: robot.tank for name, robot in ROBOTS.items()}}
    return experiment.result(figures(found), settings, "episodes are drawn anew, and used once")


def of_filter(experiment: Experiment, name: str, which: str, rate: int) -> dict[str, Any]:
    """The worst of all adversaries of a robot: energies in J, steps, and shares of them."""
    robot = ROBOTS[name]
    steps = robot.steps // (50 if experiment.quick else 1) // (1 if which == OURS else 10)
    numbers: dict[str, Any] = {"tank": robot.tank} if which in WITH_TANK else {}
    numbers |= robot.speed if which == OURS else {}
    about = {"filter": which, "numbers": numbers, "rate": rate, "steps": steps}

    def work() -> dict[str, Any]:
        period, seed = 1.0 / rate, FIRST + experiment.seed
        worlds = [robot.make(period) for _ in range(robot.worlds)]
        law = robot.law(filter_of(which, numbers), period)
        asked: dict[str, Any] = {
            "periods": RATES[rate], "touches": robot.touches,
            "reserve": EnergyTank(**robot.tank).reserve,
        }  # fmt: skip
        found: list[tuple[str, Audit]] = []
        for kind, share in robot.shares.items():
            episodes = max(1, round(steps * share / robot.worlds / RATES[rate]))
            if kind != "searched":
                presses = PRESSES if kind == "pressing" else 0.0
                adversary = RandomAdversary(robot.actions, max(1, round(HOLD * rate)), presses)
                one = audit(worlds, law, adversary, episodes=episodes, seed=seed, **asked)
                found.append((kind, one))
                continue
            numbers_seen = robot.sees(side_by_side([world.reset(0) for world in worlds])).shape[1]
            searched = SearchedAdversary(
                robot.actions, robot.sees, numbers_seen, robot.worlds, seed
            )
            for generation in range(episodes):
                one = audit(worlds, law, searched, episodes=1, seed=seed + generation, **asked)
                searched.improve(one.rise - np.where(np.isfinite(one.margin), one.margin, 0.0))
                found.append((kind, one))
        return worst(found)

    return experiment.found(f"{name}-{which}-{rate}-hz", about, work)


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


def figures(found: dict[tuple[str, str, int], dict[str, Any]]) -> list[Figure]:
    """Ours at its worst of all rates; then every filter at each."""
    ours = [found[TIP, OURS, rate] for rate in RATES]
    arms = [found[ARM, OURS, rate] for rate in RATES]
    gains = {name: max(found[TIP, name, rate]["gain"] for rate in RATES) for name in AUDITED}
    rivals = ", ".join(f"{name} {gain:.2g}" for name, gain in gains.items() if name != OURS)
    textbook = max(found[ARM, TEXTBOOK, rate]["gain"] for rate in RATES)
    listed = [
        Figure("worst_energy_gain_J", gains[OURS], "J", NO_GAIN, rival=rivals),
        Figure("tank_min_margin_J", min(one["margin"] for one in [*ours, *arms]), "J", 0.0,
               better="higher"),
        Figure("control_steps", float(sum(one["steps"] for one in ours)), "", better="higher"),
        Figure("touching", float(np.mean([one["touching"] for one in ours])), "", 0.5,
               better="higher"),
        Figure("least_braking_share", min(one["braked"] for one in ours), "", better="higher"),
        Figure("textbook_100hz_gain_J", found[TIP, TEXTBOOK, 100]["gain"], "J", TEXTBOOK_GAINS,
               better="higher"),
        Figure("arm_gain_over_drift_J", max(one["gain"] for one in arms), "J", NO_GAIN,
               rival=f"{TEXTBOOK} {textbook:.2g}"),
        Figure("arm_control_steps", float(sum(one["steps"] for one in arms)), "", better="higher"),
    ]  # fmt: skip
    for (robot, name, rate), one in found.items():
        of = f"detail.{robot}.{name.replace('-', '_')}.{rate}_hz"
        listed += [
            Figure(f"{of}.gain_J", one["gain"], "J"),
            Figure(f"{of}.margin_J", one["margin"], "J", better="higher"),
            Figure(f"{of}.drawn_J", one["drawn"], "J"),
        ]
    return listed
