"""Environments of others, made by their names and looked at before anything learns in them."""

import os
import sys
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv

from palpate.errors import PalpateError
from palpate.families.contact.environments import register
from palpate.learning.off_policy.environments import check

LOOKED_AT = 200  # random steps, in which an environment that tells costs does so
BROUGHT_BY = {"imageio": "palpate[gymnasium]"}  # which Gymnasium's MuJoCo environments want


def make_environments(name: str, count: int) -> VectorEnv:
    """So many of the environment `name` side by side, as `gymnasium.make` knows it.

    "module:Name-v0" imports the module first, which may lie in the current folder.

    Raises `PalpateError` where there is none of that name, where it cannot be made, and for
    observations and actions that are no vectors or have no bounds.
    """
    register()  # ours are found without a module
    if ":" in name and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    cannot, autoreset = f"the environment '{name}' cannot be made", AutoresetMode.SAME_STEP
    try:
        environments = gymnasium.make_vec(
            name, count, "sync", vector_kwargs={"autoreset_mode": autoreset}
        )
    except ModuleNotFoundError as error:
        brought = BROUGHT_BY.get(error.name or "")
        advice = f"`pip install '{brought}'` brings it" if brought else "is its package installed?"
        raise PalpateError(f"{cannot}: {str(error).rstrip('.')}; {advice}") from error
    except gymnasium.error.UnregisteredEnv as error:
        raise PalpateError(
            f"unknown environment '{name}': {error} Expected an id that gymnasium.make takes; "
            "module:Name-v0 imports the module that registers it"
        ) from error
    except Exception as error:  # whatever is wrong with somebody's environment
        raise PalpateError(f"{cannot}: {type(error).__name__}: {error}") from error
    try:
        check(environments)
    except PalpateError as error:
        environments.close()
        raise PalpateError(f"nothing can learn in '{name}': {error}") from error
    return environments


def describe_environment(name: str) -> dict[str, Any]:
    """What is found of an environment in `LOOKED_AT` random steps.

    The bounds of its actions ("low", "high"), s of a step by its frames per second ("period", 1
    where it has none), and whether its info had a "cost" ("costs"). Raises as `make_environments`.
    """
    environments, costs = make_environments(name, 1), False
    space, frames = environments.single_action_space, environments.metadata.get("render_fps")
    assert isinstance(space, Box)
    environments.reset(seed=0)
    environments.action_space.seed(0)
    for _ in range(LOOKED_AT):
        *_, infos = environments.step(environments.action_space.sample())
        costs = costs or "cost" in infos or "cost" in infos.get("final_info", {})
    environments.close()
    bounds = {side: np.asarray(getattr(space, side), float).tolist() for side in ("low", "high")}
    return {**bounds, "period": 1.0 / frames if frames else 1.0, "costs": costs}
