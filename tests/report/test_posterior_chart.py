"""The figure of a calibration is drawn, the same each time."""

import numpy as np

from palpate.report.posterior_chart import rank_figure


def test_ranks_are_drawn_the_same_each_time(tmp_path):
    counts = {"right": np.full((5, 8), 40), "wrong": np.full((5, 8), 40)}
    names = [f"parameter {index}" for index in range(5)]
    first, second = (rank_figure(tmp_path / f"{i}.png", names, counts) for i in range(2))
    assert first.read_bytes() == second.read_bytes()
    assert first.read_bytes().startswith(b"\x89PNG")
