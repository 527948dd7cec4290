"""Contact's worlds as others find them: by their names in Gymnasium."""

import math
import tomllib
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from palpate.errors import PalpateError
from palpate.families.contact import environments
from palpate.worlds.gymnasium import GymnasiumWorlds
from palpate.worlds.maze.maze import FORCE_LIMIT


@pytest.mark.parametrize("name", environments.ENVIRONMENTS)
def test_gymnasium_finds_nothing_to_object_to(name):
    environment = gymnasium.make(name, render_mode="rgb_array")
    environment.reset(seed=0)
    try:
        environment.render()
    except PalpateError:  # no OpenGL on this machine
        check_env(gymnasium.make(name).unwrapped, skip_render_check=True)
    else:
        check_env(environment.unwrapped)


def test_names_are_entered_once_and_declared():
    environments.register()
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text("utf-8"))
    place = project["project"]["entry-points"]["gymnasium.envs"]["palpate"]
    assert place == f"{environments.__name__}:register"
    made = gymnasium.make(f"{environments.__name__}:palpate/Navigation2D-v0")
    assert made.spec.id == "palpate/Navigation2D-v0"


def test_mazes_side_by_side_repeat_with_their_seed():
    def lived(seed):
        several = gymnasium.make_vec("palpate/BlindMaze-v0", num_envs=2)
        assert isinstance(several.unwrapped, GymnasiumWorlds)
        several.action_space.seed(1)
        found = [several.reset(seed=seed)[0]]
        for _ in range(3):
            seen, reward, *_ = several.step(several.action_space.sample())
            found += [seen, reward]
        return np.concatenate([np.ravel(part) for part in found])

    np.testing.assert_array_equal(lived(0), lived(0))
    assert (lived(0) != lived(1)).any()


def test_a_stiff_push_into_a_wall_is_a_violation_and_a_soft_one_is_not():
    ends = []
    for stiffness in (-1.0, 1.0):
        environment = gymnasium.make("palpate/BlindMaze-v0", noise=0.0)
        # Below the left gap, 5 mm from the thin wall.
        environment.reset(seed=0, options={"start": (-0.2, -0.1)})
        for _ in range(10):
            action = np.array([1, 0, stiffness, stiffness], np.float32)
            _, _, terminated, _, info = environment.step(action)
            if terminated:
                break
        ends.append((info["end"], info["cost"]))
        if terminated:
            assert FORCE_LIMIT < info["force"] < 2 * FORCE_LIMIT
    assert ends == [("", 0), ("violation", 1)]


def test_a_policy_that_outputs_nan_ends_in_no_power():
    environments_ = gymnasium.make_vec("palpate/BlindMaze-v0", num_envs=2, noise=0.0)
    environments_.reset(seed=0)
    for _ in range(5):
        seen, reward, *_, infos = environments_.step(np.full((2, 4), math.nan, np.float32))
        assert np.isfinite(seen).all()
        assert np.isfinite(reward).all()
    assert infos["force"].max() < FORCE_LIMIT
