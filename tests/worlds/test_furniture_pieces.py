"""Outlines of furniture: centred, and placed where a piece stands."""

import numpy as np
import pytest

from palpate.numerics.polygons import place_points
from palpate.worlds.furniture.pieces import KINDS, centroid


def test_placing_turns_and_moves():
    outline = np.array([(1.0, 0.0), (0.0, 2.0)])
    moved = place_points(outline, np.array([3.0, 4.0, np.pi / 2]))
    assert moved == pytest.approx(np.array([(3, 5), (1, 4)]))


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_an_outline_is_centred(kind):
    assert centroid(np.array(kind.outline)) == pytest.approx(0, abs=1e-12)
