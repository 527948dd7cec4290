"""Plain numbers of a robot's log, by topic and field."""

import numpy as np
import pytest

from bags import Ros, nanoseconds, write_mcap, write_ros1, write_ros2
from palpate.errors import PalpateError
from palpate.recordings.files import read_recording

pytest.importorskip("rosbags")

TIMES = 0.02 * np.arange(50)
ANGLE, TORQUE = "/joint_states.position[1]", "/torque"


def messages(one=False, late=0.0):
    """Joint states with stamps, received `late`, and torques without."""
    ros = Ros(one=one)
    found = []
    for time, ns in zip(TIMES, nanoseconds(TIMES), strict=True):
        position = np.array([7.0, np.sin(time)])
        empty = np.zeros(0)
        state = ros.types["JointState"](ros.header(ns), ["a", "b"], position, empty, empty)
        found.append(("/joint_states", ns + round(1e9 * late), state))
        found.append(("/torque", ns + 5_000_000, ros.types["Float64"](float(time > 0.5))))
    return sorted(found, key=lambda row: row[1])


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_numbers_are_read_by_topic_and_field(tmp_path, kind):
    if kind == "ros1":
        path = write_ros1(tmp_path / "run.bag", messages(one=True))
    else:
        path = write_ros2(tmp_path / "run", messages())
    (trial,) = read_recording(path, columns=(ANGLE, TORQUE)).trials
    angle, torque = trial[ANGLE], trial[TORQUE]
    np.testing.assert_allclose(angle.time, TIMES, atol=1e-6)
    np.testing.assert_allclose(angle.values[:, 0], np.sin(TIMES), atol=1e-9)
    np.testing.assert_allclose(torque.time, TIMES + 0.005, atol=1e-6)
    np.testing.assert_array_equal(torque.values[:, 0], TIMES > 0.5)


def test_stamps_of_the_messages_count_where_all_have_them(tmp_path):
    path = write_ros2(tmp_path / "run", messages(late=0.5))
    (trial,) = read_recording(path, columns=(ANGLE,)).trials
    np.testing.assert_allclose(trial[ANGLE].time, TIMES, atol=1e-6)
    (trial,) = read_recording(path, columns=(ANGLE, TORQUE)).trials
    np.testing.assert_allclose(trial[ANGLE].time[0] - trial[TORQUE].time[0], 0.495, atol=1e-6)


def test_json_in_an_mcap_file(tmp_path):
    rows = [("/door", ns, {"angle": {"rad": float(t)}, "ok": True})
            for t, ns in zip(TIMES, nanoseconds(TIMES), strict=True)]  # fmt: skip
    path = write_mcap(tmp_path / "run.mcap", rows)
    (trial,) = read_recording(path, columns=("/door.angle.rad",)).trials
    np.testing.assert_allclose(trial["/door.angle.rad"].values[:, 0], TIMES)


def test_what_is_not_there_is_named(tmp_path):
    path = write_ros2(tmp_path / "run", messages())
    for column, said in (
        ("/angles", "there is no topic /angles .*there are: /joint_states, /torque"),
        ("/joint_states.effort[0]", "no message has a number at .*has effort, header, name, pos"),
        ("/joint_states", "no message has a number at /joint_states;"),
        ("/joint_states.header.frame_id", "no message has a number at"),
    ):
        with pytest.raises(PalpateError, match=said):
            read_recording(path, columns=(column,))


def test_a_number_that_is_missing_for_a_while_was_not_seen(tmp_path):
    rows = messages()
    for _, _, message in rows[20:40]:
        if hasattr(message, "position"):
            message.position = message.position[:1]
    path = write_ros2(tmp_path / "run", rows)
    (trial,) = read_recording(path, columns=(ANGLE,)).trials
    assert np.isnan(trial[ANGLE].values[10:20]).all()
    assert np.isfinite(trial[ANGLE].values[:10]).all()
