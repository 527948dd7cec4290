"""A camera whose pose is known badly is laid onto what was seen before, though a door has moved."""

import dataclasses
import math

import numpy as np
from scipy.spatial.transform import Rotation

from depth_scenes import depth_of
from palpate.identification.interactive.registration import FEWEST, exact_poses, register
from palpate.identification.interactive.screws import NOWHERE
from palpate.numerics.pinhole import DepthImage, Pinhole
from palpate.perception.clouds import cloud_of

SCENE = """
<mujoco>
  <worldbody>
    <geom type="box" size=".3 .4 .4" pos=".3 0 .9"/>
    <geom type="box" size=".2 .3 .5" pos=".3 -.9 .7"/>
    <geom type="box" size=".1 .15 .1" pos=".2 .1 1.4"/>
    <geom type="box" size=".02 1.5 1" pos=".65 0 1"/>
    <geom type="box" size=".2 .2 .5" pos=".2 .9 .7" euler="0 0 40"/>
    <geom type="box" size="1.5 1.5 .02" pos="0 0 .1"/>
    <body pos="-.02 .3 .9">
      <joint axis="0 0 1"/>
      <geom type="box" size=".015 .3 .3" pos="0 -.3 0"/>
    </body>
  </worldbody>
</mujoco>
"""
HOME = Pinhole.looking_at((0.1, 0.0, 1.0), (-1.5, 0.7, 1.7), 320, 240, math.radians(55.0))
AWAY = Pinhole.looking_at((0.1, 0.0, 1.0), (-1.6, -0.4, 1.6), 320, 240, math.radians(55.0))


def seen(pinhole: Pinhole, door: float, seed: int) -> DepthImage:
    return depth_of(SCENE, -door, pinhole, seed)


def spoilt(image: DepthImage, degrees: float, metres: float, seed: int) -> DepthImage:
    """The image with a pose that is wrong by an angle and a way."""
    random = np.random.default_rng(seed)
    turn, way = (one / np.linalg.norm(one) for one in random.standard_normal((2, 3)))
    pinhole = image.pinhole
    rotation = Rotation.from_rotvec(math.radians(degrees) * turn).as_matrix()
    wrong = dataclasses.replace(
        pinhole,
        position=tuple((np.array(pinhole.position) + metres * way).tolist()),
        world_from_camera=tuple(map(tuple, rotation @ np.array(pinhole.world_from_camera))),
    )
    return dataclasses.replace(image, pinhole=wrong)


def misses(one: Pinhole, other: Pinhole) -> float:
    """How far (m) what one camera sees around the door is from where the other says it is."""
    points = np.array([[0.1, y, z] for y in (-0.3, 0.3) for z in (0.7, 1.1)])
    pixels, depth = one.project(points)
    return float(np.linalg.norm(other.back_project(pixels, depth) - points, axis=1).max())


def test_poses_are_made_exact_though_a_door_has_opened():
    """To half of what they were off, mostly upwards, where all that is level is seen from aside."""
    before, after = [], []
    for seed in range(6):
        first = cloud_of([seen(HOME, 0.0, 10 + seed)])
        wrong = spoilt(seen(AWAY, 1.1, seed), 0.3, 0.01, seed)
        (found,) = exact_poses([wrong], [first])
        before.append(misses(AWAY, wrong.pinhole))
        after.append(misses(AWAY, found.pinhole))
        across = np.subtract(found.pinhole.position, AWAY.position)[:2]
        assert np.linalg.norm(across) < 0.005
    assert np.mean(before) > 0.01
    assert np.mean(after) < 0.65 * np.mean(before)


def test_what_shows_nothing_of_it_stays_as_it_is():
    first = cloud_of([seen(HOME, 0.0, 0)])
    beside = seen(HOME, 0.0, 1)
    far = dataclasses.replace(beside.pinhole, position=(20.0, 0.0, 1.7))
    (found,) = exact_poses([dataclasses.replace(beside, pinhole=far)], [first])
    assert found.pinhole == far
    blank = dataclasses.replace(beside, depth=np.full_like(beside.depth, np.nan))
    assert exact_poses([blank], [first]) == [blank]


def test_the_same_cloud_stays_where_it_is():
    cloud = cloud_of([seen(HOME, 0.4, 3)])
    pose, count = register(cloud, cloud)
    assert count > FEWEST
    assert np.allclose(pose.rotation, NOWHERE.rotation, atol=1e-9)
    assert np.allclose(pose.origin, NOWHERE.origin, atol=1e-9)
