"""The passivity filter before the servos of a rope's gripper."""

import dataclasses

import numpy as np

from palpate.safety.energy_tank import EnergyTank, TankMeter
from palpate.safety.filtered_drive import FilteredDrive
from palpate.trials.rope.stabilization import StabilizationTrial, behind_filter
from palpate.worlds.rope.rope import GRIPPER_MASS, RopeConfiguration, RopeWorld

ROPE = RopeConfiguration(bodies=10, markers=3)
SHAKEN = 0.8 * np.stack([np.sign(np.sin(0.4 * np.arange(60))), *np.zeros((2, 60))], axis=1)


def moved(drive) -> np.ndarray:
    world = RopeWorld(ROPE, drive)
    world.reset(3, "straight", azimuth=0.0)
    return np.array([world.step(command).gripper_position for command in SHAKEN])


def meter(initial) -> FilteredDrive:
    one = TankMeter(tank=EnergyTank(initial=initial, upper=initial))
    return FilteredDrive(one, GRIPPER_MASS * np.eye(3), ROPE.time_step)


def filtered(tank):
    (trial,) = behind_filter([StabilizationTrial(ROPE, "straight", 3)], tank)
    return trial.drive(ROPE)


def test_a_drive_that_lets_all_pass_changes_nothing():
    np.testing.assert_allclose(moved(meter(5.0)), moved(None), atol=1e-12)


def test_a_full_tank_changes_nothing_and_an_empty_one_slows_the_shaking():
    counted, rich, poor = meter(5.0), filtered(5.0), filtered(0.22)
    free = moved(counted)
    np.testing.assert_allclose(moved(rich), free, atol=1e-12)
    assert rich.least == counted.least
    assert 5.0 - counted.least > 0.1  # more than the other has above its lower bound
    held = moved(poor)
    assert poor.least >= EnergyTank(initial=0.22, upper=0.22).reserve
    fastest = [np.abs(np.diff(way[:, 0])).max() for way in (held, free)]
    assert fastest[0] < 0.7 * fastest[1]
    assert counted.drawn > poor.drawn > 0.0


def test_every_trial_has_a_filter_of_its_own():
    trial = StabilizationTrial(ROPE, "straight", 3)
    one, other = (each.world() for each in behind_filter([trial, trial], 1.0))
    assert one.drive is not other.drive
    assert trial.world().drive is None
    assert dataclasses.replace(trial, steps=3).drive is None
