"""The room that parts take: of cells, of a door whose sides are known, and in the file."""

import math

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from depth_scenes import depth_of
from palpate.identification.interactive.description import describe
from palpate.identification.interactive.handling import Handling, Push
from palpate.identification.interactive.screws import Screw
from palpate.identification.interactive.shape import FILLED, MOST_BOXES, _fill, boxes_of
from palpate.identification.interactive.twin import Twin
from palpate.models.articulated.mjcf import write_mjcf
from palpate.numerics.pinhole import Pinhole
from palpate.perception.clouds import Cloud, cloud_of

DOOR = 0.04, 0.6, 0.7  # m
SCENE = f"""
<mujoco>
  <worldbody>
    <geom type="box" size=".25 .32 .02" pos=".29 0 1.4"/>
    <geom type="box" size=".25 .32 .02" pos=".29 0 .6"/>
    <geom type="box" size=".25 .02 .4" pos=".29 .33 1"/>
    <geom type="box" size=".25 .02 .4" pos=".29 -.33 1"/>
    <geom type="box" size=".02 .35 .42" pos=".55 0 1"/>
    <body pos="0 .31 1">
      <joint axis="0 0 1"/>
      <geom type="box" size="{DOOR[0] / 2} {DOOR[1] / 2} {DOOR[2] / 2}" pos="0 -.31 0"/>
    </body>
  </worldbody>
</mujoco>
"""
HINGE, HAND = np.array([0.0, 0.31, 1.0]), np.array([-0.02, -0.25, 1.0])
OPEN = 1.3  # rad, towards the cameras


@pytest.fixture(scope="module")
def twin() -> Twin:
    """A cupboard whose door was opened before two cameras."""
    cameras = [
        Pinhole.looking_at((0.1, 0.0, 1.0), place, 320, 240, math.radians(50.0))
        for place in ((-1.7, 0.9, 1.6), (-1.8, -0.8, 1.3))
    ]

    def look(position: float) -> Cloud:
        return cloud_of([depth_of(SCENE, position, one, seed) for seed, one in enumerate(cameras)])

    screw = Screw("revolute", np.array([0.0, 0.0, 1.0]), HINGE)
    way = np.stack([screw.pose(-one).at(HAND[None])[0] for one in np.linspace(0.0, OPEN, 60)])
    found = Twin()
    found.look(look(0.0))
    push = Push(HAND, np.array([-1.0, 0.0, 0.0]))
    after = look(-OPEN)
    found.observe(
        Handling(push, found.looks[0], after, 0.02 * np.arange(60.0), way, np.zeros((60, 3)))
    )
    return found


@given(st.integers(0, 10_000), st.floats(0.05, 0.95))
@settings(deadline=None, max_examples=40)
def test_boxes_fill_what_is_taken_and_nothing_else(seed, share):
    random = np.random.default_rng(seed)
    taken = random.random(tuple(random.integers(1, 8, size=3))) < share
    covered = np.zeros(taken.shape, int)
    boxes = _fill(taken)
    for first, last in boxes:
        assert (last > first).all()
        covered[tuple(map(slice, first, last))] += 1
    assert covered.max(initial=0) <= 1
    assert not covered[~taken].any()
    assert len(boxes) == MOST_BOXES or covered.sum() >= FILLED * taken.sum()


def test_a_solid_room_is_one_box():
    taken = np.zeros((9, 8, 7), bool)
    taken[2:7, 1:8, 3:5] = True
    ((first, last),) = _fill(taken)
    assert first.tolist() == [2, 1, 3]
    assert last.tolist() == [7, 8, 5]


def test_a_door_has_its_volume_and_the_cupboard_is_hollow(twin):
    """One box around all that is seen of the cupboard would be three times what it is."""
    assert [part.screw.joint for part in twin.parts] == ["revolute"]
    door, body = (sum(math.prod(box.size) for box in boxes_of(twin, part)) for part in (0, -1))
    assert door == pytest.approx(math.prod(DOOR), rel=0.5)
    inside = np.stack(
        np.meshgrid([0.15, 0.3], [-0.15, 0.0, 0.15], [0.8, 1.0, 1.2], indexing="ij"), axis=-1
    ).reshape(-1, 3)
    within = np.zeros(len(inside), bool)
    for box in boxes_of(twin, -1):
        local = (inside - box.place.origin) @ box.place.rotation
        within |= (np.abs(local) < np.array(box.size) / 2).all(axis=1)
    assert within.mean() < 0.2
    assert body > 0.01


def test_a_file_of_the_twin_has_its_room(twin, tmp_path):
    description = describe(twin, "cupboard")
    write_mjcf(tmp_path / "twin.xml", description)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "twin.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    shapes = np.flatnonzero(model.geom_bodyid == model.body("part 1").id)
    corners = np.concatenate([
        data.geom_xpos[one] + (np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
                               * model.geom_size[one]) @ data.geom_xmat[one].reshape(3, 3).T
        for one in shapes
    ])  # fmt: skip
    low, high = corners.min(axis=0), corners.max(axis=0)
    assert np.allclose(low, [-0.02, -0.3, 0.65], atol=0.03)
    assert np.allclose(high, [0.02, 0.3, 1.35], atol=0.03)
