"""What one message of a robot's log shows: markers, a pose, or an ordered velocity.

A message is a tree: objects with named fields (ROS) or dictionaries (JSON). It is read by its
shape and not by the name of its type, so that message types of one laboratory are read too.
"""

import base64
import enum
from dataclasses import dataclass
from typing import Any

import numpy as np

MAX_POINTS = 1000  # points in a message; more are the surface that a depth camera sees, not markers
MAX_STAMP = 2**62  # ns after 1970 that a clock may show: the year 2116
_FLOATS = {7: "f4", 8: "f8"}  # of sensor_msgs/PointField, and of foxglove.PackedElementField
_NO_POINT = {9}  # visualization_msgs/Marker: a text
_DELETED = {2, 3}  # visualization_msgs/Marker: an order to forget earlier ones
_LABELS = ("marker_name", "name", "label", "id", "marker_index", "index")


class Kind(enum.Enum):
    """What a topic shows."""

    MARKERS = "markers"
    POSE = "pose"
    VELOCITY = "velocity"


@dataclass(frozen=True, eq=False)
class Sight:
    """What a message shows: `points` (points, 3), NaN for what was not seen.

    `stamp` is when it was measured, in ns on the sender's clock; None if the message does not say.
    `frame` is the coordinate frame; None if the message does not say. `names` of the points, all
    different, where they have any. `child` is what a transform leads to.
    """

    kind: Kind
    points: np.ndarray
    stamp: int | None
    frame: str | None
    names: tuple[str, ...] | None = None
    child: str = ""


def sights(message: Any) -> list[Sight]:
    """All that `message` shows; nothing for a message of another kind.

    - *Markers*: a list of items that each have a place (geometry_msgs/PoseArray,
      visualization_msgs/MarkerArray and Marker, sensor_msgs/PointCloud, the marker arrays of Vicon,
      Qualisys and OptiTrack drivers, foxglove.PosesInFrame), or a packed cloud
      (sensor_msgs/PointCloud2, foxglove.PointCloud) of at most 1000 points.
    - *Pose*: one place (PoseStamped, PointStamped, TransformStamped, Odometry, ...), or one for
      each transform of tf2_msgs/TFMessage.
    - *Velocity*: Twist and TwistStamped.
    """
    transforms = _field(message, "transforms")
    if isinstance(transforms, list):
        return [sight for item in transforms if (sight := _pose(item))]
    found = _markers(message) or _pose(message) or _velocity(message)
    return [found] if found else []


def named_fields(item: Any) -> dict[str, Any]:
    """The fields of an object or a dictionary by name; none of anything else."""
    return item if isinstance(item, dict) else getattr(item, "__dict__", {})


def _field(item: Any, *path: str) -> Any:
    """The field of a field of `item`; None where there is none."""
    for name in path:
        item = named_fields(item).get(name)
    return item


# --- many places ------------------------------------------------------------------------------


def _markers(message: Any) -> Sight | None:
    names = None
    items: list[Any] = []
    if _field(message, "fields") is not None:
        points = cloud_points(message)
    else:
        values = [
            value
            for own in named_fields(message).values()
            for value in (own, *named_fields(own).values())
        ]
        lists = (value for value in values if isinstance(value, list) and value)
        items = next((value for value in lists if _place(value[0]) is not None), [])
        if not items or len(items) > MAX_POINTS:
            return None
        there = [item for item in items if _field(item, "action") not in _DELETED]
        points, names = _places(there)
        # visualization_msgs/Marker: its points lie in a frame of their own
        points = _move(points, _field(message, "pose"))
    if points is None or len(points) > MAX_POINTS:
        return None
    stamp, frame = header(message)
    if stamp is None and frame is None and items:
        stamp, frame = header(items[0])
    return Sight(Kind.MARKERS, points, stamp, frame, names)


def _places(items: list[Any]) -> tuple[np.ndarray, tuple[str, ...] | None]:
    """(points, 3) and the names of items, or the points of the only one that is a list of them."""
    lists = [item for item in items if _field(item, "points")]
    single = [
        item
        for item in items
        if not _field(item, "points") and _field(item, "type") not in _NO_POINT
    ]
    if len(lists) == 1 and not single:
        points, _ = _places(_field(lists[0], "points"))
        return _move(points, _field(lists[0], "pose")), None
    places = [_place(item) for item in single]
    hidden = [_field(item, "occluded") is True for item in single]
    if None in places:
        raise ValueError("some items of a list have a place and others do not")
    points = np.array(places, np.float64).reshape(-1, 3)
    points[np.array(hidden, bool)] = np.nan
    names = [_name(item) for item in single]
    if "" in names or len(set(names)) < len(names):
        return points, None
    return points, tuple(names)


def _name(item: Any) -> str:
    """What tells an item from the others, where anything does."""
    for label in _LABELS:
        value = _field(item, label)
        if isinstance(value, str | int) and value != "":
            space = _field(item, "ns")
            return f"{space}/{value}" if space else str(value)
    return ""


def cloud_points(message: Any, most: int = MAX_POINTS) -> np.ndarray | None:
    """(points, 3) of a packed cloud; None if it has no x, y and z in floating point, or more than
    `most` of them.

    Raises `ValueError` for one whose bytes are not as many as it says.
    """
    packed = {_field(field, "name"): field for field in _field(message, "fields")}
    step = _field(message, "point_step") or _field(message, "point_stride")
    if not {"x", "y", "z"} <= packed.keys() or not isinstance(step, int):
        return None
    order = ">" if _field(message, "is_bigendian") else "<"
    formats, offsets = [], []
    for axis in "xyz":
        kind = _field(packed[axis], "datatype") or _field(packed[axis], "type")
        if kind not in _FLOATS:
            return None
        formats.append(order + _FLOATS[kind])
        offsets.append(_field(packed[axis], "offset"))
    height, width = _field(message, "height"), _field(message, "width")
    if height is not None and height * width > most:
        return None
    data = _field(message, "data")
    data = base64.b64decode(data, validate=True) if isinstance(data, str) else bytes(data)
    row = np.dtype({"names": [*"xyz"], "formats": formats, "offsets": offsets, "itemsize": step})
    if height is not None and (stride := _field(message, "row_step")) > step * width:
        lines = np.frombuffer(data, np.uint8).reshape(height, stride)[:, : step * width]
        data = lines.tobytes()  # rows of an organised cloud may be padded
    if height is not None and len(data) != height * width * step:
        raise ValueError(f"{len(data)} bytes for {height} x {width} points of {step} bytes")
    points = np.frombuffer(data, row)
    return np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=-1)


def _move(points: np.ndarray, pose: Any) -> np.ndarray:
    """`points` (points, 3) of the frame that lies at `pose`, in the frame in which it lies there.

    A quaternion of length 0, as an unset one has, turns nothing.
    """
    origin = _point(_field(pose, "position"))
    turn = [_field(pose, "orientation", axis) for axis in "wxyz"]
    if origin is None or None in turn:
        return points
    w, *v = np.array(turn, np.float64)
    squared = w * w + np.dot(v, v)
    if squared > 0:
        # v' = v + 2 w (u x v) + 2 u x (u x v), divided by the quaternion's squared length
        twice = 2 * np.cross(v, points) / squared
        points = points + w * twice + np.cross(v, twice)
    return points + origin


# --- one place --------------------------------------------------------------------------------


def _pose(message: Any) -> Sight | None:
    place = _place(message)
    if place is None:
        return None
    stamp, frame = header(message)
    child = _field(message, "child_frame_id")
    return Sight(Kind.POSE, np.array([place]), stamp, frame, child=child or "")


def _velocity(message: Any) -> Sight | None:
    for path in (("linear",), ("twist", "linear"), ("twist", "twist", "linear")):
        velocity = _point(_field(message, *path))
        if velocity is not None:
            return Sight(Kind.VELOCITY, np.array([velocity]), *header(message))
    return None


def _place(item: Any) -> list[float] | None:
    """x, y, z of a point, pose or transform, however deep it stands."""
    for path in (
        (),
        ("position",),
        ("translation",),
        ("point",),
        ("pose", "position"),
        ("pose", "pose", "position"),
        ("transform", "translation"),
    ):
        place = _point(_field(item, *path))
        if place is not None:
            return place
    return None


def _point(item: Any) -> list[float] | None:
    """x, y, z of what has these and no w; null, which JSON has for NaN, is NaN."""
    fields = named_fields(item)
    if "w" in fields or not {*"xyz"} <= fields.keys():
        return None
    values = [fields[axis] for axis in "xyz"]
    if not all(value is None or isinstance(value, int | float) for value in values):
        return None
    return [float("nan") if value is None else float(value) for value in values]


def header(message: Any) -> tuple[int | None, str | None]:
    """(ns, frame) of a message: `header` in ROS, `timestamp` and `frame_id` in Foxglove's JSON."""
    places = ("header", "frame_id"), ("frame_id",), ("parent_frame_id",)
    frame = next((f for place in places if (f := _field(message, *place)) is not None), None)
    stamp = _field(message, "header", "stamp") or _field(message, "timestamp")
    seconds = _field(stamp, "sec")
    fraction = _field(stamp, "nanosec")
    fraction = _field(stamp, "nsec") if fraction is None else fraction
    frame = frame if isinstance(frame, str) else None
    if not isinstance(seconds, int) or not isinstance(fraction, int):
        return None, frame
    if not 0 <= seconds * 10**9 + fraction < MAX_STAMP:
        raise ValueError(f"a stamp of {seconds} s")
    return seconds * 10**9 + fraction or None, frame
