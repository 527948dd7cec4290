"""HalfCheetah and Ant under a speed limit: rewards and costs by hand, from MuJoCo's positions."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from palpate.worlds import velocity
from palpate.worlds.velocity import LIMITS, SpeedLimit

STEPS = 40


def pushed(name: str, direction: tuple[float, ...]) -> tuple[list[dict], np.ndarray]:
    """What steps tell of a robot that is thrown, and its root's positions before and after each."""
    velocity.register()
    environment = gymnasium.make(name)
    environment.reset(seed=1)
    inside = environment.unwrapped
    speed = inside.data.qvel.copy()
    speed[: len(direction)] = direction
    inside.set_state(inside.data.qpos.copy(), speed)
    random, told, way = np.random.default_rng(0), [], [inside.data.qpos[:3].copy()]
    for _ in range(STEPS):
        action = random.uniform(-1, 1, environment.action_space.shape).astype(np.float32)
        _, reward, terminated, truncated, info = environment.step(action)
        way.append(inside.data.qpos[:3].copy())
        told.append(info | {"reward": reward, "terminated": terminated, "action": action})
        if terminated or truncated:
            break
    assert inside.dt == pytest.approx(0.05)
    return told, np.array(way)


def test_a_cheetah_is_too_fast_forwards_alone():
    for direction in (4.5, -4.5):
        told, way = pushed("palpate/VelocityHalfCheetah-v0", (direction,))
        speed = np.diff(way[:, 0]) / 0.05
        control = [0.1 * np.sum(one["action"] ** 2) for one in told]
        np.testing.assert_allclose([one["reward"] for one in told], speed - control, atol=1e-6)
        np.testing.assert_array_equal([one["cost"] for one in told], speed > 3.2096)
        assert not any(one["terminated"] for one in told)
        assert bool((speed > 3.2096).any()) == (direction > 0)
        assert not (speed > 3.2096).all()


def test_an_ant_is_too_fast_in_any_direction():
    told, way = pushed("palpate/VelocityAnt-v0", (-2.2, 2.2))
    # Of the torso's frame, which the root's position is.
    x, y = np.diff(way[:, :2], axis=0).T / 0.05
    # MuJoCo's bodies stand where they were at the beginning of the last substep.
    speed = np.hypot(x, y)
    told_speed = np.array([np.hypot(one["x_velocity"], one["y_velocity"]) for one in told])
    np.testing.assert_allclose(told_speed, speed, atol=0.35)
    np.testing.assert_array_equal([one["cost"] for one in told], told_speed > 2.6222)
    assert 0 < sum(one["cost"] for one in told) < len(told)
    assert max(abs(x).max(), abs(y).max()) < 2.6222  # neither direction alone is too fast
    for one in told:
        control = 0.5 * np.sum(one["action"] ** 2)
        assert one["reward"] == pytest.approx(one["x_velocity"] + 1.0 - control, abs=1e-6)
    healthy = (way[1:, 2] >= 0.2) & (way[1:, 2] <= 1.0)
    np.testing.assert_array_equal([one["terminated"] for one in told], ~healthy)


def test_an_episode_has_a_thousand_steps_and_the_limits_are_those_printed():
    velocity.register()
    assert LIMITS == {"HalfCheetah": 3.2096, "Ant": 2.6222}
    for robot in LIMITS:
        spec = gymnasium.spec(f"palpate/Velocity{robot}-v0")
        assert spec.max_episode_steps == 1000
        assert "_v4:" in str(spec.entry_point)


class Told(gymnasium.Env):
    """Tells the speed that it was made with."""

    observation_space = action_space = Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, **told):
        self.told = told

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, dict(self.told)


@pytest.mark.parametrize(
    ("told", "cost"),
    [
        ({"x_velocity": 2.0}, 0), ({"x_velocity": 2.001}, 1), ({"x_velocity": -9.0}, 0),
        ({"x_velocity": -1.2, "y_velocity": 1.6}, 0), ({"x_velocity": 0, "y_velocity": -2.1}, 1),
        ({"x_velocity": float("nan")}, 1),
    ],
)  # fmt: skip
def test_the_limit_itself_is_not_too_fast_and_what_is_not_known_is(told, cost):
    *_, info = SpeedLimit(Told(**told), 2.0).step(np.zeros(1))
    assert info["cost"] == cost
    assert info.items() >= {name: info[name] for name in told}.items()
