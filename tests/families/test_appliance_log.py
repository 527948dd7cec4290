"""A log of ROS, with clouds, a wrench and frames, becomes a recording and a twin."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bags import START, Ros, write_mcap, write_ros1, write_ros2
from depth_scenes import depth_of
from palpate.errors import PalpateError
from palpate.families.appliance import cloud_log
from palpate.families.appliance.cloud_log import read_log
from palpate.families.appliance.options import IdentifyAppliance
from palpate.families.appliance.recording import FORCE, HAND, twin_of
from palpate.identification.interactive.screws import Screw
from palpate.numerics.pinhole import Pinhole
from palpate.trials.appliance.score import difference

SCENE = """
<mujoco>
  <worldbody>
    <geom type="box" size=".25 .4 .4" pos=".3 0 1"/>
    <body pos="0 .31 1">
      <joint axis="0 0 1"/>
      <geom type="box" size=".02 .3 .35" pos="0 -.3 0"/>
    </body>
  </worldbody>
</mujoco>
"""
HINGE = Screw("revolute", np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.31, 1.0]))
GRIP = np.array([-0.02, -0.2, 1.0])
CAMERA = Pinhole.looking_at((0.1, 0.0, 1.0), (-1.6, 0.8, 1.6), 320, 240, math.radians(50.0))
RATE, LASTS = 50.0, 1.5  # Hz, and s of a pull
FRICTION = 4.0  # N at the hand


def messages(ros: Ros, sign: float = 1.0, transforms: bool = True) -> list:
    """Two pulls at the door, with clouds in the camera's frame, and a wrench in the tool's."""
    made = []

    def ns(seconds: float) -> int:
        return START + round(1e9 * seconds)

    def transform(seconds, child, position, rotation):
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        one = ros.types["TransformStamped"](
            ros.header(ns(seconds), "base"), child,
            ros.types["Transform"](ros.vector(position), ros.turn((w, x, y, z))),
        )  # fmt: skip
        return ros.types["TFMessage"]([one])

    def cloud(seconds, position):
        seen = depth_of(SCENE, position, CAMERA, 0)
        row, column = np.nonzero(np.isfinite(seen.depth))
        points = CAMERA.back_project(np.stack([column, row], axis=1), seen.depth[row, column])
        local = (points - CAMERA.position) @ np.array(CAMERA.world_from_camera)
        made.append(("/points", ns(seconds), ros.packed_cloud(ns(seconds), local, "camera")))

    turned = np.array(CAMERA.world_from_camera)
    if transforms:
        made.append(("/tf_static", ns(0.0), transform(0.0, "camera", CAMERA.position, turned)))
    tool = Rotation.from_euler("z", 0.7).as_matrix()
    for number, (begin, end) in enumerate(((0.0, -0.7), (-0.7, -1.2))):
        start = 5.0 * number + 1.0
        cloud(start - 0.5, begin)
        for time in np.arange(-0.6, LASTS + 1.2, 1.0 / RATE):
            share = np.clip(time / LASTS, 0.0, 1.0)
            smooth = 3.0 * share**2 - 2.0 * share**3
            position = begin + (end - begin) * smooth
            point = HINGE.pose(position).at(GRIP[None])[0]
            way = -np.cross(HINGE.axis, point - HINGE.point)
            force = np.zeros(3)
            if 0.0 < time < LASTS:
                force = sign * FRICTION * way / np.linalg.norm(way)
            if transforms:
                at = start + time
                made.append(("/tf", ns(at), transform(at, "tool", point, tool)))
            wrench = ros.types["Wrench"](ros.vector(force @ tool), ros.vector((0, 0, 0)))
            stamped = ros.types["WrenchStamped"](ros.header(ns(start + time), "tool"), wrench)
            made.append(("/wrench", ns(start + time), stamped))
        cloud(start + LASTS + 0.8, end)
    return made


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_mcap(tmp_path_factory.mktemp("log") / "log.mcap", messages(Ros()))


def test_a_log_makes_the_twin_of_its_door(log):
    recording = IdentifyAppliance(recordings=(log,)).read(log)
    assert len(recording.trials) == 2
    trial = recording.trials[0]
    assert trial[HAND].values[0] == pytest.approx(GRIP, abs=0.01)
    assert np.linalg.norm(trial[FORCE].values, axis=1) == pytest.approx(FRICTION, abs=1e-3)
    (part,) = twin_of(recording).twin.parts
    degrees, centimetres = difference(part.screw, HINGE.axis, HINGE.point)
    assert part.screw.joint == "revolute"
    assert degrees < 1.0
    assert centimetres < 1.0


def test_a_force_on_the_hand_is_turned_round(tmp_path):
    other = write_ros2(tmp_path / "log", messages(Ros(), sign=-1.0))
    found = IdentifyAppliance(recordings=(other,)).read(other)
    same = read_log(write_ros1(tmp_path / "log.bag", messages(Ros(one=True))))
    assert found.provenance["force"] == "turned round"
    assert same.provenance["force"] == "as the log has it"
    for one, two in zip(found.trials, same.trials, strict=True):
        assert one[FORCE].values == pytest.approx(two[FORCE].values, abs=1e-6)


def test_what_a_log_lacks_is_named(tmp_path, log, monkeypatch):
    whole = messages(Ros())

    def read(name, kept):
        return read_log(write_mcap(tmp_path / f"{name}.mcap", kept))

    with pytest.raises(PalpateError, match="no messages of the type sensor_msgs/msg/PointCloud2"):
        read("clouds", [one for one in whole if one[0] != "/points"])
    with pytest.raises(PalpateError, match="no messages of the type geometry_msgs/msg/Wrench"):
        read("wrench", [one for one in whole if one[0] != "/wrench"])
    with pytest.raises(PalpateError, match="expected one, of the hand"):
        read("two", whole + [("/other", ns, one) for topic, ns, one in whole if topic == "/wrench"])
    with pytest.raises(PalpateError, match="the frame 'tool' comes 0 s after it is needed first"):
        read("late", [one for one in whole if one[0] != "/tf" or one[1] < START + 2 * 10**9])
    monkeypatch.setattr(cloud_log, "HOLDS", 50.0)
    with pytest.raises(PalpateError, match="0 times in which the hand gave more than 50 N"):
        read_log(log)
    with pytest.raises(PalpateError, match="--viewpoint is for a folder"):
        IdentifyAppliance(recordings=(log,), viewpoint=(1.0, 2.0, 3.0)).read(log)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(log.read_bytes()[:5000])
    with pytest.raises(PalpateError, match="is damaged or no MCAP"):
        read_log(broken)


def test_a_log_without_frames_says_from_where_nothing_is_seen(tmp_path):
    with pytest.raises(PalpateError, match="expected the frame of the camera that saw them"):
        read_log(write_mcap(tmp_path / "log.mcap", messages(Ros(), transforms=False)))
