"""Impedance that tunes itself, against what its law says."""

from types import SimpleNamespace

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.safety.self_tuning import SelfTuningLaw

PERIOD, GAIN, RESTING, RANGE = 1e-3, 5e4, 200.0, (50.0, 1000.0)
ALONG_X = np.array([[1.0, 0.0, -1.0, -1.0]])


def law(**changes) -> SelfTuningLaw:
    given = {"resting": RESTING, "contact_force": 5.0, "gain": GAIN, "control_period": PERIOD}
    return SelfTuningLaw(0.03, RANGE, **(given | changes))


def seen(force=(0.0, 0.0), position=(0.0, 0.0)) -> SimpleNamespace:
    return SimpleNamespace(
        wrench=np.array([[*force, 0, 0, 0, 0]], float),
        position=np.array([[*position, 0]], float),
        velocity=np.zeros((1, 3)),
    )


def test_stiffness_rises_with_the_error_while_something_resists_and_falls_when_it_yields():
    tuned = law()
    tuned.begin(seen(), ALONG_X, np.ones(1, bool))
    for _ in range(100):
        tuned.command(seen(force=(-6.0, 0.0)))
    risen = RESTING + 100 * GAIN * 0.03 * PERIOD
    np.testing.assert_allclose(tuned.stiffness, [np.diag([risen, RANGE[0]])])
    tuned.begin(seen(), ALONG_X, np.zeros(1, bool))  # another decision goes on from there
    tuned.command(seen(force=(-6.0, 0.0), position=(0.03, 0.0)))  # where it should be: no error
    np.testing.assert_allclose(tuned.stiffness[0, 0, 0], risen)
    for _ in range(2000):
        tuned.command(seen(force=(-6.0, 0.0)))
    assert tuned.stiffness[0, 0, 0] == RANGE[1]
    tuned.command(seen(force=(-4.0, 0.0)))
    assert tuned.stiffness[0, 0, 0] == RESTING


@pytest.mark.parametrize("force", [(6.0, 0.0), (0.0, -9.0), (np.nan, 0.0), (-np.inf, 0.0)])
def test_what_does_not_resist_the_motion_stiffens_nothing(force):
    tuned = law()
    tuned.begin(seen(), ALONG_X, np.ones(1, bool))
    command = tuned.command(seen(force=force))
    np.testing.assert_allclose(tuned.stiffness, [np.diag([RESTING, RANGE[0]])])
    np.testing.assert_allclose(command, [[RESTING * 0.03, 0, 0]], atol=1e-12)


def test_a_position_that_is_lost_leaves_damping_alone():
    tuned = law()
    tuned.begin(seen(), ALONG_X, np.ones(1, bool))
    for place in (np.nan, np.inf):
        lost = seen(force=(-6.0, 0.0), position=(place, 0.0))
        np.testing.assert_array_equal(tuned.command(lost), np.zeros((1, 3)))
        assert tuned.stiffness[0, 0, 0] == RESTING
    np.testing.assert_array_equal(tuned.command(lost), np.zeros((1, 3)))
    tuned.begin(lost, ALONG_X, np.zeros(1, bool))
    np.testing.assert_array_equal(tuned.command(seen()), np.zeros((1, 3)))


def test_values_that_are_not_positive_are_refused():
    with pytest.raises(PalpateError, match="contact force is positive"):
        law(contact_force=0.0)
    with pytest.raises(PalpateError, match="gain is positive"):
        law(gain=np.inf)
