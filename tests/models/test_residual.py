"""A corrected model: nothing at first, bounded, the same whichever way the object is turned."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.models.articulated import Articulated, Link, tree_of
from palpate.models.model import Model, Wrapper, rollout
from palpate.models.planar import Planar, PlanarState, furniture
from palpate.models.planar.shapes import rectangle
from palpate.models.residual import Residual, SiteNetwork, correctable
from palpate.models.rope import Rope, RopeState
from palpate.parameters import parameters_of, with_values
from toys import Cart, Pendulum

BOUND = 0.05


def network(model, trained: bool = True, key: int = 0) -> SiteNetwork:
    """With random weights in every layer, or as it starts."""
    state, actions = motion(model, batch=50)
    physics = correctable(model)
    features = physics.residual_features(state, actions[:, 0])
    (sites, axes), groups = physics.correction_shape, physics.correction_neighbours.shape[1]
    created = SiteNetwork.create(
        jax.random.key(key), features, jnp.full(sites, BOUND), axes, groups, width=8
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
    state = eqx.filter_jit(model.initial_state)(jnp.asarray(frames, jnp.float32))
    actions = 0.1 * rng.normal(size=(batch, steps, *model.action_shape))
    if isinstance(model, Rope):
        driven = frames[:, 1, list(model.driven)]
        actions = driven[:, None] + 0.01 * actions
    return state, jnp.asarray(actions, jnp.float32)


def rope(**fields) -> Rope:
    fields = {"driven": (0, 1, 4, 5), "drive": "position"} | fields
    return Rope.uniform(length=0.4, mass=0.03, nodes=6, **fields)


def bodies(**fields) -> Planar:
    box = rectangle(0.6, 0.4)
    return furniture([box, 0.5 * box, 2.0 * box], **fields)


MODELS = {
    "cart": Cart(1.0, 0.2),
    "pendulum": Pendulum(1.0, 0.2),
    "cabinet": tree_of(
        [
            Link(axis=(0.0, 0.0, 1.0), mass=1.0, inertia=np.diag([0.1, 0.1, 0.1])),
            Link("fixed", parent=0, mass=0.3, inertia=np.diag([0.01, 0.01, 0.01])),
            Link("prismatic", parent=0, mass=0.5, inertia=np.diag([0.1, 0.1, 0.1])),
        ]
    ),
    "bodies": bodies(),
    "bodies, one of them bolted": bodies(bolted=[1], poses=np.zeros((3, 3))),
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
    assert not np.any(eqx.filter_jit(corrected.correction)(state, actions[:, 0]))


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
    moved = eqx.filter_jit(
        lambda *now: correctable(model).corrected(now[0], corrected.correction(*now))
    )
    together = moved(state, actions[:, 0])
    member = jax.tree.map(lambda x: x[1], state)
    alone = moved(member, actions[1, 0])
    for batch, single in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(batch[1], single, rtol=1e-4, atol=1e-6)


def test_what_is_corrected_is_what_lies_between(model):
    state, actions = motion(model)
    correction = eqx.filter_jit(Residual(model, network(model)).correction)(state, actions[:, 0])
    assert correction.shape == (3, *correctable(model).correction_shape)
    assert np.max(np.abs(correction)) > 0.1 * BOUND
    found = correctable(model).correction_between(
        state, correctable(model).corrected(state, correction)
    )
    free = np.ones(correctable(model).correction_shape)
    if isinstance(model, Planar):
        free -= np.asarray(model.bolted)[:, None]
    if isinstance(model, Articulated):
        free[1] = 0.0  # the fixed one
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
        return correctable(model).corrected(state, corrected.correction(state, action)).velocity

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
        return jnp.sum(correctable(model).corrected(state, correction).velocity)

    assert np.all(np.isfinite(jax.jit(jax.grad(moved))(closed)))


def test_bodies_turned_and_moved_are_corrected_the_same_turned_and_moved():
    model = bodies()
    state, actions = motion(model)
    corrected, action = Residual(model, network(model)), actions[:, 0]
    sine, cosine = np.sin(2.1), np.cos(2.1)
    turn = jnp.asarray([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], jnp.float32)
    away = jnp.asarray([0.3, -0.2, 2.1], jnp.float32)
    turned = PlanarState(state.pose @ turn.T + away, state.velocity @ turn.T)
    here = corrected._kick(state, action).velocity - state.velocity
    there = corrected._kick(turned, action @ turn.T).velocity - turned.velocity
    np.testing.assert_allclose(there, here @ turn.T, atol=1e-5)
    assert np.min(np.max(np.abs(here), axis=(0, 2))) > 0.1 * BOUND


def test_a_body_is_corrected_by_what_itself_does():
    model = bodies()
    state, actions = motion(model)
    corrected = Residual(model, network(model))
    faster = PlanarState(state.pose, state.velocity.at[:, 1].multiply(3.0))
    change = corrected.correction(faster, actions[:, 0]) - corrected.correction(
        state, actions[:, 0]
    )
    assert np.all(np.any(np.asarray(change) != 0.0, axis=(0, 2)) == [False, True, False])


def test_in_a_chain_a_layer_sees_the_site_before_the_site_and_the_one_after():
    """What files of version 2 were written for: weights in this order, zeros beyond the ends."""
    model = MODELS["rope held at one end"]
    state, actions = motion(model)
    net = network(model)
    features = model.residual_features(state, actions[:, 0])
    x = (features - net.mean) / net.deviation
    x = jnp.concatenate([x, jnp.broadcast_to(net.place, (*x.shape[:-1], 4))], axis=-1)
    for weight, bias in zip(net.weights, net.biases, strict=True):
        nothing = jnp.zeros_like(x[..., :1, :])
        before = jnp.concatenate([nothing, x[..., :-1, :]], axis=-2)
        after = jnp.concatenate([x[..., 1:, :], nothing], axis=-2)
        x = jnp.tanh(jnp.concatenate([before, x, after], axis=-1) @ weight + bias)
    found = net(features, model.correction_neighbours)
    np.testing.assert_array_equal(found, net.bound[:, None] * x)


@pytest.mark.parametrize(
    ("neighbours", "seen"),
    [
        ([[[0, -1], [1, 2]], [[1, -1], [0, 2]], [[2, -1], [0, 1]]], [[1, 5], [2, 4.5], [8, 1.5]]),
        (
            [
                [[-1, -1], [0, -1], [1, 2]],
                [[0, -1], [1, -1], [-1, -1]],
                [[0, -1], [2, -1], [-1] * 2],
            ],
            [[0, 1, 5], [1, 2, 0], [1, 8, 0]],
        ),
    ],
    ids=["set", "tree"],
)
def test_a_layer_sees_the_means_of_the_groups_that_the_model_names(neighbours, seen):
    neighbours, seen = np.array(neighbours), np.array(seen)
    groups = neighbours.shape[1]
    weight = jnp.linspace(0.1, 0.3, groups)[:, None]
    one = SiteNetwork(
        mean=jnp.zeros((3, 1)),
        deviation=jnp.ones((3, 1)),
        bound=jnp.ones(3),
        place=jnp.zeros((3, 0)),
        weights=(weight,),
        biases=(jnp.zeros(1),),
    )
    one.check_layers(groups)
    found = one(jnp.array([[[1.0], [2.0], [8.0]]]), neighbours)
    np.testing.assert_allclose(found[0], np.tanh(seen @ weight), rtol=1e-6)


class Marked(Pendulum):
    """A pendulum that overrides all of the contract: nothing in it is `Model`'s default."""

    action_shape = (1,)
    observation_shape = (1,)
    observation_units = ("N m",)

    def difference(self, predicted, observed):
        return jnp.sin(predicted - observed)

    def observe(self, state):
        return jnp.cos(state.angle)

    def velocity(self, state):
        return state.angle

    def stepper(self):
        return lambda state, action: self.step(state, 2.0 * action)

    def constrain(self):
        return Marked(2.0, 0.2)


ONE, STATE = jnp.ones(1), Marked(1.0, 0.2).initial_state(jnp.ones((2, 1)))
FORWARDED = {
    "control_period": None, "action_shape": None, "observation_shape": None,
    "observation_units": None, "observes_force": None, "observe": (STATE,),
    "difference": (ONE, 3.0 * ONE), "initial_state": (jnp.ones((2, 1)),), "velocity": (STATE,),
    "drawing": (ONE,),
}  # fmt: skip
CORRECTED = {"overrides", "step", "stepper", "independent_parts", "constrain"}


def test_each_member_of_a_model_is_forwarded_or_corrected():
    """A new member of `Model` belongs in one of the lists above, and in `Residual`."""
    own = {name for name in dir(Model) if not hasattr(eqx.Module, name)} | set(
        Model.__annotations__
    )
    public = {name for name in own if not name.startswith("_")}
    assert public == {*FORWARDED, *CORRECTED}
    assert public - {"independent_parts"} <= {
        *vars(Residual),
        *vars(Wrapper),
        *Residual.__annotations__,
    }


@pytest.mark.parametrize("name", FORWARDED)
def test_what_is_forwarded_is_that_of_the_physics(name):
    physics = Marked(1.0, 0.2, control_period=0.03)
    expected = getattr(physics, name)
    found = getattr(Residual(physics, network(physics)), name)
    if FORWARDED[name] is not None:
        expected, found = expected(*FORWARDED[name]), found(*FORWARDED[name])
    assert eqx.tree_equal(found, expected)


def test_what_is_corrected_goes_through_the_physics():
    physics = Marked(1.0, 0.2)
    corrected = Residual(physics, network(physics))
    kicked = correctable(physics).corrected(STATE, corrected.correction(STATE, ONE))
    assert kicked.rate == STATE.rate  # `Marked` takes the angle for the velocity
    assert kicked.angle != STATE.angle
    assert eqx.tree_equal(corrected.step(STATE, ONE), physics.step(kicked, ONE))
    assert eqx.tree_equal(corrected.stepper()(STATE, ONE), physics.step(kicked, 2.0 * ONE))
    assert corrected.constrain().physics.length == 2.0
    (part, of), *others = corrected.independent_parts()
    assert (part is corrected, of, others) == (True, (0,), [])


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
    with pytest.raises(PalpateError, match=r"^a layer .* each of 3 groups .*\(21, outputs\)"):
        Residual(rope(), network(MODELS["cart"]))
    more = dataclasses.replace(rope(), control_period=0.02)
    five = Rope.uniform(length=0.4, mass=0.03, nodes=5, driven=(0,))
    with pytest.raises(PalpateError, match=r"expects a correction of shape \(5, 3\), .*\(6, 3\)$"):
        Residual(five, network(more))
    whole = network(rope())
    for change, sentence in (
        ({"bound": jnp.ones(5)}, r"^'bound' .* shape \(6,\), got \(5,\)$"),
        ({"place": jnp.ones((5, 4))}, r"^'place' .* shape \(6, 4\), got \(5, 4\)$"),
        ({"place": jnp.ones(6)}, r"at least one layer, got \(6, 11\), \(6,\) and 3$"),
        ({"biases": whole.biases[1:]}, "^a correction of 3 layers needs as many biases, got 2$"),
    ):
        with pytest.raises(PalpateError, match=sentence):
            dataclasses.replace(whole, **change)
    backwards = dataclasses.replace(whole, weights=whole.weights[::-1])
    with pytest.raises(PalpateError, match=r"needs weights \(45, outputs\) and biases"):
        Residual(rope(), backwards)


def test_a_model_that_does_not_say_its_velocity_is_told_what_to_implement():
    class Turning(Cart):
        def initial_state(self, observations):
            return super().initial_state(observations), jnp.zeros(2)

    class Velocities(Turning):
        def velocity(self, state):
            return state[1]

    class Elsewhere(Turning):
        def velocity(self, state):
            return jnp.zeros(2)

    with pytest.raises(PalpateError, match=r"^Turning does not say which leaf .* override `Model"):
        correctable(Turning(1.0, 0.2))
    with pytest.raises(PalpateError, match=r"^Elsewhere.velocity must return one floating leaf"):
        correctable(Elsewhere(1.0, 0.2))
    assert correctable(Velocities(1.0, 0.2)).correction_shape == (1, 2)


def test_neighbours_that_are_no_sites_are_refused():
    class Lost(Rope):
        @property
        def correction_neighbours(self):
            return super().correction_neighbours + 1

    lost = Lost.uniform(length=0.4, mass=0.03, nodes=6, driven=(0, 1, 4, 5), drive="position")
    with pytest.raises(PalpateError, match=r"^the neighbours that Lost .* from -1 to 5, got \[\["):
        Residual(lost, network(rope()))
