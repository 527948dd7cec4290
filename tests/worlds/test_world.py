"""What every world shares: decimation and pictures."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.world import Decimated, World, _gl_context
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


def test_what_stands_between_the_rates_sees_each_observation_and_changes_the_action():
    seen = []

    def capped(observation, action):
        seen.append(observation)
        return min(action, 15 - observation)

    world = Decimated(Counter(), every=3, between=capped)
    world.reset(2)
    assert world.step(5) == 15
    assert seen == [2, 7, 12]
    assert world.step(1) == 15


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
