"""The figures of `twin-interactive` from what its stages keep."""

import numpy as np
import pytest

from palpate.experiments.appliance.twin_interactive import figures, several_parts
from palpate.worlds.appliance.categories import CATEGORIES, draw_design


def kept(found, degrees, centimetres, near, extra=0):
    """What a stage keeps of an appliance, as JSON has it: None for what is not known."""
    score = {
        "found": found,
        "part": [float(number) if one else None for number, one in enumerate(found)],
        "type_right": [1.0 if one else None for one in found],
        "degrees": degrees,
        "centimetres": centimetres,
        "iou": [0.9 if one else None for one in found],
        "parent_right": [1.0 if one else None for one in found],
        "inside": [[1.0, 0.5] if one else [None, None] for one in found],
        "extra": extra,
    }
    return {"score": score, "pushes_to_near": near, "seconds": [1.0, 2.0]}


MOVED = {
    "motions": [
        {
            "error": 0.02,
            "corrected": 0.03,
            "still": 0.4,
            "covered": 1.0,
            "inside": [True, True, False],
        },
        {
            "error": 0.1,
            "corrected": 0.08,
            "still": 0.5,
            "covered": 0.5,
            "inside": [True, False, False],
        },
        {
            "error": 0.03,
            "corrected": 0.03,
            "still": 0.3,
            "covered": 0.9,
            "inside": [True, True, True],
        },
    ],
    "urdf_s": 0.5,
}


FOUND = {
    ("box", 1, "information"): kept([1.0], [0.5], [0.2], 2) | MOVED,
    ("oven", 1, "information"): kept([1.0, 0.0], [1.5, None], [None, None], 4, extra=1),
    ("oven", 1, "random"): kept([1.0, 1.0], [1.5, 0.1], [None, 0.3], 8),
}


def test_parts_are_pooled_and_categories_stand_by_themselves():
    values = {figure.name: figure.value for figure in figures(FOUND)}
    assert values["recall"] == pytest.approx(2 / 3)
    assert values["precision"] == pytest.approx(2 / 3)
    assert values["axis_deg"] == pytest.approx(1.0)
    assert values["axis_cm"] == pytest.approx(0.2)
    assert values["axis_deg_worst_category"] == 1.5
    assert values["axis_cm_worst_category"] == pytest.approx(0.2)
    assert values["tree_accuracy"] == 0.5
    assert values["axis_coverage_90"] == 0.75
    assert values["oven.recall"] == 0.5
    assert values["pushes_to_2deg_over_random"] == 0.5
    assert 1.0 < values["interaction_s_p95"] <= 2.0
    assert values["motion_rmse_share_of_range"] == 0.03
    assert values["motion_coverage_90"] == pytest.approx(0.8)
    assert values["parameter_coverage_90"] == pytest.approx(2 / 3)
    assert values["cloud_to_urdf_s_p95"] == 0.5


@pytest.mark.parametrize(("corrected", "worse", "kept"), [(0.05, 0, 1), (0.06, 1, 1), (None, 0, 0)])
def test_an_appliance_is_worse_where_its_correction_moves_it_worse(corrected, worse, kept):
    moves = [dict(one) for one in MOVED["motions"]]
    for one in moves:
        one["corrected"] = corrected  # beside a mean error of 0.05 without
    of = FOUND | {("box", 1, "information"): FOUND["box", 1, "information"] | {"motions": moves}}
    values = {figure.name: figure.value for figure in figures(of)}
    assert values["residual_worse_count"] == worse
    assert values["residual_kept_count"] == kept


def test_only_appliances_with_several_parts_are_handled_at_random_too():
    chosen = several_parts(0, 10)
    assert all(len(draw_design(name.replace("-", " "), seed).parts) > 1 for name, seed in chosen)
    count = [sum(name == one.replace(" ", "-") for name, _ in chosen) for one in CATEGORIES]
    assert np.max(count) <= 5
    assert np.min(count) >= 1
