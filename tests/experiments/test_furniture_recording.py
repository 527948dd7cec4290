"""What a recording of furniture says of itself."""

import re
from pathlib import Path

import numpy as np

from palpate.experiments.furniture_recording import POSE, WRENCH, checked, starting_furniture
from palpate.recording_files import read_recording


def test_the_page_on_furniture_shows_how_a_recording_of_ones_own_is_made(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "furniture.md").read_text()
    (example,) = (code for code in re.findall(r"```python\n(.*?)```", page, re.S) if "felt" in code)
    seen, felt = np.linspace(0, 3, 151), np.linspace(0, 3, 1501)
    given = {"seen": seen, "poses": np.zeros((151, 1, 3)), "felt": felt}
    monkeypatch.chdir(tmp_path)
    exec(example, given | {"wrenches": np.ones((1501, 1, 3))})
    made = checked(read_recording(tmp_path / "R.npz"))
    model = starting_furniture(made, 0.02)
    np.testing.assert_allclose(model.half_extent, [[0.6, 0.35]], rtol=1e-6)
    aligned = made.align(0.02, POSE, WRENCH)
    assert aligned.observation.shape == (1, 151, 1, 3)
    assert np.all(aligned.action == 1.0)
