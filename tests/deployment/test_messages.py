"""Messages come through as they were, or not at all."""

import struct

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

BIG = st.integers(0, 2**64 - 1)
COORDINATE = st.floats(width=32)  # NaN and infinity too: whoever decodes has to look


@given(BIG, BIG, st.floats(), st.lists(st.tuples(*[COORDINATE] * 3), min_size=1, max_size=30))
def test_states_round_trip(session, sequence, time, points):
    points = np.array(points, np.float32)
    came = decode_state(encode_state(StateMessage(session, sequence, time, points[0], points[1:])))
    assert (came.session, came.sequence) == (session, sequence)
    np.testing.assert_equal(came.time, time)
    np.testing.assert_array_equal(came.gripper, points[0])
    np.testing.assert_array_equal(came.markers, points[1:])


@given(BIG, BIG, BIG, st.integers(0, 3), st.tuples(*[st.floats(-9, 9, width=32)] * 3))
def test_commands_round_trip(session, sequence, state, mode, velocity):
    sent = CommandMessage(session, sequence, mode, state, np.array(velocity, np.float32))
    came = decode_command(encode_command(sent))
    assert (came.session, came.sequence, came.mode, came.state) == (session, sequence, mode, state)
    np.testing.assert_array_equal(came.velocity, velocity)


STATE = encode_state(StateMessage(1, 2, 3.0, np.zeros(3), np.ones((4, 3))))
COMMAND = encode_command(CommandMessage(1, 2, 1, 3, np.ones(3)))


@pytest.mark.parametrize(("data", "decode"), [(STATE, decode_state), (COMMAND, decode_command)])
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
    import zlib

    changed = bytearray(data[:-4])
    struct.pack_into(layout, changed, start, value)
    return bytes(changed) + struct.pack("<I", zlib.crc32(changed))


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"", "0 bytes that are no message of palpate: expected a state"),
        (COMMAND, "a message of version 1 and kind 2: expected a state, version 1 and kind 1"),
        (resealed(STATE, 4, "B", 2), "a message of version 2 and kind 1: expected a state"),
        (resealed(STATE, 6, "<H", 5), "a state of 96 bytes: expected 108"),
        (resealed(STATE, 6, "<H", 65535), "a state of 96 bytes: expected 786468"),
        (STATE[:-1] + b"x", "a state that is damaged: its checksum is wrong"),
    ],
)
def test_sentences(data, sentence):
    with pytest.raises(PalpateError) as refused:
        decode_state(data)
    assert str(refused.value).startswith(sentence)


def test_a_command_that_is_no_number_is_refused():
    data = encode_command(CommandMessage(1, 2, 1, 3, np.array([0, np.nan, 0])))
    with pytest.raises(PalpateError, match="a command is a finite velocity, not"):
        decode_command(data)
