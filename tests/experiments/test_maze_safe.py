"""How the figures of maze-safe are pooled, and which rivals count."""

import json

import numpy as np
import pytest

from palpate.experiments.contact import maze_figure, maze_safe
from palpate.families.contact.methods import METHODS


def run(success, violation, **more):
    return {
        "success_rate": success, "violation_rate": violation, "progress": success,
        "progress.held_still": 0.0, "stiffness_contrast": 3.0, "risk_rank_correlation": 0.7,
        "risk_gain_over_force": 0.2, **more,
    }  # fmt: skip


def test_a_rival_that_violates_too_often_is_none():
    names = [maze_safe.PLAIN, *METHODS]
    costs = {n: 2 * [{"training.violations": 10.0, "pretraining.violations": 5.0}] for n in names}
    costs["no-recovery"] = 2 * [{"training.violations": 100.0, "pretraining.violations": 0.0}]
    home = {n: [run(0.2, 0.5), run(0.4, 0.5)] for n in names}
    home["srl-vic"] = [run(0.9, 0.02), run(1.0, 0.02)]
    home["k500"] = 2 * [run(0.6, 0.03)]  # at 1.5 times the violations
    home["k1000"] = 2 * [run(0.99, 0.04)]
    noisy = {"srl-vic": run(0.8, 0.1), maze_safe.PLAIN: run(0.5, 0.3)}

    def figures():
        found = {
            n: [
                {"costs": costs[n][i], "home": home[n][i], "away": home["srl-vic"][i]}
                | {"noisy": noisy.get(n)}
                for i in range(2)
            ]
            for n in names
        }
        return {f.name: f for f in maze_safe.figures(100, found)}

    found = figures()
    assert found["success_rate"].value == pytest.approx(0.95)
    assert found["constant_gap"].value == pytest.approx(0.35)
    assert "k500" in str(found["constant_gap"].rival)
    assert found["violations_ratio"].value == pytest.approx(0.1)
    assert found["violations_ratio_with_pretraining"].value == pytest.approx(0.15)
    assert found["baseline_violations"].value == 200
    assert found["no_noise.violation_rate"].value == pytest.approx(0.3)
    home["srl-vic"] = [run(0.9, 0.0), run(1.0, 0.0)]
    found = figures()
    assert found["constant_gap"].value == pytest.approx(0.95)  # nobody else is as safe


def test_curves_count_episodes_between_lines(tmp_path):
    lines = [
        {"step": 10 * n, "time": n, "episodes": 2, "ends": {"goal": n % 2}, "violations": n}
        for n in range(1, 61)
    ]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    steps, share, violations = maze_figure.curve_of(tmp_path)
    np.testing.assert_array_equal(steps, np.arange(20, 601, 20))
    np.testing.assert_allclose(share, 0.25)
    np.testing.assert_array_equal(violations, np.arange(2, 61, 2))
    for line in lines[:2]:
        line |= {"episodes": 0, "ends": {}}
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (tmp_path / "metrics.jsonl").write_text(text)
    assert np.isnan(maze_figure.curve_of(tmp_path)[1, 0])  # nothing ended there
    curve = maze_figure.curve_of(tmp_path)
    maze_figure.draw(tmp_path / "curves.png", {"srl-vic": [curve.tolist()], "k300": [curve]})
    assert (tmp_path / "curves.png").stat().st_size > 10_000
