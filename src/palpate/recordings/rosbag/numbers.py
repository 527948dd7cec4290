"""Plain numbers from a robot's log: joint angles, torques, forces, whatever has a field."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import PalpateError, list_names
from palpate.recordings.channel import Channel, Role
from palpate.recordings.recording import Recording
from palpate.recordings.rosbag.files import open_bag
from palpate.recordings.rosbag.messages import MAX_STAMP, header, named_fields
from palpate.recordings.trial import Trial
from palpate.runs.storage import DamagedFileError

_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")  # a field's name, or an index


def read_numbers(path: Path, names: Sequence[str]) -> Recording:
    """One trial: a channel of one number for each of `names`, which say where it stands.

    A name is a topic and the way to a number in its messages, "/joint_states.position[0]" or
    "/wrist.wrench.torque.z"; the topic alone stands for its field `data`, as in std_msgs/Float64.
    Time is that of the messages' own stamps if all these topics have them, else of their receipt,
    and starts at 0. What does not exist in a message is NaN, which was not seen. The log does not
    say what is observed and what acts: all are observed.

    Raises `PalpateError` (the path is the caller's part) for a topic or a number that is nowhere in
    the log, and `DamagedFileError` for one that cannot be read to its end.
    """
    bag = open_bag(path)
    wanted: dict[str, dict[str, list[str | int]]] = {}
    for name in names:
        topic, _, way = name.partition(".")
        steps = [field or int(index) for field, index in _STEP.findall(way or "data")]
        wanted.setdefault(topic, {})[name] = steps
    rows: dict[str, list[tuple[int, int | None, float]]] = {name: [] for name in names}
    fields: dict[str, list[str]] = {}
    skipped: set[str] = set()
    try:
        for topic, received, decode, data in bag.messages(skipped):
            if topic not in wanted:
                skipped.add(topic)
                continue
            if not 0 <= received < MAX_STAMP:
                raise DamagedFileError(f"a message was received {received} ns after 1970")
            message = decode(data)
            stamp, _ = header(message)
            fields.setdefault(topic, sorted(n for n in named_fields(message) if n[0] != "_"))
            for name, steps in wanted[topic].items():
                rows[name].append((received, stamp, _number(message, steps)))
    except (PalpateError, OSError, MemoryError):
        raise
    except Exception as error:  # what the libraries raise on wrong bytes has no end
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise DamagedFileError(f"the file is damaged or no {bag.format} ({reason})") from error
    for name, found in rows.items():
        topic = name.partition(".")[0]
        if not found:
            raise PalpateError(
                f"there is no topic {topic} with messages that can be read; there are: "
                f"{list_names(sorted(bag.types))}"
            )
        if all(math.isnan(value) for _, _, value in found):
            raise PalpateError(
                f"no message has a number at {name}; {topic} has {list_names(fields[topic])}"
            )
    stamped = all(stamp is not None for found in rows.values() for _, stamp, _ in found)
    channels = {}
    for name, found in rows.items():
        nanoseconds = np.array([row[1] if stamped else row[0] for row in found], np.int64)
        order = np.unique(nanoseconds, return_index=True)[1]
        values = np.array([row[2] for row in found])[order, None]
        channels[name] = (nanoseconds[order], values)
    began = min(times[0] for times, _ in channels.values())
    made = {
        name: Channel(name, Role.OBSERVATION, 1e-9 * (times - began), values, "")
        for name, (times, values) in channels.items()
    }
    return Recording((Trial(path.stem, made),), {"file": str(path), "source": bag.format})


def _number(message: Any, steps: Sequence[str | int]) -> float:
    """What stands there, NaN where nothing does or it is no number."""
    for step in steps:
        if isinstance(step, str):
            message = named_fields(message).get(step)
        else:
            there = isinstance(message, list | tuple | np.ndarray) and step < len(message)
            message = message[step] if there else None
    number = isinstance(message, int | float | np.number) and not isinstance(message, bool)
    return float(message) if number else math.nan
