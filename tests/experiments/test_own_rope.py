"""The NumPy rope against closed forms and conservation; mistakes in its recordings; the figures."""

import dataclasses
import math

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.experiments.experiment import Experiment
from palpate.experiments.rope import own_rope, spoilt
from palpate.experiments.rope.numpy_rope import NumpyRope, draw_rope, record_rope
from palpate.tasks.rope.stabilization import FIRST_ROOT
from palpate.worlds.rope.configuration import RopeConfiguration, in_step
from palpate.worlds.rope.rope import RopeWorld

FREE = {"joint_damping": 0.0, "air_viscosity": 0.0, "air_density": 0.0, "observation_noise": 0.0}


def rope(**constants) -> RopeConfiguration:
    return in_step(0.01, **{"bodies": 16, "markers": 9, **constants})


def test_a_hanging_rope_stays_at_rest_and_each_segment_bears_what_is_below():
    world = NumpyRope(rope(tip_mass=0.05, observation_noise=0.0))
    seen = world.reset(0)
    for _ in range(20):
        seen = world.step(np.zeros(3))
    truth = world.truth()
    assert np.abs(truth.velocities).max() < 1e-6
    assert truth.energy == pytest.approx(0.0, abs=1e-9)
    assert truth.positions[-1, 2] == pytest.approx(1.5 - 1.0 * (1 + 0.005), abs=2e-3)
    np.testing.assert_allclose(seen.markers, truth.positions[::2])


def test_nothing_is_lost_without_damping():
    world = NumpyRope(dataclasses.replace(rope(**FREE), bending_stiffness=1e-6))
    world.reset(0, start="straight")
    world._dashpot = 0.0
    energies = []
    for _ in range(150):
        world.step(np.zeros(3))
        energies.append(world.truth().energy)
    assert np.ptp(energies) < 0.02 * energies[0]


def test_a_small_swing_lasts_the_first_period_of_a_hanging_chain():
    world = NumpyRope(dataclasses.replace(rope(bodies=40, **FREE), bending_stiffness=1e-7))
    world.reset(0)
    world._velocity[:, 0] = 0.02 * np.arange(41) / 40  # about the shape of the first mode
    tip = []
    for _ in range(400):
        world.step(np.zeros(3))
        tip.append(world.truth().positions[-1, 0])
    signs = np.flatnonzero(np.diff(np.sign(tip)))
    period = 2 * 0.01 * float(np.mean(np.diff(signs)))
    expected = 2 * math.pi / (FIRST_ROOT * math.sqrt(9.81 / 1.005))
    assert period == pytest.approx(expected, rel=0.03)


def test_it_moves_as_the_mujoco_cable_of_its_constants_does():
    own = rope(bodies=32, markers=9, observation_noise=0.0)
    tips = []
    for kind in (NumpyRope, RopeWorld):
        world = kind(own)
        world.reset(3, start="half_circle")
        tips.append([world.step(np.array([0.3, 0.0, 0.1])).markers[-1] for _ in range(60)])
    # Stretching, the servo's lag and the air's law differ; only MuJoCo's pivot resists.
    assert np.abs(np.subtract(*tips)).max() < 0.08


def test_the_gripper_keeps_its_limits():
    world = NumpyRope(rope())
    world.reset(0)
    speeds = [0.0]
    for _ in range(40):
        seen = world.step(np.array([9.0, 0.0, 0.0]))
        speeds.append(float(np.linalg.norm(seen.gripper_velocity)))
    assert max(speeds) == pytest.approx(1.5, abs=0.01)
    assert np.max(np.diff(speeds)) <= 0.1 + 1e-9


@pytest.fixture(scope="module")
def recording():
    own = draw_rope(7, 9, 50.0)
    return own, record_rope(own, 7, 1, 4.0)


def test_a_recording_is_noisy_and_has_gaps(recording):
    _, made = recording
    seen = made.trials[0]["markers"].values
    assert seen.shape == (201, 9, 3)
    assert 0.01 < np.isnan(seen).mean() < 0.1
    assert made.trials[0]["markers"].nominal_period == pytest.approx(0.02)


@pytest.mark.parametrize("name", spoilt.KINDS)
def test_each_mistake_is_flagged_by_its_cause(recording, name, tmp_path, capsys):
    own, made = recording
    kind, file = spoilt.KINDS[name], tmp_path / "R.npz"
    bad = spoilt.spoil(made, kind, np.random.default_rng(0))
    spoilt.write_recording(file, bad)
    (said, *_) = spoilt.problems(file, kind.mass * own.mass)
    assert said.startswith(f"{kind.cause}:")


def test_what_is_missed_and_what_is_flagged_falsely_is_counted(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(spoilt, "draw_rope", lambda seed, markers, rate: rope(bodies=8, markers=9))
    monkeypatch.setattr(spoilt, "record_rope", lambda own, seed, *_: record_rope(own, seed, 1, 1.0))
    said = iter([[], ["rate: it is"], ["rate: it is"], ["unit"]])
    monkeypatch.setattr(spoilt, "problems", lambda *_: next(said))
    found = spoilt.check_recordings(Experiment("own-rope", tmp_path, True, 0), 2)
    rate, false = found.figures()
    assert (rate.value, false.value) == (0.5, 1)
    second = spoilt.FIRST + 1
    assert found.missed == [f"{second}, rate halved: unit"]
    assert found.false == [f"{second}: rate: it is"]


def test_the_headline_is_the_worst_rope_in_the_worse_world():
    rates = {
        ("mujoco", "controlled"): 39, ("own", "controlled"): 40, ("mujoco", "served"): 40,
        ("own", "served"): 38, ("mujoco", "swing damper"): 40, ("own", "swing damper"): 20,
    }  # fmt: skip
    times: dict[tuple[str, str], float | None] = {key: 1.0 for key in rates} | {
        ("own", "controlled"): 0.9
    }
    first = own_rope.Outcome(40, rates, times, True)
    second = dataclasses.replace(first, time=times | {("own", "swing damper"): 0.5}, ended=False)
    values = {figure.name: figure.value for figure in own_rope.figures([first, second])}
    assert values["at_rest_rate"] == pytest.approx(39 / 40)
    assert values["served_rate"] == pytest.approx(38 / 40)
    assert values["time_ratio_to_damper"] == pytest.approx(1.8)
    assert values["loops_ended_by_themselves"] == 0.5
    never = dataclasses.replace(first, time=times | {("own", "controlled"): None})
    (ratio,) = (f.value for f in own_rope.figures([never]) if f.name == "time_ratio_to_damper")
    assert ratio is None


def test_other_runs_are_not_written_over(tmp_path):
    experiment = Experiment("own-rope", tmp_path, True, 0)
    with experiment.stage("rope-0/tried", {"rope": 1}):
        pass
    with pytest.raises(PalpateError), experiment.stage("rope-0/tried", {"rope": 2}):
        pass
