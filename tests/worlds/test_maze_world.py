"""The maze against closed forms: springs, momentum, sway, noise, dry friction, and its limits."""

import math

import mujoco
import numpy as np
import pytest

from maze_worlds import held
from palpate.errors import PalpateError
from palpate.worlds.maze.layout import BLOCK_HALF_SIZES, TIP_RADIUS, find_layout
from palpate.worlds.maze.maze import (
    DISPLACEMENT_LIMIT,
    FORCE_LIMIT,
    OBSTACLE_FRICTION,
    STIFFNESS_RANGE,
    SWAY,
    BlindMaze,
)
from palpate.worlds.maze.scene import (
    CONTACT_STIFFNESS,
    REFERENCE_HEIGHT,
    SHAFT_HEIGHT,
    SWAY_AXIS,
    TIP_MASS,
)
from palpate.worlds.maze.tip import (
    FORCE_NOISE,
    POSITION_CORRELATION,
    POSITION_NOISE,
    WRENCH_CORRELATION,
)
from palpate.worlds.world import DivergedError

HOME = find_layout("home")
BLOCK_FACE = HOME.obstacle.position[0] - BLOCK_HALF_SIZES[0]
AT_BLOCK = (BLOCK_FACE - TIP_RADIUS - 1e-4, HOME.obstacle.position[1])
OPEN = (-0.12, -0.15)  # 5 cm from every wall, between the thin wall and the thick one


def still(**options) -> BlindMaze:
    return BlindMaze(sway=0.0, noise=0.0, **options)


@pytest.mark.parametrize("force", [2.0, 10.0, FORCE_LIMIT])
@pytest.mark.parametrize("direction", [(-1, 0), (0.6, -0.8)])
def test_a_wall_gives_way_like_a_spring(force, direction):
    world = still()
    start = (-0.165 + TIP_RADIUS, -0.15) if direction[0] < 0 else (-0.1, -0.235)
    world.reset(0, start=start, contact_friction=0.0)
    push = force * np.array([*direction, 0.0])
    observation = held(world, push, 3000, damping=60.0)
    truth = world.truth()
    if direction[0] < 0:  # against the thin wall's right face
        depth, feels, arm = -0.175 + TIP_RADIUS - truth.position[0], -push, (-1, 0)
    else:  # pressed onto the arena's lower wall, along which it slides until the thick wall
        assert abs(truth.velocity[0]) < 1e-3
        depth, feels, arm = -0.25 + TIP_RADIUS - truth.position[1], -push, (0, -1)
    normal = abs(push @ (*arm, 0))
    assert depth == pytest.approx(normal / CONTACT_STIFFNESS, rel=0.015)
    np.testing.assert_allclose(truth.force, feels, atol=1e-4)
    np.testing.assert_allclose(observation.wrench[:3], truth.force, atol=1e-4)
    assert truth.peak_force == pytest.approx(force, rel=1e-5)
    level = np.cross([0, 0, -REFERENCE_HEIGHT], feels)[:2]
    np.testing.assert_allclose(observation.wrench[3:5], level, atol=1e-4)


def test_the_block_is_felt_at_the_shaft():
    """The same force has another torque than a wall's, which tells the two from each other."""
    world = still()
    world.reset(0, start=AT_BLOCK, obstacle_friction=20.0)
    observation = held(world, np.array([8.0, 0, 0]), 3000, damping=60.0)
    np.testing.assert_allclose(observation.wrench[:3], [-8.0, 0, 0], atol=1e-3)
    assert observation.wrench[4] == pytest.approx(8.0 * (REFERENCE_HEIGHT - SHAFT_HEIGHT), rel=1e-3)


def test_friction_is_felt_as_a_torque_about_the_vertical():
    world = still()
    world.reset(0, start=(-0.1, -0.239), contact_friction=0.3)
    observation = held(world, np.array([3.0, -4.0, 0.0]), 250, damping=20.0)
    # It slides: the wall drags it back by 0.3 times 4 N, at the radius less half its depth.
    np.testing.assert_allclose(observation.wrench[:2], [-1.2, 4.0], rtol=0.02)
    depth = 4.0 / CONTACT_STIFFNESS
    assert observation.wrench[5] == pytest.approx(-1.2 * (TIP_RADIUS - depth / 2), rel=0.05)


def test_in_free_space_force_is_mass_times_acceleration():
    world = still()
    world.reset(0, start=OPEN)
    observation = held(world, np.array([0.6, -0.8, 0.0]), 200)
    np.testing.assert_allclose(
        TIP_MASS * observation.velocity, np.array([0.6, -0.8, 0]) * 0.2, atol=1e-5
    )
    assert not observation.wrench.any()
    assert observation.time == pytest.approx(0.2)


def test_the_base_sways_and_what_rides_on_it_is_seen_at_rest():
    world = BlindMaze(noise=0.0)
    first = world.reset(5, start=(-0.24, 0.1))
    places, times = [], []
    for _ in range(2000):
        observation = world.step(np.zeros(3))
        truth = world.truth()
        times.append(truth.time)
        places.append(truth.sway)
        # Nothing pulls it: it flies on in the world, while the base moves below it.
        offset = truth.position - observation.position
        np.testing.assert_allclose(offset[:2], np.multiply(truth.sway, SWAY_AXIS), atol=1e-12)
        if truth.force.any():
            break
    assert len(times) > 300
    assert first.velocity[1] == 0
    turns = np.array(places) / SWAY
    assert np.abs(turns).max() <= 1.001
    # delta'' = -(2 pi f)^2 delta, with f within 10 % of 1 Hz.
    acceleration = np.diff(turns, 2) / 1e-6
    rate = math.sqrt(-(acceleration @ turns[1:-1]) / (turns[1:-1] @ turns[1:-1]))
    assert 0.9 <= rate / (2 * math.pi) <= 1.1


def test_momentum_of_tip_and_base_together_is_what_the_servo_gives():
    """The force acts between the two: the tip gains what the base loses."""
    world = still()
    world.reset(0, start=OPEN)
    held(world, np.array([0.0, -5.0, 0.0]), 40)
    truth = world.truth()
    assert truth.velocity[1] == pytest.approx(-0.2, rel=1e-3)
    assert 0 < truth.sway < 5e-6  # recoil, which the servo holds


def test_noise_is_an_ornstein_uhlenbeck_process():
    world = BlindMaze(sway=0.0)
    quiet = still()
    world.reset(1, start=OPEN)
    quiet.reset(1, start=OPEN)
    wrench, position = [], []
    for _ in range(40_000):
        observation = world.step(np.zeros(3))
        wrench.append(observation.wrench)
        position.append(observation.position - (*OPEN, 0))
        assert not observation.velocity.any()
    force = np.array(wrench)[:, :3]
    # 400 correlation times of three channels: the variance is known to about 6 %.
    assert force.std() == pytest.approx(FORCE_NOISE, rel=0.1)
    lag = round(WRENCH_CORRELATION / 1e-3)
    correlation = (force[lag:] * force[:-lag]).mean() / force.var()
    assert correlation == pytest.approx(math.exp(-1), abs=0.08)
    assert np.std(position) == pytest.approx(POSITION_NOISE, rel=0.3)
    # It never jumps, not even where the next block of it is drawn: 6 standard deviations.
    most = 6 * POSITION_NOISE * math.sqrt(2 * 1e-3 / POSITION_CORRELATION)
    assert np.abs(np.diff(position, axis=0)).max() < most
    louder = BlindMaze(sway=0.0, noise=2.0)
    np.testing.assert_allclose(
        louder.reset(1, start=OPEN).wrench, 2 * world.reset(1, start=OPEN).wrench
    )


def test_the_block_holds_below_its_friction_and_yields_above():
    world = still()
    world.reset(0, start=AT_BLOCK, obstacle_friction=20.0)
    held(world, np.array([19.0, 0, 0]), 5000, damping=60.0)
    assert world.truth().obstacle < 3e-3  # its dent at first touch, then less than 1 mm in 5 s
    before = world.truth().obstacle
    held(world, np.array([19.0, 0, 0]), 5000, damping=60.0)
    assert world.truth().obstacle - before < 1e-4
    held(world, np.array([21.0, 0, 0]), 10_000, damping=60.0)
    truth = world.truth()
    assert truth.obstacle == pytest.approx(HOME.obstacle.travel, abs=1e-3)
    # Pushed to its end, it lets the tip out of the channel: beyond the thick wall's corner.
    assert truth.position[0] > 0.07 + TIP_RADIUS
    held(world, np.array([0.0, 3.0, 0]), 600, damping=60.0)
    assert world.truth().position[1] > AT_BLOCK[1] + BLOCK_HALF_SIZES[1] + TIP_RADIUS


def pushed_by_spring(stiffness, friction):
    """The block's way and the greatest force as the tip is sent on by the displacement limit.

    Slowly, by a critically damped spring whose end moves at 5 cm/s up to the limit ahead.
    """
    world = still()
    observation = world.reset(0, start=AT_BLOCK, obstacle_friction=friction)
    damping, peak, reached = 2 * math.sqrt(stiffness * TIP_MASS), 0.0, AT_BLOCK[0]
    for _ in range(3000):
        reached = min(reached + 5e-5, observation.position[0] + DISPLACEMENT_LIMIT)
        pull = stiffness * (reached - observation.position[0]) - damping * observation.velocity[0]
        observation = world.step(np.array([pull, 0, 0]))
        peak = max(peak, world.truth().peak_force)
    return world.truth().obstacle, peak


def test_soft_cannot_move_the_block_and_stiff_can_break_the_limit():
    softest = OBSTACLE_FRICTION[0]
    assert softest > 300 * DISPLACEMENT_LIMIT
    assert STIFFNESS_RANGE[1] * DISPLACEMENT_LIMIT > FORCE_LIMIT > OBSTACLE_FRICTION[1]
    moved, peak = pushed_by_spring(300, softest)
    assert moved < 1e-3
    assert peak < 300 * DISPLACEMENT_LIMIT * 1.01
    # On a block at its end stop, or a wall, 30 N are reached; the heaviest block goes before.
    assert pushed_by_spring(STIFFNESS_RANGE[1], 40.0)[1] > FORCE_LIMIT
    moved, peak = pushed_by_spring(850, OBSTACLE_FRICTION[1])
    assert moved > 0.02
    assert peak < FORCE_LIMIT


def test_the_same_seed_gives_the_same_bits_and_another_gives_others():
    def run(seed):
        world = BlindMaze(("home", "training-1"))
        found = [world.reset(seed)]
        force = np.random.default_rng(0).normal(size=(300, 3)) * 10
        return np.concatenate([np.hstack(o) for o in found + [world.step(f) for f in force]])

    np.testing.assert_array_equal(run(4), run(4))
    assert (run(4) != run(5)).mean() > 0.7
    world = BlindMaze()
    world.reset(9)
    held(world, np.ones(3), 50)  # what happened before a reset leaves nothing behind
    np.testing.assert_array_equal(world.reset(4).wrench, BlindMaze().reset(4).wrench)


@pytest.mark.parametrize("force", [(math.nan, 0, 0), (0, math.inf, 0)])
def test_a_command_that_is_not_finite_gives_no_force(force):
    world = still()
    world.reset(0, start=OPEN)
    observation = held(world, np.array(force), 100)
    assert world.truth().fault
    np.testing.assert_allclose(observation.position, (*OPEN, 0), atol=1e-12)
    world.step(np.zeros(3))
    assert not world.truth().fault


def test_episodes_may_begin_anywhere():
    world = BlindMaze(noise=0.0, scattered=True)
    for seed in range(30):
        world.reset(seed)
        world.step(np.zeros(3))
        assert world.truth().peak_force < 3  # the base may bring it to a wall that is near
    assert np.ptp([world.reset(seed).position[0] for seed in range(30)]) > 0.3


def test_several_physics_steps_in_a_period_keep_the_peak():
    slow, fast = still(control_period=0.01), still()
    peaks = []
    for world, steps in ((slow, 10), (fast, 100)):
        world.reset(0, start=(-0.1, -0.235))
        force, seen = np.array([0, -20.0, 0]), []
        for _ in range(steps):
            world.step(force)
            seen.append(world.truth().peak_force)
        peaks.append(np.array(seen))
    np.testing.assert_array_equal(peaks[0], peaks[1].reshape(10, 10).max(1))


def test_what_cannot_be_is_refused():
    with pytest.raises(PalpateError, match="there are: home"):
        BlindMaze(("hom",))
    with pytest.raises(PalpateError, match="whole number of"):
        BlindMaze(control_period=1.5e-3)
    with pytest.raises(PalpateError, match="noise is 0 or greater"):
        BlindMaze(noise=math.nan)
    world = still()
    with pytest.raises(PalpateError, match="after reset"):
        world.step(np.zeros(3))
    with pytest.raises(PalpateError, match="from every wall"):
        world.reset(0, start=(-0.18, 0.2))
    world.reset(0)
    with pytest.raises(PalpateError, match="takes a force"):
        world.step(np.zeros(2))
    world._data.qvel[1] = math.nan
    with pytest.raises(DivergedError):
        world.step(np.zeros(3))
    world.reset(0)


def test_a_picture_shows_the_maze():
    world = still()
    world.reset(0)
    try:
        picture = world.render(64, 48)
    except PalpateError as error:
        if "needs OpenGL" not in str(error):
            raise
        pytest.skip(str(error))  # what no package of Python can bring
    assert picture.shape == (48, 64, 3)
    assert picture.std() > 5


def test_contact_parameters_are_those_of_the_engine():
    """The wall's spring is the same for the block, whatever it weighs."""
    world = still()
    for seed in range(3):
        world.reset(seed, start=AT_BLOCK, obstacle_friction=20.0)
        held(world, np.array([15.0, 0, 0]), 3000)
        truth = world.truth()
        depth = truth.position[0] + TIP_RADIUS - BLOCK_FACE - truth.obstacle
        assert depth == pytest.approx(15.0 / CONTACT_STIFFNESS, rel=0.015)
    assert world._model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
