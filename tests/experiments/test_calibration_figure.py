"""The figure of a calibration is drawn, the same each time."""

import numpy as np

from palpate.experiments.furniture.calibration_figure import rank_figure


def test_ranks_are_drawn_the_same_each_time(tmp_path):
    counts = {"right": np.full((5, 8), 40), "wrong": np.full((5, 8), 40)}
    names, paths = [f"parameter {index}" for index in range(5)], [tmp_path / "0", tmp_path / "1"]
    for path in paths:
        rank_figure(path, names, counts)
    first, second = (path.read_bytes() for path in paths)
    assert first == second
    assert first.startswith(b"\x89PNG")
