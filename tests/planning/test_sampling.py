"""Sampling MPC on a cart: it gets where it is told, within limits and within its time."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.planning.sampling import Cem, Mppi, SamplingPlanner, samples_within
from toys import Cart, CartState

CART = Cart(jnp.asarray(1.0), jnp.asarray(0.5))
LIMIT, RATE = 4.0, 40.0  # N, N/s


def stage_loss(states: CartState, commands, goal):
    return (states.position[:, 0] - goal) ** 2 + 0.05 * states.velocity[:, 0] ** 2


def planner(rule, **settings) -> SamplingPlanner:
    settings = {"samples": 64, "knots": 6, "spacing": 4, "rate_limit": RATE} | settings
    return SamplingPlanner(model=CART, stage_loss=stage_loss, rule=rule, limit=LIMIT, **settings)


def drive(plans: SamplingPlanner, goal, steps: int = 80):
    """The cart's positions and the commands, from the origin at rest; `goal` of the time (s)."""
    state, command = CartState(jnp.zeros(1), jnp.zeros(1)), jnp.zeros(1)
    plan = plans.init(command, jax.random.key(0))
    positions, commands = [], []
    for step in range(steps):
        instants = (step + 1 + jnp.arange(plans.horizon)) * CART.control_period
        plan, command = plans(plan, state, goal(instants))
        state = CART.step(state, command)
        positions.append(float(state.position[0]))
        commands.append(float(command[0]))
    return np.array(positions), np.array(commands)


RULES = pytest.mark.parametrize(
    ("rule", "iterations"), [(Mppi(), 1), (Cem(), 3)], ids=["mppi", "cem"]
)


@RULES
@pytest.mark.parametrize("rate", [RATE, None], ids=["rate", "no rate"])
def test_goes_where_it_is_told_and_stays(rule, iterations, rate) -> None:
    plans = planner(rule, iterations=iterations, rate_limit=rate)
    positions, commands = drive(plans, jnp.ones_like)
    assert np.abs(positions[60:] - 1).max() < 0.2
    assert np.abs(commands).max() <= LIMIT * 1.0001
    if rate is not None:
        assert np.abs(np.diff(commands)).max() <= RATE * CART.control_period * 1.001


@RULES
def test_follows_a_goal_that_moves(rule, iterations) -> None:
    positions, _ = drive(planner(rule, iterations=iterations), lambda time: 0.5 * jnp.sin(time))
    expected = 0.5 * np.sin(np.arange(1, 81) * CART.control_period)
    assert np.abs(positions - expected)[20:].mean() < 0.12  # at rest: 0.33


def test_more_samples_plan_better() -> None:
    loss = {}
    for samples in (4, 256):
        positions, _ = drive(planner(Mppi(), samples=samples), jnp.ones_like, 40)
        loss[samples] = np.mean((positions - 1) ** 2)
    assert loss[256] < 0.9 * loss[4]


def test_the_same_key_decides_the_same() -> None:
    first, second = (drive(planner(Mppi()), jnp.ones_like, 5)[1] for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_plan_moves_on_with_time() -> None:
    """Without deviation the plan is only carried out: its curve comes by, one period at a time."""
    plans = planner(Mppi(), samples=2, deviation=0.0, rate_limit=None)
    curve = jnp.linspace(0.0, 1.0, 6)[:, None]
    plan = plans.init(jnp.zeros(1), jax.random.key(0))
    plan = type(plan)(curve, plan.command, plan.key)
    state, goals = CartState(jnp.zeros(1), jnp.zeros(1)), jnp.zeros(plans.horizon)
    for step in range(8):
        knot = step / 4 * 0.2
        plan, command = plans(plan, state, goals)
        assert float(command[0]) == pytest.approx(LIMIT * knot / np.sqrt(1 + knot**2), rel=1e-3)


def test_weights_are_shares_and_ignore_what_diverged() -> None:
    losses = jnp.array([3.0, 1.0, jnp.inf, 2.0])
    for rule in (Mppi(), Cem(elites=0.5)):
        weights = np.asarray(rule.weights(losses))
        assert weights.sum() == pytest.approx(1.0)
        assert weights[1] == weights.max()
        assert weights[2] == 0
    scaled = Mppi().weights(1e6 * losses)
    np.testing.assert_allclose(scaled, Mppi().weights(losses), rtol=1e-4)  # any unit
    equal = Mppi().weights(jnp.full(4, 5.0))
    np.testing.assert_allclose(equal, 0.25)


def test_a_plan_without_any_finite_future_is_still_a_command() -> None:
    def hopeless(states, commands, goal):
        return jnp.full(states.position.shape[0], jnp.nan)

    for rule in (Mppi(), Cem()):
        plans = SamplingPlanner(
            model=CART, stage_loss=hopeless, rule=rule, limit=LIMIT, rate_limit=RATE
        )
        plan = plans.init(jnp.zeros(1), jax.random.key(0))
        _, command = plans(plan, CartState(jnp.zeros(1), jnp.zeros(1)), None)
        assert bool(jnp.isfinite(command).all())


@dataclasses.dataclass(frozen=True)
class Only:
    """The sample of this number, whatever it loses."""

    number: int
    narrows = False

    def weights(self, losses):
        return jnp.zeros_like(losses).at[self.number].set(1.0)


def test_samples_of_no_share_forget_the_plan_and_are_one_command() -> None:
    """Sample 1 has the share 0, sample 2 is about the plan, sample 0 is the plan."""
    for number, same in ((0, True), (1, True), (2, False)):
        plans = planner(Only(number), samples=4, deviation=0.5, rate_limit=None, shares=(1.0, 0.0))
        plan = plans.init(jnp.zeros(1), jax.random.key(0))
        plan = dataclasses.replace(plan, knots=jnp.full_like(plan.knots, 30.0))
        plan, _ = plans(plan, CartState(jnp.zeros(1), jnp.zeros(1)), jnp.zeros(20))
        knots = np.asarray(plan.knots)
        assert (np.ptp(knots) == 0.0) == same
        np.testing.assert_allclose(knots, 0.0 if number == 1 else 30.0, atol=3.0)
        assert number == 0 or np.abs(knots - 30.0).min() > 1e-3


def test_samples_about_a_share_of_the_plan_let_go_of_what_achieves_nothing() -> None:
    """Where all plans are as good, the new one is the mean of the shares of the old."""
    for shares, left in (((1.0,), 1.0), ((1.0, 0.0, 1.0, 0.5), 0.625)):
        plans = planner(Mppi(), samples=16, deviation=0.0, rate_limit=None, shares=shares)
        plans = dataclasses.replace(plans, stage_loss=lambda *_: jnp.zeros(16))
        plan = plans.init(jnp.zeros(1), jax.random.key(0))
        plan = dataclasses.replace(plan, knots=jnp.full_like(plan.knots, 3.0))
        plan, command = plans(plan, CartState(jnp.zeros(1), jnp.zeros(1)), jnp.zeros(20))
        np.testing.assert_allclose(plan.knots, 3.0 * left, rtol=1e-5)
        np.testing.assert_allclose(command, LIMIT * 3 * left / np.hypot(1, 3 * left), rtol=1e-5)
    with pytest.raises(PalpateError, match="first of the shares"):
        planner(Mppi(), shares=(0.0, 1.0))


def test_counts_that_make_no_planner_are_refused() -> None:
    with pytest.raises(PalpateError, match="at least two samples, one iteration, two knots"):
        planner(Mppi(), knots=1)


def test_samples_are_counted_in_time() -> None:
    def decision(samples: int):
        return lambda: time.sleep(1e-4 * samples)

    samples, took = samples_within(0.02, decision)
    assert samples % 16 == 0
    assert 96 <= samples <= 200
    assert took <= 0.02
    with pytest.raises(PalpateError, match=r"16 samples already take .* the 1\.0 ms allowed"):
        samples_within(0.001, decision)
