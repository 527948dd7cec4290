"""Contact's worlds as environments of Gymnasium: importing this module registers them.

    import gymnasium
    import palpate.families.contact.environments
    environments = gymnasium.make_vec("palpate/BlindMaze-v0", num_envs=16)

Gymnasium 1 imports a module that is named before the identifier, too:
`gymnasium.make("palpate.families.contact.environments:palpate/BlindMaze-v0")`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium

from palpate.safety.impedance import ImpedanceLaw
from palpate.tasks.maze.maze import MazeTask
from palpate.tasks.maze.navigation import NavigationTask
from palpate.worlds.arm.maze import ArmMaze
from palpate.worlds.gymnasium import GymnasiumWorld, GymnasiumWorlds
from palpate.worlds.maze.layout import Layout
from palpate.worlds.maze.maze import DISPLACEMENT_LIMIT, STIFFNESS_RANGE, BlindMaze
from palpate.worlds.maze.navigation import PERIODS, Navigation
from palpate.worlds.maze.scene import TIP_MASS

DECISION_PERIOD = 0.1  # s, in the maze


def maze_law(constant_stiffness: float | None = None) -> ImpedanceLaw:
    """The tip's impedance, with the limits of the maze; N/m, None where the policy chooses it."""
    return ImpedanceLaw(
        DISPLACEMENT_LIMIT, STIFFNESS_RANGE, mass=TIP_MASS, constant_stiffness=constant_stiffness
    )


def _maze_parts(
    layouts: Sequence[str | Layout] = ("home",),
    noise: float = 1.0,
    scattered: float = 0.0,
    constant_stiffness: float | None = None,
    decision_period: float = DECISION_PERIOD,
    count: int = 1,
    world: type[BlindMaze] = BlindMaze,
) -> tuple[list[BlindMaze], MazeTask, ImpedanceLaw, int]:
    worlds = [
        world(layouts, noise=noise, scattered=number < scattered * count) for number in range(count)
    ]
    every = max(1, round(decision_period / worlds[0].control_period))
    return worlds, MazeTask(), maze_law(constant_stiffness), every


def blind_maze(render_mode: str | None = None, **options: Any) -> GymnasiumWorld:
    """One blind maze. `options`: `layouts` and `noise` as `BlindMaze` has them, `scattered`, the
    share of the worlds side by side that begin anywhere, `constant_stiffness` as `ImpedanceLaw`,
    `decision_period` in s."""
    worlds, task, law, every = _maze_parts(**options)
    return GymnasiumWorld(worlds[0], task, law, every, render_mode)


def blind_mazes(
    num_envs: int = 1, render_mode: str | None = None, **options: Any
) -> GymnasiumWorlds:
    """Blind mazes side by side; options as `blind_maze`."""
    return GymnasiumWorlds(*_maze_parts(**options, count=num_envs), render_mode=render_mode)


def arm_maze(render_mode: str | None = None, **options: Any) -> GymnasiumWorld:
    """One maze that an arm feels, under the same law as the tip; options as `blind_maze`."""
    worlds, task, law, every = _maze_parts(**options, world=ArmMaze)
    return GymnasiumWorld(worlds[0], task, law, every, render_mode)


def arm_mazes(num_envs: int = 1, render_mode: str | None = None, **options: Any) -> GymnasiumWorlds:
    """Mazes that arms feel, side by side; options as `blind_maze`."""
    parts = _maze_parts(**options, count=num_envs, world=ArmMaze)
    return GymnasiumWorlds(*parts, render_mode=render_mode)


def navigation(render_mode: str | None = None, scattered: bool = False) -> GymnasiumWorld:
    """One point between obstacles; `scattered` as `Navigation` has it."""
    return GymnasiumWorld(Navigation(scattered), NavigationTask(), None, PERIODS, render_mode)


def navigations(
    num_envs: int = 1, render_mode: str | None = None, scattered: bool = False
) -> GymnasiumWorlds:
    """Points between obstacles, side by side; `scattered` as `Navigation` has it."""
    worlds = [Navigation(scattered) for _ in range(num_envs)]
    return GymnasiumWorlds(worlds, NavigationTask(), None, PERIODS, render_mode)


ENVIRONMENTS = {
    "palpate/BlindMaze-v0": (blind_maze, blind_mazes),
    "palpate/ArmMaze-v0": (arm_maze, arm_mazes),
    "palpate/Navigation2D-v0": (navigation, navigations),
}


def register() -> None:
    """Enter the environments into Gymnasium's registry, once."""
    for name, (single, vector) in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            places = (f"{__name__}:{function.__name__}" for function in (single, vector))
            entry_point, vector_entry_point = places
            gymnasium.register(name, entry_point=entry_point, vector_entry_point=vector_entry_point)


register()
