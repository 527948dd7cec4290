"""What a message shows is read off its shape, and definitions are not trusted."""

import base64
import sys

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.recordings.rosbag.messages import MAX_POINTS, Kind, sights

POINTS = np.arange(12.0).reshape(4, 3)


def xyz(point):
    return dict(zip("xyz", map(float, point), strict=True))


def only(message):
    (sight,) = sights(message)
    return sight


@pytest.mark.parametrize(
    "wrap",
    [
        xyz,
        lambda p: {"position": xyz(p), "orientation": {"w": 1.0, **xyz((0, 0, 0))}},
        lambda p: {"pose": {"position": xyz(p)}},
        lambda p: {"pose": {"pose": {"position": xyz(p)}}},
        lambda p: {"translation": xyz(p)},
        lambda p: {"point": xyz(p)},
    ],
)
def test_lists_of_places_are_markers_and_one_place_is_a_pose(wrap):
    sight = only({"header": {"frame_id": "map"}, "things": [wrap(p) for p in POINTS]})
    assert (sight.kind, sight.frame, sight.stamp) == (Kind.MARKERS, "map", None)
    np.testing.assert_array_equal(sight.points, POINTS)
    deeper = only({"polygon": {"points": [wrap(p) for p in POINTS]}})
    np.testing.assert_array_equal(deeper.points, POINTS)
    single = only({"header": {"stamp": {"sec": 1, "nanosec": 5}}, **wrap(POINTS[1])})
    assert (single.kind, single.stamp) == (Kind.POSE, 1_000_000_005)
    np.testing.assert_array_equal(single.points, POINTS[1:2])


def test_markers_of_motion_capture_drivers():
    vicon = [
        {"marker_name": f"m{i}", "occluded": i == 2, "translation": xyz(p)}
        for i, p in enumerate(POINTS)
    ]
    sight = only({"header": {}, "frame_number": 3, "markers": vicon})
    assert sight.names == ("m0", "m1", "m2", "m3")
    assert np.isnan(sight.points[2]).all()
    np.testing.assert_array_equal(sight.points[[0, 1, 3]], POINTS[[0, 1, 3]])
    numbered = [
        {"marker_name": "", "marker_index": i, "translation": xyz(p)} for i, p in enumerate(POINTS)
    ]
    assert only({"markers": numbered}).names == ("0", "1", "2", "3")
    twins = [{"name": "m", "position": xyz(p)} for p in POINTS]
    assert only({"markers": twins}).names is None


def test_velocities_and_transforms():
    sight = only({"header": {"frame_id": "a"}, "twist": {"linear": xyz((1, 2, 3)), "angular": {}}})
    assert (sight.kind, sight.frame) == (Kind.VELOCITY, "a")
    np.testing.assert_array_equal(sight.points, [[1, 2, 3]])
    transform = {"child_frame_id": "hand", "transform": {"translation": xyz((1, 2, 3))}}
    assert [(s.kind, s.child) for s in sights({"transforms": [transform] * 2})] == [
        (Kind.POSE, "hand")
    ] * 2


@pytest.mark.parametrize(
    "message",
    [
        {},
        [],
        None,
        7,
        "text",
        {"data": "x"},
        {"x": 1, "y": 2, "z": 3, "w": 1},
        {"x": "1", "y": 2, "z": 3},
        {"names": ["a", "b"], "position": [1.0, 2.0]},
        {"colors": [{"r": 1, "g": 1, "b": 1, "a": 1}]},
        {"points": [xyz((0, 0, 0))] * (MAX_POINTS + 1)},
        {"fields": [], "data": "", "point_stride": 4},
    ],
)
def test_other_messages_show_nothing(message):
    assert sights(message) == []


def packed(axes="xyz", kind=7, offset=4, stride=16, count=4, swap=False):
    data = np.zeros((count, stride), np.uint8)
    fields = []
    dtype = (">" if swap else "<") + {7: "f4", 8: "f8", 5: "u4"}[kind]
    for number, axis in enumerate(axes):
        at = offset + number * np.dtype(dtype).itemsize
        column = POINTS[:count, number].astype(dtype)[:, None].view(np.uint8)
        data[:, at : at + column.shape[1]] = column
        fields.append({"name": axis, "offset": at, "datatype": kind})
    return fields, data


def test_packed_clouds():
    for kind, stride in ((7, 16), (8, 28)):
        fields, data = packed(kind=kind, stride=stride, swap=True)
        message = {
            "fields": fields,
            "is_bigendian": True,
            "point_step": stride,
            "row_step": 2 * stride + 3,
            "height": 2,
            "width": 2,
            "data": np.pad(data.reshape(2, -1), ((0, 0), (0, 3))).ravel(),
        }
        np.testing.assert_array_equal(only(message).points, POINTS)
        with pytest.raises(ValueError, match=r"reshape|bytes"):
            sights({**message, "data": message["data"][:-1]})
    fields, data = packed()
    text = base64.b64encode(data.tobytes()).decode()
    foxglove = [{"name": f["name"], "offset": f["offset"], "type": f["datatype"]} for f in fields]
    message = {"frame_id": "a", "fields": foxglove, "point_stride": 16, "data": text}
    np.testing.assert_array_equal(only(message).points, POINTS)
    assert sights({**message, "fields": foxglove[:2]}) == []
    integers, _ = packed(kind=5)
    assert sights({**message, "fields": integers}) == []


def test_a_list_of_which_some_have_no_place_is_refused():
    with pytest.raises(ValueError, match="some items of a list have a place and others do not"):
        sights({"markers": [xyz((0, 0, 0)), {"name": "b"}]})


# --- definitions ------------------------------------------------------------------------------


RULE = "\n" + "=" * 80 + "\n"


@pytest.mark.parametrize(
    ("kind", "definition", "sentence"),
    [
        ("a/msg/B", "float64[100000000] x", "'x' is an array of 100000000 elements; at most 4096"),
        ("a/msg/B", f"C[5000] x{RULE}MSG: a/C\nbool y", "an array of 5000 elements"),
        ("a/msg/B", "float64 x]\nbool y", "its definition is damaged"),
        ("a/msg/B:\n  pass\nimport sys; sys.pwned = 1\nclass C", "float64 x", "is damaged"),
        ("a/msg/1", "float64 x", "its definition has a type called 'a/msg/1'"),
        ("no/msg/Type", "", "its definition is not in the file"),
    ],
)
def test_definitions_that_cannot_be_used_are_refused(kind, definition, sentence):
    pytest.importorskip("rosbags")
    from palpate.recordings.rosbag.decoding import ros_decoder

    with pytest.raises(PalpateError, match=sentence) as error:
        ros_decoder(kind, definition, "ros2msg")
    assert "\n" not in str(error.value)
    assert not hasattr(sys, "pwned")


@pytest.mark.parametrize(
    "definition",
    [
        'string C=\'"""\\nimport sys; sys.pwned = 1\'\na/C x',
        "float64 x\nimport os",
        "B x",
    ],
)
def test_definitions_with_unknown_types_fail_when_a_message_comes(definition):
    pytest.importorskip("rosbags")
    from palpate.recordings.rosbag.decoding import ros_decoder

    decode = ros_decoder("a/msg/B", definition, "ros2msg")
    with pytest.raises((KeyError, RecursionError)):
        decode(bytes(16))
    assert not hasattr(sys, "pwned")


def test_definitions_in_idl():
    pytest.importorskip("rosbags")
    from palpate.recordings.rosbag.decoding import ros_decoder

    idl = (
        "="
        * 80
        + "\nIDL: a/msg/Point\nmodule a { module msg { struct Point { double x; double y; double z;"
        " }; }; };\n"
        + "="
        * 80
        + "\nIDL: a/msg/Points\nmodule a { module msg { struct Points { sequence<a::msg::Point> "
        "points; }; }; };\n"
    )
    decode = ros_decoder("a/msg/Points", idl, "ros2idl")
    body = b"\x00\x01\x00\x00" + np.uint32(2).tobytes() + bytes(4) + POINTS[:2].tobytes()
    np.testing.assert_array_equal(only(decode(body)).points, POINTS[:2])
