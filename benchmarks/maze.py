"""Speed of learning off-policy: `python -m benchmarks.maze [--out FILE] [--quick]`.

Soft actor-critic, ours and that of stable-baselines3 (extra `sac`), with the same sizes: batches of
256, two layers of 256 units, a buffer of 100,000 transitions that is full. First both have to solve
a problem whose answer is known, a contextual bandit with a quadratic reward; then updates are timed
in turn, and the median of the ratios is kept.

What is timed: ours as a training makes them, eight environments' transitions added and eight
updates in one call; theirs by `SAC.train`, eight updates a call, which adds nothing. Sampling from
the buffer counts in both. `train_steps_per_s` are decisions of a whole training at one update every
second step, in environments that cost next to nothing.
"""

import time
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from benchmarks import run
from palpate.errors import PalpateError, extra_module
from palpate.learning.off_policy import (
    OffPolicyTraining,
    SoftActorCritic,
    Transition,
    at_its_best,
    train_off_policy,
)
from palpate.learning.off_policy.buffer import ReplayBuffer
from palpate.learning.off_policy.loop import Compiled
from palpate.numerics import devices
from palpate.runs import Figure, Result

FEATURES, ACTIONS = 9, 4  # of the maze's task
BATCH, WIDTH, DEPTH, FILLED = 256, 256, 2, 100_000
TOGETHER = 8  # environments side by side, and updates in one call
CHECK_STEPS, CHECK_RATE = 2000, 1e-3  # of the known answer: steps, updates, learning rate
WRONG = 0.01  # the most that the mean reward may stay below the best one, 0


class Bandit(gymnasium.Env):
    """One step: the reward is -(action - half of what is seen)^2 summed, at best 0."""

    observation_space = Box(-1.0, 1.0, (2,), np.float32)
    action_space = Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._seen = self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)
        return self._seen, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return self._seen, reward(self._seen, action).item(), True, False, {}


def reward(seen: np.ndarray, action: np.ndarray) -> np.ndarray:
    """Of the bandit, (*batch,)."""
    return -np.sum((np.asarray(action) - 0.5 * seen) ** 2, axis=-1)


def environments() -> SyncVectorEnv:
    """Bandits side by side."""
    return SyncVectorEnv([Bandit] * TOGETHER, autoreset_mode=AutoresetMode.SAME_STEP)


def check_known_answer() -> dict[str, float]:
    """The mean rewards of both after as many updates; raises if either has not solved it."""
    agent = SoftActorCritic(learning_rate=CHECK_RATE, width=WIDTH, depth=DEPTH)
    training = OffPolicyTraining(CHECK_STEPS, warm_up=256, batch=BATCH, ratio=1.0, capacity=FILLED)
    state = train_off_policy(environments(), agent, training, 0)
    act = at_its_best(agent)
    theirs = rival(Bandit(), CHECK_RATE)
    theirs.learn(CHECK_STEPS)
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (1000, 2)).astype(np.float32)
    found = {
        "reward_ours": float(reward(seen, np.asarray(act(state, seen))).mean()),
        "reward_stable_baselines3": float(
            reward(seen, theirs.predict(seen, deterministic=True)[0]).mean()
        ),
    }
    for name, value in found.items():
        if not value > -WRONG:
            raise PalpateError(f"{name} is {value:.4g}: expected above {-WRONG}, so no timing")
    return found


class Noise(gymnasium.Env):
    """Sizes of the maze's task, and nothing to learn: for spaces alone."""

    observation_space = Box(-np.inf, np.inf, (FEATURES,), np.float32)
    action_space = Box(-1.0, 1.0, (ACTIONS,), np.float32)


def rival(environment: gymnasium.Env, learning_rate: float = 3e-4) -> Any:
    """Their agent, set as ours."""
    library = extra_module("stable_baselines3", "sac")
    return library.SAC(
        "MlpPolicy",
        environment,
        learning_rate=learning_rate,
        buffer_size=FILLED,
        learning_starts=BATCH,
        batch_size=BATCH,
        policy_kwargs={"net_arch": [WIDTH] * DEPTH},
        seed=0,
        device="cpu",
    )


def our_updates() -> Callable[[], None]:
    """A call that makes `TOGETHER` updates, finished."""
    agent = SoftActorCritic(width=WIDTH, depth=DEPTH)
    compiled = Compiled(agent, OffPolicyTraining(FILLED, batch=BATCH, capacity=FILLED))
    key = jax.random.key(0)
    state = compiled.init(key, FEATURES, ACTIONS)
    buffer = jax.jit(ReplayBuffer.add)(
        ReplayBuffer.create(FEATURES, ACTIONS, FILLED), lived(FILLED)
    )
    held = [state, (buffer, None)]
    new = lived(TOGETHER)
    others = None, key, np.int32(TOGETHER), np.float32(0.0)

    def call() -> None:
        held[:] = compiled.learn(*held, new, *others)[:2]
        jax.block_until_ready(held)

    return call


def lived(count: int) -> Transition:
    """Random transitions (count, ...)."""
    keys = jax.random.split(jax.random.key(1), 4)
    action = jax.random.uniform(keys[0], (count, ACTIONS), minval=-1.0)
    seen, after = jax.random.normal(keys[1], (2, count, FEATURES))
    nothing = jnp.zeros(count)
    return Transition(
        seen, action, action, jax.random.normal(keys[2], (count,)), nothing, after, nothing
    )


def their_updates() -> Callable[[], None]:
    """The same of stable-baselines3."""
    agent = rival(Noise())
    agent.set_logger(extra_module("stable_baselines3.common.logger", "sac").Logger(None, []))
    buffer, random = agent.replay_buffer, np.random.default_rng(0)
    for values in (buffer.observations, buffer.next_observations, buffer.rewards):
        values[:] = random.normal(size=values.shape)
    buffer.actions[:] = random.uniform(-1.0, 1.0, buffer.actions.shape)
    buffer.full = True
    return lambda: agent.train(gradient_steps=TOGETHER, batch_size=BATCH)


def per_second(call: Callable[[], None], seconds: float) -> float:
    """Updates a second over about so long."""
    began, calls = time.perf_counter(), 0
    while time.perf_counter() - began < seconds:
        call()
        calls += 1
    return calls * TOGETHER / (time.perf_counter() - began)


def training_steps_per_second(steps: int) -> float:
    """Decisions a second of a whole training, compiling not counted: of the second of two."""
    taken = []
    for number in (steps // 4, steps):
        began = time.perf_counter()
        settings = OffPolicyTraining(number, warm_up=0, batch=BATCH, capacity=FILLED)
        train_off_policy(environments(), SoftActorCritic(), settings, 0)
        taken.append(time.perf_counter() - began)
    # Both compile and begin alike: what the longer one takes besides are its steps.
    return (steps - steps // 4) / (taken[1] - taken[0])


def benchmark(quick: bool = False) -> Result:
    """Check, then time in turn."""
    began = time.monotonic()
    checks = check_known_answer()
    ours, theirs = our_updates(), their_updates()
    for call in (ours, theirs):
        call()
    rounds, seconds = (3, 1.0) if quick else (9, 4.0)
    rows = [(per_second(ours, seconds), per_second(theirs, seconds)) for _ in range(rounds)]
    mine, others = np.array(rows).T
    steps = training_steps_per_second(1600 if quick else 8000)
    settings = {
        "batch": BATCH,
        "width": WIDTH,
        "depth": DEPTH,
        "buffer": FILLED,
        "rounds": rounds,
        "cores": devices.cores(),
        "updates_per_s": float(np.median(mine)),
        "stable_baselines3_updates_per_s": float(np.median(others)),
        "checks": checks,
    }
    for name in ("updates_per_s", "stable_baselines3_updates_per_s"):
        print(f"  {name}: {settings[name]:.4g}")
    ratios = mine / others
    spread = float((ratios.max() - ratios.min()) / 2)
    return Result(
        "bench-maze",
        [
            Figure(
                "speedup_over_sb3",
                float(np.median(ratios)),
                "",
                bar=2.5,
                better="higher",
                spread=spread,
            ),
            Figure("train_steps_per_s", steps, "1/s", bar=None, better="higher", spread=None),
        ],
        settings,
        [0],
        {},
        time.monotonic() - began,
    )


if __name__ == "__main__":
    run(benchmark, __doc__ or "")
