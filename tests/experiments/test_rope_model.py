"""What `reproduce rope-model` prints and keeps, on small ropes; identification is stood in for."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.experiments.experiment import Experiment
from palpate.experiments.rope import model as rope_model
from palpate.experiments.rope.swing import swing_half_life
from palpate.parameters import describe
from palpate.worlds.rope.rope import RopeConfiguration
from small_rope import SMALL


@pytest.fixture
def small(monkeypatch):
    """Two small ropes for less than a second, and the model that is started from as the fit."""
    worlds = {
        "sim1": RopeConfiguration(**SMALL, joint_damping=1e-3),
        "sim2": RopeConfiguration(**SMALL, length=0.6),
    }
    monkeypatch.setattr(rope_model, "WORLDS", worlds)
    monkeypatch.setattr(rope_model, "DURATION", 0.6)
    monkeypatch.setattr(rope_model, "identify", lambda start, *_: start)
    return worlds


def write_capture(folder, name: str, unseen: dict[int, slice]) -> None:
    """Three trials of ten markers on an arc whose first end is moved up and down."""
    time = np.arange(40) / rope_model.RATE
    angle = np.linspace(0.0, np.pi, 10)
    arc = 0.3 * np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], axis=-1)
    positions = np.tile(arc, (3, len(time), 1, 1))
    lift = 0.02 * np.sin(2 * np.pi * time / 0.4)[:, None] * np.linspace(1, 0, 10)
    positions[..., 2] += lift
    for marker, rows in unseen.items():
        positions[0, rows, marker] = np.nan
    np.savez(folder / name, positions=positions)


def test_worlds_are_told_with_how_fast_their_swing_dies(small, tmp_path, capsys):
    result = rope_model.reproduce(tmp_path, quick=True)
    found = {figure.name: figure for figure in result.figures}
    lines = capsys.readouterr().out.splitlines()
    for name, world in small.items():
        figure = found[f"{name}.swing_half_life_periods"]
        assert figure.value == pytest.approx(swing_half_life(world))
        assert (figure.unit, figure.bar) == ("periods", None)
        (line,) = [line for line in lines if line.startswith(f"{name}: a small free swing")]
        assert line.endswith(f"in {figure.value:.2f} periods (a rope's: 2 to 6)")
        constants = next(line for line in lines if line.startswith(f"{name}: world."))
        assert f"world.length {world.length}" in constants
    assert any(line.startswith("excitation: ") for line in lines)
    assert found["sim1.ratio_to_undamped"].value == pytest.approx(
        found["sim1.tip_rmse_per_length"].value / found["sim1.undamped.tip_rmse_per_length"].value
    )
    assert not any(name.startswith("real.") for name in found)


def test_what_was_mended_in_either_capture_is_told(small, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(rope_model, "WORLDS", {})
    write_capture(tmp_path, "dlo1_train.npz", {0: slice(10, 12)})
    write_capture(tmp_path, "dlo1_eval.npz", {-1: slice(20, 23)})
    result = rope_model.reproduce(tmp_path / "out", quick=True, mocap=tmp_path)
    notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert notes == [
        "note: trial 'dlo1_train/0', grip: 2 unseen positions of driven markers were interpolated",
        "note: trial 'dlo1_eval/0', grip: 3 unseen positions of driven markers were interpolated",
    ]
    assert "real.l1_cm" in [figure.name for figure in result.figures]


def test_wall_time_counts_what_earlier_processes_did(small, tmp_path, monkeypatch):
    monkeypatch.setattr(rope_model, "WORLDS", {})
    for name in ("dlo1_train.npz", "dlo1_eval.npz"):
        write_capture(tmp_path, name, {})

    def resumed(start, fitted, settings, run):
        run._began -= 1000.0  # what `Run.restore` does with the time of a checkpoint
        return start

    monkeypatch.setattr(rope_model, "identify", resumed)
    result = rope_model.reproduce(tmp_path / "out", quick=True, mocap=tmp_path)
    assert 2000.0 < result.wall_time_s < 2100.0


def test_a_folder_without_captures_is_refused(small, tmp_path, monkeypatch):
    monkeypatch.setattr(rope_model, "WORLDS", {})
    with pytest.raises(PalpateError, match=r"there is no .*dlo1_train.npz: --mocap needs"):
        rope_model.reproduce(tmp_path / "out", quick=True, mocap=tmp_path)


def test_the_baseline_has_no_damping_and_cannot_find_any(small, tmp_path):
    world = small["sim1"]
    fitted, _ = rope_model._simulate(Experiment("rope-model", tmp_path, True, 0), world)
    rope = rope_model.remove_damping(rope_model.starting_rope(fitted, mass=world.mass))
    damping = [row for row in describe(rope) if row["name"] in rope_model.DAMPING]
    assert len(damping) == len(rope_model.DAMPING)
    for row in damping:
        assert np.max(row["value"]) == 0
        assert row["fixed"]
