"""Which topics of a robot's log are the markers, the gripper and its command."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from palpate.errors import PalpateError, list_names
from palpate.recordings.alignment import MAX_BYTES
from palpate.recordings.csv import in_natural_order
from palpate.recordings.rosbag.files import Bag
from palpate.recordings.rosbag.messages import MAX_POINTS, MAX_STAMP, Kind, Sight, sights
from palpate.runs.storage import DamagedFileError

MAX_EMPTY_MESSAGES = 500  # messages of a topic that show nothing before it is read no further
MIN_SHARE = 0.5  # of the messages that have to hold as many points as most others do


@dataclass(eq=False)
class Track:
    """What one topic shows: a sight for each message, and when the message was received, in ns."""

    topic: str
    kind: Kind
    sights: list[Sight] = field(default_factory=list)
    received: list[int] = field(default_factory=list)

    @property
    def frame(self) -> str | None:
        """The coordinate frame; None if the messages do not say."""
        return self.sights[0].frame

    @property
    def delay(self) -> float:
        """Median seconds from a message's own stamp to its receipt; 0 for messages without one."""
        if not self.stamped:
            return 0.0
        stamps = [sight.stamp for sight in self.sights]
        return float(np.median(np.array(self.received) - np.array(stamps))) * 1e-9

    @property
    def stamped(self) -> bool:
        """Whether the messages say when they were measured, each something else."""
        stamps = {sight.stamp for sight in self.sights}
        return None not in stamps and len(stamps) > len(self.sights) / 2

    def time(self, by_receipt: bool) -> np.ndarray:
        """(messages,) in ns: of measurement, where messages say so and it is wanted."""
        if by_receipt or not self.stamped:
            return np.array(self.received, np.int64)
        return np.array([sight.stamp for sight in self.sights], np.int64)

    def __str__(self) -> str:
        size = Counter(len(sight.points) for sight in self.sights).most_common(1)[0][0]
        what = f"{size} points, " if self.kind is Kind.MARKERS else ""
        return f"{self.topic} ({what}{len(self.sights)} messages)"


@dataclass(frozen=True, eq=False)
class Chosen:
    """The topics that make a recording, and what a person should know about them.

    `positions` (messages, markers, 3) are those of `markers`, `names` theirs if they have any.
    """

    markers: Track
    positions: np.ndarray
    names: tuple[str, ...]
    gripper: Track | None
    command: Track | None
    notes: tuple[str, ...]

    @property
    def tracks(self) -> list[Track]:
        """Those that there are."""
        return [track for track in (self.markers, self.gripper, self.command) if track]


def tracks_of(bag: Bag, named: Sequence[str]) -> dict[str, Track]:
    """What the topics of `bag` show, by topic, transforms by "topic:child".

    A topic that shows nothing for long is given up, unless it is `named`. Raises `PalpateError` for
    more than fits in memory, `DamagedFileError` for a file that cannot be read to its end.
    """
    tracks: dict[str, Track] = {}
    worth = {name.partition(":")[0] for name in named}
    skipped: set[str] = set()
    size = 0
    try:
        for topic, received, decode, data in bag.messages(skipped):
            bag.read[topic] += 1
            if not 0 <= received < MAX_STAMP:
                raise DamagedFileError(f"a message was received {received} ns after 1970")
            try:
                found = sights(decode(data))
            except Exception as error:  # a message can be anything, and a topic be of no interest
                bag.unreadable[topic] = f"a message of it is damaged ({_reason(error)})"
                skipped.add(topic)
                continue
            for sight in found:
                name = f"{topic}:{sight.child}" if sight.child else topic
                track = tracks.setdefault(name, Track(name, sight.kind))
                if track.kind is not sight.kind:
                    bag.unreadable[topic] = (
                        f"some messages of it hold {track.kind.value}, others {sight.kind.value}"
                    )
                    skipped.add(topic)
                track.sights.append(sight)
                track.received.append(received)
                size += sight.points.nbytes
            if found:
                worth.add(topic)
            elif topic not in worth and bag.read[topic] >= MAX_EMPTY_MESSAGES:
                skipped.add(topic)
            if size > MAX_BYTES:
                raise PalpateError(
                    f"the markers and poses in it take more than {MAX_BYTES / 2**30:.0f} GiB: "
                    "split it into several recordings"
                )
    except (PalpateError, OSError, MemoryError):
        raise
    except Exception as error:  # what the libraries raise on wrong bytes has no end
        raise DamagedFileError(
            f"the file is damaged or no {bag.format} ({_reason(error)})"
        ) from error
    return tracks


def _reason(error: Exception) -> str:
    return str(error).partition("\n")[0] or type(error).__name__


def choose(tracks: dict[str, Track], bag: Bag, topics: Sequence[str]) -> Chosen:
    """The topics to make a recording of: those named in `topics`, or else what is plain.

    See `palpate.recordings.rosbag.bag.read_bag`. Raises `PalpateError` for topics that are missing,
    ambiguous, damaged or in different frames.
    """
    for topic in topics:
        if topic not in tracks:
            raise PalpateError(_unusable(topic, tracks, bag))
    named = {topic: tracks[topic] for topic in topics}
    markers = _one(Kind.MARKERS, named) or _one(Kind.MARKERS, tracks)
    if markers is None:
        raise PalpateError(
            "no topic holds markers, which are lists of places such as geometry_msgs/PoseArray or "
            f"visualization_msgs/MarkerArray; {_list_of_topics(bag)}"
        )
    _check_whole(markers, bag)
    positions, names, notes = _positions(markers)
    gripper, command = _one(Kind.POSE, named), _one(Kind.VELOCITY, named)
    if not topics:
        poses = [track for track in tracks.values() if track.kind is Kind.POSE]
        there = [track for track in poses if track.frame == markers.frame]
        if len(there) == 1 and _holds_the_first(there[0], markers, positions):
            gripper = there[0]
            notes.append(f"{gripper.topic} stays at the first marker and is taken as the gripper")
        elif poses:
            notes.append(
                f"poses were left out: {list_names(track.topic for track in poses)}; --topics "
                "takes one of them as the gripper's"
            )
    for track in (gripper, command):
        if track is None:
            continue
        _check_whole(track, bag)
        if track.frame and markers.frame and track.frame != markers.frame:
            raise PalpateError(
                f"'{track.topic}' is in the frame '{track.frame}' and '{markers.topic}' in "
                f"'{markers.frame}': expected one frame, so record both in it"
            )
    return Chosen(markers, positions, names, gripper, command, tuple(notes))


def _one(kind: Kind, tracks: dict[str, Track]) -> Track | None:
    """The only one of a kind; raises `PalpateError` where there are several."""
    found = [track for track in tracks.values() if track.kind is kind]
    if len(found) > 1:
        what = "markers" if kind is Kind.MARKERS else f"a {kind.value}"
        raise PalpateError(
            f"several topics hold {what}: {list_names(str(track) for track in found)}; say which "
            f"with --topics, e.g. --topics {found[0].topic}"
        )
    return found[0] if found else None


def _unusable(topic: str, tracks: dict[str, Track], bag: Bag) -> str:
    """Why a topic that was named cannot be taken."""
    if topic in bag.unreadable:
        return f"topic '{topic}' cannot be read: {bag.unreadable[topic]}"
    children = [name for name in tracks if name.startswith(f"{topic}:")]
    if children:
        return f"topic '{topic}' holds transforms: name one of them, {list_names(children)}"
    if topic in bag.types:
        return (
            f"topic '{topic}' of type {bag.types[topic]} has no messages that show markers, a "
            "pose or a velocity"
        )
    return f"there is no topic '{topic}'; {_list_of_topics(bag)}"


def _list_of_topics(bag: Bag) -> str:
    there = []
    for topic, kind in bag.types.items():
        why = bag.unreadable.get(topic)
        there.append(f"{topic} ({kind}{f', not read: {why}' if why else ''})")
    return f"there are: {list_names(there)}" if there else "there are no topics"


def _holds_the_first(pose: Track, markers: Track, positions: np.ndarray) -> bool:
    """Whether a pose stays, by median, within the first segment's length of the first marker."""
    if len(pose.sights) < 2 or positions.shape[1] < 2:
        return False
    order = np.argsort(pose.received, kind="stable")
    when = np.array(pose.received)[order] - pose.received[order[0]]
    places = np.concatenate([sight.points for sight in pose.sights])[order]
    asked = np.array(markers.received) - pose.received[order[0]]
    at = np.stack([np.interp(asked, when, places[:, axis]) for axis in range(3)], axis=-1)
    with np.errstate(over="ignore", invalid="ignore"):  # any number may stand in a file
        away = np.linalg.norm(at - positions[:, 0], axis=-1)
        segment = np.linalg.norm(positions[:, 1] - positions[:, 0], axis=-1)
        known = np.isfinite(away + segment)
    return bool(known.any() and np.median(away[known]) <= np.median(segment[known]))


def _check_whole(track: Track, bag: Bag) -> None:
    """Refuse a topic that is damaged, not all there, or changes its frame."""
    topic = track.topic.partition(":")[0]
    if topic in bag.unreadable:
        raise DamagedFileError(f"topic '{topic}' cannot be read: {bag.unreadable[topic]}")
    if bag.read[topic] < bag.counts[topic]:
        raise DamagedFileError(
            f"topic '{topic}' has {bag.read[topic]} messages, but the index of the file "
            f"promises {bag.counts[topic]}"
        )
    if len(track.sights) < 2:
        raise PalpateError(f"topic '{track.topic}' has only one message that can be used")
    frames = {sight.frame for sight in track.sights}
    if len(frames) > 1:
        raise PalpateError(
            f"topic '{track.topic}' changes its frame: {list_names(sorted(map(str, frames)))}"
        )


def _positions(track: Track) -> tuple[np.ndarray, tuple[str, ...], list[str]]:
    """(messages, markers, 3), the names of the markers if they have any, and notes."""
    total = len(track.sights)
    if all(sight.names is not None for sight in track.sights):
        names = in_natural_order(
            list(dict.fromkeys(name for sight in track.sights for name in sight.names or ()))
        )
        if not 0 < len(names) <= MAX_POINTS:
            raise PalpateError(
                f"topic '{track.topic}' has {len(names)} markers of different names; 1 to "
                f"{MAX_POINTS} are read"
            )
        column = {name: number for number, name in enumerate(names)}
        positions = np.full((total, len(names), 3), np.nan)
        for row, sight in zip(positions, track.sights, strict=True):
            row[[column[name] for name in sight.names or ()]] = sight.points
        return positions, names, []
    sizes = Counter(len(sight.points) for sight in track.sights)
    count, usual = sizes.most_common(1)[0]
    if usual <= MIN_SHARE * total or count == 0:
        raise PalpateError(
            f"topic '{track.topic}' has {min(sizes)} to {max(sizes)} markers without names in a "
            "message, so nobody can say which is which: expected always as many, with NaN for "
            "what was not seen, or a name for each"
        )
    positions = np.full((total, count, 3), np.nan)
    for row, sight in zip(positions, track.sights, strict=True):
        if len(sight.points) == count:
            row[:] = sight.points
    if usual == total:
        return positions, (), []
    note = f"{total - usual} of {total} messages do not hold {count} markers and show nothing"
    return positions, (), [note]
