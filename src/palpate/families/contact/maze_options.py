"""What the commands need to know of the maze that is felt through."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import arg

from palpate.errors import PalpateError
from palpate.families.contact.skill_options import EvaluateSkill, TrainSkill

if TYPE_CHECKING:
    from collections.abc import Mapping

    from palpate.families.contact.methods import Skill
    from palpate.networks.guarded import ActorPolicy
    from palpate.runs import Figure, Run
    from palpate.worlds.gymnasium import GymnasiumWorlds

Mazes = Annotated[tuple[str, ...], arg(metavar="NAME ...")]


@dataclass(frozen=True, kw_only=True)
class TrainMaze(TrainSkill):
    """Train a tip to feel its way through a maze that it cannot see, and never to push too hard.

    It sees forces and its own position, and chooses ten times a second how far to go and how stiff
    to be along that direction and across it.

    1. Safe variable impedance (SRL-VIC):       palpate train maze
    2. The same without recovery:               palpate train maze --method no-recovery
    3. Motions that are interrupted (Bresa):    palpate train maze --method bresa
    4. At a constant stiffness:                 palpate train maze --method k300
    """

    task: ClassVar[str] = "maze"
    scattered: ClassVar[float] = 0.5  # begin anywhere on the way to the goal

    method: Literal[
        "srl-vic", "bresa", "no-recovery", "k300", "k500", "k600", "k1000", "self-tuning",
        "lagrangian", "penalty", "position-critic",
    ] = "srl-vic"  # fmt: skip
    """srl-vic: a critic of risks that feels forces alone overrules the policy by a recovery;
    bresa: it is asked a thousand times a second, and interrupts what is under way;
    position-critic: it is told positions too; k...: srl-vic at that stiffness (N/m);
    self-tuning: at one that rises while something resists; no-recovery: nothing overrules it;
    lagrangian, penalty: violations as a constraint, or at a price."""
    mazes: Mazes = ("home",)
    """To train in, one drawn for each episode."""
    noise: float = 1.0
    """Of the sensors, as a multiple of what the world has; 0: none."""

    def skill(self) -> Skill:
        from palpate.families.contact.methods import MAZE

        return MAZE

    def make(
        self, count: int, policy: ActorPolicy | None = None, scattered: float = 0.0
    ) -> GymnasiumWorlds:
        from palpate.families.contact.environments import blind_mazes
        from palpate.families.contact.methods import TRAINING_HORIZON

        method = self.skill().method(self.method)
        return blind_mazes(
            count,
            layouts=self.mazes,
            noise=self.noise,
            scattered=scattered,
            horizon=TRAINING_HORIZON if scattered else None,
            stiffness=method.stiffness,
            reflex=method.interrupts and (policy or True),
        )

    def show(self, run: Run, policy: ActorPolicy) -> None:
        from palpate.families.contact.path_picture import show_path

        show_path(run.path, policy, self.make(1, policy), self.seed)


@dataclass(frozen=True, kw_only=True)
class EvaluateMaze(EvaluateSkill):
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
    decision_period: Annotated[
        float | None, arg(metavar="SECONDS", help_behavior_hint="(default: as trained)")
    ] = None
    """For which each decision holds."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.decision_period is not None and not 1e-3 <= self.decision_period <= 10.0:
            raise PalpateError(
                f"--decision-period is from 0.001 to 10 s, not {self.decision_period}"
            )

    def make(
        self, count: int, manifest: Mapping[str, Any], policy: ActorPolicy | None
    ) -> GymnasiumWorlds:
        from palpate.families.contact.environments import (
            DECISION_PERIOD,
            arm_mazes,
            blind_mazes,
        )
        from palpate.families.contact.methods import MAZE

        trained = manifest["options"]
        method = MAZE.method(trained["method"])
        make = arm_mazes if self.world == "arm" else blind_mazes
        return make(
            count,
            layouts=self.mazes or tuple(trained["mazes"]),
            noise=self.noise,
            stiffness=method.stiffness,
            decision_period=self.decision_period or DECISION_PERIOD,
            reflex=method.interrupts and (policy or False),
        )

    def probed(self, policy: ActorPolicy, manifest: Mapping[str, Any]) -> list[Figure]:
        from palpate.families.contact import probes
        from palpate.families.contact.methods import MAZE

        method = MAZE.method(manifest["options"]["method"])
        environments = self.make(min(probes.PROBES, self.episodes), manifest, None)
        try:
            found = probes.probe(policy, environments, self.seed)
        finally:
            environments.close()
        return probes.figures(found, guarded=method.guarded, free=method.stiffness is None)

    def about(self, manifest: Mapping[str, Any]) -> str:
        mazes = self.mazes or manifest["options"]["mazes"]
        noise = f"with {self.noise:g} times the sensors' noise"
        return f"tried in the maze {', '.join(mazes)}, felt by the {self.world}, {noise}"

    def show(self, run: Run, policy: ActorPolicy, manifest: Mapping[str, Any]) -> None:
        from palpate.families.contact.path_picture import show_path

        show_path(run.path, policy, self.make(1, manifest, policy), self.seed)
