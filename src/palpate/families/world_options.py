"""Options of the commands for controllers that learn in a world, by trial and error.

As `palpate.families.options`: frozen dataclasses, and nothing imported here that computes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from palpate.errors import PalpateError
from palpate.families.options import Options

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from gymnasium.vector import VectorEnv

    from palpate.learning.off_policy import OffPolicyTraining, Transition
    from palpate.learning.off_policy.agent import Agent
    from palpate.networks.guarded import ActorPolicy
    from palpate.runs import Figure, Run


@dataclass(frozen=True, kw_only=True)
class TrainInWorld(Options, ABC):
    """Training in a world; each task says which environments, which agent, and how to judge it."""

    task: ClassVar[str]
    most_tried: ClassVar[int] = 100  # episodes of the trained policy, for the figures

    steps: int = 150_000
    """Decisions, those of all environments together."""
    environments: int = 16
    """That run side by side."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("steps", "environments"):
            if getattr(self, name) < 1:
                raise PalpateError(f"--{name} is 1 or greater, not {getattr(self, name)}")

    @property
    def tried(self) -> int:
        """How many episodes of the trained policy there are: fewer after a short training."""
        return max(1, min(self.most_tried, self.steps // 1000))

    def inputs(self) -> dict[str, Path]:
        """Files, by name, that decide the outcome."""
        return {}

    @abstractmethod
    def make(self, count: int, policy: ActorPolicy | None = None) -> VectorEnv:
        """So many environments side by side, to be trained in or, of a policy, to try it in."""

    def make_for_training(self) -> VectorEnv:
        """Those that it is trained in, which may begin where a task does not."""
        return self.make(self.environments)

    @abstractmethod
    def agent(self) -> Agent:
        """What learns."""

    @abstractmethod
    def training(self) -> OffPolicyTraining:
        """How long, and from how much."""

    def collected(self) -> Transition | None:
        """What a safety critic learns from before the training; None where nothing is."""
        return None

    @abstractmethod
    def policy(self, state: Any) -> ActorPolicy:
        """The controller to be kept, of an agent's state."""

    @abstractmethod
    def constants(self) -> dict[str, Any]:
        """Of world, task and method: what decides the outcome beside the options."""

    @abstractmethod
    def figures(self, episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
        """What counts, of episodes as `palpate.learning.off_policy.evaluate` gives them."""

    def show(self, run: Run, policy: ActorPolicy) -> None:
        """Leave what a person looks at in the run's folder; here nothing."""


@dataclass(frozen=True, kw_only=True)
class EvaluateInWorld(Options, ABC):
    """A policy that learnt in a world, in episodes of that world or another, beside others."""

    task: ClassVar[str]

    policy: Annotated[Path, arg(metavar="POLICY")]
    """What `palpate train` wrote: its folder, or the policy file in it."""
    episodes: int = 100
    """Of each controller."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.episodes < 1:
            raise PalpateError(f"--episodes is 1 or greater, not {self.episodes}")

    def inputs(self, manifest: Mapping[str, Any]) -> dict[str, Path]:
        """Files, by name, that decide the outcome beside the policy of the manifest."""
        return {}

    @abstractmethod
    def make(
        self, count: int, manifest: Mapping[str, Any], policy: ActorPolicy | None
    ) -> VectorEnv:
        """So many environments side by side, controlled as the policy of the manifest was.

        Without the policy itself nobody interrupts what is decided.
        """

    @abstractmethod
    def figures(self, episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
        """See `TrainInWorld.figures`."""

    def probed(self, policy: ActorPolicy, manifest: Mapping[str, Any]) -> list[Figure]:
        """What the policy knows and how it acts, beside how its episodes end; here nothing."""
        return []

    @abstractmethod
    def about(self, manifest: Mapping[str, Any]) -> str:
        """A line that says in which world the policy is tried."""

    def show(self, run: Run, policy: ActorPolicy, manifest: Mapping[str, Any]) -> None:
        """Leave what a person looks at in the run's folder; here nothing."""
