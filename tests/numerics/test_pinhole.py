"""Pinhole geometry against closed forms."""

import math

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.numerics.pinhole import Frame, Pinhole

AHEAD = Pinhole.looking_at((0.0, 0.0, 1.0), (0.0, -2.0, 1.0), 320, 240, math.radians(60))


def test_what_it_looks_at_is_in_the_middle():
    pixel, depth = AHEAD.project(np.array([0.0, 0.0, 1.0]))
    assert pixel == pytest.approx([159.5, 119.5])
    assert depth == pytest.approx(2.0)


def test_right_and_up_appear_right_and_up_by_focal_length_over_depth():
    focal = 160 / math.tan(math.radians(30))
    pixel, depth = AHEAD.project(np.array([0.3, 0.5, 1.2]))
    assert depth == pytest.approx(2.5)
    assert pixel == pytest.approx([159.5 + focal * 0.3 / 2.5, 119.5 - focal * 0.2 / 2.5])


def test_the_field_of_view_ends_at_the_picture_s_edges():
    edge = 2 * math.tan(math.radians(30))
    pixels, _ = AHEAD.project(np.array([[-edge, 0.0, 1.0], [edge, 0.0, 1.0]]))
    assert pixels[:, 0] == pytest.approx([-0.5, 319.5])


def test_back_projection_undoes_projection_for_any_pose():
    rng = np.random.default_rng(0)
    camera = Pinhole.looking_at((0.1, 0.4, 0.9), (1.5, -2.0, 2.2), 640, 480, 1.0)
    points = rng.uniform((-0.7, -0.4, 0.1), (0.9, 1.2, 1.7), (50, 3))
    pixels, depth = camera.project(points)
    assert np.allclose(camera.back_project(pixels, depth), points, atol=1e-9)


def test_directions_have_a_depth_of_one():
    forward = np.asarray(AHEAD.world_from_camera)[:, 2]
    assert np.allclose(AHEAD.directions(np.array([[3.0, 7.0], [300.0, 2.0]])) @ forward, 1.0)


def test_impossible_cameras_are_refused():
    with pytest.raises(PalpateError, match="no upright picture"):
        Pinhole.looking_at((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), 10, 10, 1.0)
    upright = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    with pytest.raises(PalpateError, match="rotation matrix"):
        Pinhole(8, 8, (5.0, 5.0), (4.0, 4.0), (0.0, 0.0, 0.0), (*upright[:2], (0.0, 0.0, 2.0)))
    with pytest.raises(PalpateError, match="focal lengths > 0"):
        Pinhole(8, 8, (0.0, 5.0), (4.0, 4.0), (0.0, 0.0, 0.0), upright)


def test_frames_whose_parts_do_not_fit_are_refused():
    with pytest.raises(PalpateError, match="uint8 of shape"):
        Frame(0.0, np.zeros((4, 4, 3)), None)
    with pytest.raises(PalpateError, match="depth has the shape of its colour"):
        Frame(0.0, np.zeros((4, 4, 3), np.uint8), np.zeros((4, 5)))
