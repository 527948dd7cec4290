"""A control law behind a filter: what it books, and when it begins anew."""

from typing import NamedTuple

import numpy as np
import pytest

from palpate.safety.energy_tank import EnergyTank
from palpate.safety.filtered_law import FilteredLaw
from palpate.safety.impedance import ImpedanceLaw
from palpate.safety.passivity import PassivityFilter
from palpate.safety.port import FilterChain
from palpate.safety.stiffness_rate import StiffnessRate
from palpate.safety.valves import TextbookValve

PERIOD = 1e-3
TANK = EnergyTank(initial=1.0, upper=2.0)


class Seen(NamedTuple):
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray


def seen(time, position, velocity, displacement) -> Seen:
    rows = (np.array(each, float) for each in (position, velocity, displacement))
    return Seen(np.full(len(position), float(time)), *rows)


def filtered(one, limit=np.inf) -> FilteredLaw:
    return FilteredLaw(ImpedanceLaw(0.03, (50.0, 1000.0)), one, 1.0, PERIOD, limit)


def level_of(law: FilteredLaw) -> np.ndarray:
    assert law.level is not None
    return law.level


STIFF = np.tile([1.0, 0.0, 1.0, 1.0], (2, 1))
NOTHING = np.zeros((2, 3))
ALONG_X = np.tile([1.0, 0.0, 0.0], (2, 1))


def test_it_books_the_force_that_was_held_over_the_way_that_was_gone():
    law = filtered(PassivityFilter(tank=TANK))
    observation = seen(0.0, NOTHING, NOTHING, NOTHING + 7.0)  # before the first there was no way
    law.begin(observation, STIFF, np.array([True, True]))
    force = law.command(observation)
    np.testing.assert_allclose(force[:, 0], 30.0)  # 1000 N/m over 3 cm
    np.testing.assert_allclose(level_of(law), TANK.initial)
    way = np.array([[2e-3, 0.0, 0.0], [-1e-3, 5e-3, 0.0]])
    law.command(seen(PERIOD, NOTHING, NOTHING, way))
    np.testing.assert_allclose(level_of(law), [1.0 - 0.06, 1.0 + 0.03])


def test_an_episode_begins_with_a_tank_and_no_force_of_the_last_one():
    chain = FilterChain((StiffnessRate(), PassivityFilter(tank=TANK)))
    law = filtered(chain)
    first = seen(0.0, NOTHING, NOTHING, NOTHING)
    law.begin(first, STIFF, np.array([True, True]))
    law.command(first)
    law.begin(seen(0.0, NOTHING, NOTHING, NOTHING), STIFF, np.array([False, True]))
    law.command(seen(PERIOD, NOTHING, NOTHING, NOTHING + 1e-3))
    assert level_of(law)[0] < TANK.initial
    assert level_of(law)[1] == TANK.initial


def test_drives_that_cut_off_are_known_to_the_filter():
    law = filtered(PassivityFilter(tank=TANK), limit=12.0)
    first = seen(0.0, NOTHING, NOTHING, NOTHING)
    law.begin(first, STIFF, np.array([True, True]))
    assert law.command(first)[0, 0] == pytest.approx(12.0)
    law.command(seen(PERIOD, NOTHING, NOTHING, 1e-3 * ALONG_X))
    np.testing.assert_allclose(level_of(law), 1.0 - 0.012)


def test_a_valve_is_told_the_impedance_behind_any_law_that_wraps_it():
    class Wrapper:
        def __init__(self, law):
            self.law = law

        def begin(self, observation, action, fresh):
            self.law.begin(observation, action, fresh)

        def command(self, observation):
            return self.law.command(observation)

    inner = ImpedanceLaw(0.03, (50.0, 1000.0))
    empty = TextbookValve(tank=EnergyTank(initial=0.2, upper=1.0))
    law = FilteredLaw(Wrapper(inner), empty, 1.0, PERIOD)
    first = seen(0.0, NOTHING, 0.2 * ALONG_X, NOTHING)
    law.begin(first, STIFF, np.array([True, True]))
    law.command(first)  # 950 N/m of 1000 over 3 cm at 0.2 m/s: what is in the tank is drawn
    now = law.command(first)
    damping = 2.0 * np.sqrt(1000.0)
    np.testing.assert_allclose(now[:, 0], 50.0 * 0.03 - 0.2 * damping, rtol=1e-9)


def test_what_brakes_is_told_from_what_would_turn_round():
    law = filtered(PassivityFilter(tank=TANK))
    still = STIFF * [0.0, 0.0, 1.0, 1.0]
    for speed, brakes in ((0.1, True), (0.0, False)):
        moving = seen(0.0, NOTHING, speed * ALONG_X, NOTHING)
        law.begin(moving, still, np.array([True, True]))
        law.command(moving)
        law.applied = 0.5 * law.wanted
        np.testing.assert_allclose(law.braked(moving), 0.5 if brakes else 1.0)
