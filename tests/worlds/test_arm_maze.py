"""The arm against its published table, Newton and Euler, closed forms, and a tip of its mass."""

import math

import mujoco
import numpy as np
import pytest

from maze_worlds import held
from palpate.errors import PalpateError
from palpate.safety.impedance import ImpedanceLaw
from palpate.worlds.arm.control import OperationalSpace
from palpate.worlds.arm.maze import APPARENT_MASS, GRAVITY, ArmMaze
from palpate.worlds.arm.panda import (
    ARMATURE,
    HAND,
    LINKS,
    RANGE,
    TORQUE_LIMITS,
    add_panda,
)
from palpate.worlds.maze.layout import TIP_RADIUS
from palpate.worlds.maze.maze import FORCE_LIMIT, BlindMaze
from palpate.worlds.maze.scene import CONTACT_STIFFNESS, REFERENCE_HEIGHT
from palpate.worlds.world import Decimated, side_by_side

OPEN = (-0.12, -0.15)  # 5 cm from every wall
# a (m), d (m), alpha (rad) before each joint and the flange: the manufacturer's table, by Craig.
TABLE = (
    (0, 0.333, 0), (0, 0, -math.pi / 2), (0, 0.316, math.pi / 2), (0.0825, 0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2), (0, 0, math.pi / 2), (0.088, 0, math.pi / 2), (0, 0.107, 0),
)  # fmt: skip


@pytest.fixture(scope="module")
def arm():
    """An arm on the ground, without a peg, which falls."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.gravity = (0, 0, -GRAVITY)
    add_panda(spec, spec.worldbody, (0.0, 0.0, 0.0), 0.0, 0.01)
    model = spec.compile()
    return model, mujoco.MjData(model)


def frames(angles):
    """World from each joint's frame and the flange's, (8, 4, 4), by the table."""
    found, pose = [], np.eye(4)
    for (a, d, alpha), theta in zip(TABLE, [*angles, 0.0], strict=True):
        (s, c), (u, v) = (math.sin(theta), math.cos(theta)), (math.sin(alpha), math.cos(alpha))
        pose = pose @ np.array(
            [[c, -s, 0, a], [s * v, c * v, -u, -d * u], [s * u, c * u, v, d * v], [0, 0, 0, 1]]
        )
        found.append(pose)
    return np.array(found)


def joint_torques(angles, speeds, accelerations, gravity=GRAVITY):
    """Newton and Euler from the base to the hand and back (Luh, Walker and Paul 1980)."""
    poses = frames(angles)
    turn, place = poses[:, :3, :3], poses[:, :3, 3]
    bodies = [(link.mass, link.centre, link.inertia, number) for number, link in enumerate(LINKS)]
    c = math.cos(-math.pi / 4)
    skewed = np.array([[c, c, 0], [-c, c, 0], [0, 0, 1]])  # flange from hand, -45 degrees
    omega, alpha = np.zeros(3), np.zeros(3)
    origin, speed_of = np.array([0, 0, gravity]), []
    before = np.zeros(3)
    for joint in range(7):
        arm = place[joint] - before
        origin = origin + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
        axis = turn[joint][:, 2]
        alpha = alpha + axis * accelerations[joint] + np.cross(omega, axis * speeds[joint])
        omega = omega + axis * speeds[joint]
        before = place[joint]
        speed_of.append((origin, omega, alpha))
    torques = np.zeros(7)

    def add(mass, centre, inertia, carrier):
        origin, omega, alpha = speed_of[carrier]
        arm = centre - place[carrier]
        force = mass * (origin + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm)))
        torque = inertia @ alpha + np.cross(omega, inertia @ omega)
        for joint in range(carrier + 1):
            whole = torque + np.cross(centre - place[joint], force)
            torques[joint] += turn[joint][:, 2] @ whole

    for mass, centre, (xx, yy, zz, xy, xz, yz), number in bodies:
        own = turn[number] @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn[number].T
        add(mass, place[number] + turn[number] @ centre, own, number)
    hand = turn[7] @ skewed
    for mass, centre, inertia in (
        (0.73, (-0.01, 0, 0.03), (0.001, 0.0025, 0.0017)),
        *((0.015, (0, y, 0.0584), (2.375e-6, 2.375e-6, 7.5e-7)) for y in (-0.01, 0.01)),
    ):
        add(mass, place[7] + hand @ np.array(centre), hand @ np.diag(inertia) @ hand.T, 6)
    return torques + ARMATURE * np.asarray(accelerations)


def drawn(random):
    return random.uniform(*RANGE), random.normal(size=7), random.normal(size=7)


def test_the_flange_is_where_the_table_says(arm):
    model, data = arm
    random = np.random.default_rng(0)
    for _ in range(20):
        data.qpos[:] = random.uniform(*RANGE)
        mujoco.mj_kinematics(model, data)
        flange = frames(data.qpos)[-1]
        np.testing.assert_allclose(data.body(HAND).xpos, flange[:3, 3], atol=1e-12)
        np.testing.assert_allclose(
            data.body(HAND).xmat.reshape(3, 3)[:, 2], flange[:3, 2], atol=1e-12
        )
    np.testing.assert_array_equal(TORQUE_LIMITS, [87] * 4 + [12] * 3)


def test_its_dynamics_are_those_of_newton_and_euler(arm):
    model, data = arm
    random = np.random.default_rng(1)
    mass = np.zeros((7, 7))
    for _ in range(5):
        angles, speeds, accelerations = drawn(random)
        data.qpos[:], data.qvel[:] = angles, speeds
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        found = mass @ accelerations + data.qfrc_bias
        expected = joint_torques(angles, speeds, accelerations)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def still(**options) -> ArmMaze:
    return ArmMaze(sway=0.0, noise=0.0, **options)


@pytest.mark.parametrize("force", [2.0, 10.0, FORCE_LIMIT])
def test_a_blocked_tip_feels_what_is_commanded(force):
    world = still()
    world.reset(0, start=(-0.165 + TIP_RADIUS, -0.15), contact_friction=0.0)
    observation = held(world, np.array([-force, 0, 0]), 1500, damping=60.0)
    truth = world.truth()
    np.testing.assert_allclose(observation.wrench[:3], (force, 0, 0), atol=0.01 * force)
    np.testing.assert_allclose(truth.force, observation.wrench[:3], atol=1e-3 * force)
    assert truth.peak_force == pytest.approx(force, rel=1e-3)
    level = np.cross([0, 0, -REFERENCE_HEIGHT], [force, 0, 0])[:2]
    np.testing.assert_allclose(observation.wrench[3:5], level, atol=0.01 * force * REFERENCE_HEIGHT)
    depth = -0.175 + TIP_RADIUS - truth.position[0]
    assert depth == pytest.approx(force / CONTACT_STIFFNESS, rel=0.015)


def test_the_wrist_feels_contact_alone_while_the_arm_moves():
    world = still()
    world.reset(0, start=(-0.1, -0.235), contact_friction=0.3)
    random, off, felt = np.random.default_rng(0), [], []
    for _ in range(6):
        push = random.normal(size=3) * (8, 8, 0)
        for _ in range(40):
            observation = world.step(push)
            off.append(observation.wrench[:3] - world.truth().force)
            felt.append(world.truth().peak_force)
    off, felt = np.abs(np.array(off)), np.array(felt)
    assert felt.max() > 5
    assert (off.max(axis=1) < 1e-6 + 0.01 * felt).all()


def test_it_does_what_a_tip_of_its_apparent_mass_does():
    """In the open, against a wall and along it."""
    paths = []
    for kind in (BlindMaze, ArmMaze):
        world = kind(noise=0.0, sway=0.0)
        world.reset(3, start=OPEN)
        found = []
        for number in range(900):
            push = np.array([-2.0, 1.5, 0]) if number < 450 else np.array([1.0, -3.0, 0])
            observation = world.step(push - 15 * world.truth().velocity * (1, 1, 0))
            found.append([*observation.position[:2], world.truth().peak_force])
        paths.append(np.array(found))
    tip, arm = paths
    touch = int(np.argmax(tip[:, 2] > 0))
    assert touch > 100
    assert np.abs(arm - tip)[:touch, :2].max() < 1e-4
    assert np.abs(arm - tip)[:, :2].max() < 0.02  # they bounce a little differently
    assert tip[:, 2].max() > 2
    assert arm[:, 2].max() == pytest.approx(tip[:, 2].max(), rel=0.1)


@pytest.mark.parametrize(("stiffness", "ratio"), [(300.0, 1.0), (800.0, 0.5)])
def test_a_step_of_the_set_point_is_answered_as_the_closed_form_says(stiffness, ratio):
    law = ImpedanceLaw(
        0.03, (50.0, 1000.0), mass=APPARENT_MASS, damping_ratio=ratio, constant_stiffness=stiffness
    )
    world = Decimated(still(), 1, law)
    seen = world.reset(0, start=OPEN)
    law.begin(side_by_side([seen]), np.array([[0.6, 0.8, 0, 0]]), np.array([True]))
    found = []
    for _ in range(400):
        seen = world.world.step(law.command(side_by_side([seen]))[0])
        found.append((seen.position[:2] - OPEN) @ (0.6, 0.8) / 0.03)
    time, rate = 1e-3 * np.arange(1, 401), math.sqrt(stiffness / APPARENT_MASS)
    if ratio == 1.0:
        expected = 1 - np.exp(-rate * time) * (1 + rate * time)
    else:
        fast = rate * math.sqrt(1 - ratio**2)
        ring = np.cos(fast * time) + ratio * rate / fast * np.sin(fast * time)
        expected = 1 - np.exp(-ratio * rate * time) * ring
        assert max(found) == pytest.approx(1 + math.exp(-math.pi * ratio * rate / fast), abs=0.02)
    assert np.abs(np.array(found) - expected).max() < 0.02


def test_energy_does_not_grow_without_a_command():
    """Thrown at a wall, it comes back slower each time, and keeps its height."""
    world = still()
    world.reset(0, start=(-0.1, -0.2), contact_friction=0.2)
    held(world, np.array([1.0, -3.0, 0.0]), 60)
    energies = []
    for _ in range(3000):
        observation = world.step(np.zeros(3))
        assert abs(observation.position[2]) < 1e-3
        if not world.truth().peak_force:
            energies.append(0.5 * APPARENT_MASS * observation.velocity @ observation.velocity)
    later = np.maximum.accumulate(energies[::-1])[::-1]  # the most that is still to come
    assert np.all(later - energies < 5e-3 * energies[0])
    assert energies[-1] < 0.3 * energies[0]


def test_its_own_inertia_is_about_twice_what_it_shows():
    world = still()
    for place in ((-0.27, 0.0), (0.0, -0.04), (0.27, 0.15)):
        world.reset(0, start=place)
        mobility = world._control.inertia()[2][:2, :2]
        own = np.linalg.eigvalsh(np.linalg.inv(mobility))
        assert own[0] > 1.4
        assert own[1] < 2.1
    with pytest.raises(PalpateError, match="does not reach"):
        world.reset(0, start=(0.0, 0.6))


def test_torques_stay_within_the_limits():
    world = still()
    world.reset(0, start=OPEN)
    control: OperationalSpace = world._control
    torque = control.torque(np.array([1e4, -1e4, 0, 0, 0]), np.zeros(5))
    assert np.all(np.abs(torque) <= TORQUE_LIMITS)
    assert np.any(np.abs(torque) == TORQUE_LIMITS)


def test_the_same_seed_gives_the_same_bits():
    def run(seed):
        world = ArmMaze()
        found = [world.reset(seed)]
        force = np.random.default_rng(0).normal(size=(100, 3)) * 10
        return np.concatenate([np.hstack(o) for o in found + [world.step(f) for f in force]])

    np.testing.assert_array_equal(run(4), run(4))
    assert (run(4) != run(5)).mean() > 0.7


def test_a_command_that_is_not_finite_gives_no_force():
    world = still()
    world.reset(0, start=OPEN)
    observation = held(world, np.array([math.nan, 0, 0]), 100)
    assert world.truth().fault
    np.testing.assert_allclose(observation.position, (*OPEN, 0), atol=1e-4)
