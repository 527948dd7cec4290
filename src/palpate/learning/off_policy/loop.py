"""Off-policy learning in environments side by side: the loop that every agent shares.

Each round all environments take a step, and the agent is updated from what is remembered. Actions
of a round are those of the agent before the updates of the round before it: so the updates run on
the device while the environments step on the host. So is the reflex of an agent that has one; what
it interrupts is remembered in pieces, from which critics of risks learn instead.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import VectorEnv
from jaxtyping import Array, PRNGKeyArray

from palpate.errors import PalpateError
from palpate.learning.off_policy.agent import Agent, Batch, copy_arrays
from palpate.learning.off_policy.buffer import Motion, ReplayBuffer, Transition
from palpate.learning.off_policy.environments import (
    advance,
    begin_episodes,
    check,
    motions_of,
    reflex_of,
)
from palpate.learning.off_policy.episodes import REMEMBERED, Episodes
from palpate.runs import Run
from palpate.runs.progress import interruptible, progress

# After so many steps and with this state: figures to log beside the others.
Evaluation = Callable[[int, Any], Mapping[str, float]]
# Transitions of the task; where motions can be interrupted, their pieces besides.
Memory = tuple[ReplayBuffer, ReplayBuffer | None]


@dataclass(frozen=True)
class OffPolicyTraining:
    """Settings of `train_off_policy`; a step is one decision in one environment."""

    steps: int
    warm_up: int = 1000  # steps of random actions, before the first update
    ratio: float = 0.5  # updates a step
    batch: int = 256
    capacity: int = 1_000_000  # transitions that are remembered
    violating_share: float = 0.3  # of the batches that a safety critic learns from
    pretraining: int = 0  # updates from what was collected before, ahead of the first step
    log_every: int = 1000
    checkpoint_every: int = 25_000
    evaluate_every: int = 25_000

    def __post_init__(self) -> None:
        least = {"steps": 1, "warm_up": 0, "batch": 1, "capacity": 1, "pretraining": 0}
        least |= {"log_every": 1, "checkpoint_every": 1, "evaluate_every": 1}
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise PalpateError(f"{name} is {getattr(self, name)}: expected at least {bound}")
        if self.ratio < 0 or not 0 <= self.violating_share <= 1:
            raise PalpateError(
                f"expected a ratio of at least 0 and a violating_share in [0, 1], got {self.ratio} "
                f"and {self.violating_share}"
            )

    def updates(self, step: int) -> int:
        """How many updates there have been after so many steps."""
        return int(self.ratio * max(0, step - self.warm_up))


class TrainingState(eqx.Module):
    """What a checkpoint holds: the rest follows from the seed and the step."""

    agent: Any
    buffer: ReplayBuffer
    totals: np.ndarray  # episodes that ended, costs
    episode_costs: np.ndarray  # of the last episodes, NaN before there were so many
    motions: ReplayBuffer | None = None  # of an agent with a reflex


def train_off_policy(
    environments: VectorEnv,
    agent: Agent,
    settings: OffPolicyTraining,
    seed: int,
    run: Run | None = None,
    *,
    offline: Transition | None = None,
    evaluation: Evaluation | None = None,
) -> Any:
    """The agent's state after training.

    The environments reset themselves in the step that ends an episode
    (`AutoresetMode.SAME_STEP`), see vectors and take bounded vectors, onto whose bounds [-1, 1] is
    stretched. A "cost" in what they tell besides is remembered (none: 0), and how an episode ended
    ("end") is counted.

    An agent with a `reflex` learns in `GymnasiumWorlds` whose law is a `Reflex`, to which its
    guard's weights are handed every round; its critic learns from the pieces of its decisions.

    `offline` transitions (of such an agent: pieces) are never forgotten; a critic of risks draws
    from them, a task's policy does not. With `settings.pretraining` the agent's `pretrain` sees
    them first.

    With a `run`, every `log_every` steps a line says what the episodes that ended since gave
    ("episodes", "return", "length", "cost", "ends"), how much cost there was in all ("violations")
    and what the last update found. As environments cannot be saved, all of them begin anew at every
    checkpoint, from seeds that follow from the step: a training that was cut off goes on from its
    last checkpoint to the same result, the buffer included. The caller opens the run and finishes
    it.

    Raises `PalpateError` for environments that are not as described, and for observations, rewards
    and losses that are not finite.
    """
    sizes = check(environments)
    count, reflex = environments.num_envs, reflex_of(environments, agent)
    if offline is not None and len(offline.reward) >= settings.capacity:
        raise PalpateError(
            f"the capacity is {settings.capacity} and {len(offline.reward)} transitions were "
            "collected before: expected more room than they take"
        )
    if offline is not None and isinstance(offline, Motion) != (reflex is not None):
        raise PalpateError(
            f"what was collected before are {type(offline).__name__}s: expected pieces of "
            "decisions (Motion) for an agent with a reflex, and for no other"
        )
    if settings.pretraining and (offline is None or not hasattr(agent, "pretrain")):
        raise PalpateError(
            "pretraining needs transitions that were collected before and an agent that learns from"
            f" them: got {'none' if offline is None else type(agent).__name__}"
        )
    compiled = compile_for(agent, settings)
    key = jax.random.key(seed)
    pieces = reflex and ReplayBuffer.create(*sizes, settings.capacity, kind=Motion)
    start = TrainingState(
        compiled.init(jax.random.fold_in(key, 0), *sizes),
        ReplayBuffer.create(*sizes, settings.capacity),
        np.zeros(2),
        np.full(REMEMBERED, np.nan),
        pieces,
    )
    restored = None if run is None else run.restore(start)
    done, state = restored or (0, start)
    history = state.totals, state.episode_costs
    learnt, memory = copy_arrays((state.agent, (state.buffer, state.motions)))
    if restored is None and offline is not None:
        memory = compiled.keep(memory, offline)
        if settings.pretraining:
            learnt = compiled.pretrain(learnt, memory, jax.random.fold_in(key, 1))
        if settings.pretraining and run is not None:
            run.save(0, TrainingState(learnt, memory[0], *history, memory[1]))
    episodes = Episodes(count, *history)
    observation, pending = None, None
    rounds = range(done + count, settings.steps + count, count)
    bar = progress(rounds, "training", done=done // count)
    with interruptible() as stop:
        for step in bar:
            if observation is None:
                observation = begin_episodes(environments, seed, step - count)
                episodes.begin()
            for_action, for_updates = jax.random.split(jax.random.fold_in(key, 1 + step))
            at_random = step <= settings.warm_up
            acting = compiled.act(learnt, observation, for_action, at_random)
            action, executed = (np.asarray(one) for one in acting)
            if reflex is not None:
                reflex.watch_with(*compiled.reflex(learnt))
            if pending is not None:
                learnt, memory, figures = compiled.learn(learnt, memory, *pending)
            lived, observation, info = advance(environments, observation, action, executed)
            episodes.add(lived, info)
            motions = None if reflex is None else motions_of(info)
            updates = settings.updates(step) - settings.updates(step - count)
            pending = lived, motions, for_updates, updates, np.float32(episodes.mean_cost)

            save = step >= settings.steps or _passes(step, count, settings.checkpoint_every)
            evaluate = evaluation is not None and _passes(step, count, settings.evaluate_every)
            if save or evaluate or _passes(step, count, settings.log_every):
                learnt, memory, figures = compiled.learn(learnt, memory, *pending)
                pending = None
                line = episodes.line() | _finite(figures if updates else {}, step)
                bar.show(**{name: line[name] for name in ("return", "violations")})
                if evaluation is not None and evaluate:
                    line |= evaluation(step, learnt)
                if run is not None:
                    run.log(step, **line)
            if save:
                observation = None
                if run is not None:
                    history = episodes.totals, episodes.costs
                    run.save(step, TrainingState(learnt, memory[0], *history, memory[1]))
            if stop:
                break
    return learnt


class Compiled:
    """What runs on the device, each compiled once: states and buffers are overwritten in place."""

    def __init__(self, agent: Agent, settings: OffPolicyTraining):
        self.init = jax.jit(agent.init, static_argnums=(1, 2))
        self.act = jax.jit(self._act)
        self.learn = jax.jit(self._learn, donate_argnums=(0, 1))
        self.pretrain = jax.jit(self._pretrain, donate_argnums=0)
        self.keep = jax.jit(self._keep, donate_argnums=0)
        self.reflex: Callable[[Any], Any] = getattr(agent, "reflex", lambda state: None)
        self._agent: Any = agent
        self._settings = settings

    def _act(
        self, state: Any, observation: Array, key: PRNGKeyArray, at_random: Array
    ) -> tuple[Array, Array]:
        """What is proposed, and what is executed in its place; both (environments, actions)."""
        proposed = self._agent.propose(state, observation, key)
        uniform = jax.random.uniform(key, proposed.shape, proposed.dtype, -1.0, 1.0)
        proposed = jnp.where(at_random, uniform, proposed)
        return proposed, self._agent.guard(state, observation, proposed)

    def _keep(self, memory: Memory, new: Transition) -> Memory:
        """With transitions, or pieces of them, that are kept for ever."""
        transitions, motions = memory
        if motions is None:
            return transitions.add(new).keep(), None
        return transitions, motions.add(new).keep()

    def _learn(
        self,
        state: Any,
        memory: Memory,
        lived: Transition,
        motions: tuple[Motion, Array] | None,
        key: PRNGKeyArray,
        updates: Array,
        episode_cost: Array,
    ) -> tuple[Any, Memory, dict[str, Array]]:
        """So many updates after `lived` is remembered; and what the last of them found."""
        pieces = memory[1]
        if pieces is not None and motions is not None:
            pieces = pieces.add(*motions)
        memory = memory[0].add(lived), pieces

        def update(number: Array, before: tuple[Any, dict[str, Array]]) -> Any:
            return self._update(self._agent.update, before[0], memory, key, number, episode_cost)

        of_state = lambda state: update(jnp.zeros((), int), (state, {}))[1]  # noqa: E731
        figures = jax.tree.map(
            lambda like: jnp.zeros(like.shape, like.dtype), jax.eval_shape(of_state, state)
        )
        state, figures = jax.lax.fori_loop(0, updates, update, (state, figures))
        return state, memory, figures

    def _pretrain(self, state: Any, memory: Memory, key: PRNGKeyArray) -> Any:
        def update(number: Array, state: Any) -> Any:
            cost = jnp.full((), jnp.nan)
            return self._update(self._agent.pretrain, state, memory, key, number, cost)[0]

        return jax.lax.fori_loop(0, self._settings.pretraining, update, state)

    def _update(
        self,
        update: Callable[[Any, Batch, PRNGKeyArray], Any],
        state: Any,
        memory: Memory,
        key: PRNGKeyArray,
        number: Array,
        episode_cost: Array,
    ) -> Any:
        keys = jax.random.split(jax.random.fold_in(key, number), 3)
        size, share = self._settings.batch, self._settings.violating_share
        transitions, motions = memory
        task = transitions.sample(keys[0], size)
        source = transitions if motions is None else motions
        risk, weight = source.sample_violating(keys[1], size, share)
        return update(state, Batch(task, risk, weight, episode_cost), keys[2])


@functools.lru_cache(maxsize=8)
def compile_for(agent: Agent, settings: OffPolicyTraining) -> Compiled:
    """The same for the same agent and settings: another seed need not be compiled anew."""
    return Compiled(agent, settings)


def _passes(step: int, count: int, every: int) -> bool:
    """Whether a multiple of `every` lies in the round that ends with `step`."""
    return step // every > (step - count) // every


def _finite(figures: Mapping[str, Array], step: int) -> dict[str, float]:
    found = {name: float(value) for name, value in figures.items()}
    for name, value in found.items():
        if not np.isfinite(value):
            raise PalpateError(
                f"the {name} is {value} after {step} steps: expected finite figures; a lower "
                "learning rate, or smaller rewards and costs, may help"
            )
    return found
