"""What `reproduce rope-markerless` measures and keeps, at a size of seconds."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from palpate.experiments.rope import markerless as rope_markerless
from palpate.experiments.rope import nominal
from palpate.experiments.rope.nominal import shipped_policy
from palpate.models.rope import Rope, RopeState
from palpate.runs.run import RESULT
from palpate.trials.rope import filming as rope_filming
from palpate.trials.rope import stabilization
from palpate.trials.rope.filming import empty_films, film
from palpate.trials.rope.stabilization import StabilizationTrial
from palpate.worlds.camera import Sensor
from palpate.worlds.rope.rope import RopeConfiguration

MODEL = Rope.uniform(nodes=11, substeps=4, bend_stiffness=2e-3, bend_damping=5e-4)


def filmed(trial: StabilizationTrial, sensor: Sensor) -> SimpleNamespace:
    """One rope that swings before a plain background."""
    row = {name: part[0] for name, part in empty_films(1, trial.steps, MODEL.nodes).items()}
    film(trial, row, model=MODEL, policy=None, background="plain", sensor=sensor, shaken=False)
    return SimpleNamespace(**row)


def test_a_trial_is_kept_beside_what_it_is_compared_with():
    trial = StabilizationTrial(RopeConfiguration(), "straight", 3, 8)
    kept = filmed(trial, Sensor(sub_frames=2))
    tracked, centre_line, alone, hanging = np.sqrt(kept.squared_error) * 100
    assert tracked.max() < 2.0
    assert np.isfinite(centre_line).tolist() == [step in (0, 6) for step in range(9)]
    assert np.nanmax(centre_line) < 2.0
    assert alone[0] == pytest.approx(tracked[0])
    # The rope starts 60 degrees to the side: as far from hanging as its nodes from the gripper.
    expected = 100 * np.sqrt(np.mean((np.arange(1, 11) / 10) ** 2))
    assert hanging[0] == pytest.approx(expected, rel=1e-3)
    miss = ((kept.tracked - kept.true)[:, 1:] ** 2).sum(-1).mean(-1)
    assert kept.squared_error[0] == pytest.approx(miss, rel=1e-2, abs=1e-7)
    assert np.nanmax(kept.hidden) == 0
    assert kept.energy[0] > 0.2


def test_a_simulation_that_diverges_leaves_nan(monkeypatch):
    def diverge(*_):
        raise rope_filming.DivergedError("too fast")

    monkeypatch.setattr(rope_filming.FilmedRope, "step", diverge)
    kept = filmed(StabilizationTrial(RopeConfiguration(), "straight", 3, 2), Sensor(sub_frames=1))
    assert np.isfinite(kept.energy).tolist() == [True, False, False]


def test_all_rows_are_filmed_once_and_resumed(tmp_path, monkeypatch):
    chosen = ("released", "shaken", "stabilised", "stabilised, colour only")
    monkeypatch.setattr(
        rope_markerless, "ROWS", {name: rope_markerless.ROWS[name] for name in chosen}
    )
    draw = rope_markerless.evaluation_trials
    monkeypatch.setattr(rope_markerless, "evaluation_trials", lambda *given: draw(*given)[:1])
    monkeypatch.setattr(rope_markerless, "START_POSES", ("straight",))
    monkeypatch.setattr(rope_markerless, "SWINGING", 0.08)
    monkeypatch.setattr(stabilization, "TRIAL_PERIODS", 0.05)
    monkeypatch.setattr(nominal, "identified_rope", lambda *_: MODEL)
    monkeypatch.setattr(rope_filming, "COMPILED", 1)
    monkeypatch.setattr(rope_filming, "TIMED", 10)
    result = rope_markerless.reproduce(tmp_path, quick=True)
    found = {figure.name: figure for figure in result.figures}
    assert found["node_rmse_cm"].bar == 1.0
    assert found["node_rmse_cm"].value < 3.0
    assert found["success_rate"].bar == 0.9
    assert found["success_rate"].value == 0.0  # nothing comes to rest in a twentieth of a period
    assert found["node_rmse_cm.hanging"].value > found["node_rmse_cm"].value
    assert found["success_rate.held_still"].value == 0.0
    assert found["frame_cpu_ms.p50"].value > 0
    assert (tmp_path / "stabilised-colour-only" / RESULT).exists()
    assert result.settings["weights"] == "shipped"

    def never(*_, **__):
        raise AssertionError("a finished row is filmed a second time")

    monkeypatch.setattr(rope_markerless, "film", never)
    again = rope_markerless.reproduce(tmp_path, quick=True)
    same = dataclasses.asdict(found["node_rmse_cm"])
    (figure,) = [figure for figure in again.figures if figure.name == "node_rmse_cm"]
    assert dataclasses.asdict(figure) == same


def test_nobody_commands_a_rope_that_is_not_known():
    policy, _ = shipped_policy()
    decide = rope_filming._Decisions(policy)
    known = RopeState(jnp.ones((11, 3)), jnp.ones((11, 3)))
    assert np.abs(decide(known)).max() > 0
    unknown = RopeState(known.position.at[4, 1].set(jnp.nan), known.velocity)
    np.testing.assert_array_equal(decide(unknown), np.zeros(3))
    assert np.isfinite(decide(known)).all()


def test_a_state_that_was_not_known_is_no_small_error():
    true = np.zeros((1, 3, 11, 3), np.float32)
    tracked = true.copy()
    tracked[0, 1, 4] = np.nan
    true[0, 2] = np.nan  # the simulation has diverged: nobody is blamed
    squared = np.array([[[1e-4, np.nan, np.nan]]], np.float32)
    arrays = {"tracked": tracked, "true": true, "squared_error": squared}
    assert rope_markerless._rmse(rope_markerless._squared_errors(arrays)) is None
    tracked[0, 1] = 0.0
    squared[0, 0, 1] = 1e-4
    assert rope_markerless._rmse(rope_markerless._squared_errors(arrays)) == pytest.approx(1.0)
