"""The rope that an identification starts from."""

import numpy as np
import pytest

from palpate.families.rope.recording import starting_rope
from palpate.recordings import Aligned


def hanging(lengths):
    """A minute of a rope that hangs still, its markers as far from each other as `lengths`."""
    markers = np.zeros((1, 60, len(lengths) + 1, 3), np.float32)
    markers[..., 1:, 2] = -np.cumsum(lengths)
    return Aligned(1.0, markers, markers[:, :-1, :1], np.array([60]))


STRETCHED = np.array([0.106, 0.104, 0.102, 0.100])  # by the weight of the nodes below
UNEVEN = np.array([0.10, 0.15, 0.10, 0.12])


def test_stretch_is_not_kept_in_the_pattern_of_one_shared_length():
    rope = starting_rope(hanging(STRETCHED), mass=0.1, one_length=True)
    assert np.asarray(rope.rest_length) == pytest.approx(np.full(4, 0.103), rel=1e-5)
    assert np.asarray(rope.node_mass) == pytest.approx([0.0125, 0.025, 0.025, 0.025, 0.0125])


@pytest.mark.parametrize(("lengths", "one_length"), [(STRETCHED, False), (UNEVEN, True)])
def test_segments_are_as_long_as_seen(lengths, one_length):
    rope = starting_rope(hanging(lengths), one_length=one_length)
    assert np.asarray(rope.rest_length) == pytest.approx(lengths, rel=1e-5)
