"""Contact's worlds as environments of Gymnasium: importing this module registers them.

    import gymnasium
    import palpate.families.contact.environments
    environments = gymnasium.make_vec("palpate/BlindMaze-v0", num_envs=16)

Gymnasium 1 imports a module that is named before the identifier, too:
`gymnasium.make("palpate.families.contact.environments:palpate/BlindMaze-v0")`.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import gymnasium
import numpy as np

from palpate.networks.guarded import ActorPolicy, GuardedPolicy
from palpate.safety.filtered_law import FilteredLaw
from palpate.safety.impedance import ImpedanceLaw
from palpate.safety.port import Filter
from palpate.safety.reflex import Reflex
from palpate.safety.self_tuning import SelfTuningLaw
from palpate.tasks.maze.maze import MazeTask
from palpate.tasks.maze.navigation import NavigationTask
from palpate.worlds import velocity
from palpate.worlds.arm.maze import ArmMaze
from palpate.worlds.gymnasium import (
    EnergyCosts,
    GymnasiumWorld,
    GymnasiumWorlds,
    WorldTask,
    features_of,
)
from palpate.worlds.maze.layout import Layout
from palpate.worlds.maze.maze import DISPLACEMENT_LIMIT, FORCE_LIMIT, STIFFNESS_RANGE, BlindMaze
from palpate.worlds.maze.mjcf import MjcfWorld
from palpate.worlds.maze.navigation import PERIODS, Navigation
from palpate.worlds.maze.scene import TIP_MASS
from palpate.worlds.maze.tip import DRIVE_LIMIT, TipWorld
from palpate.worlds.world import ControlLaw

DECISION_PERIOD = 0.1  # s, in the maze
SELF_TUNING = "self-tuning"  # in place of a stiffness
TUNING = {"resting": 250.0, "contact_force": 5.0, "gain": 6e4}  # N/m, N, N/m per m s
# Of a tip's energy in the maze. Without a filter half of the successful episodes draw more than
# 0.9 J from a tank that is full in the beginning, and 2.6 W at a time. Where the base sways against
# the block that is pushed, less than 2 W flow at a time only if the tip gives way.
TANK = {"initial": 0.5, "upper": 0.5, "flow": 2.5}  # J, J, W
REFLEX_PACE = 10, 1  # control periods in the maze and between obstacles: tenths of a decision


Law = TypeVar("Law", bound=ControlLaw | None)


def maze_law(
    stiffness: float | str | None = None, mass: float | np.ndarray = TIP_MASS
) -> ImpedanceLaw:
    """The impedance of a tip of a `mass` (kg, or (2, 2) kg), with the limits of the maze.

    `stiffness` is a constant in N/m, `SELF_TUNING`, or None where the policy chooses it.
    """
    limits = DISPLACEMENT_LIMIT, STIFFNESS_RANGE
    if stiffness == SELF_TUNING:
        return SelfTuningLaw(*limits, mass=mass, **TUNING)
    constant = None if stiffness is None else float(stiffness)
    return ImpedanceLaw(*limits, mass=mass, constant_stiffness=constant)


def _with_reflex(law: Law, task: WorldTask, pace: int, reflex: bool | ActorPolicy) -> Law | Reflex:
    """The law, under a reflex if there is to be one: that of the policy, or one to be taught."""
    if reflex is False:
        return law
    wrapped = Reflex(law, functools.partial(features_of, task), pace)
    if isinstance(reflex, GuardedPolicy):
        wrapped.watch_with(reflex.guard, reflex.threshold)
    return wrapped


def _maze_parts(
    layouts: Sequence[str | Layout] = ("home",),
    noise: float = 1.0,
    scattered: float = 0.0,
    stiffness: float | str | None = None,
    decision_period: float = DECISION_PERIOD,
    reflex: bool | ActorPolicy = False,
    horizon: int | None = None,
    count: int = 1,
    file: str | Path | None = None,
    force_limit: float | None = None,
    passes: Filter | None = None,
    world: type[BlindMaze] = BlindMaze,
) -> tuple[Sequence[TipWorld], MazeTask, ControlLaw, int]:
    make = functools.partial(world, layouts) if file is None else functools.partial(MjcfWorld, file)
    worlds = [make(noise=noise, scattered=number < scattered * count) for number in range(count)]
    every = max(1, round(decision_period / worlds[0].control_period))
    task = MazeTask(FORCE_LIMIT if force_limit is None else force_limit, horizon)
    mass, period = worlds[0].effective_mass, worlds[0].control_period
    law = _with_reflex(maze_law(stiffness, mass), task, REFLEX_PACE[0], reflex)
    if passes is not None:
        law = FilteredLaw(law, passes, mass, period, DRIVE_LIMIT)
    return worlds, task, law, every


def blind_maze(
    render_mode: str | None = None, energy: EnergyCosts | None = None, **options: Any
) -> GymnasiumWorld:
    """One blind maze. `options`: `layouts` and `noise` as `BlindMaze` has them, `scattered`, the
    share of the worlds side by side that begin anywhere, `stiffness` as `maze_law`,
    `decision_period` in s, `horizon` and `force_limit` as `MazeTask`, and `reflex`: a policy whose
    guard is to interrupt motions (`Reflex`), or whether something is to learn that. `passes` is a
    filter that forces have to pass (`palpate.safety.filters`), with which decisions may cost what
    they draw (`energy`, see `EnergyCosts`). A `file` takes the place of the maze
    by a world of your own (`MjcfWorld`)."""
    worlds, task, law, every = _maze_parts(**options)
    return GymnasiumWorld(worlds[0], task, law, every, render_mode, energy)


def blind_mazes(
    num_envs: int = 1,
    render_mode: str | None = None,
    energy: EnergyCosts | None = None,
    **options: Any,
) -> GymnasiumWorlds:
    """Blind mazes side by side; options as `blind_maze`."""
    return GymnasiumWorlds(*_maze_parts(**options, count=num_envs), render_mode, energy)


def arm_maze(render_mode: str | None = None, **options: Any) -> GymnasiumWorld:
    """One maze that an arm feels, under the same law as the tip; options as `blind_maze`."""
    return blind_maze(render_mode, world=ArmMaze, **options)


def arm_mazes(num_envs: int = 1, render_mode: str | None = None, **options: Any) -> GymnasiumWorlds:
    """Mazes that arms feel, side by side; options as `blind_maze`."""
    return blind_mazes(num_envs, render_mode, world=ArmMaze, **options)


def _navigation_parts(
    scattered: bool = False,
    reflex: bool | ActorPolicy = False,
    count: int = 1,
) -> tuple[list[Navigation], NavigationTask, ControlLaw | None, int]:
    worlds, task = [Navigation(scattered) for _ in range(count)], NavigationTask()
    return worlds, task, _with_reflex(None, task, REFLEX_PACE[1], reflex), PERIODS


def navigation(render_mode: str | None = None, **options: Any) -> GymnasiumWorld:
    """One point between obstacles. `options`: `scattered` as `Navigation` has it, and
    `reflex` as `blind_maze`."""
    worlds, task, law, every = _navigation_parts(**options)
    return GymnasiumWorld(worlds[0], task, law, every, render_mode)


def navigations(
    num_envs: int = 1, render_mode: str | None = None, **options: Any
) -> GymnasiumWorlds:
    """Points between obstacles, side by side; options as `navigation`."""
    return GymnasiumWorlds(*_navigation_parts(**options, count=num_envs), render_mode=render_mode)


ENVIRONMENTS = {
    "palpate/BlindMaze-v0": (blind_maze, blind_mazes),
    "palpate/ArmMaze-v0": (arm_maze, arm_mazes),
    "palpate/Navigation2D-v0": (navigation, navigations),
}


def register() -> None:
    """Enter the environments into Gymnasium's registry, once; those with a speed limit, too."""
    velocity.register()
    for name, (single, vector) in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            places = (f"{__name__}:{function.__name__}" for function in (single, vector))
            entry_point, vector_entry_point = places
            gymnasium.register(name, entry_point=entry_point, vector_entry_point=vector_entry_point)


register()
