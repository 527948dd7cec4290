"""Trees of links: against closed forms, conservation laws and two engines."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.errors import PalpateError
from palpate.experiments.appliance.random_trees import (
    chain,
    mujoco_acceleration,
    pinocchio_acceleration,
    random_case,
    random_rotation,
)
from palpate.models import rollout
from palpate.models.articulated import Articulated, ArticulatedState, Link, free_links, tree_of
from palpate.models.articulated.lanes import BLOCK
from palpate.models.contract import check_model
from palpate.models.files import load_model, save_model
from palpate.parameters import value_of, with_values

MOST = 12
ROD = Link(
    axis=(0.0, 1.0, 0.0),
    mass=0.8,
    centre_of_mass=(0.3, 0.0, 0.0),
    inertia=np.diag([1e-4, 0.02, 0.02]),
)
DOOR = dataclasses.replace(ROD, axis=(0.0, 0.0, 1.0))  # its hinge is upright
ABOUT_HINGE = 0.02 + 0.8 * 0.3**2  # kg m^2
DRAWER = Link("prismatic", axis=(1.0, 0.0, 0.0), mass=2.0, inertia=np.diag([0.02, 0.02, 0.02]))

run = eqx.filter_jit(rollout)


def still(model: Articulated, position: float = 0.0) -> ArticulatedState:
    return ArticulatedState(jnp.full(model.links, position), jnp.zeros(model.links))


def nothing(model: Articulated, steps: int, torque: float = 0.0) -> jax.Array:
    return jnp.zeros((steps, *model.action_shape)).at[:, :, 0].set(torque)


# --- accelerations ----------------------------------------------------------------------------


def filled(array: np.ndarray) -> jax.Array:
    return jnp.asarray(np.pad(array, [(0, MOST - len(array)), *[(0, 0)] * (array.ndim - 1)]))


@pytest.mark.parametrize("seed", range(12))
def test_accelerations_are_those_of_mujoco_and_pinocchio(float64, seed):
    case = random_case(seed)
    model = tree_of(case.links, size=MOST)
    action = np.concatenate([case.torque[:, None], case.push, case.point], axis=1)
    position, velocity, action = map(filled, (case.position, case.velocity, action))
    ours = model.acceleration(ArticulatedState(position, velocity), action)
    for theirs in (mujoco_acceleration(case), pinocchio_acceleration(case)):
        own = np.asarray(ours)[: len(theirs)]
        np.testing.assert_allclose(own, theirs, atol=1e-9 * np.abs(theirs).max())
    np.testing.assert_array_equal(np.asarray(ours)[len(case.links) :], 0.0)


def test_a_free_body_falls_and_turns_as_euler_says(float64):
    rng = np.random.default_rng(0)
    inertia = np.diag([0.01, 0.02, 0.025])
    body = Link(mass=1.5, centre_of_mass=(0.1, -0.2, 0.05), inertia=inertia,
                rotation=random_rotation(rng), origin=(0.3, 0.1, 0.9))  # fmt: skip
    model = tree_of(free_links(body))
    position, velocity = jnp.asarray(rng.normal(0, 0.4, 6)), jnp.asarray(rng.normal(size=6))
    push, point = np.array([1.0, -2.0, 3.0]), np.array([0.2, 0.1, -0.3])
    action = nothing(model, 1)[0].at[5, 1:].set(np.concatenate([push, point]))

    accelerates = model.acceleration(ArticulatedState(position, velocity), action)

    def placed(time):
        there = position + velocity * time + 0.5 * accelerates * time**2
        rotation, origin = model.link_poses(there)
        return rotation[5], origin[5]

    (rotation, _), zero = placed(0.0), jnp.zeros(())
    centre = jnp.asarray(body.centre_of_mass)
    falls = jax.jacfwd(jax.jacfwd(jax.jit(lambda t: placed(t)[1] + placed(t)[0] @ centre)))(zero)
    np.testing.assert_allclose(falls, push / 1.5 - [0, 0, 9.81], atol=1e-9)

    @jax.jit
    def momentum(time):
        turn, rate = jax.jvp(lambda t: placed(t)[0], (time,), (jnp.ones(()),))
        spin = turn.T @ rate
        return turn @ inertia @ jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0]])

    torque = np.cross(rotation @ (point - np.asarray(body.centre_of_mass)), push)
    np.testing.assert_allclose(jax.jacfwd(momentum)(zero), torque, atol=1e-9)


def test_screws_move_what_the_joints_carry(float64):
    case = random_case(3)
    model = tree_of(case.links)
    position = jnp.asarray(case.position)
    screws, poses = model.screws(position), model.link_poses
    for joint in range(model.links):
        ahead, behind = (poses(position.at[joint].add(sign * 1e-6)) for sign in (1.0, -1.0))
        rate = (ahead[1][joint] - behind[1][joint]) / 2e-6
        origin = poses(position)[1][joint]
        expected = screws[joint, 3:] + jnp.cross(screws[joint, :3], origin)
        np.testing.assert_allclose(rate, expected, atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_what_an_action_comes_to_at_the_joints_does_the_same_as_the_action(float64, seed):
    case = random_case(seed)
    model = tree_of(case.links)
    action = jnp.concatenate([case.torque[:, None], case.push, case.point], axis=1)
    state = ArticulatedState(jnp.asarray(case.position), jnp.asarray(case.velocity))
    given = model.joint_forces(state.position, action)
    alone = jnp.zeros_like(action).at[:, 0].set(given)
    expected = model.acceleration(state, action)
    found = model.acceleration(state, alone)
    np.testing.assert_allclose(found, expected, atol=1e-9 * float(jnp.abs(expected).max()))


# --- motion -----------------------------------------------------------------------------------


def test_a_pendulum_swings_with_the_closed_form_period(float64):
    model = tree_of([ROD], control_period=1e-3, substeps=1)
    start = ArticulatedState(jnp.array([0.5 * np.pi + 1e-3]), jnp.zeros(1))
    angle = np.asarray(run(model, start, nothing(model, 4000)).position)[:, 0] - 0.5 * np.pi
    crossings = np.flatnonzero(np.diff(np.sign(angle)))
    period = 2e-3 * np.mean(np.diff(crossings))
    assert period == pytest.approx(2 * np.pi * np.sqrt(ABOUT_HINGE / (0.8 * 9.81 * 0.3)), rel=2e-3)


def test_the_error_of_a_damped_spring_falls_with_the_first_order(float64):
    drawer = dataclasses.replace(DRAWER, damping=3.0, stiffness=50.0, rest=0.1)
    rate, frequency = 3.0 / 4.0, np.sqrt(50.0 / 2.0 - (3.0 / 4.0) ** 2)
    cosine, sine = np.cos(frequency * 0.4), np.sin(frequency * 0.4)
    exact = 0.1 - 0.1 * np.exp(-rate * 0.4) * (cosine + rate / frequency * sine)
    errors = []
    for substeps in (10, 20, 40):
        model = tree_of([drawer], control_period=0.02, substeps=substeps)
        end = run(model, still(model), nothing(model, 20)).position[-1, 0]
        errors.append(abs(float(end) - exact))
    orders = -np.diff(np.log2(errors))
    np.testing.assert_allclose(orders, 1.0, atol=0.06)


def test_the_energy_of_a_frictionless_chain_drifts_with_the_first_order(float64):
    drifts = []
    for substeps in (2, 4, 8):
        model = tree_of(chain(3), control_period=4e-3, substeps=substeps)
        start = still(model, 1.0)
        energy = model.energy(run(model, start, nothing(model, 250)))
        drifts.append(float(jnp.max(jnp.abs(energy - model.energy(start)))))
    np.testing.assert_allclose(-np.diff(np.log2(drifts)), 1.0, atol=0.15)


def test_dry_friction_holds_and_then_takes_its_force():
    drawer = dataclasses.replace(DRAWER, friction=3.0)
    model = tree_of([drawer], control_period=0.02, substeps=20)
    held = run(model, still(model), nothing(model, 50, 2.9))
    assert float(held.position[-1, 0]) < 0.02  # it creeps, see `slip`
    slides = run(model, still(model), nothing(model, 50, 5.0))
    assert float(slides.velocity[-1, 0]) == pytest.approx((5.0 - 3.0) / 2.0, rel=0.02)


def test_a_stop_gives_way_by_its_stiffness_and_never_pulls():
    drawer = dataclasses.replace(
        DRAWER, lower=0.0, upper=0.2, damping=1.0, stop_stiffness=2e3, stop_damping=40.0
    )
    model = tree_of([drawer], control_period=0.02, substeps=20)
    pressed = run(model, still(model, 0.1), nothing(model, 200, 6.0))
    assert float(pressed.position[-1, 0]) == pytest.approx(0.2 + 6.0 / 2e3, abs=1e-4)
    back = nothing(model, 30, -1.0)
    end = jax.tree.map(lambda leaf: leaf[-1], pressed)
    leaving = run(model, end, back)
    free = tree_of([dataclasses.replace(drawer, lower=-1e6, upper=1e6)],
                   control_period=0.02, substeps=20)  # fmt: skip
    alone = run(free, end, back)
    assert float(leaving.position[-1, 0]) <= float(alone.position[-1, 0]) + 1e-6


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_resistance_never_adds_energy(seed):
    rng = np.random.default_rng(seed)
    links = [
        dataclasses.replace(
            DOOR, damping=float(rng.uniform(0, 50)), friction=float(rng.uniform(0, 20)),
            lower=-0.2, upper=0.3, stop_stiffness=float(10 ** rng.uniform(1, 6)),
            stop_damping=float(10 ** rng.uniform(-1, 3)),
        ),
        dataclasses.replace(
            DOOR, parent=0, origin=(0.6, 0.0, 0.0), friction=float(rng.uniform(0, 20)),
            stiffness=float(rng.uniform(0, 100)),
        ),
    ]  # fmt: skip
    model = tree_of(links, control_period=0.02, substeps=10, resisted=True)
    start = ArticulatedState(jnp.zeros(2), jnp.asarray(rng.normal(0, 3, 2), jnp.float32))
    states = run(model, start, nothing(model, 100))
    energy = np.asarray(model.energy(states))
    assert np.isfinite(energy).all()
    # the doors are level: the first order's own error is what a free pair of doors shows
    assert energy.max() <= 1.1 * float(model.energy(start)) + 1e-6


def test_resistance_that_there_is_none_of_changes_nothing(float64):
    links = [ROD, dataclasses.replace(ROD, parent=0, origin=(0.6, 0.0, 0.0))]
    models = [tree_of(links, resisted=resisted) for resisted in (False, True)]
    states = [run(model, still(model), nothing(model, 20)) for model in models]
    np.testing.assert_allclose(states[0].position, states[1].position, rtol=1e-9)


# --- derivatives ------------------------------------------------------------------------------


def test_derivatives_with_friction_and_stops_are_those_of_differences(float64):
    door = dataclasses.replace(
        DOOR, friction=0.3, damping=0.2, upper=0.15, stop_stiffness=200.0, stop_damping=2.0
    )
    model = tree_of([door], control_period=0.02, substeps=10)
    actions = nothing(model, 25, 1.2)
    names = "friction", "damping", "mass", "upper", "stop_stiffness", "stop_damping"
    values = {name: value_of(model, name) for name in names}

    @jax.jit
    def end(values):
        moved = rollout(with_values(model, values), still(model), actions)
        return moved.position[-1, 0] + 0.1 * moved.velocity[-3, 0]

    slopes = jax.jit(jax.grad(end))(values)
    for name, value in values.items():
        step = 1e-6 * float(value[0])
        ahead, behind = (end(values | {name: value + sign * step}) for sign in (1.0, -1.0))
        expected = float(ahead - behind) / (2 * step)
        assert abs(expected) > 1e-7, name
        assert float(slopes[name][0]) == pytest.approx(expected, rel=1e-4), name


# --- the contract -----------------------------------------------------------------------------


def test_batches_are_the_same_as_one_after_another(strict):
    model = tree_of([ROD, dataclasses.replace(DRAWER, parent=0, friction=0.5)], substeps=4)
    check_model(model)
    masses = jnp.array([[0.5, 2.0], [1.0, 3.0], [2.0, 1.0]])
    several = with_values(model, {"mass": masses})
    start = ArticulatedState(jnp.linspace(0, 1, 6).reshape(3, 2), jnp.ones((3, 2)))
    actions = jnp.ones((3, 5, 2, 7))
    together = run(several, start, actions)
    for lane in range(3):
        one = with_values(model, {"mass": masses[lane]})
        state = jax.tree.map(lambda leaf, lane=lane: leaf[lane], start)
        apart = run(one, state, actions[lane])
        np.testing.assert_allclose(together.position[lane], apart.position, rtol=2e-5, atol=1e-6)


def test_more_lanes_than_a_block_are_the_same_as_few():
    model = tree_of([ROD, dataclasses.replace(DRAWER, parent=0, friction=0.5)], substeps=4)
    count = BLOCK + 7
    masses = jnp.linspace(0.5, 3.0, 2 * count).reshape(count, 2)
    start = ArticulatedState(jnp.linspace(0, 1, 2 * count).reshape(count, 2), jnp.ones((count, 2)))
    actions = jnp.ones((count, 3, 2, 7))
    together = run(with_values(model, {"mass": masses}), start, actions)
    last = jax.tree.map(lambda leaf: leaf[-5:], start)
    few = run(with_values(model, {"mass": masses[-5:]}), last, actions[-5:])
    np.testing.assert_allclose(together.position[-5:], few.position, rtol=1e-5, atol=1e-6)


def test_trees_of_different_structure_are_a_batch():
    other = dataclasses.replace(DRAWER, parent=-1, friction=0.5)
    trees = [
        tree_of([ROD, dataclasses.replace(other, parent=0)], substeps=4),
        tree_of([ROD, other], substeps=4),
        tree_of([other], size=2, substeps=4),
    ]
    several = jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
    start = ArticulatedState(jnp.zeros((3, 2)), jnp.ones((3, 2)))
    actions = jnp.ones((3, 5, 2, 7))
    together = run(several, start, actions)
    for lane, tree in enumerate(trees):
        state = jax.tree.map(lambda leaf, lane=lane: leaf[lane], start)
        apart = run(tree, state, actions[lane])
        np.testing.assert_allclose(together.position[lane], apart.position, rtol=1e-4, atol=1e-6)


def test_another_tree_of_as_many_links_is_not_compiled_anew():
    traced = 0

    @eqx.filter_jit
    def step(model, state, action):
        nonlocal traced
        traced += 1
        return model.step(state, action)

    for parent, joint in ((0, "revolute"), (-1, "prismatic")):
        second = dataclasses.replace(ROD, parent=parent, joint=joint)
        model = tree_of([ROD, second])
        step(model, still(model), nothing(model, 1)[0])
    assert traced == 1


def test_a_file_keeps_the_model(tmp_path):
    model = tree_of([ROD, dataclasses.replace(DRAWER, parent=0, friction=0.5)], size=3)
    save_model(tmp_path / "model.json", model)
    kept, _ = load_model(tmp_path / "model.json")
    assert eqx.tree_equal(model, kept)


# --- refusals ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parent": 0}, "hangs on 0: expected -1"),
        ({"axis": (0.0, 0.0, 0.0)}, "has no direction"),
        ({"rotation": 2 * np.eye(3)}, "is no rotation matrix"),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "is no rotation matrix"),
        ({"stop_damping": -1.0}, "stop_damping of link 0 is negative"),
        ({"mass": 0.0, "inertia": np.zeros((3, 3))}, "joint of link 0 moves nothing with a mass"),
        ({"centre_of_mass": (0.0, 0.3, 0.0), "inertia": np.zeros((3, 3))}, "moves nothing with"),
        ({"mass": -1.0}, "mass of link 0 is negative"),
        ({"mass": float("nan")}, "not finite"),
        ({"lower": 1.0, "upper": 0.5}, "ends at 0.5 before it begins at 1.0"),
        ({"inertia": np.diag([1.0, 1.0, 3.0])}, "of no rigid body"),
        ({"inertia": np.arange(9.0).reshape(3, 3)}, "not symmetric"),
        ({"mass": 0.0}, "an inertia and no mass"),
    ],
)
def test_what_no_link_can_be_is_refused(change, message):
    with pytest.raises(PalpateError, match=message):
        tree_of([dataclasses.replace(ROD, **change)])


def test_a_tree_needs_links_that_fit():
    with pytest.raises(PalpateError, match="between 1 and 1 links, got 2"):
        tree_of([ROD, ROD], size=1)
    with pytest.raises(PalpateError, match="'damping' has the shape"):
        dataclasses.replace(tree_of([ROD]), damping=jnp.zeros(2))
