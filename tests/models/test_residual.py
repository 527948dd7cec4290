"""A corrected model: nothing at first, bounded, the same whichever way the object is turned."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from correctable_toys import CorrectableCart, CorrectablePendulum
from palpate.errors import PalpateError
from palpate.models.model import rollout
from palpate.models.residual import Residual, SiteNetwork
from palpate.models.rope import Rope, RopeState
from palpate.parameters import parameters_of, with_values
from toys import Cart

BOUND = 0.05


def network(model, trained: bool = True, key: int = 0) -> SiteNetwork:
    """With random weights in every layer, or as it starts."""
    state, actions = motion(model, batch=50)
    features = model.residual_features(state, actions[:, 0])
    sites, axes = model.correction_shape
    created = SiteNetwork.create(
        jax.random.key(key), features, jnp.full(sites, BOUND), axes, width=8
    )
    if not trained:
        return created
    last = jax.random.normal(jax.random.key(key + 1), created.weights[-1].shape)
    return eqx.tree_at(lambda n: n.weights[-1], created, last)


def motion(model, batch=3, steps=20, seed=0):
    """A batch of moving states, and actions that lead on from there."""
    rng = np.random.default_rng(seed)
    frames = rng.normal(size=(batch, 1, *model.observation_shape))
    if isinstance(model, Rope):
        line = np.linspace(0.0, 1.0, model.nodes)[:, None] * np.array([0.25, 0.1, -0.05])
        frames = line + 0.01 * frames
    frames = np.concatenate([frames, frames + 1e-3 * rng.normal(size=frames.shape)], axis=1)
    state = model.initial_state(jnp.asarray(frames, jnp.float32))
    actions = 0.1 * rng.normal(size=(batch, steps, *model.action_shape))
    if isinstance(model, Rope):
        driven = frames[:, 1, list(model.driven)]
        actions = driven[:, None] + 0.01 * actions
    return state, jnp.asarray(actions, jnp.float32)


def rope(**fields) -> Rope:
    fields = {"driven": (0, 1, 4, 5), "drive": "position"} | fields
    return Rope.uniform(length=0.4, mass=0.03, nodes=6, **fields)


MODELS = {
    "cart": CorrectableCart(1.0, 0.2),
    "pendulum": CorrectablePendulum(1.0, 0.2),
    "rope held at both ends": rope(),
    "rope held at one end": rope(driven=(0,)),
    "rope that is accelerated": rope(driven=(5,), drive="acceleration"),
}


@pytest.fixture(params=MODELS.values(), ids=MODELS.keys())
def model(request):
    return request.param


def test_untrained_it_is_the_physics(model):
    state, actions = motion(model)
    corrected = Residual(model, network(model, trained=False))
    assert not np.any(corrected.correction(state, actions[:, 0]))


@pytest.mark.parametrize("kind", ["cart", "pendulum", "rope held at both ends"])
def test_untrained_it_moves_as_the_physics_does(kind):
    model = MODELS[kind]
    state, actions = motion(model, steps=3)
    corrected = Residual(model, network(model, trained=False))
    for ours, theirs in zip(
        jax.tree.leaves(rollout(corrected, state, actions)),
        jax.tree.leaves(rollout(model, state, actions)),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def test_a_batch_is_its_members(model):
    state, actions = motion(model)
    corrected = Residual(model, network(model))
    together = model.corrected(state, corrected.correction(state, actions[:, 0]))
    member = jax.tree.map(lambda x: x[1], state)
    alone = model.corrected(member, corrected.correction(member, actions[1, 0]))
    for batch, single in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(batch[1], single, rtol=1e-4, atol=1e-6)


def test_what_is_corrected_is_what_lies_between(model):
    state, actions = motion(model)
    correction = Residual(model, network(model)).correction(state, actions[:, 0])
    assert correction.shape == (3, *model.correction_shape)
    assert np.max(np.abs(correction)) > 0.1 * BOUND
    found = model.correction_between(state, model.corrected(state, correction))
    free = np.ones(model.correction_shape)
    if isinstance(model, Rope):
        free[list(model.driven)] = 0.0
        # Where the ends are near each other the axes are shorter than one, both ways.
        correction = np.array(correction)
        chord = np.linalg.norm(np.diff(state.position[:, [0, -1], :2], axis=1), axis=-1)
        correction[..., :2] *= (chord**2 / (chord**2 + (0.05 * 0.4) ** 2))[..., None]
    np.testing.assert_allclose(found, free * correction, atol=1e-5)


def test_a_correction_is_bounded_however_strange_the_state(model):
    corrected = Residual(model, network(model))
    state, actions = motion(model)
    strange = jax.tree.map(lambda x: 1e4 * x, state)
    assert np.all(np.abs(corrected.correction(strange, 1e4 * actions[:, 0])) <= BOUND)


@pytest.mark.parametrize("driven", [(0, 1, 4, 5), (0,), (5,), (2,)])
def test_turned_and_moved_it_does_the_same_turned_and_moved(driven):
    model = rope(driven=driven)
    state, actions = motion(model)
    sine, cosine = np.sin(2.1), np.cos(2.1)
    turn = jnp.asarray([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], jnp.float32)
    away = jnp.asarray([0.3, -0.2, 0.5], jnp.float32)
    corrected = Residual(model, network(model))

    def kicked(state, action):
        return model.corrected(state, corrected.correction(state, action)).velocity

    turned = RopeState(state.position @ turn.T + away, state.velocity @ turn.T)
    action = actions[:, 0]
    here = kicked(state, action)
    there = kicked(turned, action @ turn.T + away)
    np.testing.assert_allclose(there, here @ turn.T, atol=1e-5)
    assert np.max(np.abs(here - state.velocity)) > 0.1 * BOUND


def test_a_rope_whose_ends_meet_has_finite_derivatives():
    model = rope()
    state, actions = motion(model)
    closed = state.position.at[:, -1].set(state.position[:, 0])

    def moved(position):
        correction = Residual(model, network(model)).correction(
            RopeState(position, state.velocity), actions[:, 0]
        )
        return jnp.sum(model.corrected(state, correction).velocity)

    assert np.all(np.isfinite(jax.grad(moved)(closed)))


def test_it_subtracts_observations_and_names_units_as_the_physics_does():
    class Wrapped(CorrectablePendulum):
        observation_units = ("rad",)

        def difference(self, predicted, observed):
            return jnp.sin(predicted - observed)

    corrected = Residual(Wrapped(1.0, 0.2), network(MODELS["pendulum"]))
    assert corrected.observation_units == ("rad",)
    assert float(corrected.difference(jnp.ones(1), jnp.zeros(1))[0]) == pytest.approx(np.sin(1.0))


def test_its_parameters_are_those_of_the_physics_and_stay_legal():
    corrected = Residual(rope(), network(rope()))
    declared = parameters_of(corrected)
    assert set(declared) == {f"physics.{name}" for name in parameters_of(Rope)}
    wild = with_values(corrected, {"physics.stretch_stiffness": jnp.full(5, 1e9)}).constrain()
    assert isinstance(wild, Residual)
    assert np.all(wild.physics.stretch_stiffness[1:4] < 1e5)  # those between nodes that are free


def test_it_is_compiled_once():
    cart, traces = MODELS["cart"], []

    @eqx.filter_jit
    def run(model, state, actions):
        traces.append(1)
        return rollout(model, state, actions)

    for seed in range(3):
        run(Residual(cart, network(cart, key=seed)), *motion(cart, seed=seed))
    assert len(traces) == 1


def test_what_does_not_fit_together_is_refused():
    with pytest.raises(PalpateError, match=r"^Cart cannot be corrected by a network: expected a "):
        Residual(Cart(1.0, 0.2), network(MODELS["cart"]))
    with pytest.raises(PalpateError, match=r"expects a correction of shape \(6, 3\), .*\(1, 1\)$"):
        Residual(rope(), network(MODELS["cart"]))
    whole = network(rope())
    for change, sentence in (
        ({"bound": jnp.ones(5)}, r"^'bound' .* shape \(6,\), got \(5,\)$"),
        ({"place": jnp.ones((5, 4))}, r"^'place' .* shape \(6, 4\), got \(5, 4\)$"),
        ({"place": jnp.ones(6)}, r"at least one layer, got \(6, 11\), \(6,\) and 3$"),
        ({"biases": whole.biases[1:]}, "^a correction of 3 layers needs as many biases, got 2$"),
        ({"weights": whole.weights[::-1]}, r"needs weights \(45, outputs\) and biases"),
    ):
        with pytest.raises(PalpateError, match=sentence):
            dataclasses.replace(whole, **change)
