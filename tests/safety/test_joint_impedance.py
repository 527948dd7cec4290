"""Springs of joints against closed forms."""

from typing import NamedTuple

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.safety.joint_impedance import JointImpedance


class Seen(NamedTuple):
    position: np.ndarray
    velocity: np.ndarray
    mass: np.ndarray


def test_it_pulls_to_the_set_point_and_damps_for_the_inertia():
    law = JointImpedance(0.2, (10.0, 50.0), damping_ratio=0.7)
    inertia = np.diag([2.0, 0.5])
    seen = Seen(np.array([[0.1, -0.3]]), np.array([[0.4, -1.0]]), inertia[None])
    law.begin(seen, np.array([[1.0, -0.5, -1.0, 1.0]]), np.array([True]))
    np.testing.assert_allclose(law.target, [[0.3, -0.4]])
    damping = 1.4 * np.sqrt([10.0 * 2.0, 50.0 * 0.5])
    expected = np.array([10.0, 50.0]) * [0.2, -0.1] - damping * [0.4, -1.0]
    np.testing.assert_allclose(law.command(seen), [expected])


def test_a_decision_that_is_not_finite_leaves_damping():
    law = JointImpedance(0.2, (10.0, 50.0))
    seen = Seen(np.zeros((1, 2)), np.array([[0.4, -1.0]]), np.eye(2)[None])
    law.begin(seen, np.array([[np.nan, 0.0, 0.0, 0.0]]), np.array([True]))
    torque = law.command(seen)
    assert np.isfinite(torque).all()
    assert np.all(torque * seen.velocity < 0.0)
    with pytest.raises(PalpateError, match="limits of joints"):
        JointImpedance(0.2, (50.0, 10.0))
