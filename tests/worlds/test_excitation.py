"""Motions that excite a rope, and what a recording of them holds."""

import math

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.excitation import excitation, record
from small_rope import STILL, rope


@pytest.mark.parametrize("duration", [3.0, 10.0])
@pytest.mark.parametrize("seed", range(4))
def test_excitation_keeps_the_limits_is_smooth_and_has_stillness(seed, duration):
    period = 0.01
    command = excitation(seed, duration, period, 1.5, 10.0)
    assert command.shape == (round(duration / period), 3)
    assert 0.5 < np.linalg.norm(command, axis=-1).max() <= 1.5
    change = np.diff(command, axis=0, prepend=0, append=0)
    assert np.linalg.norm(change, axis=-1).max() / period <= 10.0
    path = np.cumsum(command, axis=0) * period
    assert np.abs(path).max() <= 0.4
    assert path[-1] == pytest.approx(STILL, abs=1e-9)
    assert np.linalg.norm(command[[0, -1]], axis=-1).max() < 0.05
    still = (np.abs(command) < 1e-12).all(axis=-1)
    assert 0.25 < still.mean() < 0.45
    assert still[int(0.7 * len(still)) :].all() or duration > 5
    assert (command == excitation(seed, duration, period, 1.5, 10.0)).all()
    assert np.linalg.matrix_rank(command, tol=0.1) == 3


def test_a_motion_shorter_than_a_control_period_is_refused():
    with pytest.raises(PalpateError, match="at least one control period"):
        excitation(0, 0.001, 0.01, 1.5, 10.0)


def test_a_recording_keeps_fresh_measurements_with_their_stamps():
    command = excitation(0, 1.0, 0.01, 1.5, 10.0)
    prompt = record(rope(), command, seed=2)
    assert prompt["time"] == pytest.approx(np.arange(101) * 0.01)
    assert prompt["markers"].shape == (101, 11, 3)
    assert prompt["gripper_position"].shape == prompt["gripper_velocity"].shape == (101, 3)
    assert prompt["command_time"] == pytest.approx(np.arange(100) * 0.01)
    assert (prompt["command"] == command).all()

    late = record(rope(observation_rate=50.0, observation_delay=0.05), command, seed=2)
    assert late["time"] == pytest.approx(np.arange(48) * 0.02)
    assert (late["markers"] == prompt["markers"][:95:2]).all()

    swing = record(rope(), np.zeros((5, 3)), seed=2, start="straight", azimuth=0.0)
    assert swing["markers"][0, -1, 0] == pytest.approx(math.sqrt(3) / 2)
