"""The nodes of a model among markers, against a curve that is known."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.perception.rope.nodes import at_nodes


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
