"""Logs of robots as recordings: which topics are the markers and the gripper, cut into trials.

Reads MCAP files, rosbag2 folders and databases, and ROS 1 bags. No ROS has to be installed.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from palpate.errors import PalpateError, list_names
from palpate.recordings.alignment import DRIVEN_GAP, ON_STAMP
from palpate.recordings.channel import Role
from palpate.recordings.rosbag.files import Bag, open_bag
from palpate.recordings.rosbag.topics import Chosen, Track, choose, tracks_of
from palpate.recordings.tables import InputTable, MarkerTable

MAX_CLOCK_OFFSET = 0.5  # s between clocks; less is what cameras and networks take
MIN_DURATION = 1.0  # s of a piece between two gaps that is worth being a trial
GRIPPER, COMMAND = "gripper", "command"


def read_bag(path: str | Path, topics: Sequence[str] = ()) -> list[tuple[str, MarkerTable]]:
    """Trials of a log by name: markers and what drove them, in the file's own unit and axes.

    Markers come from a topic whose messages list several places; which, is plain when there is
    only one. A gripper comes from a topic of poses in the same frame that stays within a segment of
    the first marker, when there is only one. `topics` names others, and those of the gripper's pose
    and ordered velocity; a transform is named "TOPIC:CHILD_FRAME".

    Markers with names are told apart by them and are NaN where a message lacks them. Without names
    they are told apart by their place in the list; messages with fewer or more show nothing.

    Time is that of the messages' own stamps, or that of their receipt if there are none or the
    topics' clocks disagree by more than half a second; it starts at 0. A new trial begins after a
    gap of more than 10 periods, which no driven state may have.

    Raises `PalpateError` when topics are missing or ambiguous, or when the file is damaged.
    """
    path = Path(path)
    bag = open_bag(path)
    tracks = tracks_of(bag, topics)
    return _trials(path, bag, choose(tracks, bag, topics))


def _trials(path: Path, bag: Bag, chosen: Chosen) -> list[tuple[str, MarkerTable]]:
    times, notes = _times(chosen)
    pieces = _pieces([time for track, time in times.items() if track is not chosen.command], chosen)
    long = [piece for piece in pieces if piece[1] - piece[0] >= MIN_DURATION] or pieces
    if len(long) < len(pieces):
        notes.append(
            f"{len(pieces) - len(long)} pieces of less than {MIN_DURATION:g} s between gaps in the "
            "stamps were left out"
        )
    trials = []
    for number, (begin, end) in enumerate(long):
        inputs = []
        for name, role, track in (
            (GRIPPER, Role.DRIVEN, chosen.gripper),
            (COMMAND, Role.COMMAND, chosen.command),
        ):
            if track is not None:
                time, since = times[track], begin
                if (
                    role is Role.COMMAND
                ):  # one given before the piece began is in force when it does
                    since = max(time[time <= begin], default=begin)
                rows = (time >= since) & (time <= end)
                values = np.stack([sight.points for sight in track.sights])[rows]
                inputs.append(InputTable(name, role, time[rows], values))
        time = times[chosen.markers]
        rows = (time >= begin) & (time <= end)
        table = MarkerTable(
            f"{bag.format}, topic {chosen.markers.topic}",
            time[rows],
            chosen.positions[rows],
            chosen.names,
            notes=tuple(notes) if number == 0 else (),
            inputs=tuple(inputs),
        )
        trials.append((path.stem if len(long) == 1 else f"{path.stem}/{number}", table))
    return trials


def _times(chosen: Chosen) -> tuple[dict[Track, np.ndarray], list[str]]:
    """Seconds from the first marker on, for each message of each track, and notes."""
    notes = [*chosen.notes]
    delays = [track.delay for track in chosen.tracks]
    by_receipt = max(delays) - min(delays) > MAX_CLOCK_OFFSET
    if by_receipt:
        notes.append(
            f"the clocks of the topics are {max(delays) - min(delays):.4g} s apart, so time is "
            "that of receipt"
        )
    elif not chosen.markers.stamped:
        notes.append("the messages have no stamps of their own, so time is that of receipt")
    nanoseconds = {track: track.time(by_receipt) for track in chosen.tracks}
    start = nanoseconds[chosen.markers].min()
    return {track: (time - start) * 1e-9 for track, time in nanoseconds.items()}, notes


def _pieces(times: list[np.ndarray], chosen: Chosen) -> list[tuple[float, float]]:
    """(begin, end) of what all `times` cover without a gap."""
    begin, end = max(time.min() for time in times), min(time.max() for time in times)
    gaps = []
    for time in map(np.unique, times):
        steps = np.diff(time)
        wide = steps > DRIVEN_GAP * np.median(steps) * (1 + ON_STAMP) if len(steps) else steps > 0
        gaps += zip(time[:-1][wide].tolist(), time[1:][wide].tolist(), strict=True)
    pieces = []
    for before, after in sorted(gaps):
        if begin < min(before, end):
            pieces.append((begin, min(before, end)))
        begin = max(begin, after)
    if begin < end:
        pieces.append((begin, end))
    if not pieces:
        topics = list_names(track.topic for track in chosen.tracks)
        raise PalpateError(f"{topics}: no time is covered by all of them without gaps")
    return pieces
