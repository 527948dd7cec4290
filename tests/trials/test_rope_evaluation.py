"""Controllers on the same trials: chunks, resuming, and what is reported."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.report.evidence import read_evidence
from palpate.runs import Run
from palpate.trials import trial as trial_module
from palpate.trials.rope import stabilization
from palpate.trials.rope.stabilization import (
    Episodes,
    StabilizationTrial,
    evaluation_trials,
    lasting,
    summarise,
    write_trial_evidence,
)
from palpate.trials.trial import (
    by_group,
    evaluate_trials,
    first_of_each_group,
    run_trials,
    table,
)
from palpate.worlds.rope.rope import START_POSES, RopeConfiguration
from small_rope import SMALL

BASE = RopeConfiguration(**SMALL)


class Slide:
    """Moves every gripper along x."""

    period = None

    def __init__(self, speed: float):
        self.speed = speed

    def initial_carry(self, command):
        return np.full_like(command, [self.speed, 0.0, 0.0])

    def __call__(self, carry, observation, goal, key):
        return carry, carry


def four_trials() -> list[StabilizationTrial]:
    starts = ("straight", 1), ("straight", 2), ("helix", 3), ("helix", 4)
    return lasting([StabilizationTrial(BASE, start, seed) for start, seed in starts])


CONTROLLERS = {"slow": Slide(0.1), "fast": Slide(0.4)}


@pytest.fixture
def short(monkeypatch):
    """Trials of a few steps, three at a time."""
    monkeypatch.setattr(stabilization, "TRIAL_PERIODS", 0.03)
    monkeypatch.setattr(StabilizationTrial, "side_by_side", 3)


def test_every_rope_starts_in_every_pose():
    trials = evaluation_trials(BASE, 5, 11)
    assert [trial.start for trial in trials] == [pose for pose in START_POSES for _ in range(5)]
    assert trials[0].configuration is trials[5].configuration
    assert trials[0].configuration != trials[1].configuration
    assert len({trial.seed for trial in trials}) == 20
    assert evaluation_trials(BASE, 5, 11) == trials
    assert evaluation_trials(BASE, 5, 12)[0] != trials[0]


def test_chunks_give_what_one_batch_gives(short):
    trials = four_trials()
    evaluated = evaluate_trials(CONTROLLERS, trials)
    steps = evaluated["slow"].energy.shape[1] - 1
    assert steps == np.ceil(0.03 * trials[0].period / BASE.control_period)
    whole = run_trials(trials, CONTROLLERS["fast"], steps, drawn=first_of_each_group(trials))
    np.testing.assert_array_equal(evaluated["fast"].energy, whole.energy)
    np.testing.assert_array_equal(evaluated["fast"].gripper_speed, whole.gripper_speed)
    np.testing.assert_array_equal(evaluated["fast"].markers, whole.markers)
    assert not np.array_equal(evaluated["slow"].energy, whole.energy)


def test_what_was_cut_off_goes_on_to_the_same_result(short, tmp_path, monkeypatch):
    trials = four_trials()
    expected = evaluate_trials(CONTROLLERS, trials)
    calls = []

    def dies_at_the_fourth(chosen, *arguments):
        calls.append(len(chosen))
        if len(calls) == 4:
            raise RuntimeError("killed")
        episodes = run_trials(chosen, *arguments)
        if len(calls) == 2:  # the last trial of the first controller
            episodes.failures[0] = "diverged"
        return episodes

    monkeypatch.setattr(trial_module, "run_trials", dies_at_the_fourth)
    with Run.open(tmp_path, {}) as run, pytest.raises(RuntimeError):
        evaluate_trials(CONTROLLERS, trials, run)
    with Run.open(tmp_path, {}) as run:
        resumed = evaluate_trials(CONTROLLERS, trials, run)
        assert len(run.metrics()) == 4
    assert calls == [3, 1, 3, 1, 1]
    for name, episodes in expected.items():
        np.testing.assert_array_equal(resumed[name].energy, episodes.energy)
        np.testing.assert_array_equal(resumed[name].markers, episodes.markers)
    assert resumed["slow"].failures == {3: "diverged"}
    assert resumed["fast"].failures == {}
    with Run.open(tmp_path, {}) as run:  # nothing is left to do
        run.finish({})
        again = evaluate_trials(CONTROLLERS, trials, run)
    assert len(calls) == 5
    np.testing.assert_array_equal(again["fast"].energy, expected["fast"].energy)
    assert again["slow"].failures == {3: "diverged"}


def test_ropes_that_cannot_go_side_by_side_are_refused():
    other = RopeConfiguration(**SMALL, control_period=0.02)
    with pytest.raises(PalpateError, match="one control_period"):
        lasting([*four_trials(), StabilizationTrial(other, "straight", 0)])


def test_a_controller_for_another_period_is_refused_before_the_first_is_tried(monkeypatch):
    monkeypatch.setattr(trial_module, "run_trials", None)
    slow = Slide(0.1)
    slow.period = 0.02
    with pytest.raises(PalpateError, match=r"decides every 0.02 s"):
        evaluate_trials({"fast": Slide(0.4), "slow": slow}, four_trials())


def episodes_of(*settled_after: int | None) -> Episodes:
    """Episodes of 300 control periods whose energy falls at once to nothing, or never."""
    energy = np.ones((len(settled_after), 301))
    for row, after in zip(energy, settled_after, strict=True):
        if after is not None:
            row[after:] = 0.0
    return Episodes(energy, np.zeros_like(energy), np.zeros((2, 301, 11, 3)), {})


def test_summary_counts_successes_and_failures():
    trials = four_trials()
    summary = summarise(trials, episodes_of(50, 100, None, 150))
    period = trials[0].period
    assert (summary.trials, summary.successes, summary.success_rate) == (4, 3, 0.75)
    assert summary.time == pytest.approx(1.0)
    assert summary.periods == pytest.approx(1.0 / period)
    assert summary.periods_with_failures == pytest.approx((0.5 + 1 + 1.5 + 3) / 4 / period)
    assert summary.margin == pytest.approx(1.96 * 0.5 / period / np.sqrt(3))
    assert 0.3 < summary.interval[0] < 0.75 < summary.interval[1] < 1.0


def test_trembling_of_the_gripper_is_told():
    episodes = episodes_of(50, 100, None, 150)
    episodes.gripper_speed[0, 150] = 0.03
    episodes.gripper_speed[:, -100:] += 0.01
    summary = summarise(four_trials(), episodes)
    assert (summary.successes, summary.at_rest_at_once) == (3, 2)
    assert summary.final_speed == pytest.approx(0.01)


def test_a_rope_that_rises_again_is_counted():
    episodes = episodes_of(50, 100, None, 150)
    episodes.energy[0, 170] = 0.02
    episodes.energy[1, 290:] = np.nan
    assert summarise(four_trials(), episodes).relapsed == 2
    assert summarise(four_trials(), episodes_of(50, 100, None, 150)).relapsed == 0


def test_periods_are_each_ropes_own():
    short = RopeConfiguration(**SMALL, length=0.25)
    trials = [StabilizationTrial(BASE, "straight", 0), StabilizationTrial(short, "straight", 0)]
    summary = summarise(trials, episodes_of(50, 50))
    assert trials[1].period == pytest.approx(0.5 * trials[0].period)
    assert summary.periods == pytest.approx(1.5 * 0.5 / trials[0].period)


def test_without_a_success_there_is_no_time():
    summary = summarise(four_trials(), episodes_of(None, None, None, None))
    assert summary.periods is None
    assert "never" in summary.line("x")
    rate, periods, seconds = summary.figures(bars=(0.99, 0.9))
    assert (rate.met, periods.met, seconds.met) == (False, False, None)


def test_when_every_simulation_ended_early_there_is_no_final_speed(recwarn):
    episodes = episodes_of(None, None, None, None)
    for trial in range(4):
        episodes.energy[trial], episodes.gripper_speed[trial] = np.nan, np.nan
        episodes.failures[trial] = "diverged"
    summary = summarise(four_trials(), episodes)
    assert (summary.successes, summary.diverged, summary.final_speed) == (0, 4, None)
    assert "nan" not in summary.line("x")
    assert not recwarn.list


def test_poses_are_apart():
    trials, episodes = four_trials(), episodes_of(50, 100, None, None)
    episodes.failures[3] = "diverged"
    poses = {pose: summarise(*part) for pose, part in by_group(trials, episodes).items()}
    assert poses["straight"].success_rate == 1.0
    assert poses["helix"].success_rate == 0.0
    assert (poses["straight"].diverged, poses["helix"].diverged) == (0, 1)
    lines = table(trials, {"policy": episodes})
    assert any("trial 3: diverged" in line for line in lines)


def test_figures_have_the_names_and_bars_of_the_table():
    summary = summarise(four_trials(), episodes_of(50, 100, 120, 150))
    named = {figure.name: figure for figure in summary.figures(bars=(0.99, 0.9))}
    assert list(named) == ["success_rate", "time_to_1pct_periods", "time_to_1pct_s"]
    assert named["success_rate"].better == "higher"
    assert named["success_rate"].met
    assert named["time_to_1pct_periods"].met
    assert named["time_to_1pct_s"].value == pytest.approx(1.05)
    assert summary.figures(".swing_damper")[0].name == "success_rate.swing_damper"


def test_evidence_is_what_a_report_reads(short, tmp_path):
    trials = four_trials()
    evaluated = evaluate_trials(CONTROLLERS, trials)
    with Run.open(tmp_path, {}) as run:
        write_trial_evidence(run, trials, evaluated, ["fast"])
    evidence = read_evidence(tmp_path)
    assert [motion.group for motion in evidence.motions] == ["straight", "helix"]
    assert [set(motion.chains) for motion in evidence.motions] == [{"fast"}, {"fast"}]
    assert "energy" in evidence.pieces
    assert evidence.pieces["energy"].values["slow"].shape[0] == 4
    np.testing.assert_allclose(evidence.pieces["energy"].values["slow"][:, 0], 1.0)


def test_a_rope_that_was_never_seen_is_not_drawn(short, tmp_path):
    trials = four_trials()
    evaluated = evaluate_trials(CONTROLLERS, trials)
    for episodes in evaluated.values():
        episodes.failures[2] = "diverged while it was shaken"
        for part in (episodes.energy[2], episodes.gripper_speed[2], episodes.markers[1]):
            part[:] = np.nan
    with Run.open(tmp_path, {}) as run:
        write_trial_evidence(run, trials, evaluated, ["slow", "fast"])
    evidence = read_evidence(tmp_path)
    assert [motion.group for motion in evidence.motions] == ["straight"]
    assert "energy" in evidence.pieces
