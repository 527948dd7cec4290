"""How a policy of the maze learns: what learns, and who chooses the stiffness.

SRL-VIC's and Bresa's constants are not printed. These are our own: discount, entropy and the share
of scattered starts were chosen on trainings of the seeds 0, 900 and 901, the others untried.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.families.contact.environments import DECISION_PERIOD
from palpate.family import check_name
from palpate.learning.off_policy import (
    Lagrangian,
    OffPolicyTraining,
    Penalty,
    RecoveryAgent,
    SafetyCritic,
    SoftActorCritic,
)
from palpate.learning.off_policy.agent import Agent
from palpate.networks import Channel
from palpate.networks.guarded import ActorPolicy, GuardedPolicy
from palpate.tasks.maze import maze as task
from palpate.worlds.maze import maze as world
from palpate.worlds.maze import scene

WRENCH = (0, 1, 2, 3, 4, 5)  # of the features: SRL-VIC's critic and recovery see no position
DISCOUNT, TARGET_ENTROPY = 0.98, -1.0  # of the task's agent
RISK_DISCOUNT, RISK_THRESHOLD = 0.8, 0.2
VIOLATION_PRICE = 50.0  # of the penalty, in rewards: more than the whole way to the goal is worth
COST_LIMIT = 0.02  # Lagrangian: violations an episode
PRETRAINING_STEPS, PRETRAINING_UPDATES = 20_000, 5_000
SCATTERED = 0.5  # share of the episodes of a training that begin anywhere on the way to the goal
HELD = (3, 15)  # decisions for which a scripted collision keeps its direction

OBSERVATIONS = (  # each as a share of what `palpate.tasks.maze.maze` divides it by
    Channel("wrench", (6,)),
    Channel("position", (3,)),
)
ACTIONS = (Channel("displacement", (2,)), Channel("stiffness", (2,)))


@dataclass(frozen=True)
class Method:
    """An agent, and the stiffness (N/m) that it is given; None: it chooses its own."""

    agent: Agent
    stiffness: float | None = None

    @property
    def guarded(self) -> bool:
        """Whether it has a safety critic, which learns ahead from scripted collisions."""
        return isinstance(self.agent, RecoveryAgent)


def _agent() -> SoftActorCritic:
    return SoftActorCritic(discount=DISCOUNT, target_entropy=TARGET_ENTROPY)


def _guarded(seen: tuple[int, ...] | None = WRENCH) -> RecoveryAgent:
    return RecoveryAgent(_agent(), SafetyCritic(discount=RISK_DISCOUNT, seen=seen), RISK_THRESHOLD)


METHODS: dict[str, Callable[[], Method]] = {
    "srl-vic": lambda: Method(_guarded()),
    "position-critic": lambda: Method(_guarded(seen=None)),
    "no-recovery": lambda: Method(_agent()),
    "k300": lambda: Method(_guarded(), 300.0),
    "k500": lambda: Method(_guarded(), 500.0),
    "k700": lambda: Method(_guarded(), 700.0),
    "k1000": lambda: Method(_guarded(), 1000.0),
    "lagrangian": lambda: Method(
        Lagrangian(_agent(), COST_LIMIT, discount=DISCOUNT, multiplier_rate=1e-3)
    ),
    "penalty": lambda: Method(Penalty(_agent(), VIOLATION_PRICE)),
}


def training_of(steps: int, method: Method) -> OffPolicyTraining:
    """So many decisions, and an update every second one, whatever the method."""
    updates = PRETRAINING_UPDATES if method.guarded else 0
    return OffPolicyTraining(
        steps=steps, ratio=0.5, warm_up=min(2_000, steps // 4), pretraining=updates
    )


class ScriptedCollisions:
    """Pushes in random directions, of any length and stiffness, each held for a while.

    A `palpate.learning.off_policy.rollouts.Script`: from observations (worlds, features) and
    whether each episode has just begun, actions (worlds, 4) in [-1, 1]. What a critic of risks
    learns from before a training, as SRL-VIC's (arXiv 2406.13744).
    """

    def __init__(self) -> None:
        self._action, self._left = np.zeros((0, 4)), np.zeros(0, int)

    def __call__(
        self, observation: np.ndarray, fresh: np.ndarray, random: np.random.Generator
    ) -> np.ndarray:
        count = len(observation)
        if len(self._left) != count:
            self._action, self._left = np.zeros((count, 4)), np.zeros(count, int)
        angle, length = random.uniform(0, 2 * np.pi, count), random.uniform(0.3, 1.0, count)
        stiffness = random.uniform(-1, 1, (count, 2))
        drawn = np.column_stack([length * np.cos(angle), length * np.sin(angle), stiffness])
        held = random.integers(*HELD, count)
        new = fresh | (self._left == 0)
        self._action[new], self._left[new] = drawn[new], held[new]
        self._left -= 1
        return self._action.copy()


def method_named(name: str) -> Method:
    """The method of that name; raises `PalpateError` that lists all."""
    return METHODS[check_name("method", name, METHODS)]()


def policy_of(agent: Agent, state: Any) -> ActorPolicy:
    """The controller of an agent's state: its actor, under the guard where it has one."""
    declared: dict[str, Any] = {
        "observations": OBSERVATIONS,
        "actions": ACTIONS,
        "period": DECISION_PERIOD,
    }
    if isinstance(agent, RecoveryAgent):
        task, safety = state.task, state.safety
        return GuardedPolicy(
            actor=task.actor, guard=safety.guard, threshold=agent.threshold, **declared
        )
    alone = state.agent if isinstance(agent, Lagrangian) else state
    return ActorPolicy(actor=alone.actor, **declared)


def constants(method: Method) -> dict[str, Any]:
    """Those of the method, the task and the world: what decides a training beside its options."""
    numbers = {
        f"{name}.{constant.lower()}": value
        for name, module in (("task", task), ("world", world), ("world", scene))
        for constant, value in vars(module).items()
        if constant.isupper() and isinstance(value, int | float | tuple)
    }
    agent = dataclasses.asdict(method.agent)  # type: ignore[call-overload]
    return {"method": type(method.agent).__name__, "agent": agent, **numbers}
