"""Environments with a known optimum, to be learnt in seconds."""

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, SyncVectorEnv


class Bandit(gymnasium.Env):
    """One step: the reward is -(action - half of what is seen)^2, at best 0."""

    observation_space = Box(-1.0, 1.0, (1,), np.float32)
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seen = self.np_random.uniform(-1.0, 1.0, 1).astype(np.float32)
        return self.seen, {}

    def step(self, action):
        wrong = float(action[0]) - 0.5 * float(self.seen[0])
        told = {"cost": float(action[0] > 0.4), "end": "goal" if abs(wrong) < 0.1 else "missed"}
        return self.seen, -(wrong**2), True, False, told


class Cliff(gymnasium.Env):
    """Three steps at most; each is worth its action, and one above 0 ends it by a violation."""

    observation_space = Box(-1.0, 1.0, (2,), np.float32)
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 3
        return self._seen(), {}

    def step(self, action):
        over, self.left = bool(action[0] > 0.0), self.left - 1
        told = {"cost": float(over), "end": "violation" if over else "", "force": 9.0 * over}
        return self._seen(), float(action[0]), over, not over and self.left == 0, told

    def _seen(self):
        return self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)


class Priced(gymnasium.Env):
    """One step: the reward is -(action - 1)^2, its cost the action's square.

    At a price p of the cost the best action is 1 / (1 + p); under a limit of 1/4 it is 1/2.
    """

    observation_space = Box(-1.0, 1.0, (1,), np.float32)
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        cost = {"cost": float(action[0]) ** 2}
        return np.zeros(1, np.float32), -((float(action[0]) - 1.0) ** 2), True, False, cost


class Leaving(gymnasium.Env):
    """Ten steps that cost 1 each, if no positive action ends them; each that goes on pays 0.2."""

    observation_space = Box(-1.0, 1.0, (1,), np.float32)
    action_space = Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 10
        return np.zeros(1, np.float32), {}

    def step(self, action):
        leaves = bool(action[0] > 0.0)
        self.left -= 1
        cost = {"cost": 1.0}
        return np.zeros(1, np.float32), 0.2 * (not leaves), leaves, self.left == 0, cost


class Regulator(gymnasium.Env):
    """A scalar linear system x' = x + u, cost x^2 + u^2, 10 steps; its Riccati equation is solved.

    `gain` is the steady one: the value is -p x^2 with p = (1 + sqrt 5) / 2, and u = -x / p.
    """

    observation_space = Box(-np.inf, np.inf, (1,), np.float32)
    action_space = Box(-2.0, 2.0, (1,), np.float32)
    gain = 2.0 / (1.0 + 5.0**0.5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.left = self.np_random.uniform(-1.0, 1.0), 10
        return np.array([self.state], np.float32), {}

    def step(self, action):
        reward = -(self.state**2) - float(action[0]) ** 2
        self.state, self.left = self.state + float(action[0]), self.left - 1
        return np.array([self.state], np.float32), reward, False, self.left == 0, {}


def side_by_side(kind: type[gymnasium.Env], count: int) -> SyncVectorEnv:
    return SyncVectorEnv([kind] * count, autoreset_mode=AutoresetMode.SAME_STEP)
