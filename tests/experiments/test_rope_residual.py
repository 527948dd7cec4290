"""What `reproduce rope-residual` asks for and keeps; the identification itself is stood in for."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.experiments.rope import residual as rope_residual
from palpate.families.rope.recording import GRIPPER, MARKERS
from palpate.models.rope import Rope
from palpate.recordings.files import read_recording
from palpate.runs import Figure, Result
from palpate.runs.storage import write_json


@pytest.fixture
def asked(monkeypatch):
    """The options of every identification; each says that a fifth was gained, if it was kept."""
    asked = []

    def run(options):
        asked.append(options)
        kept = bool(options.validate)
        figures = [
            Figure("l1_cm", 0.8, "cm"),
            Figure("l1_physics_cm", 1.0 if kept else 0.8, "cm"),
            Figure("l1_ratio_to_physics", 0.8 if kept else 1.0, ""),
            Figure("correction_size", 0.1, ""),
        ]
        told = {"correction": {"kept": kept, "reason": "kept" if kept else "dropped"}}
        write_json(
            options.out / "result.json",
            Result("identify-rope", figures, told, [0], None, 60.0).to_dict(),
        )
        return options.out

    monkeypatch.setattr(rope_residual.identify, "run", run)
    monkeypatch.setattr(rope_residual, "load_model", lambda path: (Rope.uniform(), {}))
    monkeypatch.setattr(rope_residual, "DURATION", 0.3)
    return asked


def capture(folder):
    for name in ("dlo1_train.npz", "dlo1_eval.npz"):
        np.savez(folder / name, positions=np.zeros((1, 5, 6, 3)))
    return folder


def test_without_motion_capture_the_simulated_rope_has_to_drop_its_correction(asked, tmp_path):
    result = rope_residual.reproduce(tmp_path, quick=True)
    (options,) = asked
    assert options.residual
    assert options.iterations == rope_residual.QUICK
    figures = {figure.name: figure for figure in result.figures}
    assert figures["simulated.dropped"].met is True
    assert "l1_ratio_to_physics" not in figures
    assert result.wall_time_s == 60.0
    recording = read_recording(options.recordings[0])
    assert len(recording.trials) == rope_residual.TRIALS
    trial = recording.trials[0]
    assert trial[MARKERS].values.shape == (31, rope_residual.NODES, 3)
    apart = trial[MARKERS].values[:, 0] - trial[GRIPPER].values[:, 0]
    assert np.std(apart) == pytest.approx(rope_residual.NOISE, rel=0.3)
    assert np.ptp(trial[GRIPPER].values[:, 0], axis=0).max() > 1e-3


def test_the_real_rope_is_the_command_of_the_bar(asked, tmp_path):
    result = rope_residual.reproduce(tmp_path / "out", seed=3, mocap=capture(tmp_path))
    _, real = asked
    assert [path.name for path in (*real.recordings, *real.validate)] == [
        "dlo1_train.npz",
        "dlo1_eval.npz",
    ]
    assert (real.driven, real.rate, real.seed, real.residual) == ((0, 1, -2, -1), 100.0, 3, True)
    assert result.figures[0].name == "l1_ratio_to_physics"
    assert (result.figures[0].value, result.figures[0].bar) == (0.8, 0.90)
    assert result.settings["real.residual"] == {"kept": True, "reason": "kept"}


def test_one_trial_that_carries_the_gain_is_seen():
    rows = rope_residual.gain_figures(np.array([1.0, 0.9, 2.0]), np.array([1.0, 1.0, 4.0]))
    values = {row.name: row.value for row in rows}
    assert values["l1_ratio_to_physics.median_trial"] == pytest.approx(0.9)
    assert values["l1_ratio_to_physics.worst_trial"] == 1.0
    assert values["share_of_trials_that_gain"] == pytest.approx(2 / 3)
    assert values["share_of_gain_in_one_trial"] == pytest.approx(2.0 / 2.1)


def test_files_that_are_not_there_are_named_before_anything_is_done(asked, tmp_path):
    with pytest.raises(PalpateError, match=r"there is no .*dlo1_train.npz: --mocap needs"):
        rope_residual.reproduce(tmp_path / "out", mocap=tmp_path)
    assert not asked
