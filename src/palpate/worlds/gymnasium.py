"""Any world as an environment of Gymnasium: one, or several that are stepped side by side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from palpate.errors import PalpateError
from palpate.worlds.motions import Motions
from palpate.worlds.world import (
    ControlLaw,
    DivergedError,
    InterruptingLaw,
    MeteredLaw,
    SpringLaw,
    World,
    side_by_side,
    whole_periods,
)

# What is beyond is cut off: features are scaled to about 1, and Gymnasium wants them bounded.
FEATURE_LIMIT = 100.0
# How an episode can end beside what the task says.
VIOLATION, HORIZON, DIVERGED = "violation", "horizon", "diverged"


@runtime_checkable
class WorldTask(Protocol):
    """What is wanted in a world, judged by its truth. It keeps nothing of an episode.

    `features` and `actions` are the sizes of what a policy sees and does, the latter in [-1, 1];
    `horizon` is the number of decisions after which an episode is cut off.
    """

    features: int
    actions: int
    horizon: int

    def observe(self, observation: Any) -> np.ndarray:
        """(worlds, features) of observations side by side."""
        ...

    def reward(self, before: Any, after: Any, action: np.ndarray) -> float:
        """Of one decision, by the truths of the world at its beginning and its end."""
        ...

    def violates(self, truth: Any) -> bool:
        """Asked in every control period: whether it breaks the limit, which ends the episode."""
        ...

    def force(self, truth: Any) -> float:
        """N: the greatest contact force in the last control period; 0 where there is none."""
        ...

    def progress(self, first: Any, truth: Any) -> float:
        """The share of the way that is behind it since the truth that its episode began with."""
        ...

    def end(self, truth: Any) -> str:
        """Asked after a decision: "" while the episode goes on, else how it ended ("goal")."""
        ...


def features_of(task: WorldTask, observation: Any) -> np.ndarray:
    """What the task sees of observations side by side, (worlds, features) float32."""
    seen = task.observe(observation)
    return np.clip(seen, -FEATURE_LIMIT, FEATURE_LIMIT).astype(np.float32)


class EnergyCosts(NamedTuple):
    """What a decision costs by the energy that it draws, and what a policy sees of the tank.

    Its level is seen as a share of `full` J. "eb" costs 1 where the level is at most `lower` J when
    the decision ends, "ef" where more than `flow` W were drawn within it: the budget and the flow
    of passivity-centric safe RL (arXiv 2503.00287), read as conditions of a violation.
    """

    costs: tuple[str, ...]  # "eb", "ef"
    full: float  # J
    lower: float  # J
    flow: float  # W

    def of(self, info: Mapping[str, np.ndarray]) -> np.ndarray:
        """(worlds,) of the decision that has ended, by its "flow" and, with a tank, "level"."""
        flow = info["flow"]
        broken = {"eb": info.get("level", flow + np.inf) <= self.lower, "ef": flow > self.flow}
        return np.sum([broken[name] for name in self.costs], axis=0)


class Lockstep:
    """Worlds side by side at the control rate, whose decisions are taken together.

    Where the law can interrupt, `motions` are the pieces of the last decision of all. Worlds that
    can be rolled out are, while the law is a spring (`SpringLaw`) and a contact force above the
    task's `force_limit` is what violates. With `energy` decisions cost what they draw, in place of
    violations; the law has to be a `MeteredLaw` then.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        task: WorldTask,
        law: ControlLaw | None,
        every: int,
        energy: EnergyCosts | None = None,
    ):
        self.worlds, self.task, self.law, self.energy = tuple(worlds), task, law, energy
        self.every = whole_periods(every)
        count = len(self.worlds)
        if not count:
            raise PalpateError("environments side by side need at least one world")
        self.observations: list[Any] = [None] * count
        self._truths: list[Any] = [None] * count
        self._first: list[Any] = [None] * count  # of the episodes under way
        self.fresh = np.ones(count, bool)
        self.decisions = np.zeros(count, int)
        self._ended: dict[int, dict[str, np.ndarray]] = {}  # in the decision: see `_draws_of`
        self.motions: Motions | None = None
        if isinstance(law, InterruptingLaw):
            self.motions = Motions(law, self.features, self.every)
        self._force_limit: float = getattr(task, "force_limit", math.inf)
        self._rollout = None
        if isinstance(law, SpringLaw) and hasattr(task, "force_limit"):
            self._rollout = self.worlds[0].rollout(self.worlds)
        numbers = task.features + (energy is not None)
        one = np.ones(numbers, np.float32) * FEATURE_LIMIT
        self.observation_space = Box(-one, one)
        self.action_space = Box(-1.0, 1.0, (task.actions,), np.float32)

    def begin(self, number: int, random: np.random.Generator, options: dict[str, Any]) -> None:
        """Begin an episode of one world, from a seed that is drawn."""
        world = self.worlds[number]
        self.observations[number] = world.reset(int(random.integers(2**31)), **options)
        self._truths[number] = self._first[number] = world.truth()
        self.fresh[number], self.decisions[number] = True, 0

    def features(self) -> np.ndarray:
        """What the task sees of all worlds, and of a tank its level, (worlds, features) float32."""
        seen, energy = features_of(self.task, side_by_side(self.observations)), self.energy
        if energy is None:
            return seen
        metered = isinstance(self.law, MeteredLaw) and not self.fresh.all()
        level = self._draws_of(self.law).get("level") if metered else None  # type: ignore[arg-type]
        full = np.where(self.fresh, energy.full, energy.full if level is None else level)
        share = np.clip(full / energy.full, -FEATURE_LIMIT, FEATURE_LIMIT)
        return np.concatenate([seen, share[:, None].astype(np.float32)], axis=1)

    def decide(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict]:
        """Rewards, who terminated, who was cut off, and what else is known, each (worlds,).

        A world whose episode ends within the decision stands still until the others are done.
        """
        task, law, observations, motions = self.task, self.law, self.observations, self.motions
        if observations[0] is None:
            raise PalpateError("an environment takes a step after reset(), not before")
        before, truths, self._ended = list(self._truths), self._truths, {}
        if law is not None:
            law.begin(side_by_side(observations), actions, self.fresh.copy())
        force, end = self._hold() or self._step(actions)
        running = np.flatnonzero(end == "").tolist()
        self.fresh[:] = False
        self.decisions += 1
        reward = np.array(
            [float(task.reward(*each)) for each in zip(before, truths, actions, strict=True)]
        )
        for number in running:
            end[number] = task.end(truths[number]) or (
                HORIZON if self.decisions[number] >= task.horizon else ""
            )
        cut = (end == HORIZON) | (end == DIVERGED)
        if motions is not None:
            motions.finish(end == VIOLATION, (end != "") & ~cut, end != DIVERGED)
        info = {"cost": (end == VIOLATION).astype(np.float32), "end": end}
        info["force"] = force
        info["progress"] = np.array([*map(task.progress, self._first, truths)])
        if isinstance(law, MeteredLaw):
            info |= self._draws_of(law)
            if self.energy is not None:
                info["cost"] = self.energy.of(info).astype(np.float32)
        return reward, (end != "") & ~cut, cut, info

    def _hold(self) -> tuple[np.ndarray, np.ndarray] | None:
        """As `_step`, by a rollout; None where that cannot be."""
        law = self.law
        spring = law.spring() if self._rollout is not None and isinstance(law, SpringLaw) else None
        if spring is None or self._rollout is None:
            return None
        held = self._rollout.hold(spring, self.every, self._force_limit)
        if isinstance(law, MeteredLaw):
            law.book(held.drawn)
        self.observations[:], self._truths[:] = held.observations, held.truths
        end = np.full(len(self.worlds), "", object)
        end[held.violated], end[held.diverged] = VIOLATION, DIVERGED
        return held.force, end

    def _draws_of(self, law: MeteredLaw) -> dict[str, np.ndarray]:
        """What the decision has drawn so far, and what is left, each (worlds,).

        Of a world that has ended within it, what was so then: the law goes on for the others.
        """
        found = {"drawn": law.drawn, "flow": law.flow, "level": law.level}
        now = {name: values.copy() for name, values in found.items() if values is not None}
        for number, then in self._ended.items():
            for name, values in now.items():
                values[number] = then[name][number]
        return now

    def _step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The greatest force in each world in a decision, N, and how it ended ("": it did not)."""
        worlds, task, law, observations = self.worlds, self.task, self.law, self.observations
        motions, truths, metered = self.motions, self._truths, isinstance(law, MeteredLaw)
        end = np.full(len(worlds), "", object)
        force, running = [0.0] * len(worlds), list(range(len(worlds)))
        for period in range(self.every):
            commands = actions if law is None else law.command(side_by_side(observations))
            if motions is not None:
                motions.follow(period, end == "")
            for number in tuple(running):
                world = worlds[number]
                try:
                    observations[number] = world.step(commands[number])
                except DivergedError:
                    end[number] = DIVERGED
                    running.remove(number)
                    continue
                truths[number] = truth = world.truth()
                force[number] = max(force[number], task.force(truth))
                if task.violates(truth):
                    end[number] = VIOLATION
                    running.remove(number)
            if metered and len(running) < len(worlds):
                for number in np.flatnonzero(end != "").tolist():
                    if number not in self._ended:
                        self._ended[number] = self._draws_of(law)  # type: ignore[arg-type]
        return np.array(force), end


class GymnasiumWorlds(VectorEnv):
    """Worlds side by side as a vector environment that resets in the step that ends an episode.

    Each action is held for `every` control periods; `law` makes of it what is done in each of them
    (None: the action itself is done). `task` says what is seen, wanted and forbidden. World i
    behaves as `GymnasiumWorld` does with the seed that Gymnasium gives it: that of `reset`, plus i.

    The infos of a step hold, for all worlds: "cost" (0 or 1: a violation, which ends the episode at
    once, within the decision), "end" (str: "" while it goes on, else what the task says,
    "violation", "horizon" or "diverged"), "force" (N, the greatest in this decision) and "progress"
    (the share of the way that is behind it); "final_obs" where an episode ended; and where the law
    can interrupt (`InterruptingLaw`) "motions", the pieces of this decision (`Motions.pieces`);
    where it counts energy (`MeteredLaw`) "drawn" (J), "flow" (W) and "level" (J). With `energy`
    "cost" is that of `EnergyCosts`, and the last feature the level of the tank. An
    episode that is cut off at the horizon, or whose simulation diverged, is truncated.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's
        "render_modes": ["rgb_array"], "render_fps": 10, "autoreset_mode": AutoresetMode.SAME_STEP,
    }  # fmt: skip

    def __init__(
        self,
        worlds: Sequence[World],
        task: WorldTask,
        law: ControlLaw | None,
        every: int,
        render_mode: str | None = None,
        energy: EnergyCosts | None = None,
    ):
        self.lockstep = Lockstep(worlds, task, law, every, energy)
        self.num_envs, self.render_mode = len(worlds), render_mode
        self.single_observation_space = self.lockstep.observation_space
        self.single_action_space = self.lockstep.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._randoms = [np_random(None)[0] for _ in range(self.num_envs)]

    @property
    def law(self) -> ControlLaw | None:
        """What stands between decisions and worlds."""
        return self.lockstep.law

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """First observations (worlds, features) float32; `options` go to the reset of each world.

        Raises `PalpateError` for a list of seeds of another length.
        """
        if seed is None or isinstance(seed, int):
            seeds = [None if seed is None else seed + number for number in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise PalpateError(f"{self.num_envs} worlds take as many seeds, not {len(seeds)}")
        for number, given in enumerate(seeds):
            if given is not None:
                self._randoms[number] = np_random(given)[0]
            self.lockstep.begin(number, self._randoms[number], options or {})
        return self.lockstep.features(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One decision of every world, `actions` (worlds, actions) in [-1, 1]."""
        lockstep = self.lockstep
        actions = _check(actions, (self.num_envs, *(self.single_action_space.shape or ())))
        reward, terminated, truncated, infos = lockstep.decide(actions)
        features, ended = lockstep.features(), terminated | truncated
        if lockstep.motions is not None:
            infos["motions"] = lockstep.motions.pieces
        if ended.any():
            final = np.full(self.num_envs, None, object)
            for number in np.flatnonzero(ended).tolist():
                final[number] = features[number]
                lockstep.begin(number, self._randoms[number], {})
            infos |= {"final_obs": final, "_final_obs": ended}
            features = lockstep.features()
        return features, reward, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture (height, width, 3) uint8 of each world, with the render mode "rgb_array"."""
        if self.render_mode is None:
            return None
        return tuple(world.render() for world in self.lockstep.worlds)


class GymnasiumWorld(gymnasium.Env):
    """One world as an environment; see `GymnasiumWorlds`. Nothing is reset but by `reset`."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        world: World,
        task: WorldTask,
        law: ControlLaw | None,
        every: int,
        render_mode: str | None = None,
        energy: EnergyCosts | None = None,
    ):
        self.lockstep = Lockstep([world], task, law, every, energy)
        self.observation_space = self.lockstep.observation_space
        self.action_space = self.lockstep.action_space
        self.render_mode = render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """The first observation (features,) float32; `options` go to the world's reset."""
        super().reset(seed=seed)
        self.lockstep.begin(0, self.np_random, options or {})
        return self.lockstep.features()[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One decision, (actions,) in [-1, 1]."""
        action = _check(action, self.action_space.shape or ())
        reward, terminated, truncated, info = self.lockstep.decide(action[None])
        info = {name: values.tolist()[0] for name, values in info.items()}
        features = self.lockstep.features()[0]
        return features, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> np.ndarray | None:
        """A picture (height, width, 3) uint8, with the render mode "rgb_array"."""
        return None if self.render_mode is None else self.lockstep.worlds[0].render()


def _check(action: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The action as it came: what is not finite is for the law, which fails closed."""
    action = np.asarray(action, float)
    if action.shape != shape:
        raise PalpateError(f"the action has the shape {shape}, not {action.shape}")
    return action
