"""Parameters: transforms, declarations and what is drawn from them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.models.model import Model
from palpate.parameters import (
    FreeParameters,
    LogNormal,
    Normal,
    Parameter,
    Uniform,
    as_floating,
    declare,
    describe,
    format_value,
    parameter,
    parameters_of,
    randomise,
    sample_prior,
    with_values,
)
from toys import Cart, Pendulum

coordinates = st.floats(-4.0, 4.0)
positive = st.floats(1e-3, 1e3)
priors = st.one_of(
    st.builds(LogNormal, st.one_of(st.none(), positive), st.floats(0.01, 3.0)),
    st.builds(Normal, st.one_of(st.none(), st.floats(-9.0, 9.0)), st.floats(0.1, 10.0)),
    st.builds(lambda low, width: Uniform(low, low + width), st.floats(-5, 5), st.floats(0.5, 5)),
)


class Chain(Model):
    """Three elements and a part: what the toys do not have."""

    stiffness: Float[Array, "*batch 3"] = parameter(
        "N/m", prior=LogNormal(10.0, 1.0), spread=0.2, about="of each spring", shared=True
    )
    offset: Float[Array, "*batch"] = parameter("m", prior=Normal(None, 0.1), about="of the end")
    share: Float[Array, "*batch"] = parameter("", prior=Uniform(0.0, 1.0), about="of the load")
    none: Float[Array, "*batch 0"] = parameter("kg", prior=Normal(0.0, 1.0), about="no elements")
    gravity: Float[Array, "*batch"] = parameter(
        "m/s^2", prior=Normal(9.81, 0.1), spread=0.01, about="free fall", fixed=True
    )
    cart: Cart
    control_period: float = eqx.field(static=True, default=0.1)
    overrides: tuple[tuple[str, Parameter], ...] = eqx.field(static=True, default=())

    action_shape = observation_shape = (1,)

    def step(self, state, action):
        return state

    def observe(self, state):
        return state

    def initial_state(self, observations):
        return observations

    def constrain(self):
        return eqx.tree_at(lambda c: c.stiffness, self, jnp.minimum(self.stiffness, 50.0))


def chain(stiffness=(10.0, 20.0, 40.0)) -> Chain:
    return Chain(stiffness, 0.3, 0.25, [], 9.81, Cart(2.0, 0.5))


@given(prior=priors, free=coordinates, reference=positive)
@settings(deadline=None)
def test_a_free_value_survives_the_round_trip(prior, free, reference):
    with jax.enable_x64(True):
        reference = jnp.asarray(reference)
        value = prior.to_value(jnp.asarray(free), reference)
        assert float(prior.to_free(value, reference)) == pytest.approx(free, abs=1e-7)


@given(prior=priors, reference=positive)
@settings(deadline=None)
def test_zero_is_the_centre_of_the_prior_and_one_its_deviation(prior, reference):
    with jax.enable_x64(True):
        centre, one = prior.to_value(jnp.asarray([0.0, 1.0]), jnp.asarray(reference))
    if isinstance(prior, LogNormal):
        middle = reference if prior.median is None else prior.median
        assert float(centre) == pytest.approx(middle)
        assert float(one / centre) == pytest.approx(np.exp(prior.sigma))
    elif isinstance(prior, Normal):
        assert float(centre) == pytest.approx(reference if prior.mean is None else prior.mean)
        assert float(one - centre) == pytest.approx(prior.sigma)
    else:  # the quantiles of a normal distribution
        shares = (np.asarray([centre, one]) - prior.lower) / (prior.upper - prior.lower)
        assert shares == pytest.approx([0.5, 0.8413447])


@given(free=st.floats(-50.0, 50.0))
@settings(deadline=None)
def test_no_free_value_leaves_the_support(free):
    free, reference = jnp.asarray(free), jnp.asarray(1.0)
    assert float(LogNormal(1.0, 1.0).to_value(free, reference)) > 0
    assert 2.0 <= float(Uniform(2.0, 3.0).to_value(free, reference)) <= 3.0
    for prior in (LogNormal(1.0, 1.0), Normal(0.0, 1.0), Uniform(2.0, 3.0)):
        assert np.isfinite(jax.grad(lambda x, p=prior: p.to_value(x, reference))(free))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: LogNormal(-1.0, 1.0), "a LogNormal needs a positive median and sigma"),
        (lambda: LogNormal(1.0, 0.0), "a LogNormal needs a positive median and sigma"),
        (lambda: Normal(0.0, 0.0), "a Normal needs a positive sigma"),
        (lambda: Uniform(1.0, 1.0), "a Uniform needs lower < upper"),
        (
            lambda: Parameter("m", "length", Normal(0.0, 1.0), spread=1.0),
            "a spread is a share between 0 and 1, got 1.0",
        ),
        (
            lambda: declare(Cart(1.0, 0.5), stiffness={"fixed": True}),
            "unknown parameter 'stiffness'; Cart has: mass, friction",
        ),
        (
            lambda: FreeParameters(
                declare(Cart(1.0, 0.5), mass={"fixed": True}, friction={"fixed": True})
            ),
            "every parameter of Cart is fixed: free at least one to identify",
        ),
    ],
)
def test_a_wrong_declaration_is_refused_with_a_sentence(make, text):
    with pytest.raises(PalpateError) as error:
        make()
    assert text in str(error.value)


def test_parameters_are_found_by_dotted_path_in_parts_too():
    assert list(parameters_of(chain())) == [
        "stiffness", "offset", "share", "none", "gravity", "cart.mass", "cart.friction",
    ]  # fmt: skip
    assert list(parameters_of(Cart)) == ["mass", "friction"]
    assert parameters_of(Cart)["mass"].unit == "kg"


def test_an_instance_may_declare_differently_and_the_class_does_not_change():
    cart = declare(Cart(1.0, 0.5), mass={"fixed": True}, friction={"prior": Normal(0.0, 1.0)})
    cart = declare(cart, friction={"spread": 0.1})
    assert parameters_of(cart)["mass"].fixed
    assert parameters_of(cart)["friction"].prior == Normal(0.0, 1.0)
    assert parameters_of(cart)["friction"].spread == 0.1
    assert parameters_of(cart)["friction"].unit == "N s/m"
    assert not parameters_of(Cart)["mass"].fixed
    assert list(FreeParameters(cart).initial) == ["friction"]


def test_a_part_is_declared_differently_from_outside_or_by_itself():
    outside = declare(chain(), **{"cart.mass": {"fixed": True}})
    assert parameters_of(outside)["cart.mass"].fixed
    inside = dataclasses.replace(chain(), cart=declare(Cart(2.0, 0.5), mass={"fixed": True}))
    assert parameters_of(inside)["cart.mass"].fixed
    assert "cart.mass" not in FreeParameters(outside).initial


def test_free_values_leave_out_what_is_fixed_or_empty_and_share_what_is_shared():
    initial = FreeParameters(chain()).initial
    assert {path: value.shape for path, value in initial.items()} == {
        "stiffness": (), "offset": (), "share": (), "cart.mass": (), "cart.friction": (),
    }  # fmt: skip
    assert float(initial["stiffness"]) == pytest.approx(np.log([1.0, 2.0, 4.0]).mean())
    assert float(initial["offset"]) == 0.0  # its own value is its prior's centre
    unshared = FreeParameters(declare(chain(), stiffness={"shared": False})).initial
    assert np.allclose(unshared["stiffness"], np.log([1.0, 2.0, 4.0]))


def test_build_sets_free_values_keeps_the_rest_and_constrains():
    free = FreeParameters(chain())
    model = free.build(free.initial | {"stiffness": jnp.asarray(np.log(3.0), jnp.float32)})
    assert np.allclose(model.stiffness, 30.0)
    assert model.stiffness.shape == (3,)
    assert float(model.gravity) == pytest.approx(9.81)
    assert float(model.cart.mass) == pytest.approx(2.0)
    assert model.cart.mass.dtype == jnp.float32
    beyond = free.initial | {"stiffness": jnp.asarray(3.0)}
    assert np.allclose(free.build(beyond).stiffness, 50.0)
    assert np.allclose(free.unconstrained(beyond).stiffness, 10.0 * np.exp(3.0))


def test_projecting_gives_back_what_is_legal_and_moves_the_rest_to_the_limit():
    free = FreeParameters(chain())
    rng = np.random.default_rng(0)
    for _ in range(20):
        values = {
            path: jnp.asarray(rng.normal(size=value.shape), jnp.float32)
            for path, value in free.initial.items()
        }
        values["stiffness"] = jnp.minimum(values["stiffness"], 1.6)  # 50 N/m is log(5)
        projected = free.project(values)
        assert projected.keys() == values.keys()
        for path, value in values.items():
            assert projected[path].shape == value.shape
            np.testing.assert_allclose(projected[path], value, atol=1e-5)
    beyond = free.initial | {"stiffness": jnp.asarray(3.0), "offset": jnp.asarray(2.0)}
    projected = free.project(beyond)
    assert float(projected["stiffness"]) == pytest.approx(np.log(5.0))
    assert float(projected["offset"]) == pytest.approx(2.0)
    ours = free.unconstrained(projected)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(free.build(beyond)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)
    again = free.project(projected)
    np.testing.assert_allclose(again["stiffness"], projected["stiffness"], atol=1e-6)


def test_projected_a_descent_comes_back_from_the_limit():
    free = FreeParameters(declare(chain(), stiffness={"shared": False}))
    beyond = free.initial | {"stiffness": jnp.asarray([3.0, 4.0, 0.0])}

    def slope(values):
        return jax.grad(lambda x: free.build(x).stiffness.sum())(values)["stiffness"]

    assert np.array_equal(slope(beyond), [0.0, 0.0, 10.0])
    assert np.all(slope(free.project(beyond)) >= 10.0)


@pytest.mark.parametrize("model", [Cart(1.7, 0.2), Pendulum(0.8, 0.3)], ids=["cart", "pendulum"])
def test_the_initial_free_values_build_the_reference(model):
    free = FreeParameters(model)
    built = free.build(free.initial)
    for ours, theirs in zip(jax.tree.leaves(built), jax.tree.leaves(model), strict=True):
        assert np.allclose(ours, theirs, rtol=1e-6)


def test_a_weakly_typed_model_has_no_weakly_typed_free_values():
    """A user's own number in a model is one, and a fit would compile all that it does twice."""
    model = eqx.tree_at(lambda one: one.length, Pendulum(1.0, 0.2), jnp.asarray(2.0))
    assert model.length.weak_type
    free = FreeParameters(model).initial
    assert not any(value.weak_type for value in free.values())


def test_the_penalty_is_half_the_squared_norm():
    free = FreeParameters(Cart(1.0, 0.5))
    assert float(free.penalty(free.initial)) == 0.0
    away = {"mass": jnp.asarray(3.0), "friction": jnp.asarray([1.0, 2.0])}
    assert float(free.penalty(away)) == pytest.approx(7.0)


def test_randomise_stays_within_the_spread_and_is_legal():
    models = randomise(chain(), jax.random.key(0), 0.5, 200)
    ratio = np.asarray(models.stiffness) / [10.0, 20.0, 40.0]
    assert np.allclose(ratio, ratio[:, :1])  # one factor for all elements
    assert 0.9 <= ratio.min() < 0.905
    assert 1.095 < ratio.max() <= 1.1
    assert np.ptp(np.asarray(models.gravity)) > 0  # not identified, and uncertain all the same
    assert models.cart.mass.shape == (200,)
    assert models.offset.shape == ()  # no spread: one for the batch
    assert np.corrcoef(ratio[:, 0], models.cart.mass)[0, 1] < 0.3  # drawn apart
    wide = declare(chain((49.0, 49.0, 49.0)), stiffness={"spread": 0.5})
    assert float(randomise(wide, jax.random.key(0), 1.0, 50).stiffness.max()) == 50.0


def test_randomise_is_a_function_of_its_key_and_nothing_at_amplitude_zero():
    cart = Cart(1.0, 0.5)
    one, again, other = (randomise(cart, jax.random.key(k), 1.0, 8) for k in (1, 1, 2))
    assert np.array_equal(one.mass, again.mass)
    assert not np.array_equal(one.mass, other.mass)
    assert np.all(np.asarray(randomise(cart, jax.random.key(1), 0.0, 8).friction) == 0.5)


def test_the_prior_is_sampled_as_declared():
    keys = jax.random.split(jax.random.key(0), 4000)
    carts = jax.vmap(lambda key: sample_prior(Cart(3.0, 0.1), key))(keys)
    drawn = ((carts.mass, LogNormal(1.0, 0.5)), (carts.friction, LogNormal(0.5, 1.0)))
    for values, prior in drawn:
        logarithm = np.log(np.asarray(values))
        assert logarithm.mean() == pytest.approx(np.log(prior.median), abs=0.06)
        assert logarithm.std() == pytest.approx(prior.sigma, rel=0.05)
    assert float(sample_prior(chain(), keys[0]).gravity) == pytest.approx(9.81)


def test_every_number_becomes_one_dtype_and_never_a_weak_one():
    for value in (1, 1.0, np.float64(1.0), np.int32(1), jnp.asarray(1), jnp.asarray(1.0)):
        converted = as_floating(value)
        assert converted.dtype == jnp.float32
        assert not converted.weak_type


def test_float64_is_kept_throughout(float64):
    free = FreeParameters(chain())
    assert {value.dtype for value in free.initial.values()} == {jnp.dtype("float64")}
    models = (
        free.build(free.initial),
        sample_prior(chain(), jax.random.key(0)),
        randomise(chain(), jax.random.key(0), 1.0, 2),
    )
    for model in models:
        assert {leaf.dtype for leaf in jax.tree.leaves(model)} == {jnp.dtype("float64")}


def test_no_operation_promotes_a_dtype(strict):
    free = FreeParameters(chain())
    key, half = jax.random.key(0), jnp.asarray(0.5)

    def loss(values):
        return free.build(values).stiffness.sum() + free.penalty(values)

    # refused while tracing
    jax.eval_shape(jax.grad(loss), free.initial)
    jax.eval_shape(free.project, free.initial)
    jax.eval_shape(lambda key: sample_prior(chain(), key), key)
    jax.eval_shape(lambda key, half: randomise(chain(), key, half, 2), key, half)


def test_with_values_may_add_a_batch_axis():
    batch = with_values(chain(), {"cart.mass": jnp.arange(1.0, 4.0)})
    assert batch.cart.mass.shape == (3,)
    assert batch.cart.friction.shape == ()
    assert with_values(batch, {}) is batch


def test_description_and_figures_carry_units():
    rows = describe(declare(Cart(1.5, 0.25), mass={"fixed": True}))
    assert rows == [
        {"name": "mass", "value": 1.5, "unit": "kg", "about": "mass of the cart",
         "fixed": True, "shared": False},
        {"name": "friction", "value": 0.25, "unit": "N s/m", "about": "friction per velocity",
         "fixed": False, "shared": False},
    ]  # fmt: skip
    assert format_value(0.123456, "kg") == "0.123 kg"
    assert format_value([1.0, 1.0001, 1.0002], "m") == "1 m"
    assert format_value([1e-4, 2.5e3], "N/m") == "0.0001 to 2.5e+03 N/m"
    assert format_value(2.0, "") == "2"
