"""What the commands need to know of the maze that is felt through."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import arg

from palpate.families.world_options import EvaluateInWorld, TrainInWorld

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from palpate.learning.off_policy import OffPolicyTraining, Transition
    from palpate.learning.off_policy.agent import Agent
    from palpate.networks.guarded import ActorPolicy
    from palpate.runs import Figure, Run
    from palpate.worlds.gymnasium import GymnasiumWorlds

Mazes = Annotated[tuple[str, ...], arg(metavar="NAME ...")]


@dataclass(frozen=True, kw_only=True)
class TrainMaze(TrainInWorld):
    """Train a tip to feel its way through a maze that it cannot see, and never to push too hard.

    It sees forces and its own position, and chooses ten times a second how far to go and how stiff
    to be along that direction and across it.

    1. Safe variable impedance (SRL-VIC):       palpate train maze
    2. The same without recovery:               palpate train maze --method no-recovery
    3. At a constant stiffness:                 palpate train maze --method k300
    """

    task: ClassVar[str] = "maze"

    method: Literal[
        "srl-vic", "no-recovery", "k300", "k500", "k700", "k1000", "lagrangian", "penalty",
        "position-critic",
    ] = "srl-vic"  # fmt: skip
    """srl-vic: a critic of risks that feels forces alone overrules the policy by a recovery;
    position-critic: it is told positions too; k...: srl-vic at that stiffness (N/m); no-recovery:
    nothing overrules it; lagrangian, penalty: violations as a constraint, or at a price."""
    mazes: Mazes = ("home",)
    """To train in, one drawn for each episode."""
    noise: float = 1.0
    """Of the sensors, as a multiple of what the world has; 0: none."""

    def make(self, count: int, scattered: float = 0.0) -> GymnasiumWorlds:
        from palpate.families.contact.environments import blind_mazes
        from palpate.families.contact.methods import method_named

        return blind_mazes(
            count,
            layouts=self.mazes,
            noise=self.noise,
            scattered=scattered,
            constant_stiffness=method_named(self.method).stiffness,
        )

    def make_for_training(self) -> GymnasiumWorlds:
        from palpate.families.contact.methods import SCATTERED

        return self.make(self.environments, SCATTERED)

    def agent(self) -> Agent:
        from palpate.families.contact.methods import method_named

        return method_named(self.method).agent

    def training(self) -> OffPolicyTraining:
        from palpate.families.contact.methods import method_named, training_of

        return training_of(self.steps, method_named(self.method))

    def collected(self) -> Transition | None:
        from palpate.families.contact.methods import (
            PRETRAINING_STEPS,
            ScriptedCollisions,
            method_named,
        )
        from palpate.learning.off_policy import collect

        if not method_named(self.method).guarded:
            return None
        environments = self.make(self.environments, scattered=1.0)
        try:
            steps = min(PRETRAINING_STEPS, self.steps)
            return collect(environments, ScriptedCollisions(), steps, self.seed)
        finally:
            environments.close()

    def policy(self, state: Any) -> ActorPolicy:
        from palpate.families.contact.methods import method_named, policy_of

        return policy_of(method_named(self.method).agent, state)

    def constants(self) -> dict[str, Any]:
        from palpate.families.contact.methods import constants, method_named

        return constants(method_named(self.method))

    def figures(self, episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
        from palpate.families.contact.episodes import figures

        return figures(episodes, suffix)

    def show(self, run: Run, policy: ActorPolicy) -> None:
        from palpate.families.contact.path_picture import show_path

        show_path(run.path, policy, self.make(1), self.seed)


@dataclass(frozen=True, kw_only=True)
class EvaluateMaze(EvaluateInWorld):
    """Try a policy in the maze that it was trained in, or in another.

    1. Where it was trained:                    palpate evaluate maze --policy P
    2. In mazes kept for testing:               palpate evaluate maze --policy P
                                                    --mazes unseen-1 unseen-2
    3. By a seven-axis arm, not trained anew:   palpate evaluate maze --policy P --world arm
    """

    task: ClassVar[str] = "maze"

    mazes: Annotated[
        tuple[str, ...], arg(metavar="NAME ...", help_behavior_hint="(default: as trained)")
    ] = ()
    """To try it in, one drawn for each episode."""
    world: Literal["tip", "arm"] = "tip"
    """What feels its way: a tip of its own, or the peg in the gripper of an arm."""
    noise: float = 1.0
    """Of the sensors, as a multiple of what the world has; 0: none."""

    def make(self, count: int, manifest: Mapping[str, Any]) -> GymnasiumWorlds:
        from palpate.families.contact.environments import arm_mazes, blind_mazes
        from palpate.families.contact.methods import method_named

        trained = manifest["options"]
        named = self.mazes or tuple(trained["mazes"])
        stiffness = method_named(trained["method"]).stiffness
        make = arm_mazes if self.world == "arm" else blind_mazes
        return make(count, layouts=named, noise=self.noise, constant_stiffness=stiffness)

    def figures(self, episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
        from palpate.families.contact.episodes import figures

        return figures(episodes, suffix)

    def about(self, manifest: Mapping[str, Any]) -> str:
        mazes = self.mazes or manifest["options"]["mazes"]
        noise = f"with {self.noise:g} times the sensors' noise"
        return f"tried in the maze {', '.join(mazes)}, felt by the {self.world}, {noise}"

    def show(self, run: Run, policy: ActorPolicy, manifest: Mapping[str, Any]) -> None:
        from palpate.families.contact.path_picture import show_path

        show_path(run.path, policy, self.make(1, manifest), self.seed)
