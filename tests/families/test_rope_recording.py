"""The rope that an identification starts from."""

import dataclasses

import numpy as np
import pytest

from palpate.families.rope.options import IdentifyRope
from palpate.families.rope.recording import BEND_DAMPING, choose_node_count, starting_rope
from palpate.models.rope import Rope
from palpate.models.rope.stability import LIMIT, load
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


def dense(markers, length, period=0.005, noise=0.0):
    seen = hanging(np.full(markers - 1, length / (markers - 1)))
    random = np.random.default_rng(0)
    shaken = seen.observation + noise * random.standard_normal(seen.observation.shape)
    return Aligned(period, shaken, seen.action, seen.length)


@pytest.mark.parametrize(("length", "substeps"), [(0.6, None), (1.1, 2)])
def test_nodes_are_as_close_as_their_time_step_can_damp(length, substeps):
    """The rule against the limit of the model itself: one node more would be beyond it."""
    found = choose_node_count(dense(60, length), substeps)
    loads = []
    for nodes in (found, found + 1):
        spacing, mass = length / (nodes - 1), 0.1 * length
        none = dict.fromkeys(
            ("stretch_stiffness", "stretch_damping", "bend_stiffness", "twist_stiffness",
             "grip_stiffness", "grip_damping"), 0.0,
        )  # fmt: skip
        rope = Rope.uniform(length, mass, nodes, control_period=0.005, substeps=1, **none)
        damping = np.full(nodes - 2, BEND_DAMPING * 0.1 / spacing, np.float32)
        rope = dataclasses.replace(rope, bend_damping=damping, substeps=substeps or 5)
        loads.append(float(load(rope)[nodes // 2]))
    assert loads[0] < LIMIT < loads[1]


@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_noise_on_close_markers_brings_no_nodes(noise):
    assert choose_node_count(dense(60, 0.6, noise=noise)) == 13


def test_markers_far_apart_are_all_nodes():
    assert choose_node_count(dense(21, 1.0)) == 21  # as `palpate record rope` has them
    assert choose_node_count(dense(5, 0.2)) == 5
    assert choose_node_count(dense(8, 0.1)) == 4  # the fewest


def test_a_model_of_fewer_nodes_is_said_and_wanted_ones_are_not(capsys):
    close, given = dense(60, 0.6), IdentifyRope(recordings=(), nodes=17)
    (fitted, scored) = IdentifyRope(recordings=()).reduced(close, dense(60, 0.7))
    assert fitted.observation.shape[2] == scored.observation.shape[2] == 13
    assert starting_rope(fitted).nodes == 13
    assert "the model has 13 nodes between the ends of 60 markers" in capsys.readouterr().out
    (fitted,) = given.reduced(close)
    np.testing.assert_allclose(fitted.observation[0, 0, :, 2], -np.linspace(0, 0.6, 17), atol=1e-6)
    inside = IdentifyRope(recordings=(), driven=(0, 1, -2, -1))
    assert inside.reduced(close) == (close,)
    assert not capsys.readouterr().out
