"""Gradient MPC: its derivatives, the linear problem it solves exactly, and its limits."""

import itertools
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.planning.gradient import GradientPlanner, iterations_within
from toys import Cart, CartState, Pendulum, PendulumState

CART = Cart(jnp.asarray(1.0), jnp.asarray(0.5))
PENDULUM = Pendulum(jnp.asarray(1.0), jnp.asarray(0.1))
LIMIT, RATE = 4.0, 40.0  # N, N/s


def cart_loss(states: CartState, commands, goal):
    distance = states.position[:, 0] - goal
    return distance**2 + 0.05 * states.velocity[:, 0] ** 2 + 0.01 * commands[:, 0] ** 2


def pendulum_loss(states: PendulumState, commands, goal):
    return PENDULUM.energy(states) + 1e-3 * commands[:, 0] ** 2


def cart_planner(**settings) -> GradientPlanner:
    settings = {"knots": 6, "spacing": 4, "limit": LIMIT, "rate_limit": RATE} | settings
    return GradientPlanner(model=CART, stage_loss=cart_loss, **settings)


def pendulum_planner(**settings) -> GradientPlanner:
    settings = {"knots": 6, "spacing": 10, "limit": 6.0, "rate_limit": 60.0} | settings
    return GradientPlanner(model=PENDULUM, stage_loss=pendulum_loss, **settings)


def cart_at(position: float, velocity: float = 0.0) -> CartState:
    return CartState(jnp.full(1, position), jnp.full(1, velocity))


def first_plan(planner: GradientPlanner):
    return planner.init(jnp.zeros(1), jax.random.key(0))


def riccati_command(position: float, velocity: float, steps: int) -> float:
    """The first command of the finite-horizon linear-quadratic regulator, in float64."""
    period = CART.control_period
    drive = np.array([period**2, period])
    move = np.array([[1.0, period * (1 - 0.5 * period)], [0.0, 1 - 0.5 * period]])
    stage, effort = np.diag([1.0, 0.05]), 0.01
    gain, value = np.zeros(2), np.zeros((2, 2))
    for _ in range(steps):
        value = value + stage  # paid after the step
        gain = drive @ value @ move / (effort + drive @ value @ drive)
        value = move.T @ value @ (move - np.outer(drive, gain))
    return float(-gain @ [position, velocity])


@pytest.mark.parametrize("start", [(1.0, 0.0), (-0.3, 0.8)])
def test_one_iteration_solves_the_linear_quadratic_problem(start) -> None:
    """With a knot in every control period, and limits far away, it is the regulator."""
    planner = cart_planner(knots=21, spacing=1, limit=1e3, rate_limit=None)
    _, command = planner(first_plan(planner), cart_at(*start), jnp.zeros(20))
    assert float(command[0]) == pytest.approx(riccati_command(*start, 20), rel=2e-3)


def test_slope_is_that_of_the_loss() -> None:
    """Against central differences, and against reverse mode, along a plan that bends and turns."""
    planner = pendulum_planner()
    knots = 0.5 * jax.random.normal(jax.random.key(1), (6, 1))
    state = PendulumState(jnp.full(1, 1.2), jnp.full(1, -0.5))
    command = jnp.full(1, 0.3)

    @jax.jit
    def loss(knots):
        return planner._losses(knots[None], command, state, None)[0]

    slope, curvature = eqx.filter_jit(planner._expansion)(knots, command, state, None)
    np.testing.assert_allclose(slope, jax.grad(loss)(knots)[:, 0], rtol=1e-3, atol=1e-3)
    for knot in range(6):
        away = jnp.zeros_like(knots).at[knot].set(1e-2)
        difference = (loss(knots + away) - loss(knots - away)) / 2e-2
        assert float(slope[knot]) == pytest.approx(float(difference), rel=2e-2, abs=2e-2)
    np.testing.assert_allclose(curvature, curvature.T, rtol=1e-3, atol=1e-3)


def test_curvature_is_whole_where_the_dynamics_are_linear() -> None:
    planner = cart_planner(limit=1e3, rate_limit=None)
    knots = 1e-3 * jax.random.normal(jax.random.key(0), (6, 1))

    def loss(knots):
        return planner._losses(knots[None, :, None], jnp.zeros(1), cart_at(1.0), jnp.zeros(20))[0]

    expansion = eqx.filter_jit(planner._expansion)
    _, curvature = expansion(knots, jnp.zeros(1), cart_at(1.0), jnp.zeros(20))
    whole = np.asarray(jax.jit(jax.hessian(loss))(knots[:, 0]))
    np.testing.assert_allclose(curvature, whole, rtol=1e-2, atol=1e-3 * np.abs(whole).max())


@pytest.mark.parametrize("rate", [RATE, None], ids=["rate", "no rate"])
def test_goes_where_it_is_told_within_limits(rate) -> None:
    planner = cart_planner(rate_limit=rate)
    state, plan = cart_at(0.0), first_plan(planner)
    positions, commands = [], [0.0]
    for _ in range(80):
        plan, command = planner(plan, state, jnp.ones(planner.horizon))
        state = CART.step(state, command)
        positions.append(float(state.position[0]))
        commands.append(float(command[0]))
    assert np.abs(np.array(positions[60:]) - 1).max() < 0.02
    assert 1.0 < np.abs(commands).max() <= LIMIT * 1.0001
    if rate is not None:
        assert np.abs(np.diff(commands)).max() <= RATE * CART.control_period * 1.001


def test_takes_the_swing_out_of_a_pendulum() -> None:
    # From 1.5 rad an iteration a decision does not settle, and rounding says where it ends.
    planner = pendulum_planner()
    start = PendulumState(jnp.full(1, 1.0), jnp.zeros(1))
    state, left, plan = start, start, first_plan(planner)
    for _ in range(100):
        plan, command = planner(plan, state, None)
        state, left = PENDULUM.step(state, command), PENDULUM.step(left, jnp.zeros(1))
    share = PENDULUM.energy(state) / PENDULUM.energy(start)
    assert float(share) < 0.01
    assert float(PENDULUM.energy(left) / PENDULUM.energy(start)) > 0.5


def test_no_iteration_makes_a_plan_worse() -> None:
    state = PendulumState(jnp.full(1, 2.5), jnp.full(1, 1.0))
    losses = []
    for iterations in range(4):
        planner = pendulum_planner(iterations=max(1, iterations))
        plan = first_plan(planner)
        knots = planner._improve(plan, state, None, plan.key) if iterations else plan.knots
        losses.append(float(planner._losses(knots[None], plan.command, state, None)[0]))
    assert losses[1] < 0.95 * losses[0]
    for earlier, later in itertools.pairwise(losses):
        assert later <= earlier * 1.0001


def test_what_is_not_finite_leaves_the_plan_as_it_was() -> None:
    planner = cart_planner()
    plan, _ = planner(first_plan(planner), cart_at(0.0), jnp.ones(20))
    expected = planner._command(plan.knots[0], plan.command)
    lost, command = planner(plan, cart_at(jnp.nan), jnp.ones(20))
    np.testing.assert_allclose(command, expected)
    np.testing.assert_allclose(lost.knots, planner._curve(plan.knots, 1.0))
    found, _ = planner(lost, cart_at(0.0), jnp.ones(20))
    assert float(jnp.abs(found.knots - lost.knots).max()) > 1e-3


def test_is_compiled_once() -> None:
    traces = []

    def counted(states, commands, goal):
        traces.append(1)
        return cart_loss(states, commands, goal)

    planner = GradientPlanner(model=CART, stage_loss=counted, limit=LIMIT, rate_limit=RATE)
    plan, _ = planner(first_plan(planner), cart_at(0.0), jnp.ones(planner.horizon))
    once = len(traces)
    other = GradientPlanner(
        model=Cart(jnp.asarray(2.0), jnp.asarray(0.1)),
        stage_loss=counted,
        limit=LIMIT,
        rate_limit=RATE,
    )
    other(plan, cart_at(1.0), jnp.zeros(planner.horizon))
    assert len(traces) == once


def test_counts_that_make_no_planner_are_refused() -> None:
    with pytest.raises(PalpateError, match="at least one iteration, two knots and one period"):
        cart_planner(iterations=0)


def test_iterations_are_counted_in_time() -> None:
    def decision(iterations: int):
        return lambda: time.sleep(2e-3 * iterations)

    iterations, took = iterations_within(0.012, decision)
    assert 3 <= iterations <= 5
    assert took <= 0.012
    with pytest.raises(PalpateError, match=r"one iteration already takes .* the 1\.0 ms allowed"):
        iterations_within(0.001, decision)
