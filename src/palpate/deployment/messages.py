"""What robot and loop say to each other: two fixed layouts in little-endian bytes.

    state:   magic "PLPT", version u8, kind u8 = 1, markers u16, session u64, sequence u64,
             time f64 (s, the sender's own monotonic clock), gripper 3 f32, markers n x 3 f32 (m),
             CRC-32 u32 of everything before
    command: magic "PLPT", version u8, kind u8 = 2, mode u16, session u64, sequence u64,
             state u64 (sequence of the newest state it rests on), velocity 3 f32 (m/s), CRC-32 u32

A session is a number that a sender draws when it starts, so that its successor is told apart.
Nothing is unpickled: a message is numbers of known size, or it is refused.
"""

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from palpate.errors import PalpateError

_MAGIC, _VERSION, _STATE, _COMMAND = b"PLPT", 1, 1, 2
_HEAD = struct.Struct("<4sBBHQQ")
_TIME, _NEWEST, _CHECK = struct.Struct("<d"), struct.Struct("<Q3f"), struct.Struct("<I")


@dataclass(frozen=True, slots=True, eq=False)
class StateMessage:
    """Where everything was at `time` (s): `gripper` (3,) and `markers` (n, 3) in m, float32."""

    session: int
    sequence: int
    time: float
    gripper: np.ndarray
    markers: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class CommandMessage:
    """The gripper velocity (3,) in m/s from now on; `mode` as `palpate.deployment.supervisor`."""

    session: int
    sequence: int
    mode: int
    state: int
    velocity: np.ndarray


def encode_state(message: StateMessage) -> bytes:
    """The state as bytes."""
    count = len(message.markers)
    head = _HEAD.pack(_MAGIC, _VERSION, _STATE, count, message.session, message.sequence)
    points = np.concatenate([message.gripper[None], message.markers]).astype("<f4")
    return _checked(head + _TIME.pack(message.time) + points.tobytes())


def decode_state(data: bytes) -> StateMessage:
    """The state in these bytes; its numbers may be NaN, its points are read-only.

    Raises `PalpateError` for anything else.
    """
    count, session, sequence = _opened(data, _STATE, "state")
    start = _HEAD.size + _TIME.size
    _length(data, start + 12 * (count + 1) + _CHECK.size, "state")
    (time,) = _TIME.unpack_from(data, _HEAD.size)
    points = np.frombuffer(data, "<f4", 3 * (count + 1), start).reshape(-1, 3)
    return StateMessage(session, sequence, time, points[0], points[1:])


def encode_command(message: CommandMessage) -> bytes:
    """The command as bytes."""
    head = _HEAD.pack(
        _MAGIC, _VERSION, _COMMAND, message.mode, message.session, message.sequence
    )  # fmt: skip
    return _checked(head + _NEWEST.pack(message.state, *message.velocity))


def decode_command(data: bytes) -> CommandMessage:
    """The command in these bytes. Raises `PalpateError` for anything else, or if not finite."""
    mode, session, sequence = _opened(data, _COMMAND, "command")
    _length(data, _HEAD.size + _NEWEST.size + _CHECK.size, "command")
    state, *velocity = _NEWEST.unpack_from(data, _HEAD.size)
    if not np.isfinite(velocity).all():
        raise PalpateError(f"a command is a finite velocity, not {velocity}")
    return CommandMessage(session, sequence, mode, state, np.array(velocity))


def _checked(data: bytes) -> bytes:
    return data + _CHECK.pack(zlib.crc32(data))


def _opened(data: bytes, kind: int, what: str) -> tuple[int, int, int]:
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
