"""The decay of a free swing: of a cosine that is known, and of ropes with a closed form."""

import math

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.experiments.rope.swing import (
    AMPLITUDE,
    first_mode,
    half_life_periods,
    swing,
    swing_half_life,
)
from palpate.worlds.rope.rope import RopeConfiguration
from small_rope import FREE, SMALL, rope

TIME = np.arange(0, 6.5, 0.01)


def cosine(half_life: float, period: float = 1.3, phase: float = 0.0) -> np.ndarray:
    """A swing whose envelope halves in that many periods."""
    envelope = 0.5 ** (TIME / (half_life * period))
    return 0.02 * envelope * np.cos(2 * np.pi * TIME / period + phase)


@pytest.mark.parametrize("half_life", [0.7, 2.0, 6.0])
@pytest.mark.parametrize("phase", [0.0, 1.0, -2.5])
def test_half_life_of_a_decaying_cosine(half_life, phase):
    assert half_life_periods(cosine(half_life, phase=phase)) == pytest.approx(half_life, rel=5e-3)


def test_a_ripple_makes_no_extremes_of_its_own():
    ripple = 0.0008 * np.sin(2 * np.pi * 7.1 * TIME)  # several tops in each half swing
    assert half_life_periods(cosine(3.0) + ripple) == pytest.approx(3.0, rel=0.1)


def test_a_swing_that_goes_on_never_halves():
    assert half_life_periods(cosine(-50.0)) == math.inf


def test_a_swing_too_short_to_tell_is_refused():
    with pytest.raises(PalpateError, match="at least 3 whole half swings, this one has 2"):
        half_life_periods(cosine(3.0)[:170])


def test_the_rope_starts_in_its_first_mode():
    configuration = RopeConfiguration(**{**SMALL, **FREE}, length=0.7)
    offsets = swing(configuration)
    assert offsets[0] == pytest.approx(0.7 * AMPLITUDE, rel=0.02)
    # One mode alone is one cosine: of the closed form's period, but for a little stiffness.
    time = np.arange(len(offsets)) * configuration.control_period
    period = 2 * np.pi / (1.2024 * np.sqrt(9.81 / 0.7))
    assert offsets == pytest.approx(offsets[0] * np.cos(2 * np.pi * time / period), abs=0.003)
    assert first_mode()[0] == pytest.approx([0, 0, 0])


def test_drag_in_proportion_to_speed_damps_as_its_closed_form_says():
    """With the force -c v on each body of mass m the amplitude falls as exp(-c t / 2 m)."""
    constants = {**FREE, "air_viscosity": 5e-3, "bending_stiffness": 1e-6}
    model = rope(**constants)._model
    last = model.nbody - 1
    mass, inertia = model.body_mass[last], model.body_inertia[last]
    sides = np.sqrt(6 / mass * (inertia.sum() - 2 * inertia))  # of the box of that inertia
    drag = 3 * np.pi * 5e-3 * sides.mean()  # MuJoCo's inertia-box law
    period = 2 * np.pi / (1.2024 * np.sqrt(9.81))
    expected = 2 * mass * math.log(2) / (drag * period)
    found = swing_half_life(RopeConfiguration(**{**SMALL, **constants}))
    assert found == pytest.approx(expected, rel=0.03)
