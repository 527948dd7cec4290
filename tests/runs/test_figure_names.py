"""Figures as a person would say them."""

import pytest

from palpate.runs import Figure
from palpate.runs.figure_names import name_in_words, value_in_words


@pytest.mark.parametrize(
    ("figure", "said"),
    [
        (Figure("time_to_1pct_periods", 0.8346, "periods"), "time to 1 % energy: 0.8346 periods"),
        (Figure("time_to_1pct_s.held_still", None, "s"), "time to 1 % energy, held still: never"),
        (Figure("in_model.settling_time", None, "s"), "time until at rest, in the model: never"),
        (Figure("in_world.success_rate", 0.975, ""), "success, in a simulated world: 97.5 %"),
        (Figure("l1_fitted_trials_cm", 0.32, "cm"), "mean error on the trials it was fitted to: "),
        (Figure("rmse_rad", None, "rad"), "error (root mean square): unknown"),
        (Figure("in_model.final_speed", 0.1, "m/s"), "final speed, in the model: 0.1 m/s"),
        (Figure("in_model.success", 1.0, ""), "success, in the model: 100 %"),
        (Figure("worst_tip_error_cm.swing_damper", 2.0, "cm"), "worst tip error, swing damper: 2 "),
        (Figure("ess_min", 340.2, ""), "effective draws, at least: 340.2"),
    ],
)
def test_a_figure_in_words(figure, said):
    assert f"{name_in_words(figure)}: {value_in_words(figure)}".startswith(said)
