"""The deck's table of primitives, and what becomes of a motion under each constraint."""

import math

import numpy as np
import pytest

from palpate.numerics.polygons import place_points
from palpate.planning.movable_obstacles.maps.map import Movable
from palpate.planning.movable_obstacles.motion.constrained import (
    ConstrainedManipulation,
    Drawn,
    swept,
)
from palpate.planning.movable_obstacles.motion.manipulation import (
    BACKWARD,
    FORWARD,
    LEFT,
    RIGHT,
    Grasp,
    ManipulationModel,
    RigidCarry,
    outline_grasps,
)
from palpate.planning.movable_obstacles.motion.primitives import (
    LEVER,
    SEPARATION,
    Constraint,
    Turn,
    anchors,
    grasp_share,
    twist,
)

OUTLINE = np.array([[-0.5, -0.3], [0.5, -0.3], [0.5, 0.3], [-0.5, 0.3]])
PIECE = Movable("piece", OUTLINE, (1.0, 2.0, 0.4))
POSE = np.array(PIECE.pose)
GRASP = Grasp((0.5, 0.1), 0.0)
ROBOT = GRASP.robot_pose(POSE, 0.4)
LENGTHS = np.linspace(0.05, 0.6, 12)


def moved(constraint: Constraint, primitive, force: float = 100.0):
    model = ConstrainedManipulation({"piece": Drawn((constraint,))}, force)
    return model.motion(PIECE, POSE, ROBOT, primitive, LENGTHS, 0)


def test_is_a_model_of_manipulation():
    assert isinstance(
        ConstrainedManipulation({"piece": Drawn((Constraint("free"),))}, 1.0), ManipulationModel
    )


@pytest.mark.parametrize("primitive", [FORWARD, LEFT])
def test_a_free_piece_is_carried_rigidly(primitive):
    ours = moved(Constraint("free"), primitive)
    rigid = RigidCarry().motion(PIECE, POSE, ROBOT, primitive, LENGTHS, 0)
    np.testing.assert_allclose(ours.object_poses, rigid.object_poses, atol=1e-9)
    np.testing.assert_allclose(ours.robot_poses, rigid.robot_poses, atol=1e-9)


@pytest.mark.parametrize("anchor", [(-0.4, -0.2), (-0.5, 0.3)])
def test_a_pivot_keeps_its_point_whatever_point_was_meant(anchor):
    constraint = Constraint("pivot", anchor)
    motion = moved(constraint, Turn("turn", turn=1.0, anchor=(anchor[0] + 0.1, anchor[1])))
    points = place_points(np.array([anchor]), motion.object_poses)[:, 0]
    np.testing.assert_allclose(points - place_points(np.array([anchor]), POSE)[0], 0, atol=1e-9)
    assert np.ptp(motion.object_poses[:, 2]) == pytest.approx(np.ptp(LENGTHS))
    # The base keeps its place by the object.
    held = [np.linalg.norm(robot[:2] - pose[:2]) for robot, pose in zip(
        motion.robot_poses, motion.object_poses, strict=True)]  # fmt: skip
    assert np.ptp(held) < 1e-9


@pytest.mark.parametrize(
    ("constraint", "primitive"),
    [
        (Constraint("pivot", (-0.4, -0.2)), FORWARD),
        (Constraint("pivot", (-0.4, -0.2)), Turn("turn", turn=1.0, anchor=(0.4, 0.2))),
        (Constraint("axis", (-0.4, 0.0), 0.0), LEFT),
        (Constraint("static"), FORWARD),
        (Constraint("static"), Turn("turn", turn=1.0)),
    ],
)
def test_what_a_constraint_holds_stays_where_it_is(constraint, primitive):
    motion = moved(constraint, primitive)
    np.testing.assert_allclose(motion.object_poses, np.tile(POSE, (len(LENGTHS), 1)), atol=1e-12)
    np.testing.assert_allclose(motion.robot_poses[:, :2], np.tile(ROBOT[:2], (12, 1)), atol=1e-12)


def test_an_axis_lets_a_piece_roll_along_it_only():
    slanted = Constraint("axis", (-0.4, 0.0), 0.2)
    motion = moved(slanted, FORWARD)
    step = motion.object_poses[-1, :2] - POSE[:2]
    assert math.atan2(-step[1], -step[0]) == pytest.approx(POSE[2] + 0.2)
    assert np.linalg.norm(step) == pytest.approx(LENGTHS[-1] * math.cos(0.2))


def test_what_is_too_heavy_for_the_hand_stays_and_energy_is_force_times_way():
    assert np.ptp(moved(Constraint("free", force=101.0), FORWARD).object_poses[:, 0]) == 0
    motion = moved(Constraint("free", force=30.0), FORWARD)
    np.testing.assert_allclose(motion.energy, 30.0 * LENGTHS, atol=1e-9)


def test_grasps_stand_as_the_table_says():
    grasps = outline_grasps(OUTLINE, 0.3)
    uniform = np.full(len(grasps), 1 / len(grasps))
    for constraint in (Constraint("free"), Constraint("axis", (-0.4, 0.0), 0.0)):
        assert grasp_share(constraint, grasps) == pytest.approx(uniform)
    point = (0.0, -0.25)
    away = grasp_share(Constraint("pivot", point), grasps)
    levers = np.array([math.dist(grasp.point, point) for grasp in grasps])
    assert ((away > 0) == (levers >= LEVER)).all()
    assert 0 < (away > 0).sum() < len(grasps)
    assert not grasp_share(Constraint("static"), grasps).any()


def test_a_piece_on_wheels_is_pulled_along_its_axis_from_any_face():
    axis = Constraint("axis", (-0.4, 0.0), 0.0)
    model = ConstrainedManipulation({"piece": Drawn((axis,))}, 100.0)
    for grasp in model.grasps(PIECE, 0.3):
        across = abs(math.cos(grasp.normal)) > 0.9
        offered = [p for p in model.primitives(PIECE, grasp, "holonomic") if not p.turn]
        assert offered == ([BACKWARD, FORWARD] if across else [LEFT, RIGHT])
        robot = grasp.robot_pose(POSE, 0.4)
        for primitive in offered:
            motion = model.motion(PIECE, POSE, robot, primitive, LENGTHS, 0)
            step = motion.object_poses[-1, :2] - POSE[:2]
            assert np.linalg.norm(step) == pytest.approx(LENGTHS[-1])
            assert abs(step @ [-math.sin(POSE[2]), math.cos(POSE[2])]) < 1e-9


def test_a_hand_at_the_point_that_is_held_in_place_turns_nothing():
    axis, grasp = Constraint("axis", (-0.4, 0.0), 0.0), Grasp((-0.5, 0.0), math.pi)
    for draws, held in (((axis,), False), ((axis, Constraint("free")), True)):
        model = ConstrainedManipulation({"piece": Drawn(draws)}, 100.0)
        near = [
            one
            for one in model.primitives(PIECE, grasp, "holonomic")
            if isinstance(one, Turn) and math.dist(one.anchor, grasp.point) < LEVER
        ]
        assert bool(near) == held


def test_points_to_turn_about_are_where_most_draws_have_one():
    near = [Constraint("pivot", (0.4, 0.2 + 0.01 * k)) for k in range(3)]
    found = anchors([Constraint("static"), Constraint("free"), *near])
    assert found[0] == pytest.approx((0.4, 0.21))
    assert (0.0, 0.0) in found
    assert all(math.dist(a, b) >= SEPARATION for a in found for b in found if a != b)


def test_a_twist_is_swept_as_small_steps_of_it_are():
    rate, pose = np.array([0.3, -0.2, 0.7]), POSE.copy()
    steps = 20_000
    for _ in range(steps):
        cosine, sine = math.cos(pose[2]), math.sin(pose[2])
        world = [cosine * rate[0] - sine * rate[1], sine * rate[0] + cosine * rate[1], rate[2]]
        pose = pose + np.array(world) * 1.5 / steps
    np.testing.assert_allclose(swept(POSE, rate, np.array([1.5]))[0], pose, atol=1e-4)
    straight = swept(POSE, np.array([0.3, 0.0, 0.0]), np.array([2.0]))[0]
    np.testing.assert_allclose(straight[:2] - POSE[:2], [0.6 * math.cos(0.4), 0.6 * math.sin(0.4)])


def test_a_hand_gives_way_by_a_share_only():
    constraint = Constraint("pivot", (0.0, 0.0))
    wanted = np.array([0.0, -0.1, 1.0])  # a turn about (0.1, 0)
    assert twist(constraint, wanted, 0.5, 0.35)[2] == 1.0
    assert not twist(constraint, wanted, 0.25, 0.35).any()
