"""Motion about and along axes, against closed forms, and its fit to the way of a hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.identification.interactive.screws import (
    NOWHERE,
    Pose,
    Screw,
    cross,
    rotation_about,
    screws_of_way,
)
from palpate.identification.interactive.two_joints import Linkage

HINGE = Screw("revolute", np.array([0.0, 0.0, 1.0]), np.array([0.3, -0.2, 0.0]))
SLIDE = Screw("prismatic", np.array([1.0, 0.0, 0.0]), np.zeros(3))
numbers = st.floats(-1.0, 1.0)


@given(st.tuples(numbers, numbers, numbers), st.floats(-3.0, 3.0))
def test_a_rotation_keeps_its_axis_and_lengths(axis, angle):
    axis = np.array(axis)
    if np.linalg.norm(axis) < 1e-3:
        return
    axis /= np.linalg.norm(axis)
    turn = rotation_about(axis, angle)
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.allclose(turn @ axis, axis, atol=1e-12)
    assert np.trace(turn) == pytest.approx(1.0 + 2.0 * math.cos(angle), abs=1e-9)


def test_a_quarter_turn_about_a_hinge():
    moved = HINGE.pose(0.5 * math.pi).at(np.array([[1.3, -0.2, 0.5]]))
    assert np.allclose(moved, [[0.3, 0.8, 0.5]])


def test_poses_compose_and_come_back():
    one, other = HINGE.pose(0.4), SLIDE.pose(0.2)
    points = np.random.default_rng(0).standard_normal((5, 3))
    assert np.allclose((one @ other).at(points), one.at(other.at(points)))
    assert np.allclose(one.inverse.at(one.at(points)), points)
    assert isinstance(one @ other, Pose)


@pytest.mark.parametrize(("screw", "end"), [(HINGE, 2.5), (SLIDE, 0.4)])
def test_positions_of_points_that_moved_are_found_again(screw, end):
    start = np.array([0.9, 0.1, 0.4])
    wanted = np.linspace(0.0, end, 20)
    way = np.array([screw.pose(one).at(start[None])[0] for one in wanted])
    assert np.allclose(screw.position_of(start, way), wanted, atol=1e-9)
    assert np.abs(screw.strays(way)).max() < 1e-12


@pytest.mark.parametrize("screw", [HINGE, SLIDE])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_joint_is_read_from_the_way_of_a_hand(screw, sign):
    start = np.array([0.9, 0.1, 0.4])
    wanted = sign * np.linspace(0.0, 0.6, 60)
    way = np.array([screw.pose(one).at(start[None])[0] for one in wanted])
    way += 3e-4 * np.random.default_rng(0).standard_normal(way.shape)
    found = screws_of_way(way)[0]
    assert found.joint == screw.joint
    assert found.axis @ (sign * screw.axis) > math.cos(math.radians(1.0))
    if screw.joint == "revolute":
        apart = np.cross(found.point - screw.point, screw.axis)
        assert np.linalg.norm(apart) < 0.01


def test_a_varied_screw_is_turned_and_moved_by_as_much():
    by = np.array([0.01, -0.02, 0.03, 0.04])
    varied = HINGE.varied(by)
    assert math.acos(varied.axis @ HINGE.axis) == pytest.approx(math.hypot(0.01, 0.02), rel=1e-3)
    assert np.linalg.norm(varied.point - HINGE.point) == pytest.approx(0.05)


def test_axes_are_as_far_apart_as_their_lines_whichever_way_they_point() -> None:
    upright = Screw("revolute", np.array([0.0, 0.0, 1.0]), np.zeros(3))
    tilt = math.radians(30.0)
    other = Screw(
        "revolute", -np.array([0.0, math.sin(tilt), math.cos(tilt)]), np.array([0.3, 0.4, 7.0])
    )
    assert upright.distance_to(other) == pytest.approx((30.0, 0.5))
    assert upright.distance_to(upright) == (0.0, 0.0)


@given(st.tuples(*6 * [numbers]))
def test_cross_products_are_numpy_s(values):
    one, other = np.array(values).reshape(2, 3)
    assert np.allclose(cross(one, other), np.cross(one, other), atol=1e-15)


def test_a_radius_is_the_distance_from_the_axis_wherever_along_it():
    points = np.array([[1.3, -0.2, 0.5], [0.3, 0.4, -7.0], [0.3, -0.2, 2.0]])
    assert HINGE.radii(points) == pytest.approx([1.0, 0.6, 0.0])


@pytest.mark.parametrize("inner", [HINGE, SLIDE], ids=["hinge", "slide"])
def test_a_way_tells_how_far_both_of_two_joints_have_gone(inner):
    base = Pose(rotation_about(np.array([0.6, 0.8, 0.0]), 0.7), np.array([0.1, 0.2, 0.3]))
    outer = Screw("revolute", np.array([0.0, 0.6, 0.8]), np.array([-0.5, 0.0, 0.2]))
    start, shares = np.array([[0.9, 0.4, -0.1]]), np.linspace(0.1, 1.0, 60)
    way = np.concatenate(
        [(base @ outer.pose(0.8 * s) @ inner.pose(-0.5 * s**2)).at(start) for s in shares]
    )
    linkage = Linkage(base, (outer, inner), start)
    assert linkage.follow((0.08, -0.005), way, 0.01) == pytest.approx((0.8, -0.5), abs=1e-6)
    assert linkage.follow((0.08, -0.005), way[:, ::-1], 0.01) is None


def test_from_a_flat_place_an_elbow_bends_up_or_down_and_otherwise_as_it_began():
    upper = Screw("revolute", np.array([0.0, 1.0, 0.0]), np.zeros(3))
    lower = Screw("revolute", np.array([0.0, 1.0, 0.0]), np.array([0.4, 0.0, 0.0]))
    linkage = Linkage(NOWHERE, (upper, lower), np.array([[0.7, 0.0, 0.0]]))
    turned = np.linspace(0.0, 1.0, 40)[:, None] * np.array([0.5, -0.9])
    way = np.array([linkage.there(one)[0] for one in turned])
    for ends in (linkage.ends((0.0, 0.0), way, 0.01), linkage.ends((0.1, -0.05), way, 0.01)):
        assert sorted(ends)[1] == pytest.approx((0.5, -0.9), abs=1e-3)
        assert len(ends) == 2
        for one in ends:
            np.testing.assert_allclose(linkage.there(np.array(one))[0], way[-1], atol=1e-3)
    back = turned[::-1][:30]
    ends = linkage.ends((0.5, -0.9), np.array([linkage.there(one)[0] for one in back]), 0.01)
    assert ends == [pytest.approx(back[-1], abs=1e-3)]
    assert linkage.leads((0.0, 0.0), (0.5, -0.9), way, 0.01)
    assert not linkage.leads((0.0, 0.0), (-0.5, 0.9), way, 0.01)
