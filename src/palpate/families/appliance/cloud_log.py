"""Actions on an appliance of yours as a log of ROS: clouds of points, a wrench, and frames.

Needed are clouds (sensor_msgs/PointCloud2) of one topic for each camera, the wrench of the hand
(geometry_msgs/WrenchStamped) without its own weight, and the frames of both (tf2_msgs/TFMessage) in
one root, m and z upwards. The hand is where the wrench's frame is. While it pulls or presses by
more than `HOLDS`, that is an action. The cloud before it and the last one at its end, before the
hand moves on, are its looks. A camera whose frame moves may do so.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from palpate.errors import PalpateError, list_names
from palpate.families.appliance.recording import FORCE, HAND, trial_of
from palpate.perception.point_files import MOST, images_of, points_of
from palpate.recordings import Channel, Recording, Role, Trial
from palpate.recordings.rosbag.files import Bag, open_bag
from palpate.recordings.rosbag.frames import Frames
from palpate.recordings.rosbag.messages import cloud_points, header
from palpate.runs.storage import DamagedFileError

HOLDS = 2.0  # N: less is the noise of a sensor
PAUSE, SHORTEST = 0.5, 0.3  # s: without force within an action, and of an action
SETTLED, LINGERS = 0.01, 2.0  # m and s: a hand that goes no further after an action still holds on
CLOUD, WRENCH = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/WrenchStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"


@dataclasses.dataclass(frozen=True, eq=False)
class _Log:
    """What a log holds: of each topic of clouds when they came, and the wrench over time."""

    frames: Frames
    clouds: dict[str, Int[np.ndarray, " clouds"]]  # stamps, ns
    stamps: Int[np.ndarray, " times"]  # of the wrench, ns
    hand: Float[np.ndarray, "times 3"]  # m
    force: Float[np.ndarray, "times 3"]  # N


@dataclasses.dataclass(frozen=True)
class _Action:
    """Rows of the wrench, from the first to that after the last; stamps of clouds by topic."""

    first: int
    last: int
    looks: dict[str, tuple[int, int]]


def read_log(path: Path) -> Recording:
    """The actions of a log as a recording.

    A force that takes more work out of the hand than it gives is that on the hand, and is turned
    round. Raises `PalpateError` where topics or frames are missing, or no action is found.
    """
    bag = open_bag(path)
    try:
        log = _first_pass(path, bag)
        actions = _actions(path, log)
        wanted = {(topic, look) for one in actions for topic, looks in one.looks.items()
                  for look in looks}  # fmt: skip
        clouds = _second_pass(open_bag(path), log.frames, wanted)
    except (PalpateError, OSError, MemoryError):
        raise
    except Exception as error:  # what the libraries raise on wrong bytes has no end
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise DamagedFileError(f"{path} is damaged or no {bag.format} ({reason})") from error
    work = sum(
        float(np.sum(log.force[one.first : one.last - 1]
                     * np.diff(log.hand[one.first : one.last], axis=0)))
        for one in actions
    )  # fmt: skip
    force = log.force if work >= 0.0 else -log.force
    trials = [
        _trial(f"action {number}", dataclasses.replace(log, force=force), one, clouds)
        for number, one in enumerate(actions, 1)
    ]
    about = {"log": path.name, "force": "as the log has it" if work >= 0.0 else "turned round"}
    return Recording(tuple(trials), about)


def _first_pass(path: Path, bag: Bag) -> _Log:
    """All but the points themselves, which are many."""
    frames, wrenches, clouds = Frames(), [], {}
    frame, topics, seen_in = "", set(), {}
    for topic, received, message in _messages(bag, {TRANSFORMS, WRENCH, CLOUD}):
        kind = _kind(bag, topic)
        if kind == TRANSFORMS:
            frames.add(message.transforms)
            continue
        stamp = header(message)[0] or received
        if kind == CLOUD:
            clouds.setdefault(topic, []).append(stamp)
            seen_in[topic] = message.header.frame_id
            continue
        force = message.wrench.force
        wrenches.append((stamp, (force.x, force.y, force.z)))
        frame = message.header.frame_id
        topics.add(topic)
    kinds = Counter(_kind(bag, topic) for topic in bag.types)
    for kind, there in ((CLOUD, clouds), (WRENCH, topics)):
        if not there:
            raise PalpateError(
                f"{path} has no messages of the type {kind}: expected clouds of points, a wrench "
                f"and tf; it has {list_names(sorted(kinds))}"
            )
    if len(topics) > 1:
        raise PalpateError(
            f"{path} has the wrenches {list_names(sorted(topics))}: expected one, of the hand; "
            "cut the others out with `ros2 bag convert`"
        )
    for topic, own in seen_in.items():
        if frames.root(own) != frames.root(frame) or own.strip("/") == frames.root(own):
            raise PalpateError(
                f"the clouds of {topic} are in the frame '{own}', which hangs on "
                f"'{frames.root(own)}', and the wrench is in '{frame}', which hangs on "
                f"'{frames.root(frame)}': expected the frame of the camera that saw them, and tf "
                "from one root to both"
            )
    rows = dict(wrenches)
    stamps = np.array(sorted(rows), np.int64)
    poses = frames.poses(frame, stamps)
    force = np.einsum("nij,nj->ni", poses[:, :3, :3], np.array([rows[one] for one in stamps]))
    if not np.isfinite(force).all():
        raise PalpateError(f"the wrench of {path} has forces that are not finite")
    looks = {topic: np.array(sorted(seen), np.int64) for topic, seen in sorted(clouds.items())}
    return _Log(frames, looks, stamps, poses[:, :3, 3], force)


def _second_pass(
    bag: Bag, frames: Frames, wanted: set[tuple[str, int]]
) -> dict[tuple[str, int], tuple[np.ndarray, np.ndarray]]:
    """Points of the clouds that count, in the root's axes, and where each was seen from."""
    found = {}
    for topic, received, message in _messages(bag, {CLOUD}):
        stamp, frame = header(message)
        stamp = stamp or received
        if (topic, stamp) not in wanted:
            continue
        points = cloud_points(message, MOST)
        if points is None:
            raise PalpateError(
                f"a cloud of {topic} has no x, y and z as floating-point numbers, or more than "
                f"{MOST:,} points"
            )
        pose = frames.poses(frame or "", np.array([stamp], np.int64))[0]
        points = points_of(points @ pose[:3, :3].T + pose[:3, 3], f"a cloud of {topic}")
        found[topic, stamp] = points, pose[:3, 3]
    return found


def _messages(bag: Bag, kinds: set[str]) -> Iterator[tuple[str, int, Any]]:
    skipped: set[str] = set()
    for topic, received, decode, data in bag.messages(skipped):
        if _kind(bag, topic) in kinds:
            yield topic, received, decode(data)
        else:
            skipped.add(topic)


def _kind(bag: Bag, topic: str) -> str:
    """The type of its messages, as ROS 2 spells it."""
    kind = bag.types.get(topic, "")
    return kind if kind.count("/") != 1 else kind.replace("/", "/msg/")


def _actions(path: Path, log: _Log) -> list[_Action]:
    """When the hand pulled, and what each camera saw before and at the end."""
    seconds = 1e-9 * (log.stamps - log.stamps[0])
    holds = np.linalg.norm(log.force, axis=1) > HOLDS
    spans = [
        (first, last)
        for first, last in _runs(holds, seconds)
        if seconds[last - 1] - seconds[first] >= SHORTEST
    ]
    found = []
    for number, (first, last) in enumerate(spans):
        until = len(log.stamps) if number + 1 == len(spans) else spans[number + 1][0]
        gone = np.linalg.norm(log.hand[last - 1 : until] - log.hand[last - 1], axis=1) > SETTLED
        late = seconds[last - 1 : until] > seconds[last - 1] + LINGERS
        leaves = np.argmax(gone | late) if (gone | late).any() else len(gone) - 1
        end = log.stamps[last - 1 + leaves]
        looks = {}
        for topic, stamps in log.clouds.items():
            before = stamps[stamps < log.stamps[first]]
            after = stamps[(stamps > log.stamps[first]) & (stamps <= end)]
            if len(before) and len(after):
                looks[topic] = int(before[-1]), int(after[-1])
        if len(looks) == len(log.clouds):
            found.append(_Action(first, last, looks))
    if not found:
        raise PalpateError(
            f"{path} has {len(spans)} times in which the hand gave more than {HOLDS:g} N for "
            f"{SHORTEST:g} s, and none with a cloud of each camera before it and at its end: "
            "expected one action or more"
        )
    return found


def _runs(holds: Bool[np.ndarray, " n"], seconds: np.ndarray) -> list[tuple[int, int]]:
    """From the first row to that after the last, of rows that hold with pauses that are short."""
    rows = np.flatnonzero(holds)
    if not len(rows):
        return []
    cuts = np.flatnonzero(np.diff(seconds[rows]) > PAUSE)
    firsts = [rows[0], *rows[cuts + 1]]
    lasts = [*rows[cuts], rows[-1]]
    return [(int(first), int(last) + 1) for first, last in zip(firsts, lasts, strict=True)]


def _trial(
    name: str,
    log: _Log,
    action: _Action,
    clouds: dict[tuple[str, int], tuple[np.ndarray, np.ndarray]],
) -> Trial:
    rows = slice(action.first, action.last)
    time = 1e-9 * (log.stamps[rows] - log.stamps[0])
    channels = [
        Channel(HAND, Role.OBSERVATION, time, log.hand[rows], "m"),
        Channel(FORCE, Role.OBSERVATION, time, log.force[rows], "N"),
    ]
    cameras = []
    for topic, looks in action.looks.items():
        points, places = zip(*(clouds[topic, look] for look in looks), strict=True)
        cameras.append(images_of(points, places))
    return trial_of(name, channels, [float(time[0]), float(time[-1])], cameras)
