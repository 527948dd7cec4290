"""The contract of every model, on the toys and the rope: one code for all."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.models.model import batch_size, rollout
from palpate.models.rope import Rope, RopeState
from palpate.parameters import parameters_of, randomise, value_of, with_values
from toys import Cart, CartState, Pendulum, PendulumState

PERIODS = 7


def toy_start(batch, key):
    first, second = jax.random.normal(key, (2, *batch, 1))
    return first, second


def rope_start(batch, key):
    line = jnp.linspace(0.0, 1.0, 6)[:, None] * jnp.asarray([0.3, 0.0, -0.4])
    bend, velocity = 0.03 * jax.random.normal(key, (2, *batch, 6, 3))
    return RopeState(line + bend, 3 * velocity)


MODELS = {
    "cart": (Cart(1.5, 0.2), lambda *a: CartState(*toy_start(*a))),
    "pendulum": (Pendulum(0.7, 0.1), lambda *a: PendulumState(*toy_start(*a))),
    "rope": (Rope.uniform(length=0.5, mass=0.05, nodes=6, substeps=4), rope_start),
}
every_model = pytest.mark.parametrize("name", MODELS)

run = jax.jit(rollout)


def case(name, batch, seed=0):
    model, start = MODELS[name]
    state = start(batch, jax.random.key(seed))
    actions = jax.random.normal(jax.random.key(seed + 1), (*batch, PERIODS, *model.action_shape))
    return model, state, 0.3 * actions


def assert_close(ours, theirs, tolerance=1e-4):
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=tolerance, atol=tolerance)


@every_model
def test_a_rollout_is_steps_in_a_row_and_does_not_mix_up_its_axes(name):
    model, state, actions = case(name, ())
    states = run(model, state, actions)
    assert all(leaf.shape[0] == PERIODS for leaf in jax.tree.leaves(states))
    assert model.observe(states).shape == (PERIODS, *model.observation_shape)
    step = jax.jit(lambda state, action: model.step(state, action))  # noqa: PLW0108
    for period in range(PERIODS):
        state = step(state, actions[period])
        assert_close(jax.tree.map(lambda leaf, period=period: leaf[period], states), state)


@every_model
@pytest.mark.parametrize("own_parameters", [False, True], ids=["shared", "own"])
def test_a_batch_is_its_members_side_by_side(name, own_parameters):
    model, state, actions = case(name, (5,))
    if own_parameters:
        model = randomise(model, jax.random.key(7), 1.0, 5)
    states = run(model, state, actions)
    assert model.observe(states).shape == (5, PERIODS, *model.observation_shape)
    drawn = parameters_of(model) if own_parameters else {}
    for index in range(5):
        values = {
            path: value_of(model, path)[index]
            for path in drawn
            if value_of(model, path).ndim > value_of(MODELS[name][0], path).ndim
        }
        state_alone = jax.tree.map(lambda leaf, index=index: leaf[index], state)
        alone = run(with_values(model, values), state_alone, actions[index])
        assert_close(jax.tree.map(lambda leaf, index=index: leaf[index], states), alone)


@every_model
def test_actions_of_a_wrong_shape_are_refused_with_a_sentence(name):
    model, state, actions = case(name, ())
    kind = type(model).__name__
    shape = ", ".join(map(str, model.action_shape))
    for wrong in (actions[..., :-1], actions[0], actions[None, None]):
        with pytest.raises(PalpateError) as error:
            rollout(model, state, wrong)
        assert str(error.value) == (
            f"{kind} expects actions of shape (time, {shape}) or (batch, time, {shape}), "
            f"got {wrong.shape}"
        )


def test_the_batch_axis_is_told_from_the_shape_of_the_actions():
    cart = Cart(1.0, 0.5)
    assert batch_size(cart, jnp.zeros((9, 1))) is None
    assert batch_size(cart, jnp.zeros((4, 9, 1))) == 4


@every_model
def test_other_values_do_not_compile_anew(name):
    traces = 0

    @jax.jit
    def counted(model, state, actions):
        nonlocal traces
        traces += 1
        return rollout(model, state, actions)

    model, state, actions = case(name, ())
    counted(model, state, actions)
    fields = {field: getattr(model, field) for field in ("mass", "length") if hasattr(model, field)}
    others = [jax.tree.map(lambda leaf: 1.1 * leaf, model)]
    for field in fields:  # however the number is written
        for value in (2, 2.0, np.float64(2.0), jnp.asarray(2.0), jnp.asarray(2)):
            others.append(type(model)(**{**vars(model), field: value}))
    for other in others:
        counted(other, *case(name, (), seed=3)[1:])
    assert traces == 1


@every_model
def test_reverse_mode_keeps_one_state_per_control_period(name):
    """What the backward pass holds grows with control periods, and not with time steps."""

    def kept(periods, substeps=4):
        model, state, actions = case(name, ())
        if name == "rope":
            model = Rope.uniform(length=0.5, mass=0.05, nodes=6, substeps=substeps)
        actions = jnp.resize(actions, (periods, *model.action_shape))
        _, pullback = jax.eval_shape(
            lambda m, s, a: jax.vjp(rollout, m, s, a), model, state, actions
        )
        return sum(leaf.size for leaf in jax.tree.leaves(pullback))

    model, state, _ = case(name, ())
    per_period = (kept(200) - kept(100)) / 100
    one = sum(leaf.size for leaf in jax.tree.leaves(state)) + np.prod(model.action_shape)
    assert 0 < per_period <= one
    if name == "rope":
        assert per_period == one
        assert kept(100, substeps=50) == kept(100)


@every_model
def test_no_operation_promotes_a_dtype(name, strict):
    model, state, actions = case(name, (5,))

    def loss(model):
        return jnp.sum(jnp.square(model.observe(rollout(model, state, actions))))

    for leaf in jax.tree.leaves(jax.eval_shape(jax.grad(loss), model)):  # refused while tracing
        assert leaf.dtype == jnp.float32


@every_model
def test_a_state_is_read_off_observed_frames(name):
    model, state, actions = case(name, (2,))
    if name == "rope":  # a driven node at constant velocity: what two frames can show
        actions = jnp.zeros_like(actions)
    frames = model.observe(run(model, state, actions))
    position, velocity = jax.tree.leaves(model.initial_state(frames))
    np.testing.assert_array_equal(position, frames[:, -1])
    difference = (frames[:, -1] - frames[:, -2]) / model.control_period
    np.testing.assert_allclose(velocity, difference, rtol=1e-5)
    at_rest = model.initial_state(frames[:, :1])
    np.testing.assert_array_equal(jax.tree.leaves(at_rest)[0], frames[:, 0])
    assert not np.any(jax.tree.leaves(at_rest)[1])


@pytest.mark.parametrize("name", ["cart", "pendulum"])
def test_gradients_of_a_toy_match_finite_differences(name, float64):
    model, state, actions = case(name, ())
    model, state, actions = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float64), (model, state, actions)
    )

    def loss(arguments):
        return jnp.sum(jnp.square(model.observe(rollout(*arguments))))

    arguments = (model, state, actions)
    gradient = jax.grad(loss)(arguments)
    leaves, structure = jax.tree.flatten(arguments)
    for index, leaf in enumerate(leaves):
        direction = jax.random.normal(jax.random.key(index), leaf.shape, leaf.dtype)

        def along(step, index=index, direction=direction, leaf=leaf):
            moved = [*leaves[:index], leaf + step * direction, *leaves[index + 1 :]]
            return loss(jax.tree.unflatten(structure, moved))

        expected = (along(1e-6) - along(-1e-6)) / 2e-6
        ours = jnp.sum(jax.tree.leaves(gradient)[index] * direction)
        assert float(ours) == pytest.approx(float(expected), rel=1e-6, abs=1e-8)
