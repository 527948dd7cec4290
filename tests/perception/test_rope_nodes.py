"""The nodes of a model among markers, against a curve that is known."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.perception.rope.nodes import SMOOTHED, at_nodes, smooth_lengths


def circle(share, radius=0.4):
    angle = np.pi * np.asarray(share)
    return radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)


def test_nodes_that_fall_on_markers_are_those_to_the_last_bit():
    markers = np.random.default_rng(0).normal(size=(2, 3, 13, 3)).astype(np.float32)
    for every in (1, 2, 3, 4, 6):
        found = at_nodes(markers, 12 // every + 1)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, markers[..., ::every, :])


@pytest.mark.parametrize(("markers", "nodes"), [(30, 8), (60, 17), (13, 12), (5, 4)])
def test_nodes_lie_evenly_along_a_polygon(markers, nodes):
    """A straight rope is met exactly, an arc as nearly as a chord: to h^2 / 8 r."""
    straight = np.linspace([0, 0, 1], [0.3, 0.4, -1], markers)
    np.testing.assert_allclose(
        at_nodes(straight, nodes), np.linspace([0, 0, 1], [0.3, 0.4, -1], nodes), atol=1e-12
    )
    off = at_nodes(circle(np.linspace(0, 1, markers)), nodes) - circle(np.linspace(0, 1, nodes))
    apart = 0.4 * np.pi / (markers - 1)
    assert 0 < np.abs(off).max() < 1.02 * apart**2 / (8 * 0.4)
    np.testing.assert_allclose(off[[0, -1]], 0, atol=1e-15)


def test_only_nodes_made_of_a_lost_marker_are_lost():
    markers = np.linspace([0.0, 0, 0], [1, 0, 0], 10)
    markers[4] = np.nan
    lost = np.isnan(at_nodes(markers, 7)).any(axis=1)  # at 0, 1.5, 3, 4.5, 6, 7.5 and 9
    np.testing.assert_array_equal(lost, [False, False, False, True, False, False, False])


@pytest.mark.parametrize("nodes", [0, 1, 6])
def test_more_nodes_than_markers_are_refused(nodes):
    with pytest.raises(PalpateError, match=f"{nodes} nodes need at least as many markers, not 5"):
        at_nodes(np.zeros((5, 3)), nodes)


def swinging(length, angle):
    """Two segments at this angle from the vertical, hung at (1, 2, 3): (3, 3) m."""
    along = np.array([np.sin(angle), 0, -np.cos(angle)])
    return np.array([1.0, 2, 3]) + np.outer([0, 1, 2], along) * length


@pytest.mark.parametrize("frequency", [2.0, 12.0])
def test_a_bounce_is_smoothed_away_and_a_swing_is_not(frequency):
    """A segment's length as a first-order lag has it; its direction as it is seen."""
    period, lengths = 0.002, []
    time = np.arange(0, 3, period)
    before = swinging(0.1, 0.0)
    for now in time:
        angle = 0.5 * np.sin(6 * now)
        seen = swinging(0.1 + 0.004 * np.sin(2 * np.pi * frequency * now), angle)
        before = smooth_lengths(before, seen, period)
        np.testing.assert_allclose(before[0], seen[0])
        edge = np.diff(before, axis=0)
        lengths.append(np.linalg.norm(edge, axis=1))
        np.testing.assert_allclose(np.arctan2(edge[:, 0], -edge[:, 2]), angle, atol=1e-12)
    bounce = np.array(lengths)[time > 2] - 0.1
    left = 0.004 / np.hypot(1, 2 * np.pi * frequency * SMOOTHED)
    np.testing.assert_allclose(np.abs(bounce).max(axis=0), left, rtol=0.02)


def test_lengths_come_to_what_is_seen_and_ropes_are_apart():
    """63 % of the way in `SMOOTHED`; a rope that is as it was stays so to the last bit but one."""
    before = np.stack([swinging(0.1, 0.3), swinging(0.1, 0.3)]).astype(np.float32)
    seen = np.stack([swinging(0.2, 0.3), swinging(0.1, 0.3)]).astype(np.float32)
    for _ in range(25):
        before = smooth_lengths(before, seen, SMOOTHED / 25)
    assert before.dtype == np.float32
    length = np.linalg.norm(np.diff(before, axis=1), axis=-1)
    np.testing.assert_allclose(length[0], 0.2 - 0.1 * np.exp(-1), rtol=1e-5)
    np.testing.assert_allclose(before[1], seen[1], atol=1e-6)


def test_nodes_in_one_place_do_not_spoil_the_others():
    seen = swinging(0.1, 0.0)
    seen[1] = seen[0]
    assert np.isfinite(smooth_lengths(swinging(0.1, 0.0), seen, 0.01)).all()
