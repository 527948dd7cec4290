"""Clouds of depth images of scenes whose surfaces are known."""

import math

import numpy as np
import pytest

from depth_scenes import depth_of
from palpate.errors import PalpateError
from palpate.numerics.pinhole import DepthImage, Pinhole
from palpate.perception.clouds import cloud_of, noise_at

CAMERA = Pinhole.looking_at((0.0, 0.0, 1.0), (0.0, -1.5, 1.0), 160, 120, math.radians(60))


def wall(offset: float = 0.0, slope: float = 0.0, noise: float = 0.0, seed: int = 0) -> DepthImage:
    """A wall at y = offset + slope x, with a hole in the picture."""
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    rays = CAMERA.directions(np.stack([columns, rows], axis=-1))
    depth = (1.5 + offset) / (rays[..., 1] - slope * rays[..., 0])
    random = np.random.default_rng(seed)
    depth = depth + noise * noise_at(depth) * random.standard_normal(depth.shape)
    depth[:10, :10] = np.nan
    return DepthImage(0.0, CAMERA, depth)


def test_points_are_on_the_surface_and_normals_towards_the_camera():
    cloud = cloud_of([wall(slope=0.3)])
    x, y, _ = cloud.points.T
    assert np.abs(y - 0.3 * x).max() < 5e-3
    expected = np.array([0.3, -1.0, 0.0]) / math.hypot(0.3, 1.0)
    assert (cloud.normals @ expected > 0.999).mean() > 0.95


@pytest.mark.parametrize("offset", [0.0, 1.5, 3.0])
def test_points_are_as_noisy_as_they_say(offset):
    cloud = cloud_of([wall(offset, noise=1.0)])
    inner = np.abs(cloud.points[:, 0]) < 0.5
    assert inner.sum() > 300
    seen = np.std(cloud.points[inner, 1])
    assert 0.7 < seen / np.median(cloud.deviation[inner]) < 1.4


def test_what_is_before_a_surface_is_free_and_what_is_behind_is_hidden():
    cloud = cloud_of([wall()])
    points = np.array([[0.0, 0.0, 1.0], [0.0, -0.2, 1.0], [0.0, 0.2, 1.0], [5.0, 0.0, 1.0]])
    on, free = cloud.surfaces(points, 3.0)
    assert on.tolist() == [True, False, False, False]
    assert free.tolist() == [False, True, False, False]


def test_nothing_is_said_of_what_no_camera_sees():
    cloud = cloud_of([wall()])
    corner = CAMERA.back_project(np.array([[3, 3]]), np.array([1.0]))  # where the picture has none
    behind = np.array([[0.0, -2.0, 1.0]])
    for points in (corner, behind):
        on, free = cloud.surfaces(points, 3.0)
        assert not on.any()
        assert not free.any()


def test_two_cameras_see_more_than_one():
    other = Pinhole.looking_at((0.0, 0.0, 1.0), (1.0, -1.5, 1.2), 160, 120, math.radians(60))
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    rays = other.directions(np.stack([columns, rows], axis=-1))
    second = DepthImage(0.0, other, 1.5 / rays[..., 1])
    one, both = cloud_of([wall()]), cloud_of([wall(), second])
    assert np.ptp(both.points[:, 0]) > np.ptp(one.points[:, 0]) + 0.2
    assert set(both.source[:, 0]) == {0, 1}


BOX = """
<mujoco>
  <worldbody>
    <geom type="box" size="2 2 .01" pos="0 0 -.01"/>
    <geom type="box" size=".3 .3 .4" pos="0 0 .4"/>
  </worldbody>
</mujoco>
"""


def test_a_face_that_another_camera_sees_edge_on_is_not_in_the_open():
    angle = math.radians(60)
    oblique = Pinhole.looking_at((0.0, 0.0, 0.4), (2.0, -3.6, 1.4), 320, 240, angle)
    edge_on = Pinhole.looking_at((0.0, -0.3, 0.4), (-1.6, -0.3, 0.5), 320, 240, angle)
    cloud = cloud_of([depth_of(BOX, 0.0, camera, n) for n, camera in enumerate((oblique, edge_on))])
    face = (cloud.normals[:, 1] < -0.95) & (np.abs(cloud.points[:, 0]) < 0.28)
    points, normals = cloud.points[face], cloud.normals[face]
    assert len(points) > 100
    assert cloud.surfaces(points, 3.0)[1].mean() > 0.03  # the second camera looks past them
    assert cloud.surfaces(points, 3.0, normals)[1].mean() < 0.005
    before = points - np.array([0.0, 0.25, 0.0])
    assert cloud.surfaces(before, 3.0, normals)[1].mean() > 0.8


@pytest.mark.parametrize("fill", [np.nan, 0.0, -1.0])
def test_an_image_that_shows_nothing_is_refused(fill):
    with pytest.raises(PalpateError, match=r"show 0 points on surfaces, .*: expected 200 or more"):
        cloud_of([DepthImage(0.0, CAMERA, np.full((120, 160), fill))])


def test_a_floor_alone_is_refused():
    camera = Pinhole.looking_at((0.0, 0.4, 0.0), (0.0, 0.0, 1.5), 160, 120, math.radians(40))
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    rays = camera.directions(np.stack([columns, rows], axis=-1))
    depth = -1.5 / rays[..., 2]
    with pytest.raises(PalpateError, match="of which 0 are above the floor"):
        cloud_of([DepthImage(0.0, camera, depth)])


def test_what_faces_a_camera_and_is_not_seen_is_missing():
    image = wall()
    depth = image.depth.copy()
    depth[40:80, 60:100] = np.nan  # a doorway, with nothing behind
    depth[20, 20] = np.nan  # a pixel that was lost
    cloud = cloud_of([DepthImage(0.0, CAMERA, depth)])
    away = np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    inside = np.tile([0.0, 0.0, 1.0], (3, 1))  # one that faces the camera, and two that do not
    assert cloud.visibility.missing(inside, away).tolist() == [True, False, False]
    edge = CAMERA.back_project(
        np.array([[60.0, 60.0], [20.0, 20.0], [120.0, 60.0]]), np.full(3, 1.5)
    )
    assert not cloud.visibility.missing(edge, np.tile(away[0], (3, 1))).any()
    beside = np.array([[3.0, 0.0, 1.0]])  # outside the picture, nobody knows
    assert not cloud.visibility.missing(beside, away[:1]).any()
