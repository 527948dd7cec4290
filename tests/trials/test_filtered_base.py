"""The passivity filter before the servos of the base among furniture."""

import math

import mujoco
import numpy as np
import pytest

from palpate.safety.energy_tank import EnergyTank, TankMeter
from palpate.safety.filtered_drive import FilteredDrive
from palpate.trials.furniture.rooms import BASE_RADIUS, POSTURE, base_filter
from palpate.worlds.furniture.furniture import FurnitureWorld, Robot, RobotAction
from palpate.worlds.furniture.robot import base_inertia
from palpate.worlds.furniture.scene import TIME_STEP
from trolley import EXACT, sledge

ROBOT = Robot((0.0, 0.0, math.pi), radius=BASE_RADIUS, nominal=POSTURE)
WALL = [(1.0, -2.0), (1.2, -2), (1.2, 2), (1, 2)]


def driven(drive, velocity=(0.4, 0.1, 0.3), steps=50, walls=()) -> FurnitureWorld:
    world = FurnitureWorld([sledge((5, 5, 0))], walls, ROBOT, EXACT, drive)
    world.reset(0)
    for _ in range(steps):
        last = world.step(RobotAction(np.array(velocity), np.zeros(3)))
    world.last = last
    return world


def meter() -> FilteredDrive:
    one = TankMeter(tank=EnergyTank(initial=100.0, upper=100.0))
    return FilteredDrive(one, base_inertia(ROBOT), TIME_STEP)


def test_what_the_servos_move_is_what_the_scene_has():
    world = driven(None, steps=1)
    model, data, *_ = world._running
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    first = model.joint("base 0").dofadr[0]
    shown = np.diagonal(full)[first : first + 3]
    assert np.diagonal(base_inertia(ROBOT)) == pytest.approx(shown, rel=0.02)


def test_behind_a_drive_that_lets_all_pass_it_drives_and_feels_as_without():
    free, metered = driven(None), driven(meter())
    for name in ("base_pose", "base_velocity", "joint_angles"):
        here, there = (getattr(world.truth().robot, name) for world in (metered, free))
        assert here == pytest.approx(there, abs=0.01)
    for velocity, walls in (((0.4, 0, 0), [WALL]), ((0.4, 0, 0), [])):
        forces = [
            driven(drive, velocity, 120, walls).last.robot.base_force for drive in (None, meter())
        ]
        assert forces[1] == pytest.approx(forces[0], abs=12.0)
    assert abs(forces[1][0]) < 15.0  # free, where the other was stopped by 200 N


def test_a_tank_bounds_what_the_base_draws_and_braking_passes():
    counted, poor = meter(), base_filter(2.2)
    fast, slow = driven(counted), driven(poor)
    assert 100.0 - counted.least > 2.5  # J: 1/2 m v^2 and more
    assert poor.least >= EnergyTank(initial=2.2, upper=2.2).reserve
    speeds = [np.linalg.norm(world.truth().robot.base_velocity[:2]) for world in (slow, fast)]
    mass = base_inertia(ROBOT)[0, 0]
    assert 0.5 * mass * speeds[0] ** 2 <= 2.2
    assert speeds[0] < 0.9 * speeds[1]
    for _ in range(25):
        slow.step(RobotAction(np.zeros(3), np.zeros(3)))
    assert np.abs(slow.truth().robot.base_velocity).max() < 0.02
    assert poor.level > 1.0  # what braking took out is in the tank again
    slow.reset(1)
    assert poor.drawn == 0.0
