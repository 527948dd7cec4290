"""Ray-cast pictures against analytic distances, and a filmed rope's frames."""

import math

import mujoco
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.numerics.pinhole import Pinhole
from palpate.worlds.camera import AMBIENT, TO_LIGHT, Camera, Sensor
from palpate.worlds.rope.filmed import ROPE_COLOUR, FilmedRope
from palpate.worlds.rope.rope import RopeConfiguration
from small_rope import QUIET, SMALL

AHEAD = Pinhole.looking_at((0.0, 0.0, 1.0), (0.0, -2.0, 1.0), 80, 60, math.radians(60))
PERFECT = {"colour_noise": 0.0, "depth_noise": 0.0, "edge_loss": 0.0}
BALL = """<mujoco><worldbody>
  <geom type="plane" size="5 5 .1" pos="0 1 0" euler="90 0 0" rgba=".5 .5 .5 1"/>
  <body pos="0 0 1"><joint type="slide" axis="1 0 0"/>
    <geom type="sphere" size=".3" rgba="1 0 0 1"/></body>
</worldbody></mujoco>"""


def picture(sensor: Sensor, *poses: float, scenery: str | None = None):
    still = None if scenery is None else mujoco.MjModel.from_xml_string(scenery)
    camera = Camera(mujoco.MjModel.from_xml_string(BALL), AHEAD, sensor, still)
    return camera.expose([np.array([pose]) for pose in poses], 0.0, np.random.default_rng(0))


def test_depth_of_a_ball_and_the_wall_behind_is_the_analytic_one():
    frame = picture(Sensor(sub_frames=1, **PERFECT), 0.0)
    columns, rows = np.meshgrid(np.arange(80), np.arange(60))
    rays = AHEAD.directions(np.stack([columns, rows], axis=-1))
    # The camera is 2 m from the ball's centre: |t d - c|^2 = r^2, and the wall is 3 m away.
    to_centre = np.array([0.0, 2.0, 0.0])
    along, squared = rays @ to_centre, (rays**2).sum(-1)
    inside = along**2 - squared * (4.0 - 0.09)
    expected = np.where(inside > 0, (along - np.sqrt(np.maximum(inside, 0))) / squared, 3.0)
    clear = np.abs(inside) > 1e-3
    assert frame.depth is not None
    assert np.allclose(frame.depth[clear], expected[clear], atol=1e-5)
    assert inside.max() > 0.05


def test_surfaces_are_lit_by_lambert_s_law():
    frame = picture(Sensor(sub_frames=1, **PERFECT), 0.0)
    red = frame.colour[29:31, 39:41, 0].mean() / 255  # where the ball faces the camera
    assert red == pytest.approx(AMBIENT + (1 - AMBIENT) * -TO_LIGHT[1], abs=0.02)


def test_what_moves_during_the_exposure_is_blurred():
    sensor = Sensor(sub_frames=2, **PERFECT)
    still, moving = picture(sensor, 0.0, 0.0), picture(sensor, -0.15, 0.15)
    # 0.35 m to the right of the ball's middle, which the ball covers half of the time.
    wall, both = still.colour[30, 52].astype(int), moving.colour[30, 52].astype(int)
    assert wall[1] > 80
    assert both[1] == pytest.approx(wall[1] / 2, abs=8)


def test_scenery_hides_and_is_hidden():
    scene = (
        '<mujoco><worldbody><geom type="box" size=".1 .1 .1" pos="0 {} 1"/></worldbody></mujoco>'
    )
    sensor = Sensor(sub_frames=1, **PERFECT)
    before, behind = (picture(sensor, 0.0, scenery=scene.format(y)).depth for y in (-1.0, 0.7))
    assert before[30, 40] == pytest.approx(0.9, abs=1e-3)
    assert behind[30, 40] == pytest.approx(1.7, abs=1e-2)


def test_depth_noise_grows_with_distance_as_the_sensor_s_does():
    frame = picture(Sensor(sub_frames=1, edge_loss=0.0), 0.0)
    wall = frame.depth[:10]
    assert wall.std() == pytest.approx(1.2e-3 + 1.9e-3 * 2.6**2, rel=0.1)
    assert wall.mean() == pytest.approx(3.0, abs=2e-3)


def test_impossible_sensors_are_refused():
    with pytest.raises(PalpateError, match="an exposure within its period"):
        Sensor(rate=30.0, exposure=0.05)
    with pytest.raises(PalpateError, match="at least one sub-frame"):
        Sensor(sub_frames=0)


def filmed(**sensor) -> FilmedRope:
    small = Pinhole.looking_at((0.0, 0.0, 1.1), (0.0, -2.5, 1.1), 80, 60, math.radians(60))
    return FilmedRope(
        RopeConfiguration(**SMALL, **QUIET), Sensor(sub_frames=2, **sensor), small, "plain"
    )


def test_frames_come_at_their_rate_and_after_their_latency():
    world = filmed(latency=0.02)
    first = world.reset(0, start="straight")
    assert first.frame is not None
    seen = [world.step(np.zeros(3)) for _ in range(100)]
    frames = [(view.time, view.frame.time) for view in seen if view.frame is not None]
    arrived, taken = np.array(frames).T
    assert np.allclose(np.diff(taken), 1 / 30)
    assert taken[0] == pytest.approx(1 / 30)
    delay = arrived - taken
    assert delay.min() >= 0.024 - 1e-9
    assert delay.max() < 0.034 + 1e-9


def test_a_filmed_rope_hands_out_no_markers_and_repeats_itself():
    worlds = filmed(), filmed()
    views = [world.reset(3, start="helix") for world in worlds]
    assert not hasattr(views[0], "markers")
    assert np.array_equal(views[0].frame.colour, views[1].frame.colour)
    assert np.array_equal(views[0].frame.depth, views[1].frame.depth, equal_nan=True)
    assert not np.array_equal(views[0].frame.colour, worlds[0].reset(4, start="helix").frame.colour)


def test_the_rope_appears_where_it_is():
    world = filmed(colour_noise=0.0)
    frame = world.reset(0, start="straight").frame
    nodes = world.truth().positions[1:-1]
    pixels, _ = world.pinhole.project(nodes)
    for column, row in pixels.round().astype(int):
        patch = frame.colour[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).astype(int)
        assert (patch[:, 0] - patch[:, 2]).max() > 40, ROPE_COLOUR
