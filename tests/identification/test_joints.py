"""A joint from ways of a hand and sheets that were seen, and what it refutes."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from palpate.identification.interactive.refinement import Estimate, Sighting, refine, surprise
from palpate.identification.interactive.screws import Screw


def sheet(corner: float) -> Sighting:
    """What is seen of a sheet in the plane z = 0, which is the same wherever it has slid to."""
    x, y = np.meshgrid(np.arange(0.2, 0.8, 0.02), np.arange(0.0, 0.5, 0.02))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, corner)], axis=1)
    normals = np.tile([0.0, 0.0, 1.0], (x.size, 1))
    return Sighting(points, normals, np.full(x.size, 1e-3), cKDTree(points))


def boxed(gone: float) -> Sighting:
    """A box's face towards x, and its side towards y, that slid along y."""
    side, up = (one.ravel() for one in np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40)))
    face = np.stack([0.0 * side, side, up], axis=1)
    flank = np.stack([side, 0.0 * side, up], axis=1)
    points = np.concatenate([face, flank]) + np.array([0.0, gone, 0.0])
    normals = np.repeat([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], len(face), axis=0)
    return Sighting(points, normals, np.full(len(points), 1e-3), cKDTree(points))


def test_a_joint_is_at_zero_in_the_look_in_which_it_was_described() -> None:
    slide = Screw("prismatic", np.array([0.0, 1.0, 0.0]), np.zeros(3))
    way = np.array([0.0, 0.5, 0.5]) + np.linspace(0.1, 0.2, 40)[:, None] * slide.axis
    seen = [boxed(0.0), boxed(0.1), boxed(0.2)]
    found = refine(slide, np.array([-0.095, 0.0, 0.1]), seen, [(1, way)])
    assert found.positions == pytest.approx([-0.1, 0.0, 0.1], abs=1e-3)


def test_the_hand_says_how_far_a_sheet_has_slid_in_its_plane() -> None:
    way = np.linspace((0.5, 0.2, 0.01), (0.6, 0.2, 0.01), 40)
    way = np.concatenate([way[:1], way[:1], way, way[-1:], way[-1:]])  # at rest at both ends
    screw = Screw("prismatic", np.array([1.0, 0.0, 0.0]), way[0])
    for guess in (0.0, 0.1, 0.16):
        found = refine(screw, np.array([0.0, guess]), [sheet(0.0), sheet(0.0)], [(0, way)])
        assert found.positions[1] == pytest.approx(0.1, abs=2e-3)
    alone = refine(screw, np.array([0.0, 0.16]), [sheet(0.0), sheet(0.0)], [])
    assert alone.positions[1] == pytest.approx(0.16, abs=2e-3)  # no cloud says it


def test_looks_that_show_a_part_at_one_place_move_together() -> None:
    slide = Screw("prismatic", np.array([0.0, 1.0, 0.0]), np.zeros(3))
    seen = [boxed(0.0), *[boxed(0.1)] * 3]
    found = refine(slide, np.array([0.0, 0.095, 0.0952, 0.0954]), seen, [])
    assert found.positions == pytest.approx([0.0, 0.1, 0.1, 0.1], abs=1e-3)


def test_where_a_hand_began_is_not_known_if_the_part_was_not_seen_there() -> None:
    # it was seen at 0 and .25, and taken from .15, where it was thought to be at .1
    moved = Screw("prismatic", np.array([0.0, 1.0, 0.0]), np.zeros(3))
    start = np.array([0.0, 0.5, 0.5])
    way = start + np.linspace(0.0, 0.1, 40)[:, None] * moved.axis
    seen = [boxed(0.0), None, boxed(0.25)]
    found = refine(moved, np.array([0.0, 0.1, 0.247]), seen, [(1, way)])
    assert found.positions == pytest.approx([0.0, 0.15, 0.25], abs=8e-3)


def turned(seen: Sighting, screw: Screw, turn: float) -> Sighting:
    """The same, once it has turned about a joint."""
    pose = screw.pose(turn)
    points = pose.at(seen.points)
    return Sighting(points, pose.turned(seen.normals), seen.deviation, cKDTree(points))


def degrees_between(screw: Screw, other: Screw) -> float:
    return float(np.degrees(np.arccos(min(abs(screw.axis @ other.axis), 1.0))))


def test_a_board_turns_about_a_hinge_in_its_plane() -> None:
    hinge, turn = Screw("revolute", np.array([0.0, 1.0, 0.0]), np.zeros(3)), -0.6
    seen = [sheet(0.0), turned(sheet(0.0), hinge, turn)]
    bisector = np.array([np.sin(0.5 * turn), 0.0, np.cos(0.5 * turn)])
    for tilt in (-0.2, 0.2):  # out of its plane: this takes the sheet to the same plane
        axis = np.cos(tilt) * hinge.axis + np.sin(tilt) * bisector
        found = refine(dataclasses.replace(hinge, axis=axis), np.array([0.0, turn]), seen, [])
        assert degrees_between(found.screw, hinge) < 2.0
        aside = np.cross(found.screw.point, hinge.axis)
        assert np.linalg.norm(aside) < 0.02


def test_what_is_not_flat_turns_about_any_axis() -> None:
    screw, turn = Screw("revolute", np.full(3, 3.0**-0.5), np.array([0.3, 0.0, 0.0])), 0.5
    seen = [boxed(0.0), turned(boxed(0.0), screw, turn)]
    guess = screw.varied(np.array([0.05, -0.05, 0.0, 0.01]))
    found = refine(guess, np.array([0.0, 0.48]), seen, [])
    assert degrees_between(found.screw, screw) < 0.2


def test_a_way_surprises_the_joint_that_it_is_not_of() -> None:
    random = np.random.default_rng(0)
    screw = Screw("revolute", np.array([0.0, 0.0, 1.0]), np.zeros(3))
    angles = np.linspace(0.0, 0.8, 60)

    def way(screw: Screw) -> np.ndarray:
        points = np.array([screw.pose(one).at(np.array([[0.5, 0.0, 0.2]]))[0] for one in angles])
        return points + 1e-3 * random.standard_normal(points.shape)

    known = refine(screw, np.zeros(2), [None, None], [(0, way(screw)) for _ in range(8)])
    assert surprise(known, way(screw)) < 1.0
    assert surprise(known, way(screw.varied(np.array([0.3, 0.0, 0.0, 0.0])))) > 3.0
    assert surprise(known, way(screw.varied(np.array([0.0, 0.0, 0.0, 0.2])))) > 1.2


@pytest.mark.parametrize(
    ("by", "joint", "refuted"),
    [
        ((0.0, 0.0, 0.02, 0.0), "revolute", False),
        ((0.0, 0.0, 0.06, 0.0), "revolute", True),
        ((0.0, 0.1, 0.0, 0.0), "revolute", False),
        ((0.3, 0.0, 0.0, 0.0), "revolute", True),
        ((0.3, 0.0, 0.2, 0.0), "prismatic", False),
    ],
)
def test_a_joint_refutes_what_is_many_intervals_away_and_of_its_kind(by, joint, refuted):
    screw = Screw("revolute", np.array([0.0, 0.0, 1.0]), np.array([0.2, 0.1, 0.0]))
    spread = np.array([0.03, 0.03, 0.006, 0.006])
    known = Estimate(screw, np.zeros(2), np.diag(spread**2), 0.0, 0.0)
    assert known.refutes(dataclasses.replace(screw.varied(np.array(by)), joint=joint)) == refuted


def test_a_slide_refutes_by_its_direction_alone():
    screw = Screw("prismatic", np.array([0.0, 0.0, 1.0]), np.zeros(3))
    known = Estimate(screw, np.zeros(2), np.diag([1e-4, 1e-4, 0.0, 0.0]), 0.0, 0.0)
    assert not known.refutes(screw.varied(np.array([0.0, 0.0, 1.0, 0.0])))
    assert known.refutes(screw.varied(np.array([0.2, 0.0, 0.0, 0.0])))
