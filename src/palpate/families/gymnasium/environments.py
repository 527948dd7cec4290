"""Environments of others, made by their names and looked at before anything learns in them."""

import os
import sys
from dataclasses import dataclass

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv

from palpate.errors import PalpateError
from palpate.families.contact.environments import register
from palpate.learning.off_policy.environments import check

LOOKED_AT = 200  # random steps, in which an environment that tells costs does so
BROUGHT_BY = {"imageio": "palpate[gymnasium]"}  # which Gymnasium's MuJoCo environments want


def made(name: str, count: int) -> VectorEnv:
    """So many of the environment `name` side by side, as `gymnasium.make` knows it.

    "module:Name-v0" imports the module first, which may lie in the current folder.

    Raises `PalpateError` where there is none of that name, where it cannot be made, and for
    observations and actions that are no vectors or have no bounds.
    """
    register()  # ours are found without a module
    if ":" in name and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        environments = gymnasium.make_vec(
            name,
            num_envs=count,
            vectorization_mode="sync",
            vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        )
    except ModuleNotFoundError as error:
        brought = BROUGHT_BY.get(error.name or "")
        advice = f"`pip install '{brought}'` brings it" if brought else "is its package installed?"
        raise PalpateError(f"the environment '{name}' cannot be made: {error}; {advice}") from error
    except gymnasium.error.UnregisteredEnv as error:
        raise PalpateError(
            f"unknown environment '{name}': {error} Expected an id that gymnasium.make takes; "
            "module:Name-v0 imports the module that registers it"
        ) from error
    except Exception as error:  # whatever is wrong with somebody's environment
        kind = type(error).__name__
        raise PalpateError(f"the environment '{name}' cannot be made: {kind}: {error}") from error
    try:
        check(environments)
    except PalpateError as error:
        environments.close()
        raise PalpateError(f"nothing can learn in '{name}': {error}") from error
    return environments


@dataclass(frozen=True)
class Described:
    """What an environment is: numbers seen, bounds of its actions, s of a step, and costs.

    A `period` of 1 where it does not say how fast it runs. `costs`: whether its info had a "cost"
    in `LOOKED_AT` random steps.
    """

    features: int
    low: tuple[float, ...]
    high: tuple[float, ...]
    period: float
    costs: bool


def described(name: str) -> Described:
    """What is found of the environment of that name; raises `PalpateError` as `made`."""
    environments = made(name, 1)
    try:
        features, _ = check(environments)
        done = environments.single_action_space
        assert isinstance(done, Box)
        environments.reset(seed=0)
        environments.action_space.seed(0)
        costs = False
        for _ in range(LOOKED_AT):
            infos = environments.step(environments.action_space.sample())[-1]
            costs = costs or "cost" in infos or "cost" in infos.get("final_info", {})
        frames = environments.metadata.get("render_fps")
    finally:
        environments.close()
    bounds = (tuple(np.asarray(bound, float).tolist()) for bound in (done.low, done.high))
    return Described(features, *bounds, 1.0 / frames if frames else 1.0, costs)
