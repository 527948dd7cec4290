"""Following paths with a small rope; identification and training are stood in for."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.experiments.rope import nominal
from palpate.experiments.rope import tracking as rope_tracking
from palpate.experiments.rope.nominal import Size
from palpate.experiments.rope.tracking import METHODS
from palpate.learning import Training
from palpate.models.rope import Rope
from palpate.networks import CommandPolicy
from palpate.report.evidence import read_evidence
from palpate.runs import Run
from palpate.runs.result import read_result
from palpate.runs.storage import write_json
from palpate.tasks.rope import RopeTracking
from palpate.tasks.rope.paths import CURVES
from palpate.tasks.rope.tracking import PREVIEW
from palpate.trials import trial as trial_module
from palpate.trials.rope.learned import LearnedController, RopeObserver
from palpate.trials.rope.planners import PlannedFollower, following_planner
from palpate.trials.rope.tracking import (
    Followed,
    PathTrial,
    blind_controllers,
    path_trials,
    summarise,
)
from palpate.trials.trial import evaluate_trials, table
from palpate.worlds.rope.rope import RopeConfiguration
from small_rope import SMALL, VELOCITY, commands, seen

BASE = RopeConfiguration(**SMALL)
FEATURES = 30 + 3 * len(PREVIEW)  # of six nodes
TINY = Size(
    2,
    (1, 1, 1),
    Training(iterations=8, width=4),
    1,
    {"recording": 1, "identification": 1, "training": 1, "evaluation": 1},
)


def brief(trials, steps: int):
    return [dataclasses.replace(trial, steps=steps) for trial in trials]


def untrained(seed: int = 0) -> CommandPolicy:
    seen = jnp.ones((2, FEATURES))
    key = jax.random.key(seed)
    return CommandPolicy.create(key, seen, VELOCITY, period=0.01, width=4)


def small_model() -> Rope:
    return Rope.uniform(1.0, 0.1, 6, drive="velocity", substeps=4, bend_stiffness=1e-4)


def test_trials_are_drawn_by_their_seed_and_begin_at_the_tip() -> None:
    trials = path_trials(BASE, 2, 5)
    assert [trial.name for trial in trials] == [name for name in CURVES for _ in range(2)]
    for trial in trials:
        tip = [0.0, 0.0, 1.5 - trial.configuration.length]
        np.testing.assert_allclose(trial.path[0], tip, atol=1e-9)
        assert 400 <= trial.steps <= 600
        assert len(trial.path) == trial.steps + 1 + 80
    again, other = path_trials(BASE, 2, 5), path_trials(BASE, 2, 6)
    np.testing.assert_array_equal(again[3].path, trials[3].path)
    assert other[3].steps != trials[3].steps
    assert trials[0].configuration == trials[2].configuration  # the same ropes


def test_a_file_is_a_path_too(tmp_path) -> None:
    rows = "\n".join(f"{t / 10},{t / 100},0,0" for t in range(21))
    (tmp_path / "mine.csv").write_text("time,x,y,z\n" + rows)
    (trial,) = path_trials(BASE, 1, 0, [str(tmp_path / "mine.csv")])
    assert (trial.name, trial.steps) == ("mine", 250)
    assert trial.path[250, 0] == pytest.approx(0.2)


def test_grippers_without_eyes_do_what_was_laid_down() -> None:
    trials = brief(path_trials(BASE, 1, 0, ["egg"]), 120)
    followed = evaluate_trials(blind_controllers(BASE), trials)
    mean = {name: summarise(trials, whole).mean for name, whole in followed.items()}
    assert mean["as a chain"] < mean["as the path"] < mean["held still"]
    assert mean["as a chain"] < 3.0
    assert any("as a chain" in line for line in table(trials, followed))


def test_a_planner_follows_better_than_not_looking() -> None:
    trials = brief(path_trials(BASE, 1, 0, ["egg"]), 120)
    planned = PlannedFollower(following_planner("mppi", small_model(), 48), 0)
    followers = {"planned": planned} | blind_controllers(BASE)
    followed = evaluate_trials(followers, trials)
    assert summarise(trials, followed["planned"]).mean < 4.0
    assert summarise(trials, followed["held still"]).mean > 5.0
    assert len(planned.spent) == 120


def test_the_learned_follower_sees_what_it_was_trained_on() -> None:
    """The features of a rope that hangs still, at the start and some periods later."""
    trial = path_trials(BASE, 1, 0, ["sine"])[0]
    down = np.linspace(0, 1, 11)[:, None] * [0.0, 0.0, -trial.configuration.length]
    hanging = seen((down + np.array([0, 0, 1.5]))[None], np.array([[0.0, 0.0, 1.5]]))
    noted = []

    class Noting(RopeTracking):
        def features(self, state, goal):
            features = super().features(state, goal)
            jax.debug.callback(lambda values: noted.append(np.asarray(values)[0]), features)
            return features

    follower = LearnedController(untrained(), Noting())
    for command in commands(follower, [hanging] * 4, PathTrial.goals([trial])):
        assert command.shape == (1, 3)
    jax.effects_barrier()
    np.testing.assert_allclose(noted[0][:15].reshape(5, 3), down[2::2], atol=1e-6)
    np.testing.assert_allclose(noted[0][15:30], 0, atol=1e-4)
    steps = np.round(np.array(PREVIEW) / 0.01).astype(int)
    for step, features in enumerate(noted):
        ahead = features[30:].reshape(-1, 3)
        np.testing.assert_allclose(ahead, trial.path[step + steps] - [0, 0, 1.5], atol=1e-5)


def test_the_observer_finds_velocities_and_takes_the_encoders_word() -> None:
    observer = RopeObserver(5, 0.01)
    markers = np.zeros((2, 11, 3))
    for step in range(8):
        shown = seen(markers + 0.005 * step, np.full((2, 3), 7.0 + 0.005 * step))
        if step == 0:
            window = observer.start(shown)
        window, state = observer.update(window, shown)
    np.testing.assert_allclose(state.velocity[:, 1:], 0.5, rtol=1e-3)
    np.testing.assert_allclose(state.position[:, 0], 7.035, rtol=1e-6)
    with pytest.raises(PalpateError, match="6 nodes need at least as many markers, not 4"):
        observer.start(seen(np.zeros((2, 4, 3)), np.zeros((2, 3))))


def test_errors_are_distances_in_time_and_divergence_counts() -> None:
    trials = brief(path_trials(BASE, 1, 0), 20)
    tips = np.full((3, 21, 3), np.nan)
    for index, trial in enumerate(trials):
        tips[index] = trial.path[:21] + np.array([0.03, 0, 0.04])
    followed = Followed(tips, np.zeros((3, 21, 11, 3)), {})
    summary = summarise(trials, followed)
    assert summary.mean == pytest.approx(5.0)
    assert summary.rms == pytest.approx(5.0)
    assert summary.worst == pytest.approx(5.0)
    lost = summarise(trials, dataclasses.replace(followed, failures={1: "diverged"}))
    assert (lost.mean, lost.diverged) == (None, 1)
    part = dataclasses.replace(followed, failures={1: "d"}).part([0, 2])
    assert summarise([trials[0], trials[2]], part).mean > 4


def test_trials_that_were_cut_off_go_on(tmp_path, monkeypatch) -> None:
    trials = brief(path_trials(BASE, 2, 0, ["egg", "sine"]), 10)
    monkeypatch.setattr(PathTrial, "side_by_side", 2)
    followers = {"still": blind_controllers(BASE)["held still"]}
    whole = evaluate_trials(followers, trials)["still"]
    calls = []
    run_trials = trial_module.run_trials

    def cut_off(*arguments):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return run_trials(*arguments)

    monkeypatch.setattr(trial_module, "run_trials", cut_off)
    with Run.open(tmp_path, {}) as run, pytest.raises(KeyboardInterrupt):
        evaluate_trials(followers, trials, run)
    with Run.open(tmp_path, {}) as run:
        resumed = evaluate_trials(followers, trials, run)["still"]
    assert len(calls) == 3
    np.testing.assert_array_equal(resumed.tips, whole.tips)
    np.testing.assert_array_equal(resumed.markers, whole.markers)


def test_stages_hand_on_what_they_made(tmp_path, monkeypatch) -> None:
    made = []

    def train(task, model, training, seed, run):
        made.append((task, training))
        return untrained(seed)

    monkeypatch.setattr(nominal, "BASE", BASE)
    monkeypatch.setattr(nominal, "NODES", 6)
    monkeypatch.setattr(nominal, "RECORDED_DURATION", 0.2)
    monkeypatch.setattr(nominal, "identify", lambda start, *_: start)
    monkeypatch.setattr("palpate.commands.train.train", train)
    monkeypatch.setattr(rope_tracking, "SMALL", TINY)
    monkeypatch.setattr(rope_tracking, "METHODS", dict.fromkeys(METHODS, lambda *_: (8, 0.001)))
    monkeypatch.setattr(rope_tracking, "UNHURRIED", (8, 2))
    monkeypatch.setattr(
        rope_tracking, "path_trials", lambda *arguments: brief(path_trials(*arguments), 4)
    )
    result = rope_tracking.reproduce(tmp_path, quick=True, seed=3)
    ((task, training),) = made
    assert isinstance(task, RopeTracking)
    assert training == TINY.training
    assert {row.name: row.bar for row in result.figures if row.bar is not None} == {
        "mean_tip_error_cm": 3.0,
        "ratio_to_mppi_10ms": 1.0,
    }
    names = {row.name for row in result.figures}
    assert {"mean_tip_error_cm.held_still", "ratio_to_mppi_unhurried", "ratio_to_chain"} <= names
    assert {"mean_tip_error_cm.egg", "decision_ms_p99.mppi_10_ms"} <= names
    write_json(tmp_path / "result.json", result.to_dict())
    read_result(tmp_path / "result.json")
    evidence = read_evidence(tmp_path / "evaluate")
    assert [motion.group for motion in evidence.motions] == list(CURVES)
    assert (tmp_path / "evaluate" / "tracking.png").read_bytes().startswith(b"\x89PNG")
    again = rope_tracking.reproduce(tmp_path, quick=True, seed=3)
    assert len(made) == 1
    assert again.figures == result.figures


def test_open_loop_velocities_lead_where_they_should() -> None:
    (trial,) = path_trials(BASE, 1, 0, ["egg"])
    shown = seen(np.zeros((1, 11, 3)), np.zeros((1, 3)))
    follower = blind_controllers(BASE)["as the path"]
    moved = sum(0.01 * one for one in commands(follower, [shown] * 50, PathTrial.goals([trial])))
    np.testing.assert_allclose(moved[0], trial.path[50] - trial.path[0], atol=1e-12)
