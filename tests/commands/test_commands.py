"""What commands do: the same code for a pendulum, a cart and a rope, in folders that resume."""

import dataclasses
import sys
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

from palpate.cli import main
from palpate.commands import demo, folders, identify, reproduce, train
from palpate.commands.identification.data import read
from palpate.commands.identification.fit import FitReport
from palpate.commands.options import Reproduce
from palpate.errors import PalpateError
from palpate.families.options import Identify, Train
from palpate.families.rope.demo import PICTURE, DemoRope, Size
from palpate.families.rope.options import IdentifyRope, RecordRope
from palpate.identification.data.prediction import PredictionError
from palpate.identification.data.segments import known_start
from palpate.identification.declarations import with_declarations
from palpate.models.files import load_model
from palpate.models.model import rollout
from palpate.networks import load_policy
from palpate.parameters import describe
from palpate.recordings import Channel, Driven, Recording, Role, Trial
from palpate.recordings.files import read_recording, write_recording
from palpate.report import read_evidence
from palpate.runs import Figure, Result, Run
from palpate.runs.result import read_result
from palpate.runs.run import read_metrics
from palpate.runs.storage import read_json, write_json
from palpate.trials.rope import stabilization
from palpate.worlds.rope.rope import RopeWorld
from toys import Cart, CartToOrigin, Pendulum, PendulumDamping, TwoPoints

TRUTH = {"cart": Cart(mass=2.0, friction=0.3), "pendulum": Pendulum(length=0.7, damping=0.4)}
START = {"cart": Cart(mass=1.0, friction=0.5), "pendulum": Pendulum(length=1.0, damping=0.2)}
TOY_TASKS = {"cart": CartToOrigin, "pendulum": PendulumDamping}
UNIT = {"cart": "m", "pendulum": "rad"}
LASTS = {"cart": "4", "pendulum": "1.6"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class IdentifyToy(Identify):
    """As a family's file would say it."""

    observation: ClassVar[str] = "sensor"
    family: str = "cart"

    def prepare(self, recording):
        return recording

    def action(self, recording):
        return "motor"

    def reference(self, recordings, aligned):
        return START[self.family]


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainToy(Train):
    """As a task's file would say it."""

    task: str = "cart-to-origin"

    def prepare(self, model):
        return model


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch, toys):
    monkeypatch.chdir(tmp_path)


def recorded(name, path, trials=5, steps=80, hidden=0):
    """A file with trials of the true toy under random pushes, seen with a little noise.

    The last `hidden` frames show nothing.
    """
    model, rng = TRUTH[name], np.random.default_rng(0)
    actions = np.repeat(rng.normal(size=(trials, steps // 10, 1)), 10, axis=1)
    start = model.initial_state(jnp.zeros((trials, 1, 1)))
    states = rollout(model, start, jnp.asarray(actions, jnp.float32))
    seen = np.concatenate([np.zeros((trials, 1, 1)), model.observe(states)], axis=1)
    seen += 1e-4 * rng.normal(size=seen.shape)
    seen[:, len(seen[0]) - hidden :] = np.nan
    time = model.control_period * np.arange(steps + 1)
    write_recording(
        path,
        Recording(
            tuple(
                Trial(
                    f"push {i}",
                    {
                        "sensor": Channel("sensor", Role.OBSERVATION, time, seen[i], UNIT[name]),
                        "motor": Channel("motor", Role.COMMAND, time[:-1], actions[i], "N"),
                    },
                )
                for i in range(trials)
            ),
            {},
        ),
    )
    return path


# --- every family goes through the same code ---------------------------------------------------


def test_a_toy_is_identified_trained_for_and_reported(tmp_path, capsys):
    name = "cart"
    recording = recorded(name, tmp_path / "toy.npz")
    folder = identify.run(
        IdentifyToy(recordings=(recording,), family=name, iterations=(20, 20, 80))
    )
    assert folder.name == f"identify-{name}-001"
    said = capsys.readouterr().out
    assert "90 % interval" in said
    assert f"predicts 1 trial of {LASTS[name]} s, which it was not fitted to" in said
    model, about = load_model(folder / folders.MODEL)
    result = read_result(folder / "result.json")
    unit = {"cart": "cm", "pendulum": "rad"}[name]
    assert [figure.name for figure in result.figures] == [
        f"l1_{unit}",
        f"rmse_at_end_{unit}",
        f"l1_fitted_trials_{unit}",
        "wall_time_s",
    ]
    assert about["figures"][f"l1_{unit}"] == result.figures[0].value
    assert len(result.split["fitted"]) == 4
    (held_out,) = result.split["validation"]
    assert held_out not in result.split["fitted"]
    for row in result.parameters:
        true = float(getattr(TRUTH[name], row["name"]))
        assert np.isclose(row["value"], true, rtol=0.15), row
        assert row["lower"] < row["value"] < row["upper"]
        assert row["value"] == pytest.approx(float(getattr(model, row["name"])))
    shown = read_evidence(folder)
    assert set(shown.horizon.values) == {"identified", "start model"}
    assert shown.horizon.values["identified"][-1] < shown.horizon.values["start model"][-1]
    assert not shown.motions  # a number is no chain of points
    page = (folder / folders.REPORT).read_text()
    assert f"RMSE ({UNIT[name]})" in page
    assert f" {UNIT[name]} after {LASTS[name][:-1]}" in page

    trained = train.run(
        TrainToy(model=folder, task=TOY_TASKS[name].name, iterations=30, batch=8, starts=64)
    )
    policy, manifest = load_policy(trained / folders.POLICY)
    assert manifest["task"] == TOY_TASKS[name].name
    assert manifest["training"]["iterations"] == 30
    assert policy.period == model.control_period
    figures = {figure.name: figure for figure in read_result(trained / "result.json").figures}
    assert 0.0 <= figures["in_model.success"].value <= 1.0
    units = {name: figure.unit for name, figure in figures.items()}
    distance = {"in_model.distance": "m"} if name == "cart" else {}
    assert units == {"in_model.success": "", **distance}
    task = "" if name == "cart" else " --task pendulum-damping"
    assert manifest["command"] == (
        f"palpate train {TOY_TASKS[name].name} --seed 0{task} --model {folder} --iterations 30 "
        "--batch 8 --starts 64"
    )
    assert len(read_evidence(trained).metrics) == 30
    assert (trained / folders.REPORT).exists()


def test_the_only_trial_is_fitted_and_said_to_be(tmp_path, capsys):
    recording = recorded("cart", tmp_path / "toy.npz", trials=1)
    folder = identify.run(IdentifyToy(recordings=(recording,), iterations=(1, 1, 1)))
    assert "1 trial of 4 s, which it was fitted to" in capsys.readouterr().out
    assert "none" in read_json(folder / "result.json")["split"]["validation"]


def test_the_error_at_the_end_is_the_last_that_was_seen(tmp_path):
    recording = recorded("cart", tmp_path / "toy.npz", hidden=10)
    folder = identify.run(IdentifyToy(recordings=(recording,), iterations=(1, 1, 1)))
    result = read_json(folder / "result.json")
    curve = read_evidence(folder).horizon.values["identified"]
    assert np.isnan(curve[-10:]).all()
    assert result["settings"]["end_s"] == pytest.approx(69 * 0.05)
    (end,) = (f["value"] for f in result["figures"] if f["name"] == "rmse_at_end_cm")
    assert end == pytest.approx(100 * curve[68], rel=1e-5)
    assert end > 0.1
    assert "NaN" not in (folder / "result.json").read_text()


def test_a_chain_that_is_not_seen_for_a_while_leaves_a_gap(tmp_path):
    seen = np.ones((4, 6, 2, 3), bool)
    seen[:, 2] = seen[1:, 3] = seen[:, 4, 1] = False
    prediction, target = np.full(seen.shape, 0.1), np.zeros(seen.shape)
    target[0] = 7.0  # the median of those trials that were scored
    start = target[:, 0], target[:, 0], target[:, :, 0, :1]
    segments = known_start(*map(jnp.asarray, (*start, target, seen)))
    by_trial, time = np.array([2.0, 1.0, np.nan, np.nan]), 0.1 * np.arange(1, 7)
    error = PredictionError(0.1, by_trial, time, np.ones(6), prediction, segments, np.ones(6))
    file = recorded("cart", tmp_path / "cart.npz", trials=1)
    data = read(IdentifyToy(recordings=(file,)))
    metres, newtons = (
        FitReport(
            TwoPoints(1.0, 0.5, units=(unit,) * 3),
            *(error, error, error, error, dataclasses.replace(data, unit=unit), None),
        ).evidence()
        for unit in ("m", "N")
    )
    for edge in ("low", "high"):
        assert np.flatnonzero(np.isnan(metres[f"horizon.identified.{edge}"])).tolist() == [2]
    np.testing.assert_allclose(metres["horizon.identified.low"][3], 6.9 * np.sqrt(3), rtol=1e-5)
    np.testing.assert_allclose(metres["motion.observed"][0], 7.0)
    assert np.isnan(metres["motion.observed"][2]).all()
    assert not any(name.startswith("motion") for name in newtons)  # no places, whatever the shape


def test_validation_is_scored_as_recorded_and_not_fitted(tmp_path):
    options = IdentifyToy(
        recordings=(recorded("cart", tmp_path / "a.npz", trials=2),),
        validate=(recorded("cart", tmp_path / "b.npz", trials=3),),
    )
    data = read(options)
    assert len(data.fitted.trials) == 2
    assert len(data.validation.trials) == 3
    both = read(dataclasses.replace(options, validate=(), recordings=options.validate * 2))
    assert {trial.name for trial in both.fitted.trials}.isdisjoint(
        trial.name for trial in both.validation.trials
    )
    assert len(both.fitted.trials) + len(both.validation.trials) == 6


def test_what_was_put_right_is_said_of_every_recording(tmp_path, capsys):
    def marked(name, hidden, left_out):
        time, values = 0.01 * np.arange(30), np.zeros((30, 3, 3))
        values[..., 0] = 0.1 * np.sin(20 * time)[:, None]
        values[..., 2] = -0.1 * np.arange(3)
        values[hidden, 0] = np.nan
        notes = (f"{left_out} unlabelled markers were left out",)
        markers = Channel("markers", Role.OBSERVATION, time, values, "m", notes=notes)
        write_recording(tmp_path / name, Recording((Trial("one", {"markers": markers}),), {}))
        return tmp_path / name

    fitted, validation = marked("a.npz", [7], 4), marked("b.npz", [11, 12], 5)
    options = IdentifyRope(recordings=(fitted,), validate=(validation,))
    read(options)
    unseen = "unseen positions of driven markers were interpolated"
    assert capsys.readouterr().out.splitlines() == [
        "note: trial 'one', markers: 4 unlabelled markers were left out",
        f"note: trial 'one', grip: 1 {unseen}",
        "note: validation, trial 'one', markers: 5 unlabelled markers were left out",
        f"note: validation, trial 'one', grip: 2 {unseen}",
    ]
    read(dataclasses.replace(options, nodes=3, validate=()))
    assert capsys.readouterr().out.splitlines()[1] == f"note: trial 'one', grip: 1 {unseen}"


def test_parameters_are_freed_fixed_and_shared_by_name():
    cart = with_declarations(START["cart"], (), ("mass",), ("friction",))
    rows = {row["name"]: row for row in describe(cart)}
    assert rows["mass"]["fixed"]
    assert rows["friction"]["shared"]
    with pytest.raises(PalpateError, match=r"unknown parameter 'mas'; did you mean 'mass'\?"):
        with_declarations(cart, ("mas",), (), ())
    with pytest.raises(PalpateError, match="'mass' cannot be fixed and identified"):
        with_declarations(cart, (), ("mass",), ("mass",))


# --- recording --------------------------------------------------------------------------------

SHORT = ["--trials", "2", "--duration", "0.5", "--markers", "5"]


def test_a_recording_holds_what_the_world_shows_and_how_it_was_made(tmp_path, capsys):
    assert main(["record", "rope", "--out", "R.npz", "--seed", "3", *SHORT]) == 0
    assert capsys.readouterr().out == "recording: R.npz (2 trials of 0.5 s)\n"
    recording = read_recording("R.npz")
    roles = {name: channel.role for name, channel in recording.trials[0].channels.items()}
    assert roles == {
        "markers": Role.OBSERVATION,
        "gripper": Role.DRIVEN,
        "force": Role.OBSERVATION,
        "command": Role.COMMAND,
    }
    assert recording.trials[0]["force"].values.shape == (51, 1, 3)
    assert recording.trials[0]["markers"].values.shape == (51, 5, 3)
    assert recording.trials[0]["gripper"].values.shape == (51, 1, 3)
    assert recording.provenance["seed"] == 3
    assert recording.provenance["markers"] == 5
    assert recording.fact("gripper", Driven) == Driven("markers", (0,))
    result = read_result(tmp_path / "runs" / "record-rope-001" / "result.json")
    assert result.seeds == [3]
    # the same again is no harm; another one is not written over it
    assert main(["record", "rope", "--out", "R.npz", "--seed", "3", *SHORT]) == 0
    assert "it was there already" in capsys.readouterr().out
    assert main(["record", "rope", "--out", "R.npz", "--seed", "4", *SHORT]) == 2
    assert "R.npz holds another recording: give another --out" in capsys.readouterr().err
    assert main(["record", "rope", "--out", "R.npz", "--seed", "4", "--fresh", *SHORT]) == 0
    assert read_recording("R.npz").provenance["seed"] == 4


def test_two_seeds_make_two_recordings():
    for seed in ("0", "1", "0"):
        main(["record", "rope", "--seed", seed, "--fresh", *SHORT])
    first, other, same = (
        read_recording(f"runs/record-rope-00{i}/recording.npz").trials[0]["markers"].values
        for i in (1, 2, 3)
    )
    assert np.array_equal(first, same)
    assert not np.allclose(first, other)


# --- reproduce and report ---------------------------------------------------------------------


class Experiment:
    """Stands in for the module of an experiment."""

    def __init__(self):
        self.given = None

    def reproduce(self, out, *, quick, seed, mocap=None):
        self.given = {"out": out, "quick": quick, "seed": seed, "mocap": mocap}
        with Run.open(out / "stage", {"seed": seed}) as run:
            if not run.finished:
                run.finish({"wall_time_s": 1.0})
        figures = [Figure("error", 0.2, "m", bar=0.3), Figure("rate", 0.5, "")]
        return Result("rope-model", figures, {}, [seed], None, 1.0)


@pytest.fixture
def experiment(monkeypatch):
    experiment = Experiment()
    monkeypatch.setitem(sys.modules, "palpate.experiments.rope.model", experiment)
    return experiment


def test_reproduce_writes_the_result_and_prints_a_line_for_each_figure(
    experiment, tmp_path, capsys, monkeypatch
):
    given = ["reproduce", "rope-model", "--out", "here", "--seed", "5", "--mocap", "m"]
    monkeypatch.setattr(sys, "argv", ["palpate", *given])  # what the run's environment tells
    assert main(given) == 0
    assert experiment.given["seed"] == 5
    assert str(experiment.given["mocap"]) == "m"
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("error | 0.2 m | bar <= 0.3 | met")
    assert lines[1].startswith("rate ")
    assert read_result(tmp_path / "here" / "result.json").figures[0].met
    assert (tmp_path / "here" / "report.html").exists()
    # another seed in the same folder is another run, until it is started over
    assert main(["reproduce", "rope-model", "--out", "here", "--seed", "6"]) == 2
    assert "seed was 5, now 6" in capsys.readouterr().err
    assert main(["reproduce", "rope-model", "--out", "here", "--seed", "6", "--fresh"]) == 0


def test_a_quick_run_is_held_against_the_kept_one(experiment, tmp_path, monkeypatch, capsys):
    def kept(*figures, seeds=(0,)):
        return Result("rope-model", list(figures), {}, list(seeds), None, 1.0)

    run = experiment.reproduce(tmp_path, quick=True, seed=0)
    same = [Figure("error", 0.20001, "m"), Figure("rate", 0.5, "")]
    assert reproduce.compare(run, kept(*same)) == [
        "error: as kept",
        "rate: as kept",
        "2 of 2 figures as kept; times are not compared",
    ]
    others = Figure("error", 0.16, "m"), Figure("gone", 1.0, ""), Figure("real.wall_time_s", 9, "s")
    assert reproduce.compare(run, kept(*others)) == [
        "error: 0.2, kept 0.16 (+25 %)",
        "rate: only in this run",
        "gone: only in the kept run",
        "0 of 3 figures as kept; times are not compared",
    ]
    assert reproduce.compare(run, kept(Figure("error", None, "m")))[0] == "error: 0.2, kept none"
    assert "has the seed 1" in reproduce.compare(run, kept(*same, seeds=[1]))[0]
    monkeypatch.setattr(reproduce, "KEPT", tmp_path)
    write_json(tmp_path / "rope-model.json", kept(*same).to_dict())
    reproduce.run(Reproduce(out=tmp_path / "out", quick=True), "rope-model")
    assert "2 of 2 figures as kept" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "clock"),
    [
        ("real.wall_time_s", True),
        ("100.planning_s", True),
        ("planning_s_at_100", True),
        ("decision_ms_p99.cem_10_ms", True),
        ("ess_per_s_over_adapted", True),
        ("mean_tip_error_cm.mppi_10_ms", False),
        ("time_to_1pct_s", False),
        ("ours.time", False),
    ],
)
def test_times_of_a_clock_are_told_from_those_of_a_simulation(name, clock):
    assert bool(reproduce.CLOCK.search(name)) == clock


def test_report_tells_the_runs_below_a_folder(experiment, tmp_path, capsys):
    reproduce.run(Reproduce(out=tmp_path / "here"), "rope-model")
    assert main(["report", "here", "--out", "page.html", "--title", "A <page>"]) == 0
    assert capsys.readouterr().out.endswith("report: page.html\n")
    assert "A &lt;page&gt;" in (tmp_path / "page.html").read_text()


# --- interruption -----------------------------------------------------------------------------


def test_ctrl_c_says_how_to_go_on_and_the_same_command_does(tmp_path, monkeypatch, capsys):
    def interrupted(options):
        raise KeyboardInterrupt

    words = ["record", "rope", "--seed", "7", *SHORT]
    with monkeypatch.context() as patched:
        patched.setattr(RecordRope, "record", interrupted)
        assert main(words) == 130
    assert capsys.readouterr().err.splitlines()[-1] == (
        "palpate: interrupted; `palpate record rope --seed 7 --trials 2 --duration 0.5 "
        "--markers 5` goes on where it stopped"
    )
    assert main(words) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert (folder / "result.json").exists()


def test_a_stopped_identification_goes_on_to_the_same_result(tmp_path, monkeypatch):
    recording = recorded("cart", tmp_path / "toy.npz")
    options = IdentifyToy(recordings=(recording,), iterations=(4, 4, 4))
    whole = identify.run(dataclasses.replace(options, out=tmp_path / "whole"))
    log = Run.log

    def stopped(run, step, /, **metrics):
        log(run, step, **metrics)
        if step == 6:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Run, "log", stopped)
        with pytest.raises(KeyboardInterrupt):
            identify.run(options)
    resumed = identify.run(options)
    assert resumed.name == "identify-cart-001"
    losses = [[line["loss"] for line in read_metrics(run)] for run in (whole, resumed)]
    assert losses[0] == losses[1]
    assert (
        read_json(whole / folders.MODEL)["parameters"]
        == (read_json(resumed / folders.MODEL)["parameters"])
    )


# --- the rope, once, through everything --------------------------------------------------------


def test_a_rope_goes_from_recording_to_report(
    tmp_path, monkeypatch, capsys, short_tuning, one_horizon
):
    def blind(world, width, height):
        raise PalpateError("no OpenGL here; install libegl1")

    monkeypatch.setattr(stabilization, "TRIAL_PERIODS", 0.3)
    monkeypatch.setattr(RopeWorld, "render", blind)
    tiny = Size(
        trials=2, duration=0.6, identification=(1,), training=1, batch=2, starts=32, ropes=1
    )
    tiny = dataclasses.replace(tiny, nodes=6)
    monkeypatch.setattr(DemoRope, "size", tiny)
    folder = demo.run(DemoRope(out=tmp_path / "demo"))
    said = capsys.readouterr().out
    assert "demo: about" in said.splitlines()[0]
    assert said.splitlines()[-1] == f"report: {folder / folders.REPORT}"
    assert "m per metre of rope" in said
    assert (folder / PICTURE).read_bytes().startswith(b"\x89PNG")
    figures = {figure.name: figure.value for figure in read_result(folder / "result.json").figures}
    assert 0.0 < figures["tip_rmse_per_length"] < 0.2
    assert "note: the rope is drawn, not rendered: no OpenGL here; install libegl1\n" in said
    page = (folder / folders.REPORT).read_text()
    assert "the rope is drawn, not rendered" in page
    assert all(name in page for name in ("identify-rope", "held still", "bend stiffness"))
    model, _ = load_model(folder / "identify" / folders.MODEL)
    assert model.nodes == 6
    assert model.driven == (0,)

    policy, model = str(folder / "train"), str(folder / "identify")
    evaluate = ["evaluate", "rope-stabilization", "--ropes", "1", "--out", "again"]
    assert main([*evaluate, "--policy", policy, "--model", model]) == 0
    result = read_result(tmp_path / "again" / "result.json")
    names = {figure.name for figure in result.figures}
    assert {"success_rate", "success_rate.held_still", "in_model.success"} <= names
    assert "in_model.final_speed m/s" in {f"{f.name} {f.unit}" for f in result.figures}
    assert main([*evaluate, "--policy", policy]) == 2
    assert "model was" in capsys.readouterr().err
    # nothing that is finished is done again, and the time it took stays what it was
    before = (folder / "train" / "result.json").stat().st_mtime_ns
    took = read_result(folder / "result.json").wall_time_s
    demo.run(DemoRope(out=tmp_path / "demo"))
    assert read_result(folder / "result.json").wall_time_s == took
    assert (folder / "train" / "result.json").stat().st_mtime_ns == before
