"""What every world shares: decimation and pictures."""

from typing import NamedTuple

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.world import Decimated, World, _gl_context, side_by_side
from small_rope import rope


class Counter(World):
    """Adds up its actions."""

    control_period = 0.1

    def reset(self, seed, **options):
        self.total = options.get("total", seed)
        return self.total

    def step(self, action):
        self.total += action
        return self.total

    def truth(self):
        return self.total

    def render(self, width=640, height=480):
        return np.zeros((height, width, 3), np.uint8)


def test_a_decimated_world_holds_the_action():
    world = Decimated(Counter(), every=3)
    assert world.control_period == pytest.approx(0.3)
    assert world.reset(2) == 2
    assert world.reset(2, total=7) == 7
    assert world.step(10) == 37
    assert world.truth() == 37
    assert world.render(4, 2).shape == (2, 4, 3)


class Shown(NamedTuple):
    total: float
    place: np.ndarray


class ShowingCounter(Counter):
    def reset(self, seed, **options):
        return Shown(super().reset(seed), np.zeros(2))

    def step(self, action):
        return Shown(super().step(float(action[0])), np.ones(2))


class Capped:
    """Counts on, but not beyond 15."""

    def __init__(self):
        self.seen, self.began = [], []

    def begin(self, observation, action, fresh):
        self.action = action
        self.began.append((*observation.total, *fresh))

    def command(self, observation):
        assert observation.place.shape == (1, 2)
        self.seen.append(*observation.total)
        return np.minimum(self.action, 15 - observation.total[:, None])


def test_a_law_between_the_rates_sees_each_observation_and_makes_the_command():
    law = Capped()
    world = Decimated(ShowingCounter(), every=3, law=law)
    world.reset(2)
    assert world.step(np.array([5.0])).total == 15
    assert law.seen == [2, 7, 12]
    assert world.step(np.array([1.0])).total == 15
    world.reset(4)
    world.step(np.array([1.0]))
    assert law.began == [(2, True), (15, False), (4, True)]


def test_worlds_side_by_side_show_named_tuples():
    both = side_by_side([Shown(1.0, np.zeros(2)), Shown(2.0, np.ones(2))])
    np.testing.assert_array_equal(both.total, [1, 2])
    np.testing.assert_array_equal(both.place, [[0, 0], [1, 1]])
    with pytest.raises(PalpateError, match="named tuples of numbers and arrays, not int"):
        side_by_side([1, 2])


@pytest.mark.parametrize("every", [0, -2])
def test_a_decision_is_held_for_at_least_one_period(every):
    with pytest.raises(PalpateError, match="whole number of control periods"):
        Decimated(Counter(), every)


def test_a_picture_shows_the_rope():
    world = rope()
    world.reset(0, start="straight", azimuth=0.0)
    try:
        hanging = world.render(160, 120)
    except PalpateError as error:
        if "needs OpenGL" not in str(error):
            raise
        pytest.skip(str(error))  # what no package of Python can bring
    assert hanging.shape == (120, 160, 3)
    assert hanging.dtype == np.uint8
    red_over_blue = hanging[..., 0].astype(int) - hanging[..., 2]
    assert (red_over_blue > 60).sum() > 20  # the rope is orange, nothing else is
    world.reset(0, start="straight", azimuth=np.pi)
    assert (world.render(160, 120) != hanging).any()


def test_without_opengl_the_sentence_names_the_packages(monkeypatch):
    def broken(width, height):
        raise AttributeError("'NoneType' object has no attribute 'eglQueryDevicesEXT'")

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr("mujoco.egl.GLContext", broken)
    monkeypatch.setattr("sys.platform", "linux")
    _gl_context.cache_clear()
    world = rope()
    world.reset(0)
    with pytest.raises(PalpateError, match="libegl1, libopengl0 and libgl1-mesa-dri"):
        world.render()
