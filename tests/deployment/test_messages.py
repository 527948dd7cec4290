"""Messages come through as they were, or not at all."""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.deployment.messages import (
    CommandMessage,
    StateMessage,
    decode_command,
    decode_state,
    encode_command,
    encode_state,
)
from palpate.errors import PalpateError
from palpate.networks import Channel

BIG = st.integers(0, 2**64 - 1)
COORDINATE = st.floats(width=32)  # NaN and infinity too: whoever decodes has to look


@given(BIG, BIG, st.floats(), st.lists(st.tuples(*[COORDINATE] * 3), min_size=2, max_size=30))
def test_states_round_trip(session, sequence, time, points):
    points = np.array(points, np.float32)
    values = {"gripper": points[0], "markers": points[1:]}
    sensors = Channel("gripper", (3,)), Channel("markers", (len(points) - 1, 3))
    came = decode_state(encode_state(StateMessage(session, sequence, time, values)), sensors)
    assert (came.session, came.sequence) == (session, sequence)
    np.testing.assert_equal(came.time, time)
    np.testing.assert_array_equal(came.values["gripper"], points[0])
    np.testing.assert_array_equal(came.values["markers"], points[1:])


@given(BIG, BIG, BIG, st.integers(0, 3), st.tuples(*[st.floats(-9, 9, width=32)] * 3))
def test_commands_round_trip(session, sequence, state, mode, velocity):
    sent = CommandMessage(session, sequence, mode, state, np.array(velocity, np.float32))
    came = decode_command(encode_command(sent), 3)
    assert (came.session, came.sequence, came.mode, came.state) == (session, sequence, mode, state)
    np.testing.assert_array_equal(came.action, velocity)


SENSORS = Channel("gripper", (3,), "m"), Channel("markers", (4, 3), "m")
VALUES = {"gripper": np.zeros(3), "markers": np.ones((4, 3))}
STATE = encode_state(StateMessage(1, 2, 3.0, VALUES))
COMMAND = encode_command(CommandMessage(1, 2, 1, 3, np.ones(3)))


@pytest.mark.parametrize(
    ("data", "decode"),
    [
        (STATE, lambda data: decode_state(data, SENSORS)),
        (COMMAND, lambda data: decode_command(data, 3)),
    ],
)
def test_every_damage_is_refused(data, decode):
    for end in range(len(data)):
        with pytest.raises(PalpateError):
            decode(data[:end])
    for place in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[place // 8] ^= 1 << place % 8
        with pytest.raises(PalpateError):
            decode(bytes(flipped))
    with pytest.raises(PalpateError):
        decode(data + b"\0")


def resealed(data: bytes, start: int, layout: str, value) -> bytes:
    """The message with one field changed and a checksum that fits."""
    changed = bytearray(data[:-4])
    struct.pack_into(layout, changed, start, value)
    return sealed(bytes(changed))


def sealed(data: bytes) -> bytes:
    return data + struct.pack("<I", zlib.crc32(data))


def test_a_ropes_bytes_are_those_of_every_version_before():
    """Robots' programs that were written to the first layout are understood."""
    points = np.arange(15, dtype="<f4")
    head = struct.pack("<4sBBHQQ", b"PLPT", 1, 1, 4, 1, 2)
    data = sealed(head + struct.pack("<d", 3.0) + points.tobytes())
    values = {"gripper": points[:3], "markers": points[3:].reshape(4, 3)}
    assert encode_state(StateMessage(1, 2, 3.0, values)) == data
    command = sealed(struct.pack("<4sBBHQQQ3f", b"PLPT", 1, 2, 1, 1, 2, 3, 0.5, 0.25, -1.0))
    assert encode_command(CommandMessage(1, 2, 1, 3, np.array([0.5, 0.25, -1.0]))) == command


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "0 bytes that are no message of palpate: expected a state"),
        (COMMAND, "a message of version 1 and kind 2: expected a state, version 1 and kind 1"),
        (resealed(STATE, 4, "B", 2), "a message of version 2 and kind 1: expected a state"),
        (resealed(STATE, 6, "<H", 5), "5 markers where 4 were agreed"),
        (resealed(STATE, 6, "<H", 65535), "65535 markers where 4 were agreed"),
        (sealed(STATE[:-16]), "a state of 84 bytes: expected 96"),
        (STATE[:-1] + b"x", "a state that is damaged: its checksum is wrong"),
    ],
)
def test_sentences(data, sentence):
    with pytest.raises(PalpateError) as refused:
        decode_state(data, SENSORS)
    assert str(refused.value).startswith(sentence)


def test_a_command_that_is_no_number_is_refused():
    data = encode_command(CommandMessage(1, 2, 1, 3, np.array([0, np.nan, 0])))
    with pytest.raises(PalpateError, match="a command is finite, not"):
        decode_command(data, 3)
