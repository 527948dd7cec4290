"""Controllers of every kind come back from their files as they were, or are refused."""

import dataclasses
import importlib.resources
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate import family
from palpate.errors import PalpateError
from palpate.models.files import load_model, save_model
from palpate.networks import (
    Channel,
    CommandPolicy,
    DeclaredController,
    load_controller,
    load_policy,
    save_controller,
)
from palpate.runs.storage import save_arrays
from toy_family import FAMILY
from toys import Cart

ANGLE, FORCE = (Channel("angle", (1,), "rad"),), (Channel("force", (1,), "N", 4.0, 20.0),)


class Damper(DeclaredController):
    """Hand-written: a force against what is seen."""

    gain: float = eqx.field(static=True)
    observations: tuple[Channel, ...] = eqx.field(static=True, default=ANGLE)
    actions: tuple[Channel, ...] = eqx.field(static=True, default=FORCE)
    period: float = eqx.field(static=True, default=0.05)

    def initial_carry(self, command):
        return None

    def __call__(self, carry, observation, goal=None, key=None):
        return carry, -self.gain * observation


class Planner(Damper):
    """Its model stands in a file beside its own."""

    model: Any = None

    def settings(self, folder: Path) -> dict[str, Any]:
        save_model(folder / "model.json", self.model)
        return {"gain": self.gain, "model": "model.json"}

    @classmethod
    def from_settings(cls, folder: Path, model: str, **settings: Any) -> "Planner":
        return cls(model=load_model(folder / model)[0], **settings)


@pytest.fixture(autouse=True)
def kinds(monkeypatch):
    here = {"damper": f"{__name__}:Damper", "planner": f"{__name__}:Planner"}
    toys = dataclasses.replace(FAMILY, controllers=here)
    table = family.families() | {"toys": toys}
    monkeypatch.setattr(family, "families", lambda: table)


def network(**changes) -> CommandPolicy:
    seen = jax.random.normal(jax.random.key(1), (50, 3))
    settings = {"period": 0.05, "width": 8, "observations": [Channel("shape", (3,), "m")]}
    stiffness = Channel("stiffness", (2, 1), "N/m", 800.0, 4000.0)
    return CommandPolicy.create(jax.random.key(0), seen, (*FORCE, stiffness), **settings | changes)


def test_a_network_comes_back_the_same(tmp_path):
    policy, path = network(), tmp_path / "policy.safetensors"
    save_controller(path, policy, {"task": "a task"})
    loaded, manifest = load_policy(path)
    assert manifest["task"] == "a task"
    assert manifest["controller"]["kind"] == "command network"
    assert manifest["controller"]["actions"][1] == {
        "name": "stiffness", "shape": [2, 1], "unit": "N/m", "limit": 800.0, "rate_limit": 4000.0,
    }  # fmt: skip
    assert jax.tree.structure(loaded) == jax.tree.structure(policy)
    observation, command = jnp.arange(3.0), jnp.zeros(3)
    np.testing.assert_array_equal(loaded(command, observation)[1], policy(command, observation)[1])


def test_a_hand_written_law_is_json_that_a_person_can_read(tmp_path):
    path = tmp_path / "damper.json"
    save_controller(path, Damper(2.5), {"about": "tuned by hand"})
    described = json.loads(path.read_text())["manifest"]["controller"]
    assert described["kind"] == "damper"
    assert described["settings"] == {"gain": 2.5}
    loaded, manifest = load_controller(path)
    assert loaded == Damper(2.5)
    assert manifest["about"] == "tuned by hand"
    with pytest.raises(PalpateError, match="holds a damper: expected a network"):
        load_policy(path)


def test_a_planner_brings_its_model(tmp_path):
    path = tmp_path / "planner.safetensors"
    planner = Planner(1.0, model=Cart(mass=jnp.array(2.0), friction=jnp.array(0.25)))
    save_controller(path, planner, {})
    loaded, _ = load_controller(path)
    assert float(loaded.model.mass) == 2.0
    with pytest.raises(PalpateError, match="cannot hold arrays"):
        save_controller(tmp_path / "planner.json", planner, {})


def test_the_policy_that_ships_says_what_its_channels_are():
    file = importlib.resources.files("palpate") / "assets" / "rope-stabilization.safetensors"
    policy, manifest = load_policy(str(file))
    assert manifest["task"] == "rope-stabilization"
    assert policy.observations == (
        Channel("node position relative to the gripper", (10, 3), "m"),
        Channel("node velocity", (10, 3), "m/s"),
    )
    assert policy.actions == (Channel("gripper velocity", (1, 3), "m/s", 1.5, 10.0),)
    seen = policy.mean + policy.scale * jnp.sin(jnp.arange(60.0))
    _, command = policy(jnp.full((1, 3), 0.1), seen)
    np.testing.assert_allclose(command, [SHIPPED], rtol=1e-5)


SHIPPED = (0.04565805196762085, 0.11529237031936646, 0.169844388961792)  # before channels were


def test_earlier_files_without_descriptions_still_load(tmp_path):
    policy = network(observations=(), width=4, depth=1)
    policy = dataclasses.replace(policy, actions=(Channel("action", (3,), "", 4.0),))
    own = {
        "kind": "command policy", "features": 3, "width": 4, "depth": 1, "action_shape": [3],
        "period": 0.05, "limit": 4.0, "rate_limit": None,
    }  # fmt: skip
    save_arrays(tmp_path / "policy.safetensors", policy, {"task": "old", "policy": own})
    loaded, _ = load_policy(tmp_path / "policy.safetensors")
    assert loaded.observations == (Channel("features", (3,)),)
    assert loaded.actions == policy.actions
    wrong = {"task": "old", "policy": own, "features": {"height": "metres"}}
    save_arrays(tmp_path / "policy.safetensors", policy, wrong)
    with pytest.raises(PalpateError, match="feature 'height' is described as 'metres'"):
        load_policy(tmp_path / "policy.safetensors")


def changed(path: Path, **changes) -> Path:
    content = json.loads(path.read_text())
    content["manifest"]["controller"] |= changes
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"kind": "dampr"}, "unknown kind of controller 'dampr'; did you mean 'damper'?"),
        ({"settings": {}}, "does not say which controller it holds"),
        ({"settings": {"gain": 1.0, "os": "system"}}, "does not say which controller it holds"),
        ({"actions": [{"name": "force"}]}, "channels are described by name, shape"),
        ({"period": None}, "does not say which controller it holds"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(tmp_path, changes, sentence):
    path = tmp_path / "damper.json"
    save_controller(path, Damper(2.5), {})
    with pytest.raises(PalpateError) as refused:
        load_controller(changed(path, **changes))
    assert sentence in str(refused.value)


def test_other_files_are_refused(tmp_path):
    save_arrays(tmp_path / "model.safetensors", {"a": np.zeros(3)}, {"kind": "model"})
    with pytest.raises(PalpateError, match="holds no controller"):
        load_controller(tmp_path / "model.safetensors")
    (tmp_path / "a.json").write_text('{"format": "palpate.model"}')
    with pytest.raises(PalpateError, match="holds no controller"):
        load_controller(tmp_path / "a.json")
    (tmp_path / "a.json").write_text('{"format": "palpate.controller", "version": 2}')
    with pytest.raises(PalpateError, match="has version 2; this palpate reads version 1"):
        load_controller(tmp_path / "a.json")


class Stranger(Damper):
    """Of no kind in the table."""


def test_what_could_not_be_loaded_is_not_saved(tmp_path):
    with pytest.raises(PalpateError, match="type Stranger cannot be saved; kinds: command network"):
        save_controller(tmp_path / "a.json", Stranger(1.0), {})
    assert not list(tmp_path.iterdir())
