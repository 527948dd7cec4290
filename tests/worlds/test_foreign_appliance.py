"""Files that somebody else wrote, as worlds: what of them moves, and what is refused."""

import math

import numpy as np
import pytest

from palpate.errors import PalpateError, PalpateWarning
from palpate.families.appliance.foreign import read_scene
from palpate.worlds.appliance.appliance import HOLD, ApplianceWorld, HandAction
from palpate.worlds.appliance.scene import labels_of
from palpate.worlds.depth import DepthSensor

KITCHEN = """
<mujoco model="kitchen">
  <compiler angle="radian"/>
  <worldbody>
    <geom type="plane" size="5 5 .1" pos="0 0 -1"/>
    <body name="counter" pos="0 1 0">
      <geom type="box" size=".8 .3 .02" pos="0 0 -.4"/>
      <body name="cabinet">
        <geom type="box" size=".3 .15 .3" pos="0 .15 0"/>
        <body name="door" pos="-.3 -.02 0">
          <joint name="hinge" axis="0 0 1" range="-1.5 0" damping="1" frictionloss=".2"/>
          <geom type="box" size=".28 .01 .28" pos=".3 0 0" mass="1"/>
          <body name="handle" pos=".5 -.05 0"><geom type="capsule" size=".01 .05" mass=".1"/></body>
          <body name="flap" pos=".3 -.02 0">
            <joint name="slide" type="slide" axis="1 0 0" range="0 .2"/>
            <geom type="box" size=".1 .005 .1" mass=".2"/>
          </body>
          <geom type="box" size=".4 .4 .4" group="4" mass=".1" contype="0" conaffinity="0"/>
        </body>
      </body>
      <body name="drawer" pos="1 0 0">
        <joint name="drawn" type="slide" axis="0 -1 0" range="0 .3"/>
        <geom type="box" size=".2 .2 .1"/>
      </body>
    </body>
    <body name="arm" pos="0 -2 0">
      <joint name="shoulder" axis="0 0 1"/><geom type="box" size=".1 .1 .5"/>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder"/></actuator>
  <keyframe><key qpos="0 0 0 1"/></keyframe>
</mujoco>
"""
URDF = """
<robot name="chest">
  <link name="base"><visual><geometry><box size=".4 .3 .2"/></geometry></visual></link>
  <link name="lid"><visual><origin xyz=".15 0 0"/><geometry><box size=".3 .3 .02"/></geometry>
  </visual></link>
  <joint name="lift" type="revolute"><parent link="base"/><child link="lid"/>
    <origin xyz="-.15 0 .12"/><axis xyz="0 -1 0"/><limit lower="0" upper="1.2"/></joint>
</robot>
"""


@pytest.fixture
def kitchen(tmp_path):
    path = tmp_path / "kitchen.xml"
    path.write_text(KITCHEN)
    return path


def test_what_moves_is_a_part_and_a_robot_is_left_out(kitchen):
    scene = read_scene(kitchen)
    assert [part.name for part in scene.parts] == ["hinge", "slide", "drawn"]
    door, flap, drawer = scene.parts
    assert (door.joint, door.parent, flap.parent, drawer.parent) == ("revolute", -1, 0, -1)
    assert (door.low, door.high, door.damping, door.friction) == (-1.5, 0.0, 1.0, 0.2)
    assert scene.travel == pytest.approx([-1.5, 0.2, 0.3])  # away from where they are closed
    # the box that is only felt is not measured, the handle that is fixed to the door is
    assert door.size == pytest.approx(0.56, abs=1e-3)
    model = scene.model
    labels = labels_of(model, scene.bodies)
    named = {model.body(number).name: label for number, label in enumerate(labels)}
    assert named["handle"] == named["door"] == 0
    assert (named["flap"], named["drawer"], named["cabinet"]) == (1, 2, -1)
    assert "arm" not in named  # held still it is scenery
    assert model.nu == 0
    assert model.nkey == 0


def test_one_body_is_kept_with_what_hangs_on_it(kitchen):
    scene = read_scene(kitchen, "cabinet")
    assert [part.name for part in scene.parts] == ["hinge", "slide"]
    names = {scene.model.body(number).name for number in range(scene.model.nbody)}
    assert names == {"world", "counter", "cabinet", "door", "handle", "flap"}
    # it is where it was, and cameras stand where its door is seen
    assert scene.middle == pytest.approx([0.0, 1.12, 0.0], abs=0.1)
    assert math.cos(scene.front + math.pi / 2) > 0.9


def test_a_door_of_a_file_is_seen_and_pulled_open(kitchen):
    clean = DepthSensor(noise=0.0, flying=0.0, lost=0.0)
    world = ApplianceWorld(read_scene(kitchen, "cabinet"), sensor=clean)
    world.reset(3, position=[0.0, 0.0])
    image = world.look()[0]
    rows, columns = np.nonzero((world.truth().labels[0] == 0) & np.isfinite(image.depth))
    pixels = np.stack([columns, rows], axis=1)
    points = image.pinhole.back_project(pixels, image.depth[rows, columns])
    point = points[np.argmax(points[:, 0])]  # furthest from the hinge
    pull = HandAction(HOLD, point, (0.0, -10.0, 0.0))
    for _ in range(5):  # a hand may get no hold
        if world.step(pull).holding:
            break
        world.step(HandAction())
    for _ in range(20):
        world.step(pull)
    assert world.truth().position[0] < -0.1


def test_a_urdf_is_mended_and_moves(tmp_path):
    path = tmp_path / "chest.urdf"
    path.write_text(URDF)  # without any mass, effort or velocity
    with pytest.warns(PalpateWarning, match="of .*chest.urdf mended: `palpate check` names them"):
        world = ApplianceWorld(read_scene(path))
    world.reset(0)
    assert [part.joint for part in world.parts] == ["revolute"]
    assert -0.01 <= world.truth().position[0] <= 1.21


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("<mujocoinclude><body/></mujocoinclude>", "a piece that other files include"),
        ("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>", "nothing moves in"),
        ("<scene/>", "holds <scene>: expected <robot> of URDF or <mujoco> of MJCF"),
        ("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>", "MuJoCo cannot use"),
        (
            "<mujoco><worldbody><body name='puck'><joint type='slide'/><joint axis='0 1 0'/>"
            "<geom size='.1'/></body></worldbody></mujoco>",
            "the body 'puck' of .* has 2 joints",
        ),
        ("no xml", "is not plain XML"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><mujoco>&b;</mujoco>", "is not plain XML"),
    ],
)
def test_a_file_that_is_no_appliance_is_refused_with_its_fault(tmp_path, text, sentence):
    path = tmp_path / "one.xml"
    path.write_text(text)
    with pytest.raises(PalpateError, match=sentence):
        read_scene(path)


def test_a_body_that_is_not_there_is_refused_with_a_guess(kitchen):
    with pytest.raises(PalpateError, match=r"'cabinets'; did you mean 'cabinet'\?"):
        read_scene(kitchen, "cabinets")
