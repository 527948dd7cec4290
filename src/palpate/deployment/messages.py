"""What robot and loop say to each other: two layouts in little-endian bytes.

    state:   magic "PLPT", version u8, kind u8 = 1, rows u16 (length of the last channel's first
             axis), session u64, sequence u64, time f64 (s, the sender's own monotonic clock), the
             declared sensor channels one after the other f32, CRC-32 u32 of everything before
    command: magic "PLPT", version u8, kind u8 = 2, mode u16, session u64, sequence u64,
             state u64 (sequence of the state that it was decided on), the declared action channels
             one after the other f32, CRC-32 u32

Where an action is a motion from where the robot is, a command of the same state and action is that
motion, which goes on; any other begins a new one.

A session is a number that a sender draws when it starts, so that its successor has another.
Nothing is unpickled: a message is numbers of declared size, or it is refused.
"""

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from palpate.errors import PalpateError
from palpate.networks import Channel, count_of

_MAGIC, _VERSION, _STATE, _COMMAND = b"PLPT", 1, 1, 2
_HEAD = struct.Struct("<4sBBHQQ")
_TIME, _NEWEST, _CHECK = struct.Struct("<d"), struct.Struct("<Q"), struct.Struct("<I")


@dataclass(frozen=True, slots=True, eq=False)
class StateMessage:
    """What the sensors showed at `time` (s): an array for each channel, float32, in its unit."""

    session: int
    sequence: int
    time: float
    values: Mapping[str, np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class CommandMessage:
    """The action from now on, flat; `mode` as in `palpate.deployment.supervisor`."""

    session: int
    sequence: int
    mode: int
    state: int
    action: np.ndarray


def encode_state(message: StateMessage) -> bytes:
    """The state as bytes, channels in the order of `values`."""
    values = [np.asarray(value, "<f4") for value in message.values.values()]
    rows = len(values[-1])
    head = _HEAD.pack(_MAGIC, _VERSION, _STATE, rows, message.session, message.sequence)
    whole = b"".join(value.tobytes() for value in values)
    return _check(head + _TIME.pack(message.time) + whole)


def decode_state(data: bytes, sensors: Sequence[Channel]) -> StateMessage:
    """The state of these channels in these bytes; its numbers may be NaN, its arrays are read-only.

    Raises `PalpateError` for anything else.
    """
    rows, session, sequence = _open(data, _STATE, "state")
    last = sensors[-1]
    if rows != last.shape[0]:
        raise PalpateError(f"{rows} {last.name} where {last.shape[0]} were agreed")
    start = _HEAD.size + _TIME.size
    _length(data, start + 4 * count_of(sensors) + _CHECK.size, "state")
    (time,) = _TIME.unpack_from(data, _HEAD.size)
    values = {}
    for channel in sensors:
        values[channel.name] = np.frombuffer(data, "<f4", channel.count, start).reshape(
            channel.shape
        )
        start += 4 * channel.count
    return StateMessage(session, sequence, time, values)


def encode_command(message: CommandMessage) -> bytes:
    """The command as bytes."""
    head = _HEAD.pack(
        _MAGIC, _VERSION, _COMMAND, message.mode, message.session, message.sequence
    )  # fmt: skip
    action = np.asarray(message.action, "<f4").tobytes()
    return _check(head + _NEWEST.pack(message.state) + action)


def decode_command(data: bytes, count: int) -> CommandMessage:
    """The command of `count` numbers in these bytes.

    Raises `PalpateError` for anything else, or if not finite.
    """
    mode, session, sequence = _open(data, _COMMAND, "command")
    start = _HEAD.size + _NEWEST.size
    _length(data, start + 4 * count + _CHECK.size, "command")
    (state,) = _NEWEST.unpack_from(data, _HEAD.size)
    action = np.frombuffer(data, "<f4", count, start).astype(float)
    if not np.isfinite(action).all():
        raise PalpateError(f"a command is finite, not {action.tolist()}")
    return CommandMessage(session, sequence, mode, state, action)


def _check(data: bytes) -> bytes:
    return data + _CHECK.pack(zlib.crc32(data))


def _open(data: bytes, kind: int, what: str) -> tuple[int, int, int]:
    """What the 16-bit field of the head holds, the session and the sequence number."""
    if len(data) < _HEAD.size + _CHECK.size or data[:4] != _MAGIC:
        raise PalpateError(f"{len(data)} bytes that are no message of palpate: expected a {what}")
    _, version, found, number, session, sequence = _HEAD.unpack_from(data)
    if version != _VERSION or found != kind:
        raise PalpateError(
            f"a message of version {version} and kind {found}: expected a {what}, version "
            f"{_VERSION} and kind {kind}"
        )
    if zlib.crc32(data[: -_CHECK.size]) != _CHECK.unpack_from(data, len(data) - _CHECK.size)[0]:
        raise PalpateError(f"a {what} that is damaged: its checksum is wrong")
    return number, session, sequence


def _length(data: bytes, expected: int, what: str) -> None:
    if len(data) != expected:
        raise PalpateError(f"a {what} of {len(data)} bytes: expected {expected}")
