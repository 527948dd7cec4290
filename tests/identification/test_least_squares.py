"""Combinations that the data leave free are named, beside parameters they say nothing of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from palpate.errors import PalpateError
from palpate.identification.data.prediction import observation_scale
from palpate.identification.data.segments import SegmentSource, difference
from palpate.identification.gradient.least_squares import (
    KNEE,
    Objective,
    _undecided,
    intervals,
    pseudo_huber,
)
from palpate.models.model import Model, rollout
from palpate.parameters import FreeParameters, LogNormal, parameter
from palpate.recordings import Aligned
from toys import CartState

PRIOR = LogNormal(1.0, 0.5)


class GearedCart(Model):
    """mass a = gear action - friction v: without an action the gear is not seen at all."""

    gear: Float[Array, "*batch"] = parameter("N", prior=PRIOR, about="force per action")
    mass: Float[Array, "*batch"] = parameter("kg", prior=PRIOR, about="mass of the cart")
    friction: Float[Array, "*batch"] = parameter("N s/m", prior=PRIOR, about="per velocity")
    control_period = 0.05
    overrides = ()
    action_shape = (1,)
    observation_shape = (1,)

    def step(self, state, action):
        force = self.gear * action - self.friction * state.velocity
        velocity = state.velocity + self.control_period * force / self.mass
        return CartState(state.position + self.control_period * velocity, velocity)

    def observe(self, state):
        return state.position

    def initial_state(self, observations):
        last = observations[..., -1, :]
        if observations.shape[-2] < 2:
            return CartState(last, jnp.zeros_like(last))
        return CartState(last, (last - observations[..., -2, :]) / self.control_period)


@pytest.mark.parametrize(
    ("push", "together"), [(0.0, ("friction", "mass")), (1.0, ("friction", "gear", "mass"))]
)
def test_a_combination_is_named_whatever_else_is_undecided(push, together):
    """A coasting cart shows friction per mass and nothing of its gear, a pushed one two ratios."""
    cart = GearedCart(gear=1.0, mass=1.0, friction=1.0)
    rng = np.random.default_rng(0)
    actions = push * jnp.asarray(rng.normal(size=(4, 60, 1)), jnp.float32)
    start = CartState(jnp.zeros((4, 1)), 2.0 * jnp.ones((4, 1)))
    states = rollout(cart, start, actions)
    position = np.concatenate([start.position[:, None], states.position], axis=1)
    noisy = position + 1e-3 * rng.normal(size=position.shape)
    aligned = Aligned(0.05, noisy.astype(np.float32), np.asarray(actions), np.full(4, 61))
    coordinates = FreeParameters(cart)
    found = intervals(coordinates, coordinates.initial, aligned)
    assert (found.verdict["gear"] is None) == (push > 0.0)
    assert [named(warning) for warning in found.warnings] == [together]


def test_curved_products_are_the_derivatives_of_the_loss_beyond_its_knee():
    """By the starts, in which a cart is linear: intervals stand on them, so on no larger ones."""
    cart = GearedCart(gear=1.0, mass=1.0, friction=1.0)
    noise = np.random.default_rng(0).normal(size=(2, 31, 1))
    moving = np.linspace(0.0, 1.0, 31)[:, None] + 0.03 * noise
    aligned = Aligned(0.05, moving, np.zeros((2, 30, 1)), np.full(2, 31))
    segments = SegmentSource.of(aligned, cart).whole()
    coordinates = FreeParameters(cart)
    objective = Objective(coordinates, observation_scale(aligned, cart), KNEE)
    start = jnp.zeros((2, 2, 1))

    def loss(offset):
        relative = objective.relative(coordinates.initial, offset.reshape(start.shape), segments)
        return jnp.sum(pseudo_huber(relative, KNEE))

    curved, straight = (
        objective.products(coordinates.initial, start, segments, curved).sum(axis=1)[:, 3:, 3:]
        for curved in (True, False)
    )
    slope, curvature = jax.grad(loss)(start.ravel()), jax.hessian(loss)(start.ravel())
    np.testing.assert_allclose(curved[:, :-1, -1].ravel(), slope, rtol=1e-4, atol=1e-6)
    for trial in range(2):
        own = slice(2 * trial, 2 * trial + 2)
        np.testing.assert_allclose(curved[trial, :-1, :-1], curvature[own, own], rtol=1e-4)
    assert np.all(np.diagonal(straight / curved, axis1=1, axis2=2)[:, :-1] > 1.3)
    np.testing.assert_allclose(curved[:, -1, -1], straight[:, -1, -1], rtol=1e-5)


def test_products_of_many_segments_are_those_of_each():
    """Six in groups of four: the second group is filled up to the first one's shape."""
    cart, random = GearedCart(gear=1.0, mass=1.0, friction=1.0), np.random.default_rng(0)
    moving = np.cumsum(random.normal(size=(6, 31, 1)), axis=1)
    aligned = Aligned(0.05, moving, random.normal(size=(6, 30, 1)), np.full(6, 31))
    segments, coordinates = SegmentSource.of(aligned, cart).whole(), FreeParameters(cart)
    objective = Objective(coordinates, observation_scale(aligned, cart), KNEE)
    start = jnp.asarray(random.normal(size=(6, 2, 1)), jnp.float32)
    products = objective.products(coordinates.initial, start, segments)
    each = [
        objective.products(coordinates.initial, start[i : i + 1], segments.take([i]))
        for i in range(6)
    ]
    np.testing.assert_allclose(products, np.concatenate(each), rtol=1e-4, atol=1e-6)


def test_a_trial_that_jumps_out_of_all_bounds_is_named():
    cart = GearedCart(gear=1.0, mass=1e-3, friction=1e-3)
    moving = np.tile(np.linspace(0.0, 1.0, 61, dtype=np.float32)[:, None], (4, 1, 1))
    acting = np.ones((4, 60, 1), np.float32)
    acting[2, 30:] = 1e38
    aligned = Aligned(0.05, moving, acting, np.full(4, 61))
    coordinates = FreeParameters(cart)
    with pytest.raises(PalpateError, match=r"trial 2 cannot be predicted .* cut it where it jumps"):
        intervals(coordinates, coordinates.initial, aligned)


def named(warning):
    """The parameters that a warning calls inseparable."""
    return tuple(warning.split(" tell ")[1].split(" apart")[0].split(", "))


def warned(jacobian):
    """What is named for the residuals' derivatives by parameter, {path: (residuals, elements)}."""
    like = {path: jnp.zeros(columns.shape[1]) for path, columns in jacobian.items()}
    _, unravel = ravel_pytree(like)
    columns = np.concatenate([jacobian[path] for path in sorted(jacobian)], axis=1)
    return [named(warning) for warning in _undecided(columns.T @ columns, unravel)]


def derivatives(elements=1, size=30.0, seed=0):
    return size * np.random.default_rng(seed).normal(size=(200, elements)) / np.sqrt(200)


def test_undecided_parameters_alone_are_no_combination():
    told, none = derivatives(3), np.zeros((200, 2))
    assert warned({"told": told, "none": none, "little": derivatives(2, 0.3, 1)}) == []
    assert warned({"none": none, "nothing": none}) == []
    little = derivatives(1, 0.8, 1)  # less than the prior, their difference more
    assert warned({"little": little, "as little": -little}) == []
    assert warned({"told": told}) == []


def test_elements_of_one_parameter_are_not_told_to_be_fixed():
    told = derivatives()
    assert warned({"shape": np.concatenate([told, -told], axis=1), "size": derivatives(1)}) == [
        ("shape", "size")
    ]
    assert warned({"shape": np.concatenate([told, -told], axis=1)}) == []


@pytest.mark.parametrize("left", [0.0, 1e-9, 0.1])
def test_combinations_are_named_apart_however_their_eigenvectors_mix(left):
    """Two of equal information, of elements in any order, beside parameters undecided alone."""
    one, other, trace = derivatives(2, seed=0), derivatives(1, seed=1), derivatives(2, seed=2)
    jacobian = {
        "damping": -other + left * trace[:, :1] / 30,
        "gravity": derivatives(1, seed=3),
        "gripping": np.zeros((200, 1)),
        "mass": one,
        "stiffness": other,
        "twisting": 1e-3 * derivatives(3, seed=4),
        "width": -one + left * trace / 30,
    }
    found = warned(jacobian)
    assert sorted(found) == [("damping", "stiffness"), ("mass", "width")]
    told = jacobian | {"width": -one + 0.01 * trace}
    assert warned(told)[0] == ("damping", "stiffness")
    told = jacobian | {"damping": -other + 0.02 * trace[:, :1]}
    assert warned(told)[0] == ("mass", "width")
    told = jacobian | {"damping": -other + 0.2 * trace[:, :1]}
    assert warned(told) == [("mass", "width")]


def test_one_stiffness_is_named_beside_the_masses_of_many_nodes():
    masses = derivatives(20)
    stiffness = -np.sum(masses, axis=1, keepdims=True) / 0.3  # a prior three times as wide
    shape = derivatives(2, seed=1)
    assert warned({"mass": masses, "shape": shape, "stiffness": stiffness}) == [
        ("mass", "stiffness")
    ]


@pytest.mark.parametrize(("shape", "other"), [((7, 5), (7, 5)), ((5, 7), ()), ((), ()), ((0,), ())])
def test_differences_of_any_number_of_observations_are_each_its_own(shape, other):
    """Their number is filled up to a power of two, and observations that all share are repeated."""
    random = np.random.default_rng(0)
    cart = GearedCart(gear=1.0, mass=1.0, friction=1.0)
    predicted, observed = random.normal(size=(*shape, 1)), random.normal(size=(*other, 1))
    off = difference(cart, predicted, observed)
    assert off.dtype == np.float64
    np.testing.assert_allclose(off, predicted - observed, atol=1e-6)
    assert off.shape == (*shape, 1)
    whole = np.zeros((*shape, 1), int)  # its type is not the other's
    np.testing.assert_allclose(difference(cart, whole, observed), whole - observed, atol=1e-6)
