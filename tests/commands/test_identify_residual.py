"""`palpate identify ... --residual`: what it hands over, says and keeps, of a cart."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

from palpate.commands import identify
from palpate.errors import PalpateError
from palpate.families.options import Identify
from palpate.identification.gradient.residual import ResidualSettings
from palpate.models.files import load_model
from palpate.models.model import rollout
from palpate.models.residual import Residual
from palpate.recordings import Channel, Recording, Role, Trial
from palpate.recordings.files import write_recording
from palpate.report import read_evidence
from palpate.runs.result import read_result
from toys import Cart


@dataclasses.dataclass(frozen=True, kw_only=True)
class IdentifyCart(Identify):
    """As a family's file would say it."""

    family: ClassVar[str] = "cart"
    observation: ClassVar[str] = "sensor"

    def prepare(self, recording):
        return recording

    def action(self, recording):
        return "motor"

    def reference(self, recordings, aligned):
        return Cart(1.0, 0.2)


class StickyCart(Cart):
    """With friction that grows with the square of its speed, which the model lacks."""

    def step(self, state, action):
        braked = state.velocity * (1.0 - 0.3 * self.control_period * jnp.abs(state.velocity))
        return super().step(type(state)(state.position, braked), action)


@pytest.fixture
def recording(tmp_path, monkeypatch, toys):
    few = {"horizons": (0.5,), "iterations": (60,), "windows": 8, "width": 8}
    monkeypatch.setattr(
        identify,
        "ResidualSettings",
        lambda seed: ResidualSettings(seed=seed, learning_rate=0.01, share=1.0, **few),
    )
    cart, random = StickyCart(1.0, 0.2), np.random.default_rng(0)
    forces = jnp.asarray(3.0 * np.repeat(random.normal(size=(16, 6, 1)), 10, axis=1), jnp.float32)
    start = cart.initial_state(jnp.zeros((16, 1, 1)))
    positions = np.pad(rollout(cart, start, forces).position, ((0, 0), (1, 0), (0, 0)))
    forces, positions = np.asarray(forces), positions + 1e-4 * random.normal(size=positions.shape)
    time = np.arange(61) * cart.control_period
    trials = [
        Trial(
            str(index),
            {
                "sensor": Channel("sensor", Role.OBSERVATION, time, positions[index], "m"),
                "motor": Channel("motor", Role.COMMAND, time[:-1], forces[index], "N"),
            },
        )
        for index in range(16)
    ]
    write_recording(tmp_path / "cart.npz", Recording(tuple(trials), {}))
    return tmp_path / "cart.npz"


def test_what_became_of_the_correction_is_handed_over_and_told(recording, tmp_path, capsys):
    options = IdentifyCart(
        recordings=(recording,), iterations=(3, 3, 5), residual=True, out=tmp_path / "run"
    )
    folder = identify.run(options)
    said = capsys.readouterr().out
    result = read_result(folder / "result.json")
    told = result.settings["correction"]
    assert f"Correction by a network {told['reason']}" in said
    assert told["reason"].startswith("kept: " if told["kept"] else "dropped: ")
    assert set(told["held_out"]) < set(result.split["fitted"])
    figures = {figure.name: figure.value for figure in result.figures}
    assert figures["l1_ratio_to_physics"] == pytest.approx(
        figures["l1_cm"] / figures["l1_physics_cm"]
    )
    model, _ = load_model(folder / "model.json")
    assert isinstance(model, Residual) == told["kept"]
    assert {row["name"] for row in result.parameters} == {"mass", "friction"}
    assert ("physics alone" in read_evidence(folder).horizon.values) == told["kept"]
    assert identify.run(options) == folder  # finished: told again, not fitted again
    assert told["reason"] in capsys.readouterr().out


def test_nothing_is_said_of_a_correction_that_was_not_asked_for(recording, tmp_path, capsys):
    options = IdentifyCart(recordings=(recording,), iterations=(3, 3, 5), out=tmp_path / "run")
    result = read_result(identify.run(options) / "result.json")
    assert "correction" not in capsys.readouterr().out
    assert "correction" not in result.settings


def test_too_few_trials_are_refused_before_anything_is_fitted(recording, tmp_path):
    options = IdentifyCart(recordings=(recording,), residual=True, out=tmp_path / "run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(IdentifyCart, "held_out", 0.9)
        with pytest.raises(PalpateError, match=r"needs at least 8 trials.* the recording has 2$"):
            identify.run(options)
    assert not (tmp_path / "run").exists()
