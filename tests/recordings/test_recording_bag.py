"""Logs of robots become recordings, whatever container and message they are in, or are refused."""

import sys

import numpy as np
import pytest

from bags import (
    MARKERS,
    POSE,
    START,
    TWIST,
    Ros,
    chain,
    nanoseconds,
    write_mcap,
    write_ros1,
    write_ros2,
)
from palpate.errors import PalpateError
from palpate.recordings import Role
from palpate.recordings.files import read_recording
from palpate.runs.storage import DamagedFileError

pytest.importorskip("rosbags")
pytest.importorskip("mcap")

TIME, CHAIN = chain()
STAMPS = nanoseconds(TIME)
LATE = 2_000_000  # ns from a stamp to its receipt


@pytest.fixture(scope="module")
def ros():
    return Ros()


def arrays(ros, points=CHAIN, stamps=STAMPS, topic=MARKERS, late=LATE, frame="world"):
    return [
        (topic, ns + late, ros.pose_array(ns, p, frame))
        for ns, p in zip(stamps, points, strict=True)
    ]


def poses(ros, points, stamps=STAMPS, topic=POSE, late=LATE, frame="world"):
    return [
        (topic, ns + late, ros.pose_stamped(ns, p, frame))
        for ns, p in zip(stamps, points, strict=True)
    ]


def in_order(*parts):
    return sorted((item for part in parts for item in part), key=lambda item: item[1])


def markers(recording, trial=0):
    return recording.trials[trial]["markers"]


def refused(path, sentence, kind=PalpateError, **options):
    with pytest.raises(kind, match=sentence) as error:
        read_recording(path, **options)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


# --- containers -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("storage", "compress"),
    [
        ("sqlite3", None),
        ("sqlite3", "MESSAGE"),
        ("sqlite3", "FILE"),
        ("mcap", None),
        ("mcap", "STORAGE"),
    ],
)
def test_a_rosbag2_folder(tmp_path, ros, storage, compress):
    path = write_ros2(tmp_path / "run", arrays(ros), storage, compress=compress)
    recording = read_recording(path)
    np.testing.assert_array_equal(markers(recording).values, CHAIN)
    np.testing.assert_allclose(markers(recording).time, TIME, atol=1e-8)
    assert [trial.name for trial in recording.trials] == ["run"]
    assert recording.notes == ()
    assert recording.provenance == {
        "file": str(path),
        "format": f"rosbag2 folder, topic {MARKERS}",
        "unit": "m",
        "up": "z",
    }


def test_a_database_of_an_old_release_that_does_not_hold_its_definitions(tmp_path, ros):
    folder = write_ros2(tmp_path / "run", arrays(ros), definitions=False)
    (database,) = folder.glob("*.db3")
    for path in (folder, database):
        np.testing.assert_array_equal(markers(read_recording(path)).values, CHAIN)


def test_a_ros_1_bag(tmp_path):
    path = write_ros1(tmp_path / "run.bag", arrays(Ros(one=True)))
    recording = read_recording(path)
    np.testing.assert_array_equal(markers(recording).values, CHAIN)
    np.testing.assert_allclose(markers(recording).time, TIME, atol=1e-8)


@pytest.mark.parametrize("compression", ["", "lz4", "zstd"])
@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("indexed", [True, False])
def test_an_mcap_file(tmp_path, ros, compression, chunked, indexed):
    index = {} if indexed else {"repeat_channels": False, "use_statistics": False}
    path = write_mcap(tmp_path / "run.mcap", arrays(ros), compression, chunked, **index)
    np.testing.assert_array_equal(markers(read_recording(path)).values, CHAIN)


def test_an_mcap_file_of_ros_1_and_other_encodings(tmp_path):
    from mcap.writer import Writer

    one = Ros(one=True)
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros1")
        text, _ = one.store.generate_msgdef("geometry_msgs/msg/PoseArray", ros_version=1)
        schema = writer.register_schema("geometry_msgs/PoseArray", "ros1msg", text.encode())
        channel = writer.register_channel(MARKERS, "ros1", schema)
        other = writer.register_channel("/other", "protobuf", 0)
        for topic, ns, message in arrays(one):
            assert topic == MARKERS
            data = one.store.serialize_ros1(message, message.__msgtype__)
            writer.add_message(channel, ns, bytes(data), ns)
            writer.add_message(other, ns, b"\x08\x01", ns)
        writer.finish()
    np.testing.assert_array_equal(markers(read_recording(path)).values, CHAIN)
    sentence = "topic '/other' cannot be read: its messages are encoded as 'protobuf'"
    refused(path, sentence, topics=["/other"])


def test_an_mcap_file_with_json_of_foxglove(tmp_path):
    messages = []
    for ns, points in zip(STAMPS, CHAIN, strict=True):
        turn = {"x": 0, "y": 0, "z": 0, "w": 1}
        items = [
            {"position": dict(zip("xyz", p, strict=True)), "orientation": turn} for p in points
        ]
        stamp = {"sec": ns // 10**9, "nsec": ns % 10**9}
        messages.append((MARKERS, ns, {"timestamp": stamp, "frame_id": "world", "poses": items}))
    messages[7][2]["poses"][1]["position"]["y"] = None  # as JSON writes NaN
    values = markers(read_recording(write_mcap(tmp_path / "r.mcap", messages))).values
    expected = CHAIN.copy()
    expected[7, 1, 1] = np.nan
    np.testing.assert_array_equal(values, expected)


def test_a_recording_in_millimetres_and_y_up(tmp_path, ros):
    turned = 1000 * CHAIN[..., [0, 2, 1]] * [1, 1, -1]
    tool = poses(ros, turned[:, 0])
    path = write_ros2(tmp_path / "run", in_order(arrays(ros, turned), tool))
    recording = read_recording(path, unit="mm", up="y")
    np.testing.assert_allclose(markers(recording).values, CHAIN, atol=1e-12)
    gripper = recording.trials[0]["gripper"]
    np.testing.assert_allclose(gripper.values[:, 0], CHAIN[:, 0], atol=1e-12)
    refused(path, r"looks wrong: pass the right unit, e\.g\. --unit cm")


# --- topics -----------------------------------------------------------------------------------


def test_topics_of_no_interest_are_left_out(tmp_path, ros):
    depth = np.zeros((2000, 3), np.float32)
    messages = [
        *arrays(ros),
        *[("/depth", ns, ros.packed_cloud(ns, depth)) for ns in STAMPS[:3]],
        *[("/text", ns, ros.types["String"]("a")) for ns in STAMPS[:30]],
        ("/empty", STAMPS[3], ros.pose_array(STAMPS[3], [])),
    ]
    recording = read_recording(write_ros2(tmp_path / "run", in_order(messages)))
    assert list(recording.trials[0].channels) == ["markers"]
    assert recording.notes == ()


def test_several_candidates_are_listed_with_what_they_hold(tmp_path, ros):
    messages = in_order(arrays(ros), arrays(ros, CHAIN[::2, :2], STAMPS[::2], "/other"))
    path = write_ros2(tmp_path / "run", messages)
    refused(
        path,
        r"several topics hold markers: /mocap/markers \(4 points, 40 messages\), "
        r"/other \(2 points, 20 messages\); say which with --topics, e\.g\. --topics /mocap",
    )
    chosen = read_recording(path, topics=["/other"])
    np.testing.assert_array_equal(markers(chosen).values, CHAIN[::2, :2])
    refused(path, "several topics hold markers", topics=[MARKERS, "/other"])
    refused(path, "there is no topic '/none'; there are: /mocap/markers", topics=["/none"])


def test_without_markers_the_topics_are_listed(tmp_path, ros):
    messages = [("/text", ns, ros.types["String"]("a")) for ns in STAMPS]
    path = write_ros2(tmp_path / "run", messages)
    refused(path, r"no topic holds markers, .*; there are: /text \(std_msgs/msg/String\)")
    refused(path, "'/text' of type std_msgs/msg/String has no messages that show", topics=["/text"])


def test_a_pose_at_the_first_marker_is_the_gripper(tmp_path, ros):
    messages = in_order(arrays(ros), poses(ros, CHAIN[:, 0] + [0, 0, 0.03]))
    recording = read_recording(write_ros2(tmp_path / "run", messages))
    gripper = recording.trials[0]["gripper"]
    assert gripper.role is Role.DRIVEN
    np.testing.assert_array_equal(gripper.values, CHAIN[:, :1] + [0, 0, 0.03])
    assert "/tool stays at the first marker and is taken as the gripper" in recording.notes[0]


@pytest.mark.parametrize(("away", "frame"), [(0.5, "world"), (0.0, "base")])
def test_a_pose_elsewhere_is_not_taken_unasked(tmp_path, ros, away, frame):
    messages = in_order(arrays(ros), poses(ros, CHAIN[:, 0] + [0, 0, away], frame=frame))
    path = write_ros2(tmp_path / "run", messages)
    recording = read_recording(path)
    assert list(recording.trials[0].channels) == ["markers"]
    assert "poses were left out: /tool; --topics takes one" in recording.notes[0]
    if frame == "world":
        assert "gripper" in read_recording(path, topics=[MARKERS, POSE]).trials[0].channels
    else:
        refused(path, "'/tool' is in the frame 'base' and .* in 'world'", topics=[MARKERS, POSE])


def test_an_order_in_force_when_a_trial_begins_is_kept(tmp_path, ros):
    twists = [
        (TWIST, START - 10**9, ros.twist((0.1, 0, 0))),
        (TWIST, START + 5 * 10**8, ros.twist((0.2, 0, 0))),
    ]
    path = write_ros2(tmp_path / "run", in_order(arrays(ros, late=0), twists))
    command = read_recording(path, topics=[TWIST]).trials[0]["command"]
    assert (command.role, command.unit) == (Role.COMMAND, "m/s")
    np.testing.assert_allclose(command.time, [-1, 0.5])
    np.testing.assert_allclose(command.values[:, 0, 0], [0.1, 0.2])


def test_a_transform_is_named_by_its_child(tmp_path, ros):
    transforms = [
        ("/tf", ns, ros.transforms(ns, {"tool": p, "camera": (1, 2, 3)}))
        for ns, p in zip(STAMPS, CHAIN[:, 0], strict=True)
    ]
    path = write_ros2(tmp_path / "run", in_order(arrays(ros), transforms))
    recording = read_recording(path, topics=[MARKERS, "/tf:tool"])
    np.testing.assert_array_equal(recording.trials[0]["gripper"].values, CHAIN[:, :1])
    refused(path, "'/tf' holds transforms: name one of them, /tf:tool, /tf:camera", topics=["/tf"])
    assert "poses were left out: /tf:tool, /tf:camera" in read_recording(path).notes[0]


def test_a_pose_with_nan_cannot_drive(tmp_path, ros):
    where = CHAIN[:, 0].copy()
    where[20] = np.nan
    path = write_ros2(tmp_path / "run", in_order(arrays(ros), poses(ros, where)))
    refused(
        path, r"trial 'run': channel 'gripper' is a driven input but NaN at row 20", topics=[POSE]
    )


# --- markers ----------------------------------------------------------------------------------


def test_markers_with_names_are_told_apart_by_them(tmp_path, ros):
    messages = []
    expected = CHAIN.copy()
    for row, (ns, points) in enumerate(zip(STAMPS, CHAIN, strict=True)):
        items = [ros.marker(ns, "rope", 10 - i, p) for i, p in enumerate(points)]
        if row % 5 == 0:
            items.reverse()
        if row in (3, 30):
            items = [item for item in items if item.id != 9]
            expected[row, 1] = np.nan
        items.append(ros.marker(ns, "gone", 0, (9, 9, 9), action=2))
        items.append(ros.marker(ns, "title", 0, (9, 9, 9), kind=9))
        messages.append((MARKERS, ns, ros.marker_array(items)))
    recording = read_recording(write_ros2(tmp_path / "run", messages))
    np.testing.assert_array_equal(markers(recording).values, expected[:, ::-1])
    assert recording.provenance["markers"] == "rope/7, rope/8, rope/9, rope/10"


def test_a_list_of_points_that_is_one_marker(tmp_path, ros):
    half = np.sqrt(0.5)
    messages = []
    for ns, points in zip(STAMPS, CHAIN, strict=True):
        inside = np.stack([points[:, 1], -points[:, 0], points[:, 2] - 2], -1)  # turned by 90 deg
        item = ros.marker(ns, "", 0, (0, 0, 2), 7, points=inside, wxyz=(half, 0, 0, half))
        messages.append((MARKERS, ns, item))
    alone = read_recording(write_ros2(tmp_path / "alone", messages))
    np.testing.assert_allclose(markers(alone).values, CHAIN, atol=1e-12)
    listed = [(topic, ns, ros.marker_array([item])) for topic, ns, item in messages]
    listed = read_recording(write_ros2(tmp_path / "listed", listed))
    np.testing.assert_allclose(markers(listed).values, CHAIN, atol=1e-12)


@pytest.mark.parametrize("kind", ["point_cloud", "packed_cloud"])
def test_clouds(tmp_path, ros, kind):
    points = CHAIN.astype(np.float32)
    points[4, 2] = np.nan
    make = getattr(ros, kind)
    messages = [(MARKERS, ns, make(ns, p)) for ns, p in zip(STAMPS, points, strict=True)]
    recording = read_recording(write_ros2(tmp_path / "run", messages))
    np.testing.assert_array_equal(markers(recording).values, points)


def test_a_message_with_another_number_of_points_shows_nothing(tmp_path, ros):
    messages = arrays(ros)
    messages[20] = (MARKERS, messages[20][1], ros.pose_array(STAMPS[20], CHAIN[20, :3]))
    recording = read_recording(write_ros2(tmp_path / "run", messages))
    assert np.isnan(markers(recording).values[20]).all()
    assert np.isfinite(np.delete(markers(recording).values, 20, 0)).all()
    assert "1 of 40 messages do not hold 4 markers and show nothing" in recording.notes[0]


def test_numbers_of_points_that_keep_changing_are_refused(tmp_path, ros):
    points = [p[: 2 + i % 3] for i, p in enumerate(CHAIN)]
    path = write_ros2(tmp_path / "run", arrays(ros, points))
    refused(path, "has 2 to 4 markers without names in a message, so nobody can say which is which")


def test_a_topic_that_changes_its_frame_is_refused(tmp_path, ros):
    messages = [*arrays(ros), *arrays(ros, CHAIN, nanoseconds(TIME + 2), frame="base")]
    refused(write_ros2(tmp_path / "run", messages), "changes its frame: base, world")


# --- time -------------------------------------------------------------------------------------


def test_stamps_of_the_sender_are_preferred_and_put_in_order(tmp_path, ros):
    messages = arrays(ros)
    jitter = np.random.default_rng(0).integers(0, 90_000_000, len(messages))
    jittered = [(t, ns + int(late), m) for (t, ns, m), late in zip(messages, jitter, strict=True)]
    recording = read_recording(write_ros2(tmp_path / "run", in_order(jittered)))
    np.testing.assert_allclose(markers(recording).time, TIME, atol=1e-8)
    np.testing.assert_array_equal(markers(recording).values, CHAIN)
    assert "rows were out of order" in recording.notes[0]


@pytest.mark.parametrize("stamp", [0, START])
def test_without_stamps_time_is_that_of_receipt(tmp_path, ros, stamp):
    messages = [
        (t, ns, ros.pose_array(stamp, p)) for (t, ns, _), p in zip(arrays(ros), CHAIN, strict=True)
    ]
    recording = read_recording(write_ros2(tmp_path / "run", messages))
    np.testing.assert_allclose(markers(recording).time, TIME, atol=1e-8)
    assert "no stamps of their own, so time is that of receipt" in recording.notes[0]


def test_clocks_that_disagree_are_not_mixed(tmp_path, ros):
    """The gripper's computer is 40 s ahead: by its stamps it would never meet the markers."""
    ahead = [ns + 40 * 10**9 for ns in STAMPS]
    tool = poses(ros, CHAIN[:, 0], ahead, late=-40 * 10**9 + LATE)
    recording = read_recording(write_ros2(tmp_path / "run", in_order(arrays(ros), tool)))
    np.testing.assert_allclose(recording.trials[0]["gripper"].time, TIME, atol=1e-8)
    assert any("clocks of the topics are 40 s apart" in note for note in recording.notes)
    recording.align(0.04, "markers", "gripper")


def test_a_common_clock_that_is_not_that_of_the_recorder_is_kept(tmp_path, ros):
    """As in simulation, where stamps begin at zero."""
    stamps = [ns - START + 10**9 for ns in STAMPS]
    late = START - 10**9
    messages = in_order(
        arrays(ros, stamps=stamps, late=late),
        poses(ros, CHAIN[:, 0], stamps, late=late + 40_000_000),
    )
    recording = read_recording(write_ros2(tmp_path / "run", messages))
    for channel in recording.trials[0].channels.values():
        np.testing.assert_allclose(channel.time, TIME, atol=1e-8)


def test_a_gap_begins_a_new_trial_and_short_pieces_are_left_out(tmp_path, ros):
    time = np.concatenate([np.arange(40), 60 + np.arange(5), 100 + np.arange(30)]) / 25
    _, points = chain(len(time))
    stamps = nanoseconds(time)
    messages = in_order(arrays(ros, points, stamps), poses(ros, points[:, 0], stamps))
    recording = read_recording(write_ros2(tmp_path / "run", messages))
    assert [trial.name for trial in recording.trials] == ["run/0", "run/1"]
    for trial, rows in zip(recording.trials, (slice(0, 40), slice(45, 75)), strict=True):
        for channel in trial.channels.values():
            np.testing.assert_allclose(channel.time, time[rows], atol=1e-8)
        np.testing.assert_array_equal(trial["markers"].values, points[rows])
    assert any("1 pieces of less than 1 s between gaps" in note for note in recording.notes)
    recording.align(0.04, "markers", "gripper")


def test_a_gap_of_the_gripper_counts_too(tmp_path, ros):
    time, points = chain(100)
    stamps = nanoseconds(time)
    there = [i for i in range(100) if not 40 <= i < 60]
    tool = poses(ros, points[there, 0], [stamps[i] for i in there])
    recording = read_recording(
        write_ros2(tmp_path / "run", in_order(arrays(ros, points, stamps), tool))
    )
    assert [len(trial["markers"].time) for trial in recording.trials] == [40, 40]
    recording.align(0.04, "markers", "gripper")


def test_topics_that_never_meet_are_refused(tmp_path, ros):
    later = nanoseconds(TIME + 100)
    path = write_ros2(tmp_path / "run", in_order(arrays(ros), poses(ros, CHAIN[:, 0], later)))
    refused(path, "no time is covered by all of them without gaps", topics=[MARKERS, POSE])


# --- refusals ---------------------------------------------------------------------------------


def test_without_the_extra_a_sentence_says_which(tmp_path, ros, monkeypatch):
    path = write_mcap(tmp_path / "run.mcap", arrays(ros)[:3])
    monkeypatch.setitem(sys.modules, "rosbags", None)
    refused(path, r"needs rosbags, which is not .* `pip install 'palpate\[io\]'")


def test_what_is_no_log_is_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    refused(tmp_path / "folder", "no metadata.yaml: expected one that `ros2 bag record` has")
    for suffix in ("mcap", "bag", "db3"):
        path = tmp_path / f"r.{suffix}"
        path.write_bytes(b"")
        refused(path, "the file is empty", DamagedFileError)
        path.write_bytes(b"\x80\x04\x95\x10\x00cposix\nsystem\n(S'true'\ntR." * 40)  # a pickle
        refused(path, "damaged or no|the file has no end", DamagedFileError)
    with pytest.raises(PalpateError, match=r"cannot read .*No such file"):
        read_recording(tmp_path / "none.mcap")
    refused(tmp_path / "folder" / "r.npz", "only logs have topics", topics=["/a"])


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.99])
@pytest.mark.parametrize("suffix", ["mcap", "bag", "db3"])
def test_a_file_that_was_cut_off_is_refused(tmp_path, ros, suffix, share):
    if suffix == "bag":
        path = write_ros1(tmp_path / "r.bag", arrays(Ros(one=True)))
    elif suffix == "mcap":
        path = write_mcap(tmp_path / "r.mcap", arrays(ros))
    else:
        (path,) = write_ros2(tmp_path / "r", arrays(ros)).glob("*.db3")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused(path, "cut off|damaged|promises", DamagedFileError)


def test_clocks_that_show_the_impossible_are_refused(tmp_path, ros):
    path = write_mcap(tmp_path / "run.mcap", [(MARKERS, 2**63, ros.pose_array(1, CHAIN[0]))])
    refused(path, "a message was received 9223372036854775808 ns after 1970", DamagedFileError)
    pose = {"timestamp": {"sec": 10**30, "nsec": 0}, "points": [{"x": 0, "y": 0, "z": 0}] * 3}
    path = write_mcap(tmp_path / "run.mcap", [(MARKERS, START, pose)])
    refused(path, r"not read: a message of it is damaged \(a stamp of 10{30} s\)")


def test_a_folder_that_lacks_some_of_its_messages_is_refused(tmp_path, ros):
    folder = write_ros2(tmp_path / "run", arrays(ros))
    (there,) = folder.glob("*.db3")
    (fewer,) = write_ros2(tmp_path / "fewer" / "run", arrays(ros)[:20]).glob("*.db3")
    there.write_bytes(fewer.read_bytes())
    refused(folder, "has 20 messages, but the index of the file promises 40", DamagedFileError)


def test_a_damaged_chunk_is_refused(tmp_path, ros):
    path = write_mcap(tmp_path / "run.mcap", arrays(ros), "")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    refused(path, "damaged", DamagedFileError)
