"""Impedance against closed forms: modes, responses, powers, limits, and what fails closed."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from palpate.errors import PalpateError
from palpate.safety.impedance import (
    ImpedanceLaw,
    approach,
    directed_stiffness,
    double_diagonalised_damping,
    factorised_damping,
    impedance_force,
)


class Seen(NamedTuple):
    position: np.ndarray
    velocity: np.ndarray


def seen(position, velocity=None):
    position = np.atleast_2d(np.array(position, float))
    return Seen(
        position, np.zeros_like(position) if velocity is None else np.array(velocity, float)
    )


def symmetric(key, values):
    modes = np.linalg.qr(np.random.default_rng(key).normal(size=(len(values),) * 2))[0]
    return modes @ np.diag(values) @ modes.T


MASS, STIFFNESS = symmetric(0, [1.0, 3.0, 8.0]), symmetric(1, [50.0, 300.0, 1000.0])


def closed_loop(mass, stiffness, damping):
    zero, one = np.zeros_like(mass), np.eye(len(mass))
    return np.block(
        [[zero, one], [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)]]
    )


@pytest.mark.parametrize("ratio", [0.4, 1.0])
def test_every_mode_has_the_damping_asked_for(ratio):
    damping = double_diagonalised_damping(MASS, STIFFNESS, ratio)
    rates = np.sqrt(np.linalg.eigvals(np.linalg.solve(MASS, STIFFNESS)))
    poles = np.linalg.eigvals(closed_loop(MASS, STIFFNESS, damping))
    expected = [
        -ratio * rate + sign * 1j * rate * math.sqrt(1 - ratio**2)
        for rate in rates for sign in (-1, 1)
    ]  # fmt: skip
    # A double pole is known to the square root of rounding.
    np.testing.assert_allclose(
        np.sort_complex(poles), np.sort_complex(expected), atol=1e-5 if ratio == 1 else 1e-9
    )


def test_the_rule_for_one_kilogram_leaves_two_kilograms_to_swing():
    """2 kg on 200 N/m: critically damped it comes back as (1 + w t) exp(-w t), w = 10 / s."""
    mass, stiffness = 2 * np.eye(2), 200 * np.eye(2)
    damping = double_diagonalised_damping(mass, stiffness)
    np.testing.assert_allclose(damping, 2 * math.sqrt(2 * 200) * np.eye(2))
    for time in (0.05, 0.2, 0.7):
        moved = expm(closed_loop(mass, stiffness, damping) * time) @ (0.1, 0.0, 0.0, 0.0)
        assert moved[0] == pytest.approx(0.1 * (1 + 10 * time) * math.exp(-10 * time), rel=1e-9)
    rule = 2 * math.sqrt(200) * np.eye(2)
    swings = [(expm(closed_loop(mass, stiffness, rule) * t) @ (0.1, 0, 0, 0))[0] for t in (0.5, 1)]
    assert min(swings) < 0


def test_both_designs_agree_where_mass_and_stiffness_commute():
    mass, stiffness = symmetric(3, [1.0, 2.0, 5.0]), symmetric(3, [400.0, 60.0, 900.0])
    np.testing.assert_allclose(
        double_diagonalised_damping(mass, stiffness, 0.7),
        factorised_damping(mass, stiffness, 0.7),
        rtol=1e-10, atol=1e-10,
    )  # fmt: skip
    other = factorised_damping(MASS, STIFFNESS)
    assert np.abs(double_diagonalised_damping(MASS, STIFFNESS) - other).max() > 1
    np.testing.assert_allclose(other, other.T, atol=1e-12)


def test_damping_takes_power_whatever_the_stiffness():
    random = np.random.default_rng(5)
    along, across = np.exp(random.uniform(math.log(50), math.log(1000), (2, 200)))
    stiffness = directed_stiffness(along, across, random.normal(size=(200, 2)))
    mass = np.array([[2.0, 0.7], [0.7, 1.0]])
    damping = double_diagonalised_damping(mass, stiffness)
    velocity = random.normal(size=(200, 2))
    still = np.zeros((200, 2))
    power = (impedance_force(stiffness, damping, still, velocity, still) * velocity).sum(-1)
    assert power.max() < 0
    # A spring that is switched off in one direction leaves it undamped, and does not break it.
    flat = double_diagonalised_damping(mass, np.diag([100.0, 0.0]))
    assert np.linalg.eigvalsh(flat)[0] == pytest.approx(0, abs=1e-6)


def test_stiffness_is_turned_into_the_motion():
    direction = np.array([[3.0, 4.0], [0.0, 0.0]])
    stiffness = directed_stiffness(np.array([900.0, 900.0]), np.array([100.0, 100.0]), direction)
    np.testing.assert_allclose(stiffness[0] @ (0.6, 0.8), 900 * np.array([0.6, 0.8]))
    np.testing.assert_allclose(stiffness[0] @ (-0.8, 0.6), 100 * np.array([-0.8, 0.6]))
    np.testing.assert_allclose(stiffness[1], np.diag([900.0, 100.0]))


def test_the_designs_run_under_jax(float64):
    compiled = jax.jit(jax.vmap(double_diagonalised_damping, (None, 0)))
    several = jnp.stack([STIFFNESS, 2 * STIFFNESS])
    np.testing.assert_allclose(
        compiled(jnp.array(MASS), several)[1], double_diagonalised_damping(MASS, 2 * STIFFNESS)
    )


@pytest.mark.parametrize("axes", [1, 2])
def test_a_step_is_limited_by_its_size(axes):
    before, after = np.zeros((2, *(2,) * axes)), np.ones((2, *(2,) * axes))
    after[1] *= 0.01
    near = approach(before, after, 0.5, axes)
    assert np.linalg.norm(near[0]) == pytest.approx(0.5)
    np.testing.assert_array_equal(near[1], after[1])


def law(**options):
    return ImpedanceLaw(0.03, (50.0, 1000.0), **options)


def test_a_decision_sends_the_tip_on_with_the_stiffness_it_chose():
    impedance = law(mass=2.0)
    action = np.array([[0.5, 0, 1, -1], [1, 1, 0, 0], [0, 0, 0, 0]], float)
    here = seen([[0.1, 0.2, 0.0]] * 3)
    impedance.begin(here, action, np.ones(3, bool))
    force = impedance.command(here)
    middle = (50 + 1000) / 2
    shortened = 0.03 / math.sqrt(2)
    np.testing.assert_allclose(
        force, [[15, 0, 0], [middle * shortened] * 2 + [0], [0, 0, 0]], atol=1e-9
    )
    np.testing.assert_allclose(impedance.stiffness[0], np.diag([1000, 50]), atol=1e-9)
    # Later in the same decision it is pulled to the same place, and damped.
    later = seen([[0.11, 0.2, 0.0]] * 3, [[0.1, 0.1, 0.0]] * 3)
    np.testing.assert_allclose(
        impedance.command(later)[0],
        [5 - 0.2 * math.sqrt(2000), -0.2 * math.sqrt(100), 0], atol=1e-9,
    )  # fmt: skip
    constant = law(constant_stiffness=300.0)
    constant.begin(here, action, np.ones(3, bool))
    assert constant.command(here)[0, 0] == pytest.approx(300 * 0.015)
    np.testing.assert_allclose(constant.stiffness, [300 * np.eye(2)] * 3, atol=1e-9)


def test_rates_limit_set_point_and_stiffness():
    impedance = law(set_point_rate=0.1, stiffness_rate=1e4)
    here, action = seen([0.0, 0.0, 0.0]), np.array([[1.0, 0, 1, 1]])
    impedance.begin(here, action, np.ones(1, bool))
    targets, springs = [], []
    for _ in range(400):
        impedance.command(here)
        targets.append(impedance.target[0, 0])
        springs.append(impedance.stiffness[0])
    np.testing.assert_allclose(targets[:300:100], np.array([1, 101, 201]) * 1e-4, atol=1e-9)
    assert targets[-1] == 0.03
    change = np.linalg.norm(np.diff(springs, axis=0), axis=(1, 2))
    assert change.max() == pytest.approx(10)
    np.testing.assert_allclose(springs[-1], 1000 * np.eye(2))
    np.testing.assert_allclose(impedance.damping[0], 2 * math.sqrt(1000) * np.eye(2))
    # The next decision starts from there, a new episode from the softest where the tip is.
    impedance.begin(here, -action, np.zeros(1, bool))
    impedance.command(here)
    assert impedance.target[0, 0] == pytest.approx(0.0299)
    impedance.begin(here, action, np.ones(1, bool))
    impedance.command(here)
    assert impedance.target[0, 0] == pytest.approx(1e-4)
    assert np.linalg.norm(impedance.stiffness) < 50 * math.sqrt(2) + 10.1


@pytest.mark.parametrize("spoilt", ["action", "position"])
def test_a_decision_that_is_not_finite_only_damps(spoilt):
    impedance = law()
    action, place = np.full((2, 4), 0.5), np.zeros((2, 3))
    (action if spoilt == "action" else place)[0, 1] = math.nan
    with np.errstate(all="raise"):
        impedance.begin(seen(place), action, np.ones(2, bool))
    moving = seen(np.ones((2, 3)), [[0.2, -0.1, 0]] * 2)
    force = impedance.command(moving)
    np.testing.assert_allclose(force[0], -2 * math.sqrt(50) * np.array([0.2, -0.1, 0]))
    assert np.isfinite(force).all()
    assert np.abs(force[1]).max() > 100  # its neighbour's decision stands
    impedance.begin(moving, np.ones((2, 4)), np.zeros(2, bool))
    assert impedance.command(moving)[0, 0] > 0  # and so does the next


def test_a_sensor_that_drops_out_ends_in_damping_or_in_no_force():
    impedance = law()
    impedance.begin(seen(np.zeros((3, 3))), np.full((3, 4), 0.9), np.ones(3, bool))
    place, velocity = np.zeros((3, 3)), np.full((3, 3), 0.1)
    place[0, 0] = math.nan
    velocity[1, 1] = math.inf
    force = impedance.command(Seen(place, velocity))
    assert force[0, 0] < 0
    assert force[0] @ velocity[0] < 0
    np.testing.assert_array_equal(force[1], 0)
    assert force[2, 0] > 0
    np.testing.assert_array_equal(
        impedance.command(Seen(np.full((3, 3), np.nan), np.full((3, 3), np.nan))), 0
    )


def test_limits_that_make_no_sense_are_refused():
    with pytest.raises(PalpateError, match="displacement limit is positive"):
        ImpedanceLaw(0.0, (50.0, 100.0))
    with pytest.raises(PalpateError, match="from low to high"):
        ImpedanceLaw(0.03, (500.0, 100.0))
    with pytest.raises(PalpateError, match="mass is positive definite"):
        law(mass=np.array([[1.0, 2.0], [2.0, 1.0]]))
