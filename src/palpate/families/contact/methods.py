"""How a policy of the maze learns: what learns, and who chooses the stiffness.

SRL-VIC's and Bresa's constants are not printed. These are our own: discount, entropy and the share
of scattered starts, the training's horizon and the threshold were chosen on trainings of the
seeds 0, 1, 11, 21 and 900 to 904, the others untried.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.families.contact.environments import DECISION_PERIOD, SELF_TUNING
from palpate.family import check_name
from palpate.learning.off_policy import (
    Lagrangian,
    OffPolicyTraining,
    Penalty,
    RecoveryAgent,
    ReflexAgent,
    SafetyCritic,
    SoftActorCritic,
)
from palpate.learning.off_policy.agent import Agent
from palpate.networks import Channel
from palpate.networks.guarded import ActorPolicy, GuardedPolicy
from palpate.tasks.maze import maze, navigation
from palpate.worlds.maze import maze as maze_world
from palpate.worlds.maze import navigation as navigation_world
from palpate.worlds.maze import scene, tip

WRENCH = (0, 1, 2, 3, 4, 5)  # of the features: SRL-VIC's critic and recovery see no position
LEARNING_RATE, DISCOUNT, TARGET_ENTROPY = 1e-3, 0.98, -1.0  # of the task's agent
WIDTH, BATCH = 128, 128  # of the two hidden layers of every network; transitions of an update
# A tenth a decision: one that is soft at once averts nearly every violation, and what later ones
# risk would count against all actions alike. So a risk far below a percent can be told from more.
RISK_DISCOUNT, RISK_THRESHOLD = 0.1, 0.0015
NAVIGATION_DISCOUNT, NAVIGATION_THRESHOLD = 0.8, 0.3  # Recovery RL's
VIOLATION_PRICE = 50.0  # of the penalty, in rewards: more than the whole way to the goal is worth
COST_LIMIT = 0.02  # Lagrangian: violations an episode
ENERGY_LIMIT = 0.5  # the same: decisions of an episode that break a bound of energy
PRETRAINING_STEPS, PRETRAINING_UPDATES = 60_000, 12_000
TRAINING_HORIZON = 150  # decisions: whoever is stuck begins anew sooner, somewhere else
HELD = (3, 15)  # decisions for which a scripted collision keeps its direction
AHEAD, ASTRAY = 0.5, 0.3  # share of them that go along x, as the block does; how far off, rad


@dataclass(frozen=True)
class Method:
    """An agent, and the `stiffness` of `maze_law` that it is given; None: it chooses its own."""

    agent: Agent
    stiffness: float | str | None = None
    passive: bool = False  # whether energy is what it pays for, and it sees the tank's level

    @property
    def guarded(self) -> bool:
        """Whether it has a safety critic, which learns ahead from scripted collisions."""
        return isinstance(self.agent, RecoveryAgent)

    @property
    def interrupts(self) -> bool:
        """Whether its guard is a reflex, which interrupts motions."""
        return isinstance(self.agent, ReflexAgent)


def _agent() -> SoftActorCritic:
    return SoftActorCritic(LEARNING_RATE, DISCOUNT, target_entropy=TARGET_ENTROPY, width=WIDTH)


def _guard(
    seen: tuple[int, ...] | None = WRENCH,
    kind: type[RecoveryAgent] = RecoveryAgent,
    discount: float = RISK_DISCOUNT,
    threshold: float = RISK_THRESHOLD,
) -> RecoveryAgent:
    safety = SafetyCritic(discount=discount, seen=seen, width=WIDTH)
    return kind(_agent(), safety, threshold)


METHODS: dict[str, Callable[[], Method]] = {
    "srl-vic": lambda: Method(_guard()),
    "bresa": lambda: Method(_guard(kind=ReflexAgent)),
    "position-critic": lambda: Method(_guard(seen=None)),
    "no-recovery": lambda: Method(_agent()),
    "k300": lambda: Method(_guard(), 300.0),
    "k500": lambda: Method(_guard(), 500.0),
    "k600": lambda: Method(_guard(), 600.0),  # with 3 cm 4 N more than the heaviest block resists
    "k1000": lambda: Method(_guard(), 1000.0),
    "self-tuning": lambda: Method(_guard(), SELF_TUNING),
    "lagrangian": lambda: Method(
        Lagrangian(_agent(), COST_LIMIT, discount=DISCOUNT, multiplier_rate=1e-3, width=WIDTH)
    ),
    "penalty": lambda: Method(Penalty(_agent(), VIOLATION_PRICE)),
    "passive": lambda: Method(
        Lagrangian(  # a violation of the force limit is no way out of paying for energy
            _agent(),
            ENERGY_LIMIT,
            discount=DISCOUNT,
            multiplier_rate=1e-4,
            relief=False,
            width=WIDTH,
        ),
        passive=True,
    ),
}


_beside = functools.partial(
    _guard, seen=None, discount=NAVIGATION_DISCOUNT, threshold=NAVIGATION_THRESHOLD
)
NAVIGATION_METHODS: dict[str, Callable[[], Method]] = {
    "srl-vic": lambda: Method(_beside()),
    "bresa": lambda: Method(_beside(kind=ReflexAgent)),
    "no-recovery": lambda: Method(_agent()),
}


@dataclass(frozen=True)
class Skill:
    """What is to be learnt: what a policy sees and does, by which methods, and in which worlds.

    `period` is that of a decision, s; `modules` hold the constants of task and world by the word
    that they are told under.
    """

    observations: tuple[Channel, ...]
    actions: tuple[Channel, ...]
    period: float
    methods: dict[str, Callable[[], Method]]
    modules: tuple[tuple[str, Any], ...]

    def method(self, name: str) -> Method:
        """The method of that name; raises `PalpateError` that lists all."""
        return self.methods[check_name("method", name, self.methods)]()

    def policy(self, method: Method, state: Any) -> ActorPolicy:
        """The controller of an agent's state: its actor, under the guard where it has one."""
        agent, observations = method.agent, self.observations
        if method.passive:
            observations = *observations, Channel("tank", (1,))
        declared: dict[str, Any] = {
            "observations": observations,
            "actions": self.actions,
            "period": self.period,
        }
        if isinstance(agent, RecoveryAgent):
            task, safety = state.task, state.safety
            return GuardedPolicy(
                actor=task.actor, guard=safety.guard, threshold=agent.threshold, **declared
            )
        alone = state.agent if isinstance(agent, Lagrangian) else state
        return ActorPolicy(actor=alone.actor, **declared)

    def constants(self, method: Method) -> dict[str, Any]:
        """Those of method, task and world: what decides a training beside its options."""
        numbers = {
            f"{name}.{constant.lower()}": value
            for name, module in self.modules
            for constant, value in vars(module).items()
            if constant.isupper() and isinstance(value, int | float | tuple)
        }
        agent = dataclasses.asdict(method.agent)  # type: ignore[call-overload]
        return {"method": type(method.agent).__name__, "agent": agent, **numbers}


MAZE = Skill(
    # Each a share of what `palpate.tasks.maze.maze` divides it by.
    (Channel("wrench", (6,)), Channel("position", (3,))),
    (Channel("displacement", (2,)), Channel("stiffness", (2,))),
    DECISION_PERIOD,
    METHODS,
    (("task", maze), ("world", maze_world), ("world", tip), ("world", scene)),
)
NAVIGATION = Skill(
    (Channel("position", (2,)),),
    (Channel("motion", (2,)),),
    1.0,
    NAVIGATION_METHODS,
    (("task", navigation), ("world", navigation_world)),
)


def training_of(steps: int, method: Method) -> OffPolicyTraining:
    """So many decisions, and an update every second one, whatever the method."""
    updates = min(PRETRAINING_UPDATES, steps // 4) if method.guarded else 0
    return OffPolicyTraining(
        steps=steps, ratio=0.5, batch=BATCH, warm_up=min(2_000, steps // 4), pretraining=updates
    )


class ScriptedCollisions:
    """Pushes of any length and stiffness, each held for a while, in any direction or ahead.

    Of pushes in any direction hardly one meets the block, and a critic that has not felt how it
    gives way takes it for a wall, and never lets it be pushed.

    A `palpate.learning.off_policy.rollouts.Script`: from observations (worlds, features) and
    whether each episode has just begun, `actions` numbers for each in [-1, 1], of which the first
    two are a displacement. What a critic of risks
    learns from before a training, as SRL-VIC's (arXiv 2406.13744).
    """

    def __init__(self, actions: int) -> None:
        self._action, self._left = np.zeros((0, actions)), np.zeros(0, int)

    def __call__(
        self, observation: np.ndarray, fresh: np.ndarray, random: np.random.Generator
    ) -> np.ndarray:
        count, others = len(observation), self._action.shape[1] - 2
        if len(self._left) != count:
            self._action, self._left = np.zeros((count, 2 + others)), np.zeros(count, int)
        angle, length = random.uniform(0, 2 * np.pi, count), random.uniform(0.3, 1.0, count)
        ahead = random.uniform(size=count) < AHEAD
        angle[ahead] = random.normal(0.0, ASTRAY, count)[ahead]
        stiffness = random.uniform(-1, 1, (count, others))
        drawn = np.column_stack([length * np.cos(angle), length * np.sin(angle), stiffness])
        held = random.integers(*HELD, count)
        new = fresh | (self._left == 0)
        self._action[new], self._left[new] = drawn[new], held[new]
        self._left -= 1
        return self._action.copy()
