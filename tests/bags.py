"""Logs of robots, written small: rosbag2 folders, ROS 1 bags and MCAP files for the tests."""

import contextlib
import json
import sqlite3

import numpy as np

MARKERS, POSE, TWIST = "/mocap/markers", "/tool", "/order"
START = 1_700_000_000 * 10**9  # ns


def chain(frames=40, markers=4, rate=25.0):
    """(time in s, positions) of a chain that swings below its first marker."""
    time = np.arange(frames) / rate
    reach = 0.1 * np.arange(markers)
    angle = 0.3 * np.sin(5 * time)[:, None]
    first = np.stack([0.1 * time, 0 * time, 1 + 0 * time], -1)[:, None]
    swing = np.stack([reach * np.sin(angle), 0 * angle * reach, -reach * np.cos(angle)], -1)
    return time, first + swing


def nanoseconds(time):
    return [START + round(float(t) * 1e9) for t in time]


class Ros:
    """Messages of one release of ROS: `ros.PoseArray(header, poses)`."""

    def __init__(self, one=False):
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.one = one
        self.store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
        if one:  # rosbags knows no tf2 of ROS 1, whose bags bring their definitions
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        types = sorted(self.store.types.items(), key=lambda item: "builtin" in item[0])
        self.types = {name.split("/")[-1]: kind for name, kind in types}

    def stamp(self, ns):
        return self.types["Time"](ns // 10**9, ns % 10**9)

    def header(self, ns, frame="world"):
        extra = {"seq": 0} if self.one else {}
        return self.types["Header"](stamp=self.stamp(ns), frame_id=frame, **extra)

    def point(self, xyz):
        return self.types["Point"](*map(float, xyz))

    def vector(self, xyz):
        return self.types["Vector3"](*map(float, xyz))

    def turn(self, wxyz=(1.0, 0.0, 0.0, 0.0)):
        w, x, y, z = map(float, wxyz)
        return self.types["Quaternion"](x, y, z, w)

    def pose(self, xyz, wxyz=(1.0, 0.0, 0.0, 0.0)):
        return self.types["Pose"](self.point(xyz), self.turn(wxyz))

    def pose_array(self, ns, points, frame="world"):
        return self.types["PoseArray"](self.header(ns, frame), [self.pose(p) for p in points])

    def pose_stamped(self, ns, point, frame="world"):
        return self.types["PoseStamped"](self.header(ns, frame), self.pose(point))

    def point_cloud(self, ns, points):
        item = self.types["Point32"]
        points = [item(*map(float, p)) for p in points]
        return self.types["PointCloud"](self.header(ns), points, [])

    def packed_cloud(self, ns, points, frame="world", padding=0, extra=4):
        """A PointCloud2 of one row, with something between the coordinates."""
        item = self.types["PointField"]
        fields = [item(a, o, 7, 1) for a, o in zip("xyz", (0, 4, 8 + extra), strict=True)]
        step = 12 + extra
        data = np.zeros((len(points), step), np.uint8)
        for axis, offset in enumerate((0, 4, 8 + extra)):
            column = np.ascontiguousarray(points[:, axis], "<f4").view(np.uint8)
            data[:, offset : offset + 4] = column.reshape(-1, 4)
        data = np.concatenate([data.ravel(), np.zeros(padding, np.uint8)])
        width = len(points)
        return self.types["PointCloud2"](
            self.header(ns, frame), 1, width, fields, False, step, len(data), data, False
        )

    def marker(self, ns, space, number, xyz, kind=2, action=0, points=(), wxyz=(1, 0, 0, 0)):
        values = {
            "header": self.header(ns),
            "ns": space,
            "id": number,
            "type": kind,
            "action": action,
            "pose": self.pose(xyz, wxyz),
            "scale": self.vector((0.01,) * 3),
            "color": self.types["ColorRGBA"](1.0, 0.0, 0.0, 1.0),
            "lifetime": self.types["Duration"](0, 0),
            "frame_locked": False,
            "points": [self.point(p) for p in points],
            "colors": [],
            "text": "",
            "mesh_resource": "",
            "mesh_use_embedded_materials": False,
        }
        if not self.one:
            empty = np.zeros(0, np.uint8)
            header = self.header(0, "")
            values |= {
                "texture_resource": "",
                "texture": self.types["CompressedImage"](header, "", empty),
                "uv_coordinates": [],
                "mesh_file": self.types["MeshFile"]("", empty),
            }
        return self.types["Marker"](**values)

    def marker_array(self, items):
        return self.types["MarkerArray"](items)

    def twist(self, velocity):
        return self.types["Twist"](self.vector(velocity), self.vector((0, 0, 0)))

    def transforms(self, ns, children, frame="world"):
        item, transform = self.types["TransformStamped"], self.types["Transform"]
        return self.types["TFMessage"](
            [
                item(self.header(ns, frame), child, transform(self.vector(xyz), self.turn()))
                for child, xyz in children.items()
            ]
        )


def write_ros2(folder, messages, storage="sqlite3", definitions=True, compress=None):
    """`messages`: (topic, ns of receipt, message) in a rosbag2 folder."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    ros = Ros()
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if compress:
        writer.set_compression(CompressionMode[compress], CompressionFormat.ZSTD)
    with writer:
        _write(writer, messages, ros.store, ros.store.serialize_cdr)
    if not definitions:  # as before ROS 2 Iron
        (database,) = folder.glob("*.db3")
        with contextlib.closing(sqlite3.connect(database)) as connection, connection:
            connection.execute("DELETE FROM message_definitions")
    return folder


def write_ros1(path, messages):
    """`messages`: (topic, ns of receipt, message) in a ROS 1 bag."""
    from rosbags.rosbag1 import Writer

    ros = Ros(one=True)
    with Writer(path) as writer:
        _write(writer, messages, ros.store, ros.store.serialize_ros1)
    return path


def _write(writer, messages, store, serialize):
    connections = {}
    for topic, ns, message in messages:
        kind = message.__msgtype__
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        writer.write(connections[topic], ns, serialize(message, kind))


def write_mcap(path, messages, compression="zstd", chunked=True, **summary):
    """`messages`: (topic, ns of receipt, dictionary or ROS message) in one MCAP file."""
    from mcap.writer import CompressionType, Writer

    ros = Ros()
    with path.open("wb") as file:
        kinds = {"": CompressionType.NONE, "lz4": CompressionType.LZ4}
        writer = Writer(
            file,
            compression=kinds.get(compression, CompressionType.ZSTD),
            use_chunking=chunked,
            **summary,
        )
        writer.start()
        channels = {}
        for topic, ns, message in messages:
            if topic not in channels:
                channels[topic] = _channel(writer, topic, message, ros)
            if isinstance(message, dict):
                data = json.dumps(message).encode()
            else:
                data = bytes(ros.store.serialize_cdr(message, message.__msgtype__))
            writer.add_message(channels[topic], ns, data, ns)
        writer.finish()
    return path


def _channel(writer, topic, message, ros):
    if isinstance(message, dict):
        schema = writer.register_schema("test.Message", "jsonschema", b'{"type": "object"}')
        return writer.register_channel(topic, "json", schema)
    kind = message.__msgtype__
    text, _ = ros.store.generate_msgdef(kind, ros_version=2)
    schema = writer.register_schema(kind, "ros2msg", text.encode())
    return writer.register_channel(topic, "cdr", schema)
