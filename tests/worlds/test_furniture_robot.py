"""The robot among furniture: how it drives, holds and bumps, and what its sensors feel."""

import math

import mujoco
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.numerics.polygons import place_points
from palpate.planning.movable_obstacles.motion.body_controller import BodyController, velocity_at
from palpate.worlds.furniture.furniture import FurnitureWorld, Piece, Robot, RobotAction
from palpate.worlds.furniture.robot import RobotObservation
from palpate.worlds.furniture.touch import felt_wrenches
from trolley import EXACT, LENGTH, MASS, OUTLINE, sledge

STILL = np.zeros(3)
WALL = [(1.0, -2.0), (1.2, -2), (1.2, 2), (1, 2)]
AWAY = sledge((5, 5, 0))
REACH = 0.7 * math.cos(0.9) + 0.15  # m, of the nominal posture
# Just within reach of the gripper's surface.
AHEAD = (REACH + 0.04 + 0.01 + LENGTH / 2, 0.0, 0.0)


def drive(world, base=STILL, joints=STILL, grip=None, steps=50):
    action = RobotAction(np.array(base, float), np.array(joints, float), grip)
    return [world.step(action) for _ in range(steps)]


def relative(truth, body=0):
    """The gripper in the frame of a body."""
    pose = truth.poses[body]
    back = place_points(truth.robot.gripper_pose[None, :2] - pose[:2], np.array([0, 0, -pose[2]]))[
        0
    ]
    return np.array([*back, truth.robot.gripper_pose[2] - pose[2]])


# --- driving ---


def test_the_base_follows_its_velocity_within_its_limits():
    world = FurnitureWorld([AWAY], robot=Robot((0.5, -0.5, 1.0)), sensors=EXACT)
    world.reset(0)
    drive(world, (0.2, -0.1, 0.4), steps=100)
    robot = world.truth().robot
    assert robot.base_pose == pytest.approx([0.9, -0.7, 1.8], abs=0.02)
    assert robot.base_velocity == pytest.approx([0.2, -0.1, 0.4], abs=2e-3)
    assert robot.joint_angles == pytest.approx([0.9, -1.8, 0.9], abs=5e-3)
    drive(world, (3, 4, 9))
    assert world.truth().robot.base_velocity == pytest.approx([0.36, 0.48, 1.5], abs=5e-3)


def test_the_arm_follows_and_its_kinematics_are_mujocos():
    world = FurnitureWorld([AWAY], robot=Robot((0.5, -0.5, 1.0)), sensors=EXACT)
    world.reset(0)
    observation = drive(world, (0.1, 0, 0.2), (0.3, 0.5, -0.4), steps=50)[-1]
    truth = world.truth().robot
    assert truth.joint_angles == pytest.approx([1.2, -1.3, 0.5], abs=0.06)
    assert truth.joint_velocities == pytest.approx([0.3, 0.5, -0.4], abs=0.01)
    model, data, *_ = world._running
    mujoco.mj_forward(model, data)
    gripper = data.body("gripper")
    assert truth.gripper_pose[:2] == pytest.approx(gripper.xpos[:2], abs=1e-9)
    assert gripper.xpos[2] == pytest.approx(0.3)
    yaw = math.atan2(gripper.xmat[3], gripper.xmat[0])
    assert truth.gripper_pose[2] == pytest.approx(yaw)
    assert observation.robot.gripper_pose == pytest.approx(truth.gripper_pose, abs=0.01)


def test_folded_the_gripper_is_within_the_base():
    robot = Robot()
    world = FurnitureWorld([AWAY], robot=robot, sensors=EXACT)
    world.reset(0)
    way = np.array(robot.folded) - robot.nominal
    drive(world, joints=way / 2, steps=100)
    drive(world, steps=20)
    folded = world.truth().robot
    assert folded.joint_angles == pytest.approx(robot.folded, abs=0.02)
    assert np.hypot(*folded.gripper_pose[:2]) + 0.04 < robot.radius


def test_a_wall_stops_the_base_and_is_felt():
    # Backwards, so that the gripper is out of the way.
    world = FurnitureWorld([AWAY], walls=[WALL], robot=Robot((0, 0, math.pi)), sensors=EXACT)
    world.reset(0)
    free = drive(world, (0.4, 0, 0), steps=60)[10:]
    assert np.abs([o.robot.base_force for o in free]).max() < 15
    blocked = drive(world, (0.4, 0, 0), steps=60)[-1]
    assert world.truth().robot.base_pose[0] == pytest.approx(0.75, abs=0.01)
    assert blocked.robot.base_force[0] == pytest.approx(200, rel=0.1)
    assert not blocked.wrench.any()  # no piece is near
    # No servo has run ahead meanwhile: it turns round in 0.4 s and comes away from the wall.
    drive(world, (-0.4, 0, 0), steps=25)
    assert world.truth().robot.base_pose[0] == pytest.approx(0.75 - 0.08, abs=0.03)


# --- grasping ---


def test_it_grasps_only_what_it_touches_holds_it_and_lets_go():
    turned = (*AHEAD[:2], math.pi)
    world = FurnitureWorld([sledge(turned), AWAY], robot=Robot(), sensors=EXACT)
    world.reset(0)
    assert drive(world, grip=1, steps=5)[-1].robot.holding is None
    assert drive(world, grip=0, steps=5)[-1].robot.holding == 0
    held = relative(world.truth())
    for base, joints in [((0.2, 0.1, 0), STILL), ((0, 0, 0.5), STILL), (STILL, (0.3, 0, -0.3))]:
        drive(world, base, joints, 0, 60)
        truth = world.truth()
        assert relative(truth) == pytest.approx(held, abs=0.01)
    drive(world, grip=0)
    let_go = world.truth().poses[0]
    assert drive(world, (-0.3, 0, 0), grip=None)[-1].robot.holding is None
    truth = world.truth()
    assert truth.poses[0] == pytest.approx(let_go, abs=0.05)
    assert np.linalg.norm(relative(truth)[:2] - held[:2]) > 0.1
    drive(world, (0, 0, 0), grip=0, steps=5)
    assert world.truth().robot.holding is None  # it has driven away


@pytest.mark.parametrize(("gap", "grasped"), [(0.025, True), (0.035, False)])
def test_three_centimetres_are_near_enough(gap, grasped):
    pose = (REACH + 0.04 + gap + LENGTH / 2, 0, 0)
    world = FurnitureWorld([sledge(pose)], robot=Robot(), sensors=EXACT)
    world.reset(0)
    assert (drive(world, grip=0, steps=1)[-1].robot.holding == 0) == grasped


def test_what_is_bolted_stays_though_it_is_held():
    pose = (REACH + 0.05 + 0.4, 0, 0)
    world = FurnitureWorld([Piece("bolted", pose)], robot=Robot(), sensors=EXACT)
    world.reset(0)
    observation = drive(world, (-0.3, 0, 0), grip=0)[-1]
    assert observation.robot.holding == 0
    truth = world.truth()
    assert truth.poses[0] == pytest.approx(pose)
    assert abs(truth.robot.gripper_pose[0] - REACH) < 0.03
    assert observation.robot.wrist_wrench[0] < -100
    assert observation.wrench[0, 0] == pytest.approx(observation.robot.wrist_wrench[0])


# --- feeling ---


def test_the_wrist_feels_what_newton_says():
    friction = 0.4
    world = FurnitureWorld([sledge(AHEAD, friction=friction)], robot=Robot(), sensors=EXACT)
    world.reset(0)
    drive(world, grip=0, steps=10)
    dragged = drive(world, (-0.2, 0, 0), grip=0, steps=100)[50:]
    wrench = np.mean([o.robot.wrist_wrench for o in dragged], 0)
    assert wrench[0] == pytest.approx(-friction * MASS * 9.81, rel=0.05)
    # The base pulls by as much, and knows that it bumps into nothing.
    assert np.abs(np.mean([o.robot.base_force for o in dragged], 0)).max() < 3

    world = FurnitureWorld([sledge(AHEAD)], robot=Robot(), sensors=EXACT)
    world.reset(0)
    drive(world, grip=0, steps=10)
    impulse = sum(o.wrench[0] for o in drive(world, (0.3, 0.1, 0.2), grip=0, steps=100)) * 0.02
    truth = world.truth()
    # The gripper's own 0.3 kg belong to what the wrist moves.
    assert impulse[:2] == pytest.approx(MASS * truth.velocities[0, :2], rel=0.06, abs=0.1)


def test_a_push_with_the_open_gripper_is_felt_at_its_point():
    friction = 0.1
    pose = (REACH + 0.04 + 0.05 + LENGTH / 2, 0.1, 0.0)
    world = FurnitureWorld([sledge(pose, friction=friction)], robot=Robot(), sensors=EXACT)
    world.reset(0)
    pushed = drive(world, (0.2, 0, 0), steps=60)[-1]
    assert pushed.robot.holding is None
    assert pushed.wrench[0, :2] == pytest.approx(pushed.robot.wrist_wrench[:2])
    assert pushed.wrench[0, 0] > 0.5 * friction * MASS * 9.81
    lever = pushed.robot.gripper_pose[:2] - pushed.poses[0, :2]
    force = pushed.wrench[0, :2]
    assert pushed.wrench[0, 2] == pytest.approx(lever[0] * force[1] - lever[1] * force[0], abs=1.5)


def test_a_bump_of_the_base_is_felt_by_the_piece_it_hits():
    friction = 0.3
    robot = Robot((0, 0, math.pi))  # backwards into it
    world = FurnitureWorld(
        [sledge((0.9, 0, 0), friction=friction), AWAY], robot=robot, sensors=EXACT
    )
    world.reset(0)
    seen = drive(world, (0.3, 0, 0), steps=100)
    felt = np.array([o.wrench for o in seen])
    assert not felt[:10].any()
    assert not felt[:, 1].any()
    steady = felt[-40:, 0].mean(0)
    assert steady[0] == pytest.approx(friction * MASS * 9.81, rel=0.1)
    assert abs(steady[2]) < 2
    assert world.truth().poses[0, 0] > 1.0


def touch(**changes) -> RobotObservation:
    at_rest = {
        "base_pose": STILL,
        "base_velocity": STILL,
        "joint_angles": STILL,
        "gripper_pose": np.array([0.6, 0.1, 0.0]),
        "wrist_wrench": np.array([10.0, 5.0, 2.0]),
        "base_force": np.zeros(2),
        "holding": None,
    }
    return RobotObservation(**{**at_rest, **changes})


def felt(robot, poses=((1.15, 0.0, 0.0),), walls=()):
    outlines = [np.array(OUTLINE)] * len(poses)
    return felt_wrenches(robot, 0.25, np.array(poses, float), outlines, walls)


def test_a_felt_wrench_goes_to_whom_it_belongs():
    # Held: about the origin, wherever that is.
    assert felt(touch(holding=0))[0] == pytest.approx([10, 5, 2 - 0.55 * 5 - 0.1 * 10])
    # Not held: a force at the nearest point of the outline, no torque of its own.
    assert felt(touch())[0] == pytest.approx([10, 5, -0.5 * 5 - 0.1 * 10])
    assert not felt(touch(), poses=[(1.3, 0, 0)]).any()  # 6 cm away from the gripper
    assert not felt(touch(wrist_wrench=np.array([1.0, 1.0, 9.0]))).any()  # a trembling gripper
    wall = np.array([(0.5, 0.05), (0.57, 0.05), (0.57, 0.2), (0.5, 0.2)])
    assert not felt(touch(), walls=[wall]).any()  # 3 cm from it, 5 from the body's outline
    assert felt(touch(), walls=[wall - [0.1, 0]]).any()
    # Two bodies: the nearer one.
    both = felt(touch(), poses=[(1.16, 0, 0), (1.15, 0, 0)])
    assert not both[0].any()
    assert both[1].any()
    # The base: above its threshold.
    bumped = touch(base_force=np.array([40.0, 0.0]), wrist_wrench=STILL)
    assert felt(bumped, poses=[(0.76, 0.1, 0)])[0] == pytest.approx([40, 0, 4])
    gentle = touch(base_force=np.array([10.0, 0.0]), wrist_wrench=STILL)
    assert not felt(gentle, poses=[(0.76, 0.1, 0)]).any()


# --- with the body controller ---


def test_the_body_controller_moves_a_held_table_where_it_should_go():
    robot = Robot()
    piece = sledge(AHEAD, friction=0.1)
    world = FurnitureWorld([piece], robot=robot, sensors=EXACT)
    observation = world.reset(0)
    observation = drive(world, grip=0, steps=5)[-1]
    controller = BodyController(links=robot.links, nominal=robot.nominal)
    start, wanted, commanded = world.truth().poses[0], np.array([-0.15, 0.1, 0.1]), np.zeros(3)
    for _ in range(200):
        gripper = velocity_at(wanted, observation.poses[0], observation.robot.gripper_pose[:2])
        commanded, joints = controller.split(
            observation.robot.base_pose, commanded, observation.robot.joint_angles, gripper, 0.02
        )
        observation = world.step(RobotAction(commanded, joints, 0))
    moved = world.truth().poses[0] - start
    assert moved == pytest.approx(4 * wanted, abs=0.07)
    assert world.truth().robot.joint_angles == pytest.approx(robot.nominal, abs=0.15)


# --- the contract ---


def test_the_same_seed_gives_the_same():
    def run(seed):
        world = FurnitureWorld([sledge(AHEAD)], robot=Robot())
        world.reset(seed)
        seen = drive(world, (0.2, 0.1, 0.1), (0.1, 0, 0), 0, 30)
        return np.array([[*o.robot.base_pose, *o.wrench[0], *o.poses[0]] for o in seen])

    assert (run(3) == run(3)).all()
    assert (run(3) != run(4)).any()


def test_noise_of_the_robots_sensors():
    world = FurnitureWorld([AWAY], robot=Robot())
    world.reset(0)
    seen = [o.robot for o in drive(world, steps=500)[20:]]
    assert np.std([r.base_pose for r in seen], 0) == pytest.approx([1e-3] * 3, rel=0.15)
    assert np.std([r.base_velocity for r in seen], 0) == pytest.approx([1e-3] * 3, rel=0.15)
    assert np.std([r.joint_angles for r in seen], 0) == pytest.approx([1e-4] * 3, rel=0.15)
    assert np.std([r.wrist_wrench for r in seen], 0) == pytest.approx([0.2, 0.2, 0.05], rel=0.15)
    # 33 kg whose acceleration is judged from two velocities.
    expected = 33 * math.sqrt(2) * 1e-3 / 0.02
    assert np.std([r.base_force for r in seen], 0) == pytest.approx([expected] * 2, rel=0.15)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros((1, 3)), "takes a RobotAction"),
        (RobotAction(np.zeros(2), STILL), "base_velocity is three finite numbers"),
        (RobotAction(STILL, np.full(3, np.nan)), "joint_velocity is three finite numbers"),
        (RobotAction(STILL, STILL, 1), "grips body 0 to 0, or None, not 1"),
        (RobotAction(STILL, STILL, -1), "grips body 0 to 0, or None, not -1"),
    ],
)
def test_a_malformed_action_of_a_robot_is_refused(action, message):
    world = FurnitureWorld([AWAY], robot=Robot())
    world.reset(0)
    with pytest.raises(PalpateError, match=message):
        world.step(action)


def test_a_robot_is_refused_where_it_cannot_be():
    with pytest.raises(PalpateError, match="three finite numbers x, y, yaw"):
        Robot((0, 0))
    with pytest.raises(PalpateError, match="radius and links are above 0"):
        Robot(radius=0.0)
    with pytest.raises(PalpateError, match="the sledge starts inside the robot"):
        FurnitureWorld([sledge()], robot=Robot()).reset(0)
    with pytest.raises(PalpateError, match="the robot starts inside the wall 0"):
        FurnitureWorld([AWAY], walls=[WALL], robot=Robot((1, 0, 0))).reset(0)
    world = FurnitureWorld([AWAY])
    world.reset(0)
    with pytest.raises(PalpateError, match="without a robot takes wrenches"):
        world.step(RobotAction(STILL, STILL))
