"""The planar model as a model: parameters, batches, gradients, symmetries, and what it refuses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.errors import PalpateError
from palpate.models.model import rollout
from palpate.models.planar import Planar, PlanarState, furniture
from palpate.models.planar.shapes import centre_outline, rectangle
from palpate.parameters import FreeParameters, parameters_of, sample_prior, with_values

run = jax.jit(rollout)
BOX = rectangle(1.2, 0.6)
ONE = furniture([BOX])


def pushes(count: int, bodies: int = 1, seed: int = 0) -> jnp.ndarray:
    """Wrenches of a person who pushes here and there, (count, bodies, 3)."""
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.normal(size=(count, bodies, 3)) * [30.0, 30.0, 8.0])


def draws(model: Planar, count: int, seed: int = 0) -> Planar:
    return jax.vmap(lambda key: sample_prior(model, key))(
        jax.random.split(jax.random.key(seed), count)
    )


def batched(model: Planar, draws: Planar) -> Planar:
    """The model with the parameters of many draws and its own structure."""
    return with_values(model, {path: getattr(draws, path) for path in parameters_of(model)})


# Parameters


def test_a_body_on_one_wheel_has_the_fourteen_parameters_of_the_thesis_without_a_constraint():
    names = FreeParameters(ONE).initial
    assert sum(value.size for value in names.values()) == 14
    assert {"mass", "restitution", "contact_friction", "wheel_position", "wheel_shear"} <= set(
        names
    )


@pytest.mark.parametrize("name", ["mass", "wheel_shear", "floor_friction", "wheel_along"])
def test_free_values_come_back_as_they_went(name):
    coordinates = FreeParameters(ONE)
    drawn = sample_prior(ONE, jax.random.key(3))
    free = {
        path: parameter.prior.to_free(getattr(drawn, path), getattr(ONE, path))
        for path, parameter in coordinates.declarations.items()
    }
    np.testing.assert_allclose(
        getattr(coordinates.build(free), name), getattr(drawn, name), rtol=2e-4
    )


# Batches


def test_a_thousand_draws_side_by_side_are_a_loop_over_them():
    models = draws(ONE, 1200)
    state = PlanarState(jnp.zeros((1200, 1, 3)), jnp.full((1200, 1, 3), 0.2))
    actions = jnp.broadcast_to(pushes(10), (1200, 10, 1, 3))
    together = run(batched(ONE, models), state, actions).pose
    assert together.shape == (1200, 10, 1, 3)
    assert np.all(np.isfinite(together))
    for index in (0, 17, 1199):
        model = jax.tree.map(lambda leaf, index=index: leaf[index], models)
        one = run(model, PlanarState(state.pose[index], state.velocity[index]), actions[index])
        np.testing.assert_allclose(together[index], one.pose, atol=1e-4)


@pytest.mark.parametrize("which", ["masses", "states", "pushes", "all"])
def test_what_has_no_batch_axis_serves_the_whole_batch(which, float64):
    """Of two bodies that nothing couples, which are stepped side by side."""
    model = furniture([BOX, rectangle(0.5, 0.4)], wheels=1, poses=[[0.0] * 3, [3.0, 0.0, 1.0]])
    model = dataclasses.replace(model, pairs=model.pairs[:0], bolted=jnp.array([0.0, 0.0]))
    state = PlanarState(jnp.array([[0.0] * 3, [3.0, 0.0, 1.0]]), jnp.full((2, 3), 0.3))
    push = jnp.array([[30.0, -8.0, 3.0], [-9.0, 4.0, 1.0]])
    more = jnp.array([1.0, 1.3, 0.6])
    models, states, actions = model, state, push
    if which in ("masses", "all"):
        models = dataclasses.replace(model, mass=more[:, None] * model.mass)
    if which in ("states", "all"):
        states = PlanarState(
            jnp.broadcast_to(state.pose, (3, 2, 3)), more[:, None, None] * state.velocity
        )
    if which in ("pushes", "all"):
        actions = more[:, None, None] * push
    twice = jax.jit(lambda m, s, a: m.step(m.step(s, a), a))
    together = twice(models, states, actions)
    assert together.pose.shape == (3, 2, 3)
    for index in range(3):
        one = (
            models if models.mass.ndim == 1 else dataclasses.replace(model, mass=models.mass[index])
        )
        start = states if states.pose.ndim == 2 else jax.tree.map(lambda x, i=index: x[i], states)
        action = actions if actions.ndim == 2 else actions[index]
        end = twice(one, start, action)
        np.testing.assert_allclose(together.pose[index], end.pose, atol=1e-12)
        np.testing.assert_allclose(together.velocity[index], end.velocity, atol=1e-12)
    assert np.max(np.abs(np.diff(together.pose, axis=0))) > 1e-5


def test_structure_is_a_batch_axis_and_compiles_once():
    traces = 0

    @jax.jit
    def moved(model, state, actions):
        nonlocal traces
        traces += 1
        return rollout(model, state, actions)

    state = PlanarState(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    actions = jnp.tile(jnp.array([[20.0, 6.0, 2.0]]), (40, 1, 1))
    linked = furniture([BOX], pivots={0: None}, poses=[[0.0, 0.0, 0.0]], link_anchor=[1.0, 0.0])
    none = jnp.zeros_like(linked.pivot)
    structures = [
        dataclasses.replace(linked, pivot=none),
        dataclasses.replace(linked, pivot=none, wheel=jnp.zeros_like(linked.wheel)),
        dataclasses.replace(linked, dry=jnp.zeros_like(linked.dry)),
        dataclasses.replace(linked, bolted=jnp.ones_like(linked.bolted)),
    ]
    ends = [moved(model, state, actions).pose for model in structures]
    assert traces == 1
    assert min(np.max(np.abs(a - b)) for i, a in enumerate(ends) for b in ends[:i]) > 1e-4
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *structures)
    states = PlanarState(jnp.zeros((4, 1, 3)), jnp.zeros((4, 1, 3)))
    poses = run(together, states, jnp.broadcast_to(actions, (4, *actions.shape))).pose
    np.testing.assert_allclose(poses, np.stack(ends), atol=1e-5)


def test_no_operation_promotes_a_dtype(strict):
    state = PlanarState(jnp.zeros((5, 1, 3)), jnp.zeros((5, 1, 3)))
    actions = jnp.zeros((5, 4, 1, 3))
    for wall in ([], [rectangle(0.2, 3.0) + np.array([2.0, 0.0])]):
        model = furniture([BOX], wall, distances={0: None}, poses=[[0.0, 0.0, 0.0]])
        end = jax.eval_shape(lambda m, s, a: rollout(m, s, a).pose, model, state, actions)
        assert end.dtype == jnp.float32


# Symmetries


def test_the_answer_turns_and_moves_with_the_world(float64):
    model = sample_prior(furniture([BOX]), jax.random.key(2))
    actions = pushes(60)
    start = PlanarState(jnp.array([[0.3, -0.2, 0.4]]), jnp.array([[0.3, 0.1, -0.5]]))
    angle, shift = 1.1, jnp.array([2.0, -1.0])
    spin = jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]])

    def turned(values, moved, by):
        return jnp.concatenate([values[..., :2] @ spin.T + moved, values[..., 2:] + by], axis=-1)

    expected = turned(run(model, start, actions).pose, shift, angle)
    other = PlanarState(turned(start.pose, shift, angle), turned(start.velocity, 0.0, 0.0))
    poses = run(model, other, turned(actions, 0.0, 0.0)).pose
    np.testing.assert_allclose(poses, expected, atol=1e-9)


def test_a_body_far_from_others_moves_as_if_it_were_alone(float64):
    actions = pushes(40)
    single = dataclasses.replace(ONE, iterations=10)  # both converged: contacts iterate more
    alone = run(single, PlanarState(jnp.zeros((1, 3)), jnp.zeros((1, 3))), actions).pose[:, 0]
    two = furniture([BOX, BOX], iterations=10)
    pose = jnp.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    both = run(
        two,
        PlanarState(pose, jnp.zeros((2, 3))),
        jnp.concatenate([actions, jnp.zeros_like(actions)], axis=1),
    ).pose
    np.testing.assert_allclose(both[:, 0], alone, atol=1e-3)
    np.testing.assert_allclose(both[:, 1], np.tile([50.0, 0.0, 0.0], (40, 1)), atol=1e-9)


def test_finer_steps_come_nearer_by_their_length(float64):
    model = sample_prior(furniture([BOX]), jax.random.key(5))
    actions = jnp.tile(jnp.array([[25.0, 4.0, 3.0]]), (50, 1, 1))
    start = PlanarState(jnp.zeros((1, 3)), jnp.array([[0.5, 0.2, 0.6]]))
    ends = [
        run(dataclasses.replace(model, substeps=count), start, actions).pose[-1]
        for count in (1, 2, 4, 64)
    ]
    errors = [float(jnp.max(jnp.abs(end - ends[-1]))) for end in ends[:-1]]
    assert errors[0] < 0.02
    assert errors[1] < 0.75 * errors[0]
    assert errors[2] < 0.75 * errors[1]


# Gradients


def test_gradients_match_finite_differences(float64):
    model = sample_prior(furniture([BOX]), jax.random.key(1))
    coordinates = FreeParameters(model)
    start = PlanarState(jnp.zeros((1, 3)), jnp.array([[0.3, 0.0, 0.2]]))
    actions = pushes(30, seed=4)

    def loss(free):
        return jnp.sum(jnp.square(rollout(coordinates.build(free), start, actions).pose))

    value, free = jax.jit(loss), coordinates.initial
    gradient = jax.jit(jax.grad(loss))(free)
    for path, leaf in free.items():
        direction = jax.random.normal(jax.random.key(7), leaf.shape, leaf.dtype)
        above = value(free | {path: leaf + 1e-6 * direction})
        below = value(free | {path: leaf - 1e-6 * direction})
        expected = float(above - below) / 2e-6
        ours = float(jnp.sum(gradient[path] * direction))
        assert ours == pytest.approx(expected, rel=1e-4, abs=1e-6), path


gradient = jax.jit(
    jax.grad(
        lambda free, state, actions: jnp.sum(
            jnp.square(rollout(FreeParameters(ONE).build(free), state, actions).pose)
        )
    )
)


@settings(max_examples=40, deadline=None)
@given(
    free=st.lists(st.floats(-4.0, 4.0, width=32), min_size=14, max_size=14),
    still=st.booleans(),
    push=st.floats(-500.0, 500.0, width=32),
)
def test_no_parameters_within_four_deviations_give_nan(free, still, push):
    initial = FreeParameters(ONE).initial
    values = iter(free)
    free = {
        path: jnp.asarray([next(values) for _ in range(leaf.size)], leaf.dtype).reshape(leaf.shape)
        for path, leaf in initial.items()
    }
    velocity = jnp.zeros((1, 3)) if still else jnp.array([[1.0, -0.5, 2.0]])
    state = PlanarState(jnp.zeros((1, 3)), velocity)
    actions = jnp.tile(jnp.array([[push, 0.3 * push, 0.1 * push]]), (10, 1, 1))
    slope = gradient(free, state, actions)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope))


# Observations


def test_a_state_is_read_off_frames_on_a_straight_line():
    time = 0.02 * np.arange(5)[:, None, None]
    pose = np.array([[0.1, 0.2, 3.1]]) + time * np.array([[0.5, -0.2, 1.0]])
    frames = jnp.asarray(
        np.concatenate([pose[..., :2], (pose[..., 2:] + np.pi) % (2 * np.pi) - np.pi], -1)
    )
    for count in (2, 3, 5):
        state = ONE.initial_state(frames[:count])
        np.testing.assert_allclose(state.velocity[0], [0.5, -0.2, 1.0], atol=1e-4)
        np.testing.assert_allclose(state.pose, frames[count - 1], atol=1e-5)
    still = ONE.initial_state(frames[:1])
    assert not np.any(still.velocity)


def test_the_line_through_many_frames_is_steadier_than_the_last_two():
    noise = jnp.asarray(np.random.default_rng(0).normal(size=(200, 6, 1, 3))) * 1e-3
    rough = ONE.initial_state(noise[:, -2:]).velocity
    steady = ONE.initial_state(noise).velocity
    assert np.std(steady) < 0.25 * np.std(rough)
    assert np.std(steady) == pytest.approx(np.sqrt(12 / (6 * 35)) * 1e-3 / 0.02, rel=0.1)


def test_poses_differ_by_the_short_way_round():
    off = ONE.difference(jnp.array([[1.0, 2.0, 3.1]]), jnp.array([[0.5, 2.0, -3.1]]))
    np.testing.assert_allclose(off, [[0.5, 0.0, 6.2 - 2 * np.pi]], atol=1e-6)
    assert ONE.observation_units == ("m", "m", "rad")


# Shapes


def test_an_l_is_cut_into_convex_parts_of_the_same_area():
    corners, place = centre_outline([[0, 0], [2, 0], [2, 1], [1, 1], [1, 3], [0, 3]])
    np.testing.assert_allclose(place, [0.75, 1.25])
    model = furniture([corners])
    parts = np.asarray(model.outline)[0]
    assert len(parts) == 2
    following = np.roll(parts, -1, axis=1)
    area = 0.5 * np.sum(parts[..., 0] * following[..., 1] - parts[..., 1] * following[..., 0])
    assert area == pytest.approx(4.0)


def test_the_radius_of_gyration_is_that_of_the_closed_form():
    assert float(ONE.even_gyration[0]) == pytest.approx(np.sqrt((1.2**2 + 0.6**2) / 12))
    disc = [[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 400, endpoint=False)]
    assert float(furniture([disc]).even_gyration[0]) == pytest.approx(np.sqrt(0.5), rel=1e-3)


@pytest.mark.parametrize(
    ("outline", "said"),
    [
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "crosses itself"),
        ([[0, 0], [1, 0], [2, 0]], "no area"),
        ([[0, 0], [1, 0]], "at least 3 corners"),
        ([[0, 0], [1, 0], [np.nan, 1]], "not finite"),
        ([[0, 0], [1, 0], [1, 1], [0, 1]], "`centre_outline` moves it there"),
    ],
)
def test_outlines_that_are_none_are_refused_with_a_sentence(outline, said):
    with pytest.raises(PalpateError, match=said):
        furniture([outline])


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"bolted": [3]}, "there is no body 3"),
        ({"pivots": {0: 0}, "poses": [[0, 0, 0]]}, "cannot be linked to itself"),
        ({"pivots": {0: None}}, "need the poses"),
        ({"mass": [1.0, 2.0, 3.0]}, "mass must fit the shape"),
    ],
)
def test_structure_that_cannot_be_is_refused_with_a_sentence(fields, said):
    with pytest.raises(PalpateError, match=said):
        furniture([BOX], **fields)


@pytest.mark.usefixtures("float64")
def test_what_nothing_couples_moves_as_it_does_in_the_whole():
    """Joined by a pivot, near enough to touch, or alone, in an order that is not the bodies'."""
    poses = [[0.0, 0.0, 0.1], [5.0, 0.0, 0.0], [0.9, 0.2, 0.4], [6.2, 0.1, 0.2], [9.0, 0.0, 0.0]]
    model = furniture(
        [BOX] * 5, [BOX + 20.0], pivots={2: 0}, poses=poses, link_anchor=[-1.0, 0.0],
        mass=[4.0, 5.0, 6.0, 7.0, 8.0], floor_friction=[0.02, 0.04, 0.06, 0.08, 0.1],
    )  # fmt: skip
    first, second = np.asarray(model.pairs)[:, [0, 2]].T
    near = (second < 0) | ((first == 1) & (second == 3))
    model = dataclasses.replace(model, pairs=model.pairs[near])
    parts = model.independent_parts()
    assert [group for _, group in parts] == [(0, 2), (1, 3), (4,)]
    assert [part.link_to.shape[1] for part, _ in parts] == [1, 0, 0]
    wrench = np.zeros((60, 5, 3))
    wrench[:, 1:3] = (30.0, 5.0, 4.0)
    wrench[:, 4] = (10.0, 0.0, 3.0)
    start = model.initial_state(jnp.asarray([poses]))
    whole = np.asarray(run(model, start, jnp.asarray(wrench)).pose)
    assert np.ptp(whole[:, 3, 0]) > 0.01  # it was hit
    for part, group in parts:
        rows = np.array(group)
        begun = part.initial_state(jnp.asarray(poses)[None, rows])
        found = run(part, begun, jnp.asarray(wrench[:, rows])).pose
        np.testing.assert_allclose(found, whole[:, rows], atol=1e-9)
