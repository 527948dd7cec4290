"""Filters against a meter of their own, whose robots and springs keep their energy exactly."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.errors import PalpateError
from palpate.safety.energy_tank import EnergyTank, TankMeter
from palpate.safety.filters import FILTERS, filter_of, numbers_of
from palpate.safety.kinetic_barrier import KineticBarrier
from palpate.safety.passivity import PassivityFilter
from palpate.safety.port import Filter, FilterChain, Port
from palpate.safety.stiffness_rate import StiffnessRate
from palpate.safety.valves import TextbookValve, schindlbeck
from point_robots import Robots, driven, force_of, hostile

TANK = EnergyTank(initial=1.0, upper=2.0)
OURS = PassivityFilter(tank=TANK, fastest=2.0)
RATES = [1e-3, 1e-2, 5e-2]


def port_of(velocity, mass=1.0, force=(0.0, 0.0), displacement=(0.0, 0.0), elapsed=1e-3) -> Port:
    one = np.asarray([velocity], float)
    return Port(np.asarray([force], float), np.asarray([displacement], float), one,
                mass * np.eye(2)[None], np.array([elapsed]), 1e-3)  # fmt: skip


@given(
    period=st.sampled_from(RATES),
    seed=st.integers(0, 10_000),
    mass=st.floats(0.4, 4.0),
    pushes=st.sampled_from([0.0, 5.0, 20.0]),
)
@settings(max_examples=15, deadline=None)
def test_no_impedance_creates_energy_behind_it_at_any_rate(period, seed, mass, pushes):
    samples = min(120, round(2.0 / period))
    rise, least, _ = driven(OURS, period, samples, seed=seed, mass=mass, pushes=pushes, count=8)
    assert rise < 1e-9
    if not pushes:  # whoever is flung about is faster than the filter was told
        assert least >= TANK.reserve


@pytest.mark.parametrize("period", RATES)
def test_the_same_impedances_create_energy_behind_every_rival(period):
    """The textbook's valves at any rate; limits of rate or speed where a period is long."""
    samples = min(300, round(3.0 / period))
    for valve in (TextbookValve(tank=TANK), schindlbeck(TANK)):
        rise, _, _ = driven(valve, period, samples)
        assert rise > (0.1 if period < 2e-3 else 1.0)
    for rival in (StiffnessRate(), KineticBarrier()):
        rise, _, _ = driven(rival, period, samples)
        assert rise > (0.01 if period < 2e-3 else 1.0)


def test_samples_that_are_late_or_missing_bring_no_energy():
    rise, _, _ = driven(OURS, 1e-2, 200, late=0.2)
    assert rise < 1e-9


def test_what_a_full_tank_can_pay_passes_bit_for_bit():
    """A spring that lets go and comes to rest, and never draws what it has not given."""
    spring, damping, full = 300.0, 20.0, EnergyTank(initial=5.0, upper=9.0)
    one, robots = PassivityFilter(tank=full), Robots(1, 1.0, 1e-3)
    state, force, before = one.begin(1), np.zeros((1, 2)), np.zeros((1, 2))
    for _ in range(400):
        port = robots.port(force, before, 1e-3, 1e-3)
        wanted = spring * (0.05 - robots.position) - damping * robots.velocity
        state, force = one(state, port, wanted)
        assert np.array_equal(force, wanted)
        before = robots.position.copy()
        robots.hold(force, 1e-3)
    np.testing.assert_allclose(robots.position, 0.05, atol=2e-3)


def test_a_constant_push_draws_the_tank_to_its_lower_bound_and_then_coasts():
    """From rest 1/2 m v^2 = initial - lower bound, in closed form; the rest is for braking."""
    robots, state = Robots(1, 2.0, 1e-3), OURS.begin(1)
    robots.wall_stiffness = 0.0
    force, before = np.zeros((1, 2)), np.zeros((1, 2))
    for _ in range(2000):
        port = robots.port(force, before, 1e-3, 1e-3)
        state, force = OURS(state, port, np.array([[12.0, 5.0]]))
        before = robots.position.copy()
        robots.hold(force, 1e-3)
    kinetic = 0.5 * 2.0 * np.sum(robots.velocity**2)
    assert kinetic == pytest.approx(TANK.initial - TANK.lower, rel=1e-9)
    assert state[0] == pytest.approx(TANK.lower, rel=1e-9)
    port = robots.port(force, before, 1e-3, 1e-3)
    braking = -15.0 * robots.velocity
    assert np.array_equal(OURS(state, port, braking)[1], braking)
    # Pushed across, it is turned and no faster.
    across = np.stack([-robots.velocity[:, 1], robots.velocity[:, 0]], axis=1) * 20.0
    _, turned = OURS(state, port, across)
    then = robots.velocity + 1e-3 * turned / 2.0
    assert np.linalg.norm(then) == pytest.approx(np.linalg.norm(robots.velocity), rel=1e-12)
    assert np.sum(turned * across) > 0.9 * np.sum(across * across)


def test_no_more_power_is_drawn_than_the_flow():
    limited = PassivityFilter(tank=EnergyTank(initial=1.0, upper=2.0, flow=3.0), fastest=2.0)
    moving = port_of([0.5, 0.0])
    _, force = limited(limited.begin(1), moving, np.array([[30.0, 0.0]]))
    drawn = force[0, 0] * (0.5 * 1e-3 + 0.5 * force[0, 0] * 1e-6)
    assert drawn == pytest.approx(3.0 * 1e-3, rel=1e-9)


def test_a_wall_that_gives_way_in_mid_push_gets_no_more_than_the_tank():
    for period in RATES:
        robots, state = Robots(1, 1.0, 2e-4), OURS.begin(1)
        robots.position[:] = [0.1 + 20.0 / 200.0, 0.0]  # pressed in, at rest
        force, before = np.array([[20.0, 0.0]]), robots.position.copy()
        start = robots.energy() + state
        for sample in range(round(1.0 / period)):
            port = robots.port(force, before, period, period)
            state, force = OURS(state, port, np.array([[20.0, 0.0]]))
            before = robots.position.copy()
            if sample * period >= 0.5:
                robots.wall_stiffness = 0.0
                kinetic = 0.5 * np.sum(robots.velocity**2)
                assert kinetic + state[0] <= start[0] + 1e-9
            robots.hold(force, period)
            assert state[0] >= TANK.reserve


def test_what_is_not_finite_is_braked_and_never_powered():
    state, push = np.array([0.5]), np.array([[10.0, 0.0]])
    nan = [np.nan, 0.0]
    _, force = OURS(state, port_of([0.4, 0.3]), np.array([nan]))
    assert force[0] @ [0.4, 0.3] < 0.0
    _, force = OURS(state, port_of(nan), push)
    assert np.array_equal(force, np.zeros((1, 2)))
    for elapsed in (np.nan, -1.0, 0.0, 10.0):  # a clock that jumps
        _, force = OURS(state, port_of([0.4, 0.0], elapsed=elapsed), push)
        assert 0.4 * force[0, 0] * 1e-3 + 0.5 * (force[0, 0] * 1e-3) ** 2 <= 1e-15
        _, force = OURS(state, port_of([0.4, 0.0], elapsed=elapsed), -push)
        assert np.array_equal(force, -push)
    lost = port_of([0.4, 0.0], force=[10.0, 0.0], displacement=nan)
    level, force = OURS(state, lost, push)
    assert level[0] == pytest.approx(0.5 - 10.0 * 2.0 * 1e-3)  # as if it had gone at the fastest
    assert 0.4 * force[0, 0] <= 0.0
    level, force = OURS(state, port_of([0.4, 0.0], force=nan), push)
    assert level[0] <= 0.0
    assert 0.4 * force[0, 0] <= 0.0
    rivals: list[Filter] = [TextbookValve(tank=TANK), StiffnessRate(), KineticBarrier()]
    for one in rivals:
        robots = Robots(1, 1.0)
        robots.velocity[:] = [0.4, 0.3]
        spring = hostile(np.random.default_rng(0), robots, 1)
        port = robots.port(np.zeros((1, 2)), robots.position, 1e-3, 1e-3, spring)
        _, force = one(one.begin(1), port, np.array([nan]))
        assert np.isfinite(force).all()
        assert force[0] @ [0.4, 0.3] <= 0.0


def test_robots_side_by_side_do_not_touch_each_other():
    random = np.random.default_rng(3)
    robots = Robots(5, 1.0)
    robots.velocity = random.normal(size=(5, 2))
    spring = hostile(random, robots, 5)
    action = force_of(spring, robots.velocity)
    action[3] = np.nan
    port = robots.port(random.normal(size=(5, 2)), robots.position - 0.001, 1e-2, 1e-2, spring)
    state = np.linspace(0.0, 1.0, 5)
    level, force = OURS(state, port, action)
    for n in range(5):
        one = port._replace(
            force=port.force[n : n + 1], displacement=port.displacement[n : n + 1],
            velocity=port.velocity[n : n + 1], mass=port.mass[n : n + 1],
            elapsed=port.elapsed[n : n + 1], impedance=None,
        )  # fmt: skip
        alone = OURS(state[n : n + 1], one, action[n : n + 1])
        np.testing.assert_allclose(level[n], alone[0][0], rtol=1e-12)
        np.testing.assert_allclose(force[n], alone[1][0], rtol=1e-12)


def test_a_chain_keeps_what_each_of_its_filters_keeps():
    """Each books what was done in the end, and none undoes the other's limit here."""
    chain = FilterChain((KineticBarrier(most=0.2), OURS))
    rise, least, _ = driven(chain, 1e-2, 200)
    assert rise < 1e-9
    assert least >= TANK.reserve
    assert chain.level(chain.begin(2)) is not None
    alone = FilterChain((KineticBarrier(),))
    assert alone.level(alone.begin(1)) is None
    _, force = chain(chain.begin(1), port_of([0.65, 0.0]), np.array([[30.0, 0.0]]))
    assert force[0, 0] < 1.0  # 0.21 J already: the barrier's part


def test_many_periods_are_booked_as_one_after_the_other():
    """What is more than the tank holds is lost when it comes, and not in the end."""
    tank, random = EnergyTank(initial=0.6, upper=0.8), np.random.default_rng(0)
    drawn = random.normal(0.0, 0.1, (5, 40))
    level, expected = np.linspace(-0.2, 0.8, 5), []
    followed = tank.followed(level, drawn)
    for period in range(40):
        one = port_of([0.0, 0.0])._replace(
            force=np.ones((5, 1)), displacement=drawn[:, period : period + 1], elapsed=np.ones(5)
        )
        level = tank.booked(level, one, 1.0)
        expected.append(level)
    np.testing.assert_allclose(followed, np.transpose(expected), atol=1e-12)
    assert (followed == 0.8).any()
    meter, push = TankMeter(tank=tank), np.array([[1e3, np.nan]])
    level, action = meter(meter.begin(1), port_of([1.0, 0.0], 1.0, [9.0, 0.0], [1.0, 0.0]), push)
    assert level[0] == pytest.approx(0.6 - 9.0)
    assert action is push


def test_filters_have_names_and_numbers():
    for name in FILTERS:
        tank = {"initial": 1.0, "upper": 2.0}
        numbers = {"tank": tank} if name not in ("stiffness-rate", "kinetic-barrier") else {}
        one = filter_of(name, numbers)
        assert filter_of(name, numbers_of(one)) == one
    with pytest.raises(PalpateError, match="there are: passivity, textbook-valve"):
        filter_of("valve", {})
    with pytest.raises(PalpateError, match="does not have these numbers"):
        filter_of("passivity", {"speed": 1.0})
    with pytest.raises(PalpateError, match="0 < reserve < lower bound"):
        EnergyTank(initial=1.0, upper=0.5)
    with pytest.raises(PalpateError, match="power that a tank gives"):
        EnergyTank(initial=1.0, upper=2.0, flow=0.0)
    with pytest.raises(PalpateError, match="fastest speed"):
        PassivityFilter(tank=TANK, fastest=0.0)
    with pytest.raises(PalpateError, match="needs to know the impedance"):
        TextbookValve(tank=TANK)(np.ones(1), port_of([0.0, 0.0]), np.zeros((1, 2)))
