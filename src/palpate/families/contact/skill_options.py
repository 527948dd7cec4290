"""What training and evaluation have in common for whatever is learnt by a method and its guard."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from palpate.families.world_options import EvaluateInWorld, TrainInWorld

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from palpate.families.contact.methods import Skill
    from palpate.learning.off_policy import OffPolicyTraining, Transition
    from palpate.learning.off_policy.agent import Agent
    from palpate.networks.guarded import ActorPolicy
    from palpate.runs import Figure
    from palpate.worlds.gymnasium import GymnasiumWorlds


@dataclass(frozen=True, kw_only=True)
class TrainSkill(TrainInWorld, ABC):
    """Training by a named method, in worlds that may begin anywhere."""

    scattered: ClassVar[float] = 0.0  # share of the worlds of a training that do

    method: str = "srl-vic"

    @abstractmethod
    def skill(self) -> Skill:
        """What is learnt."""

    @abstractmethod
    def make(
        self, count: int, policy: ActorPolicy | None = None, scattered: float = 0.0
    ) -> GymnasiumWorlds:
        """See `TrainInWorld.make`; a share of them begins anywhere."""

    def make_for_training(self) -> GymnasiumWorlds:
        return self.make(self.environments, scattered=self.scattered)

    def agent(self) -> Agent:
        return self.skill().method(self.method).agent

    def training(self) -> OffPolicyTraining:
        from palpate.families.contact.methods import training_of

        return training_of(self.steps, self.skill().method(self.method))

    def collected(self) -> Transition | None:
        from palpate.families.contact.methods import PRETRAINING_STEPS, ScriptedCollisions
        from palpate.learning.off_policy import collect

        if not self.skill().method(self.method).guarded:
            return None
        environments = self.make(self.environments, scattered=1.0)
        actions = environments.lockstep.task.actions
        try:
            steps = min(PRETRAINING_STEPS, self.steps)
            return collect(environments, ScriptedCollisions(actions), steps, self.seed)
        finally:
            environments.close()

    def policy(self, state: Any) -> ActorPolicy:
        return self.skill().policy(self.skill().method(self.method), state)

    def constants(self) -> dict[str, Any]:
        return self.skill().constants(self.skill().method(self.method))

    def figures(self, episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
        from palpate.families.contact.episodes import figures

        return figures(episodes, suffix)


@dataclass(frozen=True, kw_only=True)
class EvaluateSkill(EvaluateInWorld, ABC):
    """A policy that was trained by a method, under the reflex that it has of it."""

    def figures(self, episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
        from palpate.families.contact.episodes import figures

        return figures(episodes, suffix)
