"""Decisions that are one call of MuJoCo go through the same motion as those stepped at 1 kHz."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.families.contact.environments import arm_maze, blind_mazes
from palpate.safety.energy_tank import EnergyTank, TankMeter
from palpate.safety.passivity import PassivityFilter
from palpate.worlds.gymnasium import VIOLATION
from palpate.worlds.maze.maze import BlindMaze
from palpate.worlds.world import Spring, SpringLaw


def pair(**options):
    """The same mazes twice: rolled out, and stepped."""
    rolled, stepped = (blind_mazes(6, scattered=0.5, **options) for _ in range(2))
    assert rolled.lockstep._rollout is not None
    stepped.lockstep._rollout = None
    return rolled, stepped


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_held_decision_is_the_stepped_one(noise):
    rolled, stepped = pair(noise=noise)
    np.testing.assert_array_equal(rolled.reset(seed=3)[0], stepped.reset(seed=3)[0])
    random, touched, ends = np.random.default_rng(0), 0, []
    for decision in range(64):
        if decision % 8 == 0:
            action = random.uniform(-1, 1, (6, 4))
            action[:, 2] = np.abs(action[:, 2])
        held, others = (one.step(action) for one in (rolled, stepped))
        for one, other in zip(held[:4], others[:4], strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
        assert held[4]["end"].tolist() == others[4]["end"].tolist()
        np.testing.assert_allclose(held[4]["force"], others[4]["force"], atol=1e-7)
        ends += held[4]["end"].tolist()
        truths = zip(rolled.lockstep.worlds, stepped.lockstep.worlds, strict=True)
        for one, other in ((a.truth(), b.truth()) for a, b in truths):
            for name in ("position", "velocity", "force", "peak_force", "sway", "obstacle", "time"):
                left, right = getattr(one, name), getattr(other, name)
                np.testing.assert_allclose(left, right, atol=1e-7, err_msg=name)
            touched += one.peak_force > 1.0
    assert touched > 40
    assert VIOLATION in ends


def test_worlds_may_be_held_and_stepped_by_turns():
    """Nothing of a spring is left in the engine of a world that it was let go of."""
    held, stepped = BlindMaze(noise=1.0), BlindMaze(noise=1.0)
    seen = [world.reset(4) for world in (held, stepped)]
    rollout = held.rollout([held])
    stiffness, damping = np.diag([400.0, 150.0]), np.diag([40.0, 25.0])
    stiffness[0, 1] = stiffness[1, 0] = 90.0
    target = seen[0].position[:2] + np.array([0.01, -0.02])
    assert rollout is not None
    told = rollout.hold(Spring(target[None], stiffness[None], damping[None]), 70, 1e3)
    for _ in range(70):
        force = stiffness @ (target - seen[1].position[:2]) - damping @ seen[1].velocity[:2]
        seen[1] = stepped.step(np.array([*force, 0.0]))
    seen[0] = told.observations[0]
    assert not told.violated.any()
    for _ in range(40):
        for one, other in zip(*seen, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9)
        seen = [world.step(np.array([2.0, 1.0, 0.0])) for world in (held, stepped)]


def test_a_picture_is_of_where_a_rollout_has_come_to():
    world = BlindMaze(noise=0.0)
    position = world.reset(3).position[:2]
    rollout = world.rollout([world])
    assert rollout is not None
    spring = Spring(position[None] + 0.02, 400.0 * np.eye(2)[None], 40.0 * np.eye(2)[None])
    rollout.hold(spring, 100, 1e3)
    try:
        world.render(64, 48)
    except PalpateError as error:
        if "needs OpenGL" not in str(error):
            raise  # without it nothing is drawn, but all is in its place
    shown = world._data.geom_xpos[world.engine().geom("tip").id]
    np.testing.assert_allclose(shown, world.truth().position, atol=1e-12)


def test_a_world_stops_where_its_force_is_above_the_limit():
    world = BlindMaze(noise=0.0, sway=0.0)
    world.reset(0, start=(-0.09, -0.15), contact_friction=0.0)  # 1 cm before the thick wall
    rollout = world.rollout([world])
    assert rollout is not None
    spring = Spring(np.array([[-0.065, -0.15]]), 900.0 * np.eye(2)[None], 60.0 * np.eye(2)[None])
    held = rollout.hold(spring, 100, 8.0)
    assert held.violated[0]
    truth = held.truths[0]
    assert 8.0 < truth.peak_force == held.force[0] < 10.0
    assert truth.time < 0.1
    assert held.observations[0].time == truth.time


def test_an_engine_that_diverged_is_told_and_begins_anew():
    world = BlindMaze(noise=0.0)
    world.reset(0)
    rollout = world.rollout([world])
    assert rollout is not None
    mad = Spring(np.zeros((1, 2)), -1e7 * np.eye(2)[None], np.zeros((1, 2, 2)))
    held = rollout.hold(mad, 100, 1e12)
    assert held.diverged[0]
    world.reset(1)
    assert world.truth().time == 0.0


def test_what_follows_sensors_in_every_period_is_stepped():
    tuning = blind_mazes(1, stiffness="self-tuning")
    tuning.reset(seed=0)
    tuning.step(np.zeros((1, 4)))
    assert isinstance(tuning.law, SpringLaw)
    assert tuning.law.spring() is None
    assert blind_mazes(1, reflex=True).lockstep._rollout is None
    assert arm_maze().lockstep._rollout is None
    assert BlindMaze(control_period=0.002).rollout([BlindMaze(control_period=0.002)]) is None


def test_energy_that_is_drawn_within_a_held_decision_is_that_of_the_stepped_one():
    """Stepped, what the last period drew is booked with the next decision."""
    meter = TankMeter(tank=EnergyTank(initial=0.6, upper=0.6))
    rolled, stepped = pair(noise=1.0, passes=meter, horizon=1000, force_limit=1e3)
    rolled.reset(seed=3)
    stepped.reset(seed=3)
    random, totals, flows = np.random.default_rng(0), np.zeros((2, 6)), np.zeros((2, 6))
    for _ in range(25):
        action = random.uniform(-1, 1, (6, 4))
        told = [one.step(action)[4] for one in (rolled, stepped)]
        if (told[0]["end"] != "").any():
            break
        totals += [one["drawn"] for one in told]
        flows = np.maximum(flows, [one["flow"] for one in told])
        np.testing.assert_allclose(told[0]["level"], told[1]["level"], atol=0.01)
    assert totals.min() > 0.1
    np.testing.assert_allclose(totals[0], totals[1], atol=0.01)
    np.testing.assert_allclose(flows[0], flows[1], rtol=1e-6)
    behind = blind_mazes(6, passes=PassivityFilter(tank=meter.tank))
    behind.reset(seed=3)
    with pytest.raises(PalpateError, match="not rolled out"):
        behind.lockstep.law.book(np.zeros((6, 100)))
