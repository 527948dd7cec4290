"""Gymnasium's environments side by side, as the learning sees them."""

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv

from palpate.errors import PalpateError
from palpate.learning.off_policy.buffer import Motion, Transition
from palpate.safety.reflex import Reflex

# The greatest force in the step, N; the share of the way behind it; energy put into the robot in
# the step, J; the most of it at a time, W; and the level of a tank after it, J.
REPORTED = "force", "progress", "drawn", "flow", "level"


def check(environments: VectorEnv) -> tuple[int, int]:
    """How many numbers are seen and done in each.

    Raises `PalpateError` for what is no vector, actions without bounds, and another autoreset.
    """
    seen, done = environments.single_observation_space, environments.single_action_space
    for what, space in (("observations", seen), ("actions", done)):
        if not isinstance(space, Box) or len(space.shape) != 1:
            raise PalpateError(
                f"the {what} are {space}: expected a Box of one axis, such as "
                "gymnasium.wrappers.FlattenObservation gives"
            )
    assert isinstance(seen, Box)
    assert isinstance(done, Box)
    if not (np.isfinite(done.low).all() and np.isfinite(done.high).all()):
        raise PalpateError(f"the actions are {done}: expected bounds that are finite")
    mode = environments.metadata.get("autoreset_mode")
    if mode is not AutoresetMode.SAME_STEP:
        raise PalpateError(
            f"the environments' autoreset mode is {mode}: expected AutoresetMode.SAME_STEP, which "
            "gymnasium.make_vec takes in vector_kwargs"
        )
    return seen.shape[0], done.shape[0]


def reflex_of(environments: VectorEnv, agent: Any) -> Reflex | None:
    """What interrupts motions in the environments, for an agent that has a reflex; else None.

    Raises `PalpateError` for such an agent in environments that cannot interrupt.
    """
    if not hasattr(agent, "reflex"):
        return None
    law = getattr(environments, "law", None)
    if not isinstance(law, Reflex):
        raise PalpateError(
            f"{type(agent).__name__} interrupts motions, and {type(environments).__name__} does "
            "not let it: expected worlds side by side (GymnasiumWorlds) whose law is a Reflex"
        )
    return law


def begin_episodes(environments: VectorEnv, seed: int, step: int) -> np.ndarray:
    """The first observations (environments, features) of episodes that follow from seed and step.

    Raises `PalpateError` for one that is not finite.
    """
    drawn = np.random.SeedSequence((seed, step)).generate_state(1)[0]
    observation, _ = environments.reset(seed=int(drawn >> 1))
    return _finite("observation", np.array(observation, np.float32))


def advance(
    environments: VectorEnv, observation: np.ndarray, action: np.ndarray, executed: np.ndarray
) -> tuple[Transition, np.ndarray, dict[str, Any]]:
    """One step of all: the transitions, what is seen then, and what else is reported.

    Actions lie in [-1, 1], which is stretched onto the environments' bounds. Reported are "ended"
    (bool), "end" (how, "" where it goes on or nothing says so), and what is `REPORTED`, NaN where
    nothing says so, each (environments,); and where a decision can be interrupted "motions", as
    `Motions.pieces`.

    Raises `PalpateError` for observations, rewards and costs that are not finite.
    """
    space = environments.single_action_space
    assert isinstance(space, Box)
    commanded = space.low + 0.5 * (np.clip(executed, -1.0, 1.0) + 1.0) * (space.high - space.low)
    seen, reward, terminated, truncated, infos = environments.step(commanded.astype(space.dtype))
    after = np.array(seen, np.float32)  # of their own: they are read while the next step is taken
    ended = np.asarray(terminated | truncated, bool)
    following = after.copy()
    for number in np.flatnonzero(ended):
        following[number] = infos["final_obs"][number]
    cost = _reports_of(infos, "cost", ended, np.zeros(len(ended), np.float32))
    lived = Transition(
        np.array(observation, np.float32),
        np.array(action, np.float32),
        np.array(executed, np.float32),
        _finite("reward", np.asarray(reward, np.float32)),
        _finite("cost", np.asarray(cost, np.float32)),
        _finite("observation", following),
        np.asarray(terminated, np.float32),
    )
    end = _reports_of(infos, "end", ended, np.full(len(ended), "", object))
    info = {name: _reports_of(infos, name, ended, np.full(len(ended), np.nan)) for name in REPORTED}
    info |= {name: infos[name] for name in ("motions",) if name in infos}
    return lived, _finite("observation", after), {"ended": ended, "end": end, **info}


def motions_of(info: dict[str, Any]) -> tuple[Motion, int]:
    """The pieces of a step's decisions, and how many of the rows are pieces.

    Raises `PalpateError` for numbers that are not finite.
    """
    found = {name: _finite(name, one) for name, one in info["motions"].items()}
    count, done = int(found.pop("there").sum()), found["executed"]
    return Motion(action=done, reward=np.zeros_like(found["cost"]), **found), count


def _reports_of(
    infos: dict[str, Any], name: str, ended: np.ndarray, default: np.ndarray
) -> np.ndarray:
    """What is reported of each under a name; of an episode that ended, by its last step.

    Environments of Gymnasium put that into "final_info", others beside the rest.
    """
    values = default.copy()
    for source, which in ((infos, True), (infos.get("final_info", {}), ended)):
        if name in source:
            known = np.broadcast_to(source.get(f"_{name}", True), values.shape) & which
            values[known] = np.asarray(source[name])[known]
    return values


def _finite(what: str, values: np.ndarray) -> np.ndarray:
    if not np.isfinite(values).all():
        raise PalpateError(f"an environment gave the {what} {values}: expected finite numbers")
    return values
