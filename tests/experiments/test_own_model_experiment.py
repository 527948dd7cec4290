"""What `reproduce own-model` pushes, counts and holds against what; the command is stood in for."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from palpate.experiments import own_model
from palpate.experiments.rivals.door_sysid import fit_door
from palpate.experiments.rivals.mujoco_sysid import mujoco_sysid
from palpate.models.model import Model, rollout
from palpate.models.python_files import load_class
from palpate.runs import Figure, Result
from palpate.runs.storage import write_json

SEED = 7  # of no door that is reproduced


@pytest.fixture
def strong(monkeypatch):
    """Pushes under which a door moves far."""
    monkeypatch.setattr(own_model, "TORQUE", (1.0, 4.0))
    monkeypatch.setattr(own_model, "PUSHED", (0.5, 1.5))


def test_the_doors_of_mujoco_move_as_the_example_says(strong):
    """To the noise, from rest, over four seconds, through friction and past pi."""
    truth = own_model.draw_door(SEED)
    door = load_class(f"{own_model.EXAMPLE}:Door", Model)(**truth)
    furthest = 0.0
    for trial in own_model.push_door(truth, SEED).trials:
        angle = trial["angle"].values
        start = door.initial_state(jnp.asarray(angle[:1], jnp.float32))
        torque = jnp.asarray(trial["torque"].values[:-1], jnp.float32)
        off = door.difference(door.observe(rollout(door, start, torque)), angle[1:])
        assert np.abs(off).max() < 6.0 * own_model.NOISE
        furthest = max(furthest, np.ptp(np.unwrap(angle[:, 0])))
    assert furthest > 1.0
    assert np.abs(angle).max() <= np.pi


def test_finite_differences_find_a_door_that_moves_far(strong):
    truth = own_model.draw_door(SEED)
    found = own_model.finite_differences(own_model.push_door(truth, SEED))
    for name, true in truth.items():
        assert found[name] == pytest.approx(true, rel=0.2), name


def test_mujoco_sysid_finds_a_door(strong):
    pytest.importorskip("mujoco.sysid")
    mujoco_sysid()
    truth = own_model.draw_door(SEED)
    recording = own_model.push_door(truth, SEED)
    few = dataclasses.replace(recording, trials=recording.trials[:2])
    found = fit_door(few, lambda door: own_model.scene(door, 10), own_model.RANGES)
    for name, true in truth.items():
        assert found[name] == pytest.approx(true, rel=0.1), name


def test_the_worst_method_and_all_intervals_count(tmp_path, monkeypatch):
    """The stand-in is 1 % off and misses nothing, but with smc 20 % off, and misses inertia."""

    def run(options):
        off = 1.2 if options.method == "smc" else 1.01
        rows = [
            {"name": name, "value": off * true, "lower": 0.9 * true,
             "upper": true * (0.95 if (name, off) == ("inertia", 1.2) else 1.3)}
            for name, true in own_model.draw_door(options.seed).items()
        ]  # fmt: skip
        result = Result("x", [Figure("wall_time_s", 3.0, "s")], {}, [0], None, 3.0, parameters=rows)
        write_json(options.out / "result.json", result.to_dict())
        return options.out

    monkeypatch.setattr(own_model.identify, "run", run)
    monkeypatch.setattr(own_model, "mujoco_sysid", lambda: None)
    monkeypatch.setattr(own_model, "fit_door", lambda *_: own_model.draw_door(SEED))
    result = own_model.reproduce(tmp_path, quick=True, seed=3)
    figures = {figure.name: figure for figure in result.figures}
    assert figures["model_lines"].met
    assert figures["gradient.relative_error"].value == pytest.approx(0.01)
    assert figures["gradient.coverage_90"].value == 1.0
    assert figures["posterior.relative_error"].value == pytest.approx(0.2)
    assert not figures["posterior.relative_error"].met
    assert figures["posterior.coverage_90"].value == pytest.approx(2 / 3)
    assert figures["seconds_per_door"].value == 3.0
    assert result.seeds == [3, own_model.FIRST + 3, own_model.FIRST + 4]
    beside = figures["gradient.relative_error"].rival
    assert beside is not None
    assert "mujoco.sysid" in beside
    assert result.settings["missed"]["smc"] == [["inertia"], ["inertia"]]
