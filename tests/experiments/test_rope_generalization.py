"""Ropes that the controller was not made for; trials are short, and the evaluation stood in for."""

import dataclasses

import numpy as np
import pytest

from palpate.experiments import experiment
from palpate.experiments.rope import generalization as study
from palpate.experiments.rope import nominal
from palpate.experiments.rope.generalization import ROWS, Row
from palpate.experiments.rope.nominal import BASE, shipped_policy
from palpate.models.rope import Rope
from palpate.tasks.rope import RopeStabilization
from palpate.trials.rope.learned import LearnedController, ObservedController
from palpate.trials.rope.stabilization import Episodes, StabilizationTrial, summarise
from palpate.trials.trial import run_trials

TASK = RopeStabilization()
MODEL = Rope.uniform(BASE.length, BASE.mass, 11, driven=(0,), drive="velocity", substeps=4)
MODEL = MODEL.constrain()


def test_only_what_a_row_is_about_differs_from_the_nominal_rope():
    assert study._changes_of(ROWS["nominal"]) == {}
    assert study._changes_of(ROWS["long and heavy"]) == {"length": 1.25, "mass": 0.2}
    assert study._changes_of(ROWS["10 Hz"]) == {
        "observation_rate": 10.0,
        "observation_delay": 0.05,
    }
    assert study._changes_of(ROWS["pushed at rest"]) == {"pushed_at_s": study.SETTLED}
    weighted = ROWS["weighted"].base
    masses = weighted.body_masses()
    assert masses.sum() == pytest.approx(BASE.mass)
    assert masses[-1] / masses[0] == pytest.approx(3, rel=0.05)
    assert weighted.tip_mass == 0.04


def test_pushes_have_a_side_and_a_place_of_their_own_and_the_ropes_are_the_nominal_ones():
    pushed, plain = study._trials(ROWS["pushed at rest"], 5, 3), study._trials(Row(BASE), 5, 3)
    assert len(pushed) == 20
    pushes = [trial.configuration.disturbances[0] for trial in pushed]
    assert len({push.force for push in pushes}) == 20
    sizes = np.linalg.norm([push.force for push in pushes], axis=1)
    assert (sizes >= study.PUSH[0]).all()
    assert (sizes <= study.PUSH[1]).all()
    assert {push.time for push in pushes} == {study.SETTLED}
    for one, other in zip(pushed, plain, strict=True):
        assert dataclasses.replace(one.configuration, disturbances=()) == other.configuration
        assert (one.start, one.seed) == (other.start, other.seed)


def test_after_a_push_one_percent_is_of_what_it_gave():
    row = Row(BASE, pushed=0.3)
    energy = np.full((1, 401), 1e-6)
    energy[0, :20] = 1.0
    energy[0, 30:60] = np.linspace(0, 0.1, 30)
    energy[0, 60:110] = 2e-3  # less than 1 % of the start, not of what the push gave
    energy[0, 40] = 0.05
    episodes = Episodes(energy, np.zeros_like(energy), np.empty((0,)), {})
    trial = [StabilizationTrial(BASE, "straight", 0)]
    settled = summarise(trial, study._after_push(row, episodes))
    assert settled.time == pytest.approx(0.7)
    assert summarise(trial, episodes).time == pytest.approx(0.6)  # without a push


def test_a_rope_seen_ten_times_a_second_and_late_comes_to_rest():
    """With the policy as it is used otherwise it does not, in the same trials."""
    policy, _ = shipped_policy()
    rope = dataclasses.replace(ROWS["10 Hz"].base, length=0.8)
    trials = [StabilizationTrial(rope, start, 5) for start in ("straight", "half_circle")]
    observed = ObservedController(policy, TASK, MODEL, rope.observation_noise)
    left = {
        name: (episodes.energy[:, -1] / episodes.energy[:, 0]).max()
        for name, controller in (("own", observed), ("plain", LearnedController(policy, TASK)))
        if (episodes := run_trials(trials, controller, 200))
    }
    assert left["own"] < 0.02
    assert left["plain"] > 0.1


def test_every_row_is_tried_and_the_worst_counts(tmp_path, monkeypatch):
    rows = {"nominal": ROWS["nominal"], "weighted": ROWS["weighted"]}
    monkeypatch.setattr(study, "ROWS", rows)
    monkeypatch.setattr(nominal, "identified_rope", lambda *_: MODEL)
    monkeypatch.setattr(study, "write_trial_evidence", lambda *_: None)
    tried = []

    def evaluate_trials(controllers, trials, run):
        ((name, _),) = controllers.items()
        tried.append((name, len(trials), trials[0].configuration.tip_mass > 0))
        energy = np.ones((len(trials), 700))
        slow = 120 if trials[0].configuration.tip_mass > 0 else 100
        energy[:, slow:] = 0.0
        if name == study.PLAIN:
            energy[0] = 1.0
        return {name: Episodes(energy, np.zeros_like(energy), np.empty((0,)), {})}

    monkeypatch.setattr(experiment, "evaluate_trials", evaluate_trials)
    result = study.reproduce(tmp_path, quick=True, seed=1)
    assert tried == [
        (name, 4, weighted)
        for weighted in (False, True)
        for name in (study.CONTROLLED, study.PLAIN)
    ]
    figures = {figure.name: figure for figure in result.figures}
    assert figures["success_rate_worst"].value == 1.0
    assert figures["success_rate_worst"].rival == 0.75
    assert figures["time_ratio_worst"].value == pytest.approx(1.2, rel=0.02)
    assert figures["time_ratio_worst"].met is True
    assert figures["time_ratio.nominal"].value == 1.0
    assert result.seeds == [1, study.SEEDS + 1]
    tried.clear()
    study.reproduce(tmp_path, quick=True, seed=1)  # finished rows are only read
    assert len(tried) == 4


def test_a_row_in_which_nothing_settles_has_no_worst_ratio():
    assert study._worst([1.0, None]) is None
    assert study._worst([1.0, 1.2]) == 1.2
