"""The rope's pixels and their order, on drawn curves and on pictures of the world."""

import math

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.numerics.pinhole import Frame, Pinhole
from palpate.perception.rope.centre_line import CentreLine, centre_lines, line_points, walk
from palpate.perception.rope.segmentation import Appearance, Segmentation, segment

CAMERA = Pinhole.looking_at((0.0, 0.0, 0.0), (0.0, -2.5, 0.0), 320, 240, math.radians(60))
ROPE = Appearance((0.85, 0.45, 0.15), 0.0)
TOP = np.array([0.0, 0.0, 0.5])


def curve(shape: str) -> np.ndarray:
    """1 m of rope from TOP, (1001, 3)."""
    s = np.linspace(0, 1, 1001)[:, None]
    if shape == "straight":
        return TOP + s * [0.5, 0.3, -math.sqrt(1 - 0.34)]
    if shape == "hairpin":  # half a circle that is seen almost edge-on
        sideways = np.cos(math.pi * s) - 1
        return TOP + np.concatenate([0.1 * sideways, sideways, -np.sin(math.pi * s)], 1) / math.pi
    if shape == "arc":
        return TOP + np.concatenate([1 - np.cos(2 * s), 0 * s, -np.sin(2 * s)], axis=1) / 2
    # A loop that crosses itself: down, once around, and on down.
    angle = 1.5 * np.pi * np.clip((s - 0.25) / 0.5, 0, 1)
    heading = -0.5 * np.pi - 0.3 + angle
    step = np.concatenate([np.cos(heading), 0 * s + 0.15, np.sin(heading)], axis=1) / 1000
    step /= np.linalg.norm(step, axis=1, keepdims=True) * 1000
    return TOP + np.cumsum(step, axis=0)


def drawn(points: np.ndarray, depth_sensor: bool = True) -> Segmentation:
    """Ideal pixels: the rope covers a pixel by how near it passes, 1.2 pixels wide."""
    pixels, depth = CAMERA.project(points)
    share, near = np.zeros((240, 320), np.float32), np.full((240, 320), np.nan, np.float32)
    for (u, v), z in zip(pixels, depth, strict=True):
        for row in range(int(v) - 1, int(v) + 3):
            for column in range(int(u) - 1, int(u) + 3):
                covered = np.clip(1.1 - math.hypot(u - column, v - row), 0, 1)
                if covered > 0:
                    near[row, column] = np.fmin(near[row, column], z)
                share[row, column] = max(share[row, column], covered)
    return Segmentation(share, near if depth_sensor else None, np.zeros(share.shape, bool))


def the_line(seen: Segmentation) -> CentreLine:
    return centre_lines(seen, CAMERA, TOP, 1.0)[0]


def miss(points: np.ndarray, missing: slice = slice(0, 0)) -> np.ndarray:
    """Distances (11,) in m of the centre line's nodes from the true ones."""
    kept = np.delete(points, missing, axis=0)
    nodes = the_line(drawn(kept)).nodes(np.full(10, 0.1))
    return np.linalg.norm(nodes - points[::100], axis=-1)


def test_ridges_lie_on_the_curve_to_a_fraction_of_a_pixel():
    points = curve("arc")
    found = line_points(drawn(points))
    pixels, depth = CAMERA.project(points)
    apart = np.linalg.norm(found.pixels[:, None] - pixels, axis=-1)
    nearest = apart.argmin(1)
    inner = (nearest > 20) & (nearest < 980)
    assert apart.min(1)[inner].max() < 0.4
    assert np.abs(found.depth - depth[nearest]).max() < 0.01
    tangents = np.gradient(pixels, axis=0)[nearest]
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    assert np.abs((tangents * found.normals).sum(-1))[inner].max() < 0.25


@pytest.mark.parametrize("shape", ["straight", "arc"])
def test_nodes_of_a_whole_curve(shape):
    assert miss(curve(shape)).max() < 0.01


def test_strands_behind_each_other_are_told_apart_by_their_depth():
    points = curve("hairpin")
    pixels, depth = CAMERA.project(points)
    assert np.ptp(pixels[:, 0]) < 12
    assert np.ptp(depth) > 0.6
    assert miss(points).max() < 0.03


def test_a_gap_is_filled():
    error = miss(curve("arc"), slice(400, 600))
    assert error.max() < 0.02


def test_a_hidden_tip_is_straight_on():
    error = miss(curve("straight"), slice(800, 1001))
    assert error.max() < 0.015


def test_a_rope_that_crosses_itself_is_walked_around_its_loop():
    points = curve("loop")
    pixels, _ = CAMERA.project(points)
    found = line_points(drawn(points))
    order = walk(found, pixels[0], 1.0 * CAMERA.focal[0] / 2.5)
    nearest = np.linalg.norm(found.pixels[order][:, None] - pixels, axis=-1)
    # Near the crossing two places are as near; elsewhere the order is that along the rope.
    two = (nearest < nearest.min(1, keepdims=True) + 1.5) & (nearest < 3)
    place = nearest.argmin(1)
    spread = np.array([np.flatnonzero(row).max() - np.flatnonzero(row).min() for row in two])
    clear = spread < 60
    assert clear.sum() > 60
    assert (np.diff(place[clear]) > -10).all()
    assert (spread > 300).any(), "the curve does cross itself"
    assert miss(points).max() < 0.05


def test_without_depth_a_rope_leans_towards_the_camera_or_away():
    points = curve("straight")
    lines = centre_lines(drawn(points, depth_sensor=False), CAMERA, TOP, 1.0)
    nodes = np.array([line.nodes(np.full(10, 0.1)) for line in lines])
    error = np.linalg.norm(nodes - points[::100], axis=-1).max(-1)
    assert error.min() < 0.04
    assert nodes[:, -1, 1].min() < -0.2
    assert nodes[:, -1, 1].max() > 0.2


def test_without_depth_what_lies_behind_a_gap_is_not_surely_rope():
    points = curve("arc")
    more = points[-1] + np.linspace(0.15, 0.35, 200)[:, None] * [0.6, 0.0, 0.8]
    lines = centre_lines(drawn(np.concatenate([points, more]), False), CAMERA, TOP, 1.0)
    error = [np.linalg.norm(line.nodes(np.full(10, 0.1)) - points[::100]) for line in lines]
    assert min(error) < 0.1


def test_without_depth_a_rope_that_is_longer_than_told_faces_the_camera():
    (line,) = centre_lines(drawn(curve("arc"), depth_sensor=False), CAMERA, TOP, 0.8)
    assert np.abs(line.points[:, 1]).max() < 0.01


def test_too_little_rope_is_refused():
    few = drawn(curve("arc")[:1])
    few.share[:] = 0
    with pytest.raises(PalpateError, match="at least 4 points of the rope, 0 are seen"):
        centre_lines(few, CAMERA, TOP, 1.0)


def painted(depth: bool = True) -> Frame:
    """A grey wall 4 m away, a rope 2.5 m away, a thick and a thin thing of its colour behind it."""
    colour = np.full((240, 320, 3), 150, np.uint8)
    distance = np.full((240, 320), 4.0, np.float32)
    orange = (173, 92, 31)
    colour[60:200, 240:262] = orange
    colour[60:200, 120] = orange
    colour[70:180, 160] = orange
    distance[70:180, 160] = 2.5
    return Frame(0.0, colour, distance if depth else None)


def test_only_what_is_thin_and_in_reach_is_rope():
    found = segment(painted(), ROPE, CAMERA, TOP, 1.15)
    rows, columns = np.nonzero(found.share)
    assert set(columns) == {160}
    assert rows.min() == 70
    assert rows.max() == 179
    assert found.share[100, 160] > 0.8
    assert found.depth[100, 160] == pytest.approx(2.5)
    assert np.isnan(found.depth[100, 120])


def test_a_sensor_sees_the_rope_s_front():
    thick = Appearance(ROPE.colour, 0.01)
    found = segment(painted(), thick, CAMERA, TOP, 1.15)
    assert found.depth[100, 160] == pytest.approx(2.5 + 0.25 * math.pi * 0.01)


def test_without_depth_a_thin_thing_of_the_rope_s_colour_stays():
    found = segment(painted(depth=False), ROPE, CAMERA, TOP, 1.15)
    assert set(np.nonzero(found.share)[1]) == {120, 160}
    assert found.depth is None


def test_before_something_of_its_colour_a_rope_is_told_by_its_depth():
    frame = painted()
    frame.depth[80:160, 250] = 2.5  # before the thick thing
    found = segment(frame, ROPE, CAMERA, np.array([0.5, 0.0, 0.5]), 1.15)
    rows, columns = np.nonzero(found.share)
    assert set(columns) == {160, 250}
    assert rows[columns == 250].min() == 80
    assert rows[columns == 250].max() == 159
    assert not found.like_rope.any()
    flat = segment(painted(depth=False), ROPE, CAMERA, np.array([0.5, 0.0, 0.5]), 1.15)
    assert flat.like_rope[100, 250]
    assert not flat.like_rope[100, 160]


def test_what_cannot_be_told_apart_is_refused():
    with pytest.raises(PalpateError, match="is grey"):
        Appearance((0.5, 0.5, 0.55), 0.005)
    with pytest.raises(PalpateError, match="pictures of 320 x 240"):
        segment(Frame(0.0, np.zeros((10, 10, 3), np.uint8), None), ROPE, CAMERA, TOP, 1.0)
