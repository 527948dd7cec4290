"""What a run leaves comes back as it was; what does not fit is refused by its name."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.report import read_evidence, write_evidence
from palpate.report.evidence import EVIDENCE
from palpate.runs.storage import DamagedFileError, write_json, write_text
from synthetic_evidence import evaluation, identification, parameter, training, write_run

TIME = np.linspace(0.0, 1.0, 5)


def test_everything_a_run_holds_is_found(tmp_path):
    evidence = read_evidence(identification(tmp_path / "run"))
    (motion,) = evidence.motions
    assert list(motion.chains) == ["observed", "predicted"]
    assert motion.chains["observed"].shape == (501, 21, 3)
    assert np.isnan(motion.chains["observed"][130, 9]).all()
    assert list(evidence.horizon.values) == ["identified", "undamped baseline"]
    assert list(evidence.horizon.bands) == ["identified"]
    assert evidence.pieces == {}
    assert [figure.met for figure in evidence.figures] == [True, False]
    assert len(evidence.metrics) == 280
    assert evidence.name == "identify"


def test_parameters_may_be_scalars_lists_or_without_interval(tmp_path):
    rows = {row.name: row for row in read_evidence(identification(tmp_path)).parameters}
    assert rows["bend_stiffness"].lower.shape == rows["bend_stiffness"].value.shape == (19,)
    assert rows["drag"].upper == pytest.approx(2.5e-4)
    assert np.isnan(rows["node_mass"].lower).all()
    assert rows["node_mass"].fixed
    assert rows["stretch_stiffness"].shared


def test_what_all_elements_share_is_one_number(tmp_path):
    row = parameter("damping", [2.0] * 9, "N s/m", "", shared=True) | {"lower": 1.0, "upper": 3.0}
    differing = parameter("mass", [1.0, 2.0], "kg", "", shared=True)
    damping, mass = read_evidence(write_run(tmp_path, "x", parameters=[row, differing])).parameters
    assert (damping.value, damping.lower, damping.upper) == ([2.0], [1.0], [3.0])
    assert mass.value.tolist() == [1.0, 2.0]


def test_groups_of_motions_stay_apart(tmp_path):
    evidence = read_evidence(evaluation(tmp_path))
    assert [motion.group for motion in evidence.motions] == [
        "straight at 60 degrees",
        "half circle",
    ]
    assert evidence.pieces["energy"].values["controlled"].shape == (40, 501)


def test_a_run_without_evidence_is_read_for_the_rest(tmp_path):
    evidence = read_evidence(training(tmp_path, steps=10))
    assert evidence.motions == ()
    assert len(evidence.metrics) == 10


def test_a_run_that_goes_on_has_the_name_of_its_folder(tmp_path):
    write_json(tmp_path / "swing" / "configuration.json", {})
    assert read_evidence(tmp_path / "swing").name == "swing"


def test_the_same_arrays_give_the_same_bytes(tmp_path):
    written = [identification(tmp_path / name) / EVIDENCE for name in "ab"]
    assert written[0].read_bytes() == written[1].read_bytes()


POINTS = np.zeros((5, 3, 3))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"pose.time": TIME}, r"unknown evidence 'pose.time': expected motion.<label>"),
        ({"motion.time": TIME}, "lacks anything beside 'motion.time'"),
        ({"motion.observed": POINTS}, "lacks 'motion.time'"),
        ({"motion/a.time": TIME, "motion/b.observed": POINTS}, "anything beside 'motion/a.time'"),
        ({"motion.time": TIME[::-1], "motion.x": POINTS}, "finite, increasing seconds"),
        ({"motion.time": TIME * np.nan, "motion.x": POINTS}, "finite, increasing seconds"),
        ({"motion.time": TIME, "motion.x": POINTS[:4]}, r"'motion.x' has the shape \(4, 3, 3\)"),
        ({"motion.time": TIME, "motion.x": np.zeros((5, 3, 2))}, r"\(frames, points, 3\)"),
        ({"motion.time": TIME, "motion.x": POINTS + np.inf}, "'motion.x' is empty or infinite"),
        ({"motion.time": TIME, "motion.x": np.zeros((5, 0, 3))}, "'motion.x' is empty"),
        ({"energy.time": TIME, "energy.x": TIME}, r"expected \(episodes, times\) with 5 times"),
        ({"horizon.time": TIME, "horizon.x": TIME[:3]}, "expected \\(times\\) with 5 times"),
        (
            {"horizon.time": TIME, "horizon.x": TIME, "horizon.x.low": TIME},
            "'horizon.x.low' stands alone",
        ),
        ({"motion.time": ["now"]}, "'motion.time' is not an array of numbers"),
    ],
)
def test_what_does_not_fit_is_not_written(tmp_path, arrays, message):
    with pytest.raises(PalpateError, match=message):
        write_evidence(tmp_path, arrays)
    assert not (tmp_path / EVIDENCE).exists()


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(PalpateError, match="there is no run"):
        read_evidence(tmp_path / "nowhere")
    with pytest.raises(PalpateError, match=r"holds no run: expected configuration\.json"):
        read_evidence(tmp_path)


def test_truncated_evidence_is_named(tmp_path):
    path = identification(tmp_path) / EVIDENCE
    path.write_bytes(path.read_bytes()[:-4000])
    with pytest.raises(DamagedFileError, match=r"evidence\.npz is damaged or not NPZ"):
        read_evidence(tmp_path)


def test_pickled_evidence_is_refused(tmp_path):
    write_run(tmp_path, "train")
    np.savez(tmp_path / EVIDENCE, **{"motion.time": np.array([{}], dtype=object)})
    with pytest.raises(DamagedFileError, match=r"damaged or not NPZ .*allow_pickle"):
        read_evidence(tmp_path)


def test_gigantic_evidence_is_refused_before_memory_is_taken(tmp_path, monkeypatch):
    identification(tmp_path)
    monkeypatch.setattr("palpate.report.evidence.MAX_BYTES", 2**17)
    monkeypatch.setattr(np, "load", None)
    with pytest.raises(PalpateError, match=r"unpacks to 0 MiB, at most 0\.125 are"):
        read_evidence(tmp_path)


@pytest.mark.parametrize(
    ("result", "message"),
    [
        ("[]", "expected an object"),
        ('{"figures": 3}', "no list under 'figures'"),
        ('{"figures": [{"name": "a"}]}', r"figures\[0\] cannot be read"),
        ('{"figures": [{"name": 3, "value": 1, "unit": "m"}]}', "have to be texts"),
        ('{"figures": [{"name": "a", "value": "b", "unit": "m"}]}', r"figures\[0\]"),
        ('{"parameters": ["a"]}', r"parameters\[0\] cannot be read"),
        ('{"parameters": [{"name": "a", "value": [1, 2], "lower": [1, 2, 3]}]}', "'lower' has 3"),
        ('{"figures": [', "is not valid JSON"),
    ],
)
def test_a_damaged_result_is_named(tmp_path, result, message):
    write_text(tmp_path / "result.json", result)
    with pytest.raises(DamagedFileError, match=message) as caught:
        read_evidence(tmp_path)
    assert "result.json" in str(caught.value)
