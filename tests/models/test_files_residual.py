"""Corrected models on disk: what comes back, and what a damaged correction is told."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.models.files import load_model, save_model
from palpate.models.planar import PlanarState, furniture
from palpate.models.planar.shapes import rectangle
from palpate.models.residual import Residual, SiteNetwork
from palpate.models.rope import Rope, RopeState

REMOVED = object()
AGAIN = "; identify the model again if another version of palpate or of its class wrote the file"


def corrected() -> Residual:
    rope = Rope.uniform(length=0.4, mass=0.03, nodes=5, driven=(0, 4), drive="position")
    key = jax.random.key(0)
    features = jax.random.normal(key, (20, 5, 11))
    network = SiteNetwork.create(key, features, jnp.full(5, 0.03), 3, 3, width=4, depth=1)
    weights = tuple(weight + 0.1 for weight in network.weights)
    return Residual(rope, eqx.tree_at(lambda n: n.weights, network, weights))


@pytest.fixture
def file(tmp_path):
    save_model(tmp_path / "model.json", corrected(), {"recordings": ["one.npz"]})
    return tmp_path / "model.json"


def test_a_corrected_model_comes_back_as_it_was_saved(file):
    model, about = load_model(file)
    assert about == {"recordings": ["one.npz"]}
    assert jax.tree.structure(model) == jax.tree.structure(corrected())
    for ours, saved in zip(jax.tree.leaves(model), jax.tree.leaves(corrected()), strict=True):
        assert ours.dtype == saved.dtype
        np.testing.assert_array_equal(ours, saved)
    state = RopeState(jnp.ones((5, 3)) * jnp.arange(5)[:, None] * 0.05, jnp.ones((5, 3)))
    action = state.position[jnp.array([0, 4])]
    assert np.any(model.correction(state, action))
    np.testing.assert_array_equal(
        model.correction(state, action), corrected().correction(state, action)
    )


def test_corrected_furniture_comes_back_too(tmp_path):
    model = furniture([rectangle(0.6, 0.4), rectangle(0.5, 0.5)])
    features = jax.random.normal(jax.random.key(0), (20, 2, 6))
    network = SiteNetwork.create(jax.random.key(1), features, jnp.full(2, 0.03), 3, 1, width=4)
    network = eqx.tree_at(lambda n: n.weights[-1], network, jnp.full((4, 3), 0.1))
    save_model(tmp_path / "model.json", Residual(model, network))
    loaded, _ = load_model(tmp_path / "model.json")
    state, action = PlanarState(jnp.ones((2, 3)), jnp.ones((2, 3))), jnp.ones((2, 3))
    assert np.any(loaded.correction(state, action))
    np.testing.assert_array_equal(
        loaded.correction(state, action), Residual(model, network).correction(state, action)
    )


def test_the_physics_alone_is_written_as_ever(file, tmp_path):
    save_model(tmp_path / "physics.json", corrected().physics)
    physics, whole = (json.loads(path.read_text()) for path in (tmp_path / "physics.json", file))
    assert (physics["version"], whole["version"]) == (1, 2)
    assert "correction" not in physics
    assert whole["parameters"] == physics["parameters"]
    assert whole["model"] == physics["model"] == "rope"


@pytest.mark.parametrize(
    ("place", "to", "text"),
    [
        ((), REMOVED, "FILE is damaged: its correction is missing"),
        ((), [1], "FILE is damaged: its correction is missing"),
        (
            ("place",),
            REMOVED,
            "the correction in FILE do not fit: missing ['place'], unknown none" + AGAIN,
        ),
        (
            ("colour",),
            1,
            "the correction in FILE do not fit: missing none, unknown ['colour']" + AGAIN,
        ),
        (("weights",), "heavy", "'correction.weights' in FILE is no list of layers: 'heavy'"),
        (("weights", 0), "heavy", "'correction.weights[0]' in FILE is not numbers: 'heavy'"),
        (("biases", 1, 0), 1e60, "'correction.biases[1]' in FILE is not finite"),
        (("bound", 2), None, "'correction.bound' in FILE is not finite"),
        (("bound", 2), -1, "'correction.bound' in FILE must be positive"),
        (("deviation", 0, 0), 0, "'correction.deviation' in FILE must be positive"),
        (("mean",), [[0.0] * 10] * 5, "'correction.mean' in FILE must have the shape (5, 11), "
         "got (5, 10)"),
        (("mean",), 0.0, "'correction.mean' in FILE must have the shape (5, 11), got ()"),
        (("bound",), [0.1] * 4, "FILE is damaged: 'bound' of a correction must have the shape "
         "(5,), got (4,)"),
        (("weights",), [], "FILE is damaged: a correction needs means (sites, features), places "
         "(sites, numbers) and at least one layer, got (5, 11), (5, 4) and 0"),
        (("biases", 1), [0.0], "FILE is damaged: a layer of a correction that takes 4 numbers of "
         "each of 3 groups of sites needs weights (12, outputs) and biases (outputs,), got (12, 3) "
         "and (1,)"),
    ],
)  # fmt: skip
def test_a_damaged_correction_is_named(file, place, to, text):
    content = json.loads(file.read_text())
    entry = content
    for key in ("correction", *place)[:-1]:
        entry = entry[key]
    if to is REMOVED:
        del entry[("correction", *place)[-1]]
    else:
        entry[("correction", *place)[-1]] = to
    file.write_text(json.dumps(content))
    with pytest.raises(PalpateError) as error:
        load_model(file)
    assert str(error.value).replace(str(file), "FILE") == text
