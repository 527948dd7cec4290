"""The adapter to Gymnasium, on a world whose every number is known."""

from typing import NamedTuple

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from palpate.errors import PalpateError
from palpate.worlds.gymnasium import FEATURE_LIMIT, GymnasiumWorld, GymnasiumWorlds
from palpate.worlds.world import DivergedError, World


class Shown(NamedTuple):
    time: float
    height: np.ndarray


class Lift(World):
    """Climbs by what is done, from a height that the seed draws; breaks above 100."""

    control_period = 0.1

    def reset(self, seed, *, height=None):
        self.height = seed % 7 if height is None else height
        self.steps = 0
        return self.seen()

    def seen(self):
        return Shown(self.steps * 0.1, np.array([float(self.height)]))

    def step(self, action):
        self.height += float(action[0])
        self.steps += 1
        if self.height > 100:
            raise DivergedError("too high")
        return self.seen()

    def truth(self):
        return self.height

    def render(self, width=640, height=480):
        return np.full((height, width, 3), int(self.height), np.uint8)


class Climb:
    """Reach 20, never be between 30 and 100."""

    features, actions, horizon = 1, 1, 4

    def observe(self, observation):
        return observation.height

    def reward(self, before, after, action):
        return after - before + 0.5 * float(action[0])

    def violates(self, truth):
        return truth > 30

    def progress(self, first, truth):
        return (truth - first) / 100

    def force(self, truth):
        return truth

    def end(self, truth):
        return "goal" if truth >= 20 else ""


class Tenfold:
    """Does ten times the action, and notes what it is told."""

    def __init__(self):
        self.fresh = []

    def begin(self, observation, action, fresh):
        self.action = action
        self.fresh.append(fresh.tolist())

    def command(self, observation):
        assert observation.height.shape == (len(self.action), 1)
        return 10 * self.action


def lifts(count, law=None, every=3):
    return GymnasiumWorlds([Lift() for _ in range(count)], Climb(), law, every)


def actions(*values):
    return np.array(values, np.float32)[:, None]


def test_a_decision_is_held_and_judged():
    environments = lifts(2)
    environments.reset(seed=0, options={"height": 10.0})
    seen, reward, terminated, truncated, infos = environments.step(actions(1, -1))
    np.testing.assert_array_equal(seen, [[13], [7]])
    assert seen.dtype == np.float32
    np.testing.assert_array_equal(reward, [3.5, -3.5])
    assert not terminated.any()
    assert not truncated.any()
    np.testing.assert_array_equal(infos["cost"], [0, 0])
    np.testing.assert_array_equal(infos["force"], [13, 9])
    assert infos["end"].tolist() == ["", ""]
    np.testing.assert_allclose(infos["progress"], [0.03, -0.03])
    assert "final_obs" not in infos


def test_a_violation_ends_the_episode_within_the_decision():
    law = Tenfold()
    environments = lifts(3, law)
    environments.reset(seed=0, options={"height": 10.0})
    seen, reward, terminated, truncated, infos = environments.step(actions(1, 0.1, 0.5))
    # 20, 30, 40: beyond 30 in the third period; 10 + 3; 15, 20, 25: at the goal when it is asked.
    assert infos["end"].tolist() == ["violation", "", "goal"]
    np.testing.assert_array_equal(infos["cost"], [1, 0, 0])
    assert terminated.tolist() == [True, False, True]
    assert not truncated.any()
    np.testing.assert_allclose(infos["force"], [40, 13, 25])
    np.testing.assert_allclose(reward, [30.5, 3.05, 15.25])
    assert infos["final_obs"][0] == 40
    assert infos["final_obs"][1] is None
    assert infos["_final_obs"].tolist() == [True, False, True]
    assert seen[0, 0] < 7  # it has begun anew
    environments.step(actions(0, 0, 0))
    assert law.fresh == [[True] * 3, [True, False, True]]
    single = GymnasiumWorld(Lift(), Climb(), Tenfold(), 9)
    single.reset(seed=0, options={"height": 15.0})
    _, _, terminated, _, info = single.step(np.ones(1, np.float32))
    assert terminated
    assert info["force"] == 35  # after two of nine periods
    assert info["end"] == "violation"
    assert info["cost"] == 1


def test_what_diverges_and_what_takes_too_long_is_cut_off():
    environments = lifts(2, Tenfold(), every=1)
    environments.reset(seed=0, options={"height": 10.0})
    environments.lockstep.worlds[0].height = 95.0
    _, _, terminated, truncated, infos = environments.step(actions(1, 0))
    assert infos["end"].tolist() == ["diverged", ""]
    assert truncated.tolist() == [True, False]
    assert not terminated.any()
    assert infos["final_obs"][0] == 10  # the last that was seen
    for _ in range(2):
        environments.step(actions(0, 0))
    _, _, terminated, truncated, infos = environments.step(actions(0, 0))
    assert infos["end"].tolist() == ["", "horizon"]  # the first has begun anew after one
    assert truncated.tolist() == [False, True]
    assert not terminated.any()


def test_each_world_of_several_does_as_one_with_its_seed():
    together = lifts(3)
    alone = [GymnasiumWorld(Lift(), Climb(), None, 3) for _ in range(3)]
    first, _ = together.reset(seed=11)
    for number, environment in enumerate(alone):
        np.testing.assert_array_equal(first[number], environment.reset(seed=11 + number)[0])
    random = np.random.default_rng(0)
    begun = 0
    for _ in range(40):
        action = random.uniform(-1, 1, (3, 1)).astype(np.float32)
        seen, reward, terminated, truncated, infos = together.step(action)
        for number, environment in enumerate(alone):
            one, gain, ended, cut, info = environment.step(action[number])
            assert (gain, ended, cut) == (reward[number], terminated[number], truncated[number])
            assert info["end"] == infos["end"][number]
            if ended or cut:
                np.testing.assert_array_equal(one, infos["final_obs"][number])
                one, _ = environment.reset()  # from its own generator, as the autoreset
                begun += 1
            np.testing.assert_array_equal(one, seen[number])
    assert begun > 20
    again, _ = together.reset(seed=11)
    np.testing.assert_array_equal(first, again)


def test_what_gymnasium_asks_for():
    environments = lifts(2)
    assert environments.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert environments.observation_space.shape == (2, 1)
    assert environments.single_action_space.shape == (1,)
    environments.reset(seed=[3, None])
    assert environments.render() is None
    drawn = GymnasiumWorlds([Lift()] * 2, Climb(), None, 1, "rgb_array")
    drawn.reset(seed=0)
    assert drawn.render()[1].shape == (480, 640, 3)
    environments.close()


def test_features_are_held_within_their_space():
    environment = GymnasiumWorld(Lift(), Climb(), None, 1)
    seen, _ = environment.reset(seed=0, options={"height": -1e6})
    assert seen in environment.observation_space
    assert seen[0] == -FEATURE_LIMIT


def test_misuse_is_refused():
    with pytest.raises(PalpateError, match="at least one world"):
        GymnasiumWorlds([], Climb(), None, 1)
    with pytest.raises(PalpateError, match="whole number of control periods"):
        lifts(1, every=0)
    environments = lifts(2)
    with pytest.raises(PalpateError, match="after reset"):
        environments.step(actions(0, 0))
    with pytest.raises(PalpateError, match="as many seeds"):
        environments.reset(seed=[1, 2, 3])
    environments.reset(seed=0)
    with pytest.raises(PalpateError, match=r"shape \(2, 1\)"):
        environments.step(actions(0, 0, 0))
