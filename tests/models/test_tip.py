"""The tip against closed forms, conservation laws and finite differences."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from palpate.errors import PalpateError
from palpate.models.contact import Tip, TipState, tip_with_walls
from palpate.models.contact.integration import grip, velocity_after_friction
from palpate.models.contract import check_model
from palpate.models.files import load_model, save_model
from palpate.models.model import rollout
from palpate.parameters import FreeParameters, value_of, with_values

pytestmark = pytest.mark.usefixtures("float64")
run = jax.jit(rollout)
LEFT = math.pi  # a wall at positive x pushes to the left
FREE = {"damping_ratio": 0.0, "damping": 0.0, "friction": 0.0}


def walled(directions, **values) -> Tip:
    """Without friction and delay of the arm, mass of a tool and of walls, unless some is given."""
    nothing = {"arm_friction": 0.0, "tool_mass": 0.0, "wall_mass": 0.0, "control_delay": 0.0}
    return tip_with_walls(directions, **nothing | values)


def moving(tip, position, velocity) -> TipState:
    return tip.state(jnp.asarray(position, float), jnp.asarray(velocity, float))


def held(setpoint, stiffness, steps: int):
    return jnp.broadcast_to(jnp.array([*setpoint, *stiffness, 0.0, 0.0], float), (steps, 6))


def test_it_keeps_the_contract_of_a_model():
    check_model(tip_with_walls([0.0, 1.0, LEFT]))


def test_without_contact_the_impedance_swings_as_its_closed_form():
    """An underdamped oscillator along each axis, of another stiffness each."""
    tip = walled([LEFT], mass=2.0, damping_ratio=0.4, position=-9.0)
    states = run(tip, moving(tip, [0.0, 0.0], [0.0, 0.1]), held([0.1, 0.0], [200.0, 50.0], 200))
    time = tip.control_period * np.arange(1, 201)
    for axis, (stiffness, x, v, goal) in enumerate([(200.0, 0.0, 0.0, 0.1), (50.0, 0.0, 0.1, 0.0)]):
        natural = np.sqrt(stiffness / 2.0)
        decay, swing = 0.4 * natural, np.sqrt(1 - 0.4**2) * natural
        sine = (v + decay * (x - goal)) / swing
        shape = (x - goal) * np.cos(swing * time) + sine * np.sin(swing * time)
        expected = goal + np.exp(-decay * time) * shape
        np.testing.assert_allclose(states.position[:, axis], expected, atol=2e-5)
    assert float(jnp.abs(states.force).max()) == 0.0


def test_a_set_point_that_moves_within_a_period_pulls_as_one_that_is_ordered_more_often():
    """Behind a ramp a damped tip lags by D / K times its speed; held for a period, it jerks."""
    tip = walled([LEFT], mass=1.2, damping_ratio=0.8, tool_mass=0.4, position=-9.0)
    tip = dataclasses.replace(tip, control_period=2e-2)
    middle = 0.3 * (tip.control_period * np.arange(100) + 0.5 * tip.control_period)
    still = np.zeros_like(middle)
    force, lag = {}, {}
    for speed in (0.3, 0.0):
        rows = [middle, still, still + 300.0, still + 300.0, still + speed, still]
        states = run(tip, moving(tip, [0.0, 0.0], [0.0, 0.0]), jnp.asarray(np.stack(rows, axis=1)))
        force[speed] = float(jnp.abs(states.force[-1, 0]))
        lag[speed] = 0.3 * tip.control_period * 100 - float(states.position[-1, 0])
    damping = 2.0 * 0.8 * math.sqrt(300.0 * 1.2)
    assert lag[0.3] == pytest.approx(0.3 * damping / 300.0, rel=1e-4)
    assert force[0.3] < 1e-3
    assert force[0.0] > 0.1


def test_a_controller_that_holds_its_force_is_one_that_acts_late_by_half_as_long():
    """Integrated finely with forces held for 2 ms, against steps of a whole period of 5 ms."""
    hold, step = 2e-3, 1e-5
    mass, stiffness, ratio = 1.0, 900.0, 0.7
    damping = 2.0 * ratio * math.sqrt(stiffness * mass)
    position, velocity, expected = 0.0, 0.0, []
    for count in range(round(0.2 / step)):
        if count % round(hold / step) == 0:
            force = stiffness * (0.05 - position) - damping * velocity
        velocity += step * force / mass
        position += step * velocity
        if (count + 1) % round(5e-3 / step) == 0:
            expected.append(position)
    off = {}
    for delay in (0.0, 0.5 * hold):
        tip = walled([LEFT], mass=mass, damping_ratio=ratio, control_delay=delay, position=-9.0)
        actions = held([0.05, 0.0], [stiffness, stiffness], len(expected))
        states = run(tip, moving(tip, [0.0, 0.0], [0.0, 0.0]), actions)
        off[delay] = np.abs(np.asarray(states.position)[:, 0] - expected).max()
    assert off[0.0] > 5e-4
    assert off[0.5 * hold] < 0.2 * off[0.0]


@pytest.mark.parametrize("stiffness", [100.0, 1e4, 1e5])
def test_it_comes_to_rest_as_deep_as_the_force_over_the_stiffness(stiffness):
    """Wall and impedance as two springs in a row; a far stiffer wall than the step resolves too."""
    tip = walled([LEFT], position=-0.05, stiffness=stiffness, damping=stiffness**0.5)
    states = run(tip, moving(tip, [0.0, 0.0], [0.0, 0.0]), held([0.1, 0.0], [300.0, 300.0], 1000))
    force = 300.0 * stiffness / (300.0 + stiffness) * 0.05
    assert float(states.position[-1, 0]) - 0.05 == pytest.approx(force / stiffness, rel=1e-6)
    np.testing.assert_allclose(states.force[-1], [-force, 0.0], rtol=1e-6, atol=1e-9)


def test_a_tip_that_slides_is_slowed_by_friction_times_normal_force():
    """Pressed by a set-point behind the wall, soft along it: constant deceleration, then rest."""
    tip = walled([LEFT], mass=1.5, friction=0.4, stiffness=1e4, damping_ratio=0.0, damping=200.0)
    depth = 10.0 / 1e4
    states = run(
        tip, moving(tip, [depth, 0.0], [0.0, 0.8]), held([1.0 + depth, 0.0], [10.0, 0.0], 120)
    )
    normal, along = np.asarray(states.force).T
    time = tip.control_period * np.arange(1, 121)
    slides = time < 0.8 / (0.4 * 10.0 / 1.5)
    np.testing.assert_allclose(along[slides][:-2] / normal[slides][:-2], 0.4, rtol=2e-2)
    expected = np.maximum(0.8 - 0.4 * 10.0 / 1.5 * time, 0.0)
    np.testing.assert_allclose(states.velocity[:, 1], expected, atol=2e-3)


def test_friction_holds_what_pushes_less_than_it_and_lets_go_of_what_pushes_more():
    tip = walled([LEFT], friction=0.5, stiffness=1e4)
    for pull, sticks in ((0.9, True), (1.1, False)):
        action = held([0.1 + 10.0 / 1e4, pull * 0.5 * 10.0 / 50.0], [100.0, 50.0], 400)
        states = run(tip, moving(tip, [10.0 / 1e4, 0.0], [0.0, 0.0]), action)
        went = float(jnp.linalg.norm(states.position[-1] - jnp.array([10.0 / 1e4, 0.0])))
        assert (went < 3e-3) == sticks
        assert not sticks or np.asarray(states.force)[-1, 1] == pytest.approx(-pull * 5.0, rel=0.02)


def test_where_a_wall_holds_the_tip_the_sensor_feels_all_of_the_pull_and_the_arm_holds_nothing():
    """About 40 N on the wall would hold 12 N; the arm would take 0.6 N of the pull if it slid."""
    tip = walled([LEFT], friction=0.3, arm_friction=0.6, arm_creep=1e-3, stiffness=1e3)
    states = run(tip, moving(tip, [0.0, 0.0], [0.0, 0.0]), held([0.08, 0.01], [1e3, 500.0], 400))
    pull = 500.0 * (0.01 - states.position[-1, 1])
    assert 2.0 < float(pull) < 12.0
    np.testing.assert_allclose(states.force[-1, 1], -pull, rtol=0.01)


def test_dry_friction_of_the_arm_slows_a_free_tip_straight_to_a_stop():
    tip = walled([LEFT], mass=2.0, arm_friction=0.6, arm_creep=1e-5, position=-9.0)
    states = run(tip, moving(tip, [0.0, 0.0], [0.3, 0.4]), held([0.0, 0.0], [0.0, 0.0], 400))
    slowed_down = np.maximum(0.5 - 0.3 * tip.control_period * np.arange(1, 401), 0.0)
    expected = np.outer(slowed_down, [0.6, 0.8])
    np.testing.assert_allclose(states.velocity, expected, atol=1e-3)


def test_friction_never_turns_round_and_takes_at_most_its_own():
    sliding = jnp.linspace(-1.0, 1.0, 2001)
    for most in (0.0, 1e-3, 0.3, 30.0):
        after = velocity_after_friction(sliding, jnp.full_like(sliding, most), 1e-4)
        assert np.all(after * sliding >= 0.0)
        np.testing.assert_allclose(after + most * grip(after, 1e-4), sliding, atol=1e-12)
        slope = jax.vmap(jax.grad(velocity_after_friction), (0, None, None))(
            sliding, jnp.asarray(most), 1e-4
        )
        assert np.all(np.isfinite(slope))


@pytest.mark.parametrize("ratio", [0.02, 0.2, 0.5])
def test_a_bounce_has_the_restitution_of_the_linear_spring_and_damper(ratio):
    """Ended where the force would pull (Schwager and Poeschel, Granular Matter 9, 2007)."""
    mass, stiffness = 1.2, 4e3
    natural = np.sqrt(stiffness / mass)
    decay = ratio * natural
    swing = np.sqrt(natural**2 - decay**2)
    phase = np.arctan2(2 * decay * swing, swing**2 - decay**2)
    expected = np.exp(-decay / swing * (np.pi - phase))
    tip = walled([LEFT], **FREE | {"damping": 2 * mass * decay}, mass=mass, stiffness=stiffness)
    tip = dataclasses.replace(tip, control_period=2e-4)
    states = run(tip, moving(tip, [-0.01, 0.0], [0.5, 0.0]), held([0.0, 0.0], [0.0, 0.0], 600))
    assert float(states.velocity[-1, 0]) / -0.5 == pytest.approx(expected, rel=5e-3)


def test_no_contact_creates_energy_however_stiff_the_wall_and_wherever_a_step_meets_it():
    """Elastic bounces: from less than a thousandth of a step's period to a hundred of them."""
    stiffness = np.repeat(10.0 ** np.arange(2, 8), 20)
    tip = walled([LEFT], **FREE)
    tip = with_values(tip, {"stiffness": jnp.asarray(stiffness)[:, None]})
    start = np.zeros((len(stiffness), 2))
    start[:, 0] = -np.linspace(0.01, 0.0106, len(stiffness))
    velocity = np.broadcast_to([0.6, 0.2], start.shape)
    rest = jnp.zeros((len(stiffness), 400, 6))
    states = run(tip, moving(tip, start, velocity), rest)
    after = np.asarray(states.velocity[:, -1])
    assert np.all(after[:, 0] < 0.0)
    kept = -after[:, 0] / 0.6
    assert np.all(kept <= 1.0 + 1e-6)
    assert np.all(kept[stiffness <= 1e4] > 0.97)
    np.testing.assert_allclose(after[:, 1], 0.2)


def test_a_plate_that_is_met_takes_its_share_of_the_momentum():
    """Inelastic, as of two masses; then they swing together on the spring until it is relaxed."""
    tip = walled([LEFT], **FREE, mass=1.0, wall_mass=0.25, stiffness=500.0)
    tip = dataclasses.replace(tip, control_period=2e-4)
    states = run(tip, moving(tip, [-1e-6, 0.0], [0.5, 0.0]), held([0.0, 0.0], [0.0, 0.0], 1000))
    depth, speed = np.asarray(states.position[:, 0]), 0.5 / 1.25
    assert depth.max() == pytest.approx(speed * np.sqrt(1.25 / 500.0), rel=2e-3)
    assert float(states.velocity[-1, 0]) == pytest.approx(-speed, rel=2e-3)


@pytest.mark.parametrize("period", [2e-4, 1.25e-3])
def test_a_plate_takes_as_much_wherever_in_a_step_it_is_met(period):
    tip = walled([LEFT], **FREE, mass=1.0, wall_mass=0.25, stiffness=500.0)
    tip = dataclasses.replace(tip, control_period=period)
    before = 0.5 * period * np.array([1e-3, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
    start = np.stack([-before, 0.0 * before], axis=1)
    velocity = np.broadcast_to([0.5, 0.0], start.shape)
    rest = jnp.zeros((len(start), round(0.3 / period), 6))
    states = run(tip, moving(tip, start, velocity), rest)
    np.testing.assert_allclose(states.velocity[:, -1, 0], -0.5 / 1.25, rtol=5e-4)


def test_what_is_observed_is_continuous_in_where_a_wall_is_met():
    """Also as the impact moves from one step to another, where it would jump by 1.5 N at once."""
    where = -0.02 - 1e-6 * np.arange(1500)  # across two substeps
    tip = walled([LEFT], wall_mass=0.02, tool_mass=0.3, stiffness=1000.0, damping=25.0)
    tip = with_values(tip, {"position": jnp.asarray(where)[:, None]})
    start = jnp.zeros((len(where), 2))
    velocity = jnp.broadcast_to(jnp.array([0.5, 0.1]), start.shape)
    actions = jnp.broadcast_to(held([0.05, 0.0], [300.0, 300.0], 12), (len(where), 12, 6))
    states = run(tip, moving(tip, start, velocity), actions)
    seen = np.asarray(jax.vmap(tip.observe, in_axes=1, out_axes=1)(states))
    assert np.ptp(seen[:, :, 2], axis=0).max() > 1.5  # N: some are about to touch, and some do
    assert np.abs(np.diff(seen[:, :, 2:], axis=0)).max() < 0.06
    assert np.abs(np.diff(seen[:, :, :2], axis=0)).max() < 4e-6


def test_a_plate_that_is_left_comes_back_as_its_damper_lets_it():
    """By exp(-k t / d) without a mass; a tip that follows it back later meets it on its way."""
    tip = walled([LEFT], **FREE | {"damping": 40.0}, mass=1.0, stiffness=500.0)
    start = moving(tip, [0.01, 0.0], [-1.0, 0.0])
    states = run(tip, start, held([0.0, 0.0], [0.0, 0.0], 40))
    time = tip.control_period * np.arange(1, 41)
    expected = 0.01 * np.exp(-500.0 / 40.0 * time)
    np.testing.assert_allclose(states.plates.depth[:, 0], expected, rtol=1e-3)
    assert not states.plates.carried.any()
    back = jax.tree.map(lambda part: part[-1], states)
    back = back._replace(position=jnp.array([-1e-4, 0.0]), velocity=jnp.array([0.1, 0.0]))
    again = run(tip, back, held([0.0, 0.0], [0.0, 0.0], 6))
    met = np.argmax(np.asarray(again.plates.carried[:, 0]) > 0.0)
    depth = 0.1 * time - 1e-4
    assert met == np.argmax(depth > expected[-1] * np.exp(-12.5 * time))


def test_the_error_of_a_bounce_falls_with_the_square_of_the_step():
    tip = walled([LEFT], **FREE | {"damping": 8.0}, stiffness=1000.0, position=-0.02)
    ends = []
    for halved in range(7):
        period = 1e-3 / 2**halved
        fine = dataclasses.replace(tip, control_period=period)
        actions = held([0.05, 0.0], [100.0, 100.0], round(0.5 / period))
        ends.append(float(run(fine, moving(tip, [0.0, 0.0], [0.3, 0.0]), actions).position[-1, 0]))
    errors = np.abs(np.array(ends[:-2]) - ends[-1])
    order = np.polyfit(np.arange(len(errors)), -np.log2(errors), 1)[0]
    assert 1.5 < order < 2.8


def test_a_corner_holds_the_tip_by_both_walls():
    tip = walled([LEFT, -math.pi / 2], position=[-0.05, -0.04], stiffness=[2e3, 5e3], friction=0.3)
    states = run(tip, moving(tip, [0.0, 0.0], [0.0, 0.0]), held([0.1, 0.1], [200.0, 200.0], 800))
    force = np.asarray(states.force)[-1]
    pull = 200.0 * (0.1 - np.asarray(states.position)[-1])
    # Friction of one wall acts after the normal force of the other is known: off by a step.
    np.testing.assert_allclose(-force, pull, rtol=5e-3)
    assert np.all(np.abs(states.velocity[-1]) < 1e-3)


def test_a_tilt_turns_the_wall_about_the_point_abreast_of_its_centre():
    tip = walled([LEFT], position=-0.05, tilt=0.1, centre=[0.0, 0.3], friction=0.0, stiffness=1e4)
    for y, at in ((0.3, 0.05), (0.4, 0.05 - 0.1 * math.tan(0.1))):
        surfaces = tip.surfaces
        depth = surfaces.place - jnp.sum(surfaces.normal * jnp.array([at, y]), axis=-1)
        assert float(jnp.abs(depth).max()) < 1e-12
    assert float(surfaces.normal[0, 1]) == pytest.approx(-math.sin(0.1))


def test_derivatives_of_what_is_observed_are_those_of_finite_differences():
    """Through touching, sliding and leaving, by every parameter and by the start."""
    tip = walled([LEFT, -math.pi / 2], position=[-0.03, -0.02], friction=0.3, tilt=[0.03, -0.02])
    time = tip.control_period * np.arange(160)
    way = 0.045 * np.stack([np.sin(5.0 * time), np.sin(7.0 * time + 1.0)], axis=1)
    moves = np.gradient(way, tip.control_period, axis=0)
    actions = jnp.asarray(np.concatenate([way, np.full((160, 2), 400.0), moves], axis=1))
    coordinates = FreeParameters(tip)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(160, 4)) * [100.0, 100.0, 1.0, 1.0])

    def weighed(free, start):
        model = coordinates.build(free)
        observed = jnp.concatenate([start, jnp.zeros(2)])[None]
        states = rollout(model, model.initial_state(observed), actions)
        return jnp.sum(weight * model.observe(states))

    point = coordinates.initial, jnp.array([0.0, 0.005])
    slope = jax.jit(jax.grad(weighed, (0, 1)))(*point)
    evaluate = jax.jit(weighed)
    flat, unravel = ravel_pytree(point)
    for index, expected in enumerate(ravel_pytree(slope)[0]):
        step = jnp.zeros_like(flat).at[index].set(1e-6)
        up, down = evaluate(*unravel(flat + step)), evaluate(*unravel(flat - step))
        assert float(expected) == pytest.approx(float(up - down) / 2e-6, rel=2e-3, abs=1e-3), index


def test_an_arm_creeps_at_less_than_its_dry_friction():
    """Pulled by F: u = 2 creep (1 - sqrt(1 - F / friction)), by its definition."""
    tip = walled([LEFT], arm_friction=0.6, arm_creep=2e-3, position=-9.0)
    tip = dataclasses.replace(tip, damping_ratio=jnp.asarray(0.0))
    states = run(tip, moving(tip, [0.0, 0.0], [0.0, 0.0]), held([1e4, 0.0], [4e-5, 0.0], 200))
    assert float(states.velocity[-1, 0]) == pytest.approx(4e-3 * (1 - np.sqrt(1 / 3)), rel=1e-3)


def test_the_sensor_at_the_wrist_feels_the_tool_resist():
    """In free motion a constant pull shows the tool's share of it, against the acceleration."""
    tip = walled([LEFT], mass=1.5, tool_mass=0.3, damping_ratio=0.0, position=-9.0)
    states = run(tip, moving(tip, [0.0, 0.0], [0.0, 0.0]), held([1e4, 0.0], [3e-4, 0.0], 40))
    np.testing.assert_allclose(states.force[-1], [-0.3 * 3.0 / 1.5, 0.0], rtol=1e-3, atol=1e-9)


def test_the_sensor_shows_its_bias_and_a_start_knows_it():
    tip = walled([LEFT], force_bias=[0.5, -0.2])
    seen = jnp.array([[0.0, 0.0, 0.5, -0.2], [0.001, 0.0, 1.5, -0.2]])
    state = tip.initial_state(seen)
    np.testing.assert_allclose(state.force, [1.0, 0.0])
    np.testing.assert_allclose(state.velocity, [0.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(tip.observe(state), seen[-1])
    assert tip.velocity(state) is state.velocity


def test_walls_and_parameters_of_different_numbers_are_refused():
    with pytest.raises(PalpateError, match="'friction' has the shape"):
        dataclasses.replace(tip_with_walls([0.0, 1.0]), friction=jnp.ones(3))
    with pytest.raises(PalpateError, match="at least one wall"):
        tip_with_walls([])


def test_it_is_saved_and_loaded(tmp_path):
    tip = walled([0.1, 2.0], position=[0.2, 0.3], centre=[0.4, 0.5])
    save_model(tmp_path / "tip.json", tip)
    again, _ = load_model(tmp_path / "tip.json")
    assert isinstance(again, Tip)
    for name in ("position", "direction", "centre", "friction"):
        np.testing.assert_allclose(value_of(again, name), value_of(tip, name), rtol=1e-6)
