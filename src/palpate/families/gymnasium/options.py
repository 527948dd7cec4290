"""What the commands need to know of environments that somebody else wrote."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import arg

from palpate.errors import PalpateError, PalpateWarning
from palpate.families.world_options import EvaluateInWorld, TrainInWorld

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from gymnasium.vector import VectorEnv

    from palpate.learning.off_policy import OffPolicyTraining
    from palpate.learning.off_policy.agent import Agent
    from palpate.networks.guarded import ActorPolicy
    from palpate.runs import Figure


@dataclass(frozen=True, kw_only=True)
class TrainGymnasium(TrainInWorld):
    """Train a policy in any environment of Gymnasium that tells in `info["cost"]` what to avoid.

    What it sees and does are vectors, the latter with bounds. Soft actor-critic learns, with the
    same settings everywhere. There is no srl-vic: its critic of risks learns ahead from scripted
    collisions, and nobody knows how to collide in an environment of yours.

    1. A cheetah that may not run too fast:     palpate train gymnasium
                                                    --environment palpate/VelocityHalfCheetah-v0
    2. One that ./mine.py registers:            palpate train gymnasium
                                                    --environment mine:Mine-v0 --cost-limit 1
    """

    task: ClassVar[str] = "gymnasium"
    most_tried: ClassVar[int] = 20

    environment: Annotated[str, arg(metavar="ID")]
    """As gymnasium.make takes it, after the module that registers it and a colon."""
    method: Literal["lagrangian", "penalty", "no-recovery"] = "lagrangian"
    """lagrangian: an episode's cost as a constraint, whose price is found; penalty: at a price;
    no-recovery: costs are counted, and nothing is done about them."""
    cost_limit: float = 25.0
    """On the summed cost of an episode; for lagrangian."""
    price: float = 10.0
    """Of a cost of 1, in rewards; for penalty."""
    steps: int = 1_000_000
    """Decisions, those of all environments together."""
    environments: int = 4
    """That run side by side."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in (("cost-limit", self.cost_limit), ("price", self.price)):
            if not 0.0 <= value < float("inf"):
                raise PalpateError(f"--{name} is a number, 0 or greater, not {value}")

    @functools.cached_property
    def described(self) -> dict[str, Any]:
        """What the environment is; raises `PalpateError` where nothing can learn in it."""
        from palpate.families.gymnasium.environments import LOOKED_AT, describe_environment

        found = describe_environment(self.environment)
        silent = f"'{self.environment}' told no info[\"cost\"] in {LOOKED_AT} random steps"
        if not found["costs"] and self.method != "no-recovery":
            raise PalpateError(
                f"{silent}: expected a cost of every step, 0 where nothing is violated; --method "
                "no-recovery learns without"
            )
        if not found["costs"]:
            warnings.warn(f"{silent}: all costs count as 0", PalpateWarning, stacklevel=2)
        return found

    def make(self, count: int, policy: ActorPolicy | None = None) -> VectorEnv:
        from palpate.families.gymnasium.environments import make_environments

        return make_environments(self.environment, count)

    def agent(self) -> Agent:
        from palpate.families.gymnasium.methods import agent_of

        return agent_of(self.method, self.cost_limit, self.price)

    def training(self) -> OffPolicyTraining:
        from palpate.families.gymnasium.methods import training_of

        return training_of(self.steps)

    def policy(self, state: Any) -> ActorPolicy:
        from palpate.families.gymnasium.methods import policy_of

        return policy_of(self.agent(), state, self.described["period"])

    def constants(self) -> dict[str, Any]:
        agent: Any = self.agent()
        about = {"method": type(agent).__name__, "agent": dataclasses.asdict(agent)}
        return {**about, "environment": self.described}

    def figures(self, episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
        return figures(episodes, suffix)


@dataclass(frozen=True, kw_only=True)
class EvaluateGymnasium(EvaluateInWorld):
    """Try a policy in the environment that it was trained in.

    1. What was trained:                        palpate evaluate gymnasium --policy P
    """

    task: ClassVar[str] = "gymnasium"

    def make(
        self, count: int, manifest: Mapping[str, Any], policy: ActorPolicy | None
    ) -> VectorEnv:
        from palpate.families.gymnasium.environments import make_environments

        return make_environments(manifest["options"]["environment"], count)

    def figures(self, episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
        return figures(episodes, suffix)

    def about(self, manifest: Mapping[str, Any]) -> str:
        trained = manifest["options"]
        return f"tried in {trained['environment']}, trained by {trained['method']}"


def figures(episodes: Mapping[str, np.ndarray], suffix: str = "") -> list[Figure]:
    """Means of episodes as `palpate.learning.off_policy.evaluate` gives them: rewards and costs."""
    from palpate.runs import Figure
    from palpate.runs.result import two_standard_errors

    found = []
    for name, of, better in (
        *(("reward", "return", "higher"), ("cost", "cost", "lower")),
        ("length", "length", "higher"),
    ):
        values = episodes[of]
        spread, mean = two_standard_errors(values), float(values.mean())
        found.append(Figure(f"{name}{suffix}", mean, "", better=better, spread=spread))
    return found
