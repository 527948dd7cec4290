"""Depth images by ray casting, and what a depth camera does to them."""

import math

import mujoco
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.numerics.pinhole import DepthImage, Pinhole
from palpate.worlds.depth import DepthSensor, depth_image, measure

AHEAD = Pinhole.looking_at((0.0, 0.0, 1.0), (0.0, -2.0, 1.0), 80, 60, math.radians(60))
WALL = """<mujoco><worldbody>
  <geom type="plane" size="5 5 .1" pos="0 1 0" euler="90 0 0"/>
  <body name="plate" pos="0 0 1"><geom type="box" size=".3 .01 .3"/></body>
</worldbody></mujoco>"""
PERFECT = DepthSensor(noise=0.0, flying=0.0, lost=0.0)


def image(sensor: DepthSensor, seed: int = 0):
    model = mujoco.MjModel.from_xml_string(WALL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return depth_image(model, data, AHEAD, sensor, np.random.default_rng(seed))


def test_depths_are_those_along_the_optical_axis_and_bodies_those_that_are_seen():
    seen, bodies = image(PERFECT)
    on = bodies == 1
    assert 100 < on.sum() < 4000
    assert np.allclose(seen.depth[on], 1.99, atol=1e-5)
    assert np.allclose(seen.depth[bodies == 0], 3.0, atol=1e-5)


def test_noise_grows_with_depth_as_the_formula_says():
    model = mujoco.MjModel.from_xml_string(WALL)
    for depth in (1.0, 3.0):
        whole = np.full((200, 200), depth)
        random = np.random.default_rng(0)
        seen = measure(whole, np.ones_like(whole), DepthSensor(), random)
        expected = 1.2e-3 + 1.9e-3 * (depth - 0.4) ** 2
        assert np.nanstd(seen) == pytest.approx(expected, rel=0.02)
    assert model.ngeom == 2


def test_pixels_on_an_edge_fly_between_its_sides_or_are_lost():
    sensor = DepthSensor(noise=0.0)
    seen, bodies = image(sensor)
    between = (seen.depth > 2.05) & (seen.depth < 2.95)
    assert between.sum() > 20
    assert np.isnan(seen.depth).sum() > 20
    inner = bodies == 1
    inner[1:-1, 1:-1] &= inner[:-2, 1:-1] & inner[2:, 1:-1] & inner[1:-1, :-2] & inner[1:-1, 2:]
    assert np.allclose(seen.depth[inner], 1.99, atol=1e-5)


def test_what_is_seen_at_a_grazing_angle_or_too_far_away_is_missing():
    depth = np.array([[1.0, 1.0, 7.0]])
    cosine = np.array([[1.0, math.cos(1.5), 1.0]])
    sensor = DepthSensor(noise=0.0, flying=0.0, lost=0.0, edge=100.0)
    seen = measure(depth, cosine, sensor, np.random.default_rng(0))
    assert np.isfinite(seen).tolist() == [[True, False, False]]


def test_an_image_of_another_size_than_its_camera_is_refused():
    with pytest.raises(PalpateError, match=r"\(60, 80\), not \(2, 2\)"):
        DepthImage(0.0, AHEAD, np.zeros((2, 2)))
