"""What recorded wrenches drew, against closed forms."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.recordings import Channel, Role, Trial
from palpate.safety.recorded_energy import recorded_energy


def trial(**channels) -> Trial:
    made = {}
    for name, (time, values, unit) in channels.items():
        rows = np.asarray(time, float), np.asarray(values, float)
        made[name] = Channel(name, Role.OBSERVATION, *rows, unit)
    return Trial("push", made)


def test_a_constant_force_draws_its_way_whatever_the_rates_of_both():
    slow, fast = np.linspace(0.0, 2.0, 41), np.linspace(0.0, 2.0, 1001)
    way = np.stack([0.3 * fast, -0.1 * fast], axis=1)
    force = np.tile([-4.0, 2.0], (41, 1))  # on the robot, which pushes by 4 and -2
    pushed = trial(force=(slow, force, "N"), position=(fast, way, "m"))
    found = recorded_energy(pushed, ["force"], ["position"])
    assert found.drawn[-1] == pytest.approx(2.0 * (4.0 * 0.3 + 2.0 * 0.1))
    assert (found.returned, found.needed) == (0.0, pytest.approx(found.given))
    np.testing.assert_allclose(found.power, 1.4)
    other = recorded_energy(pushed, ["force"], ["position"], on_robot=False)
    np.testing.assert_allclose(other.drawn, -found.drawn)
    assert other.needed == 0.0


def test_velocities_and_torques_draw_as_positions_do():
    time = np.linspace(0.0, 1.0, 2001)
    angle, rate = np.sin(3.0 * time), 3.0 * np.cos(3.0 * time)
    torque = -2.0 * rate  # of a damper, on the robot
    turned = trial(torque=(time, torque, "N m"), angle=(time, angle, "rad"),
                   rate=(time, rate, "rad/s"))  # fmt: skip
    expected = 2.0 * 9.0 * (0.5 + np.sin(6.0) / 12.0)
    for motion in ("angle", "rate"):
        found = recorded_energy(turned, ["torque"], [motion])
        assert found.drawn[-1] == pytest.approx(expected, rel=1e-5)


def test_frames_that_were_not_seen_are_bridged_and_axes_may_be_channels():
    time = np.linspace(0.0, 1.0, 101)
    force = np.where((time > 0.4) & (time < 0.6), np.nan, -5.0)
    pushed = trial(fx=(time, force, "N"), fy=(time, 0.0 * time, "N"), x=(time, 0.2 * time, "m"),
                   y=(time, time, "m"))  # fmt: skip
    found = recorded_energy(pushed, ["fx", "fy"], ["x", "y"])
    assert found.drawn[-1] == pytest.approx(1.0)


def test_what_is_no_force_and_no_motion_is_refused():
    time = np.linspace(0.0, 1.0, 11)
    made = trial(force=(time, time, "N"), position=(time, np.ones((11, 2)), "m"),
                 late=(time + 5.0, time, "m"))  # fmt: skip
    with pytest.raises(PalpateError, match="is in m: expected N or N m"):
        recorded_energy(made, ["late"], ["force"])
    with pytest.raises(PalpateError, match="the same axes of both"):
        recorded_energy(made, ["force"], ["position"])
    with pytest.raises(PalpateError, match="0 frames in common"):
        recorded_energy(made, ["force"], ["late"])
