"""The MuJoCo rope that stands for an identified one swings as its model does."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from deployed import rope_policy
from palpate.errors import PalpateError
from palpate.families.rope.control_options import EvaluateRopeStabilization, TrainRopeStabilization
from palpate.families.rope.counterpart import (
    SEEN_MARKERS,
    counterpart,
    describe_rope,
    rope_for,
    with_constants,
    with_markers,
)
from palpate.families.rope.deployment import RopeDeployment
from palpate.families.rope.options import ALONG, IdentifyRope
from palpate.families.rope.recording import constants, record_rope
from palpate.families.rope.robot import with_servo
from palpate.models.model import rollout
from palpate.models.rope import Rope, RopeState
from palpate.parameters import describe
from palpate.tasks.rope import RopeStabilization
from palpate.trials.rope import stabilization
from palpate.trials.rope.learned import LearnedController
from palpate.trials.rope.stabilization import StabilizationTrial
from palpate.trials.trial import run_trials
from palpate.worlds.rope.rope import RopeConfiguration, RopeWorld
from small_rope import MINE

TILT = 0.1  # rad, of a small swing
OWN: dict = {"length": 0.73, "mass": 0.055, "nodes": 12, "control_period": 1 / 60, "substeps": 17}


def own_rope(**fields) -> Rope:
    return Rope.uniform(drive="velocity", **{**OWN, **fields})


def swing(time: np.ndarray, tip: np.ndarray) -> tuple[float, float]:
    """Period in s and decay rate in 1/s of a damped sinusoid."""

    def off(p):
        return p[0] * np.exp(-p[1] * time) * np.cos(p[2] * time + p[3]) - tip

    fits = [least_squares(off, [tip[0], 0.2, omega, 0.0]) for omega in (4.0, 5.0)]
    _, decay, omega, _ = min(fits, key=lambda fit: fit.cost).x
    return 2 * np.pi / omega, decay


def swung(model: Rope, steps: int = 240):
    """(period, decay) of a straight start, in the model and in its counterpart."""
    direction = np.array([np.sin(TILT), 0.0, -np.cos(TILT)])
    depth = np.append(0.0, np.cumsum(model.rest_length))
    position = jnp.asarray(depth[:, None] * direction, jnp.float32)
    start = RopeState(position, jnp.zeros_like(position))
    states = jax.jit(rollout)(model, start, jnp.zeros((steps, 1, 3)))
    world = RopeWorld(counterpart(model, observation_noise=0.0))
    world.reset(0, start=np.stack([np.zeros(3), direction]), azimuth=0.0)
    tips = [world.step(np.zeros(3)).markers[-1, 0] for _ in range(steps)]
    time = np.arange(1, steps + 1) * model.control_period
    return swing(time, np.asarray(states.position)[:, -1, 0]), swing(time, np.array(tips))


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"air_drag": 3e-3, "quadratic_drag": 1e-6, "bend_damping": 1e-5, "grip_damping": 1e-6},
        {"air_drag": 1e-5, "quadratic_drag": 3e-2, "bend_damping": 1e-5, "grip_damping": 1e-6},
    ],
    ids=["as the priors expect", "linear drag", "quadratic drag"],
)
def test_a_small_free_swing_has_the_period_and_the_decay_of_the_model(fields):
    (period, decay), (own_period, own_decay) = swung(own_rope(**fields))
    assert own_period == pytest.approx(period, rel=0.01)
    assert own_decay == pytest.approx(decay, rel=0.1)
    assert decay > 0.02  # there is something to agree on


def test_uneven_markers_and_masses_are_where_the_model_has_them():
    lengths = np.array([0.1, 0.2, 0.13, 0.3])
    model = Rope.from_rest_lengths(lengths, 0.055)
    heavy = eqx.tree_at(lambda rope: rope.node_mass, model, model.node_mass.at[-1].mul(3.0))
    found = counterpart(heavy, 2e-3)
    assert found.length == pytest.approx(0.73, rel=0.01)  # and what it stretches
    places = np.append(0.0, np.cumsum(lengths)) / 0.73
    assert found.marker_places == pytest.approx(places, abs=2e-3)
    assert found.mass == pytest.approx(float(heavy.node_mass.sum()))
    masses = found.body_masses()
    assert 2.5 < masses[-1] / masses[0] < 3
    assert found.observation_noise == 2e-3
    assert counterpart(own_rope(), 0.0).mass_distribution == "uniform"


def test_bending_is_that_of_a_beam_whatever_its_bodies_are():
    model = own_rope(bend_stiffness=8e-3, bend_damping=2e-4)
    found, segment = counterpart(model, 0.0), OWN["length"] / (OWN["nodes"] - 1)
    assert found.bending_stiffness == pytest.approx(8e-3 * segment, rel=1e-3)
    beam = found.joint_damping * found.length / found.bodies
    assert beam == pytest.approx(2e-4 * segment, rel=1e-2)
    assert found.grip_damping == pytest.approx(float(model.grip_damping))


def test_a_rope_held_at_both_ends_has_no_counterpart():
    with pytest.raises(PalpateError, match=r"driven at \(0, 11\) has no MuJoCo rope"):
        counterpart(own_rope(driven=(0, 11)), 0.0)


def manifest(model: Rope, recordings=None) -> dict:
    """As `palpate train` writes it, shortened."""
    told = {} if recordings is None else {"recordings": recordings}
    return {"model": describe(model), "training": {"observation_noise": 2e-3}, **told}


def test_which_rope_a_policy_is_tried_in():
    foreign = {"file": "own.npz", "format": "positions"}
    policy = rope_policy(12, period=1 / 60)
    rope, whose = rope_for(policy, manifest(own_rope(), foreign))
    assert whose == "that of the model it was trained on"
    assert rope == counterpart(own_rope(), 2e-3)
    assert describe_rope(rope).startswith("0.73")
    assert describe_rope(rope).endswith("12 markers at 60 Hz")
    other = own_rope(length=0.5)
    assert rope_for(policy, manifest(own_rope(), foreign), other) == (
        counterpart(other, 2e-3),
        "that of the model",
    )
    # Files from before, and those that ship, do not say what was recorded.
    assert rope_for(rope_policy(11), manifest(own_rope(nodes=11)))[0] == RopeConfiguration()
    assert rope_for(policy, manifest(own_rope()))[0] == counterpart(own_rope(), 2e-3)
    assert rope_for(policy, {})[0] == RopeConfiguration()


def test_a_rope_that_palpate_recorded_is_that_rope_again():
    recorded = RopeConfiguration(length=0.8, bodies=10, markers=11)
    provenance = dict(record_rope(recorded, [0], 0.1).provenance)
    model, policy = own_rope(nodes=11, control_period=0.01), rope_policy(11)
    assert rope_for(policy, manifest(model, provenance)) == (recorded, "the one that was recorded")
    several = provenance | {"world.length": "0.8; 0.9"}
    assert rope_for(policy, manifest(model, several))[1] == "that of the model it was trained on"


def test_the_cable_of_a_file_is_seen_as_ones_own_rope_is(tmp_path):
    (tmp_path / "mine.xml").write_text(MINE)
    options = EvaluateRopeStabilization(
        policy=tmp_path, world=tmp_path / "mine.xml", mass=0.09, seed=0
    )
    own = manifest(own_rope(), {"file": "own.npz"})
    base, said = options.base(rope_policy(12, period=1 / 60), own, None)
    assert (base.bodies, base.markers, base.mass) == (30, 12, 0.09)
    assert (base.length, base.control_period) == pytest.approx((0.8, 1 / 60))
    assert base.observation_noise == 2e-3
    assert said.startswith("tried in MuJoCo ropes drawn around the cable of ")
    assert options.inputs() == {"world": tmp_path / "mine.xml"}


@pytest.mark.parametrize(("markers", "rate"), [(5, 20), (17, 144), (60, 240)])
def test_any_markers_at_any_rate_are_tried_to_the_end(markers, rate):
    own = own_rope(nodes=markers, control_period=1 / rate, substeps=max(5, 1000 // rate))
    policy = rope_policy(markers, period=1 / rate)
    base, _ = rope_for(policy, manifest(own, {"file": "own.npz"}))
    trials = [StabilizationTrial(base, "straight", 0)]
    seen = run_trials(trials, LearnedController(policy, RopeStabilization()), 5, drawn=[0])
    assert not seen.failures
    assert seen.markers.shape == (1, 6, markers, 3)
    apart = np.linalg.norm(np.diff(seen.markers[0], axis=1), axis=-1)
    assert apart.mean() == pytest.approx(base.length / (markers - 1), rel=0.05)


def test_a_policy_of_few_nodes_sees_all_markers_that_were_recorded():
    """In trials, and in the loop of `serve` as an exported file would be."""
    policy, model = rope_policy(7, period=1 / 60), own_rope(nodes=7)
    told = manifest(model, {"file": "own.npz", SEEN_MARKERS: 30})
    base, _ = rope_for(policy, told)
    assert base == with_markers(counterpart(model, 2e-3), 30)
    assert rope_for(policy, told, own_rope(nodes=9))[0].markers == 30
    deployment = RopeDeployment(policy, told, {})
    assert deployment.sensors[1].shape == (30, 3)
    assert deployment.segment_lengths() == pytest.approx(np.full(29, 0.73 / 29))
    trials = [StabilizationTrial(base, "straight", 0)]
    seen = run_trials(trials, LearnedController(policy, RopeStabilization()), 5, drawn=[0])
    assert not seen.failures
    decision, check = deployment.decision(), deployment.check()
    for markers in seen.markers[0]:
        values = {"gripper": markers[0], "markers": markers}
        assert not check.problem(values)
        decision.see(values)
    assert np.isfinite(decision.decide(np.zeros(3, np.float32))).all()


def test_a_training_tries_its_policy_in_the_same_rope(tmp_path, monkeypatch):
    monkeypatch.setattr(stabilization, "TRIAL_PERIODS", 0.1)
    options = TrainRopeStabilization(model=tmp_path, observation_noise=2e-3)
    told = manifest(own_rope(), {"file": "own.npz"})
    figures = options.in_world(rope_policy(12, period=1 / 60), told)
    assert figures[0].name == "in_world.success_rate"
    assert figures[0].value == 0.0


def test_what_cannot_be_tried_is_not_trained(tmp_path):
    stiff = own_rope(substeps=4000, bend_stiffness=6000.0)
    with pytest.raises(PalpateError, match="too slow to wait for: expected one of less stiffness"):
        TrainRopeStabilization(model=tmp_path).prepare(stiff)


def test_markers_between_markers():
    base = counterpart(own_rope(nodes=5), 0.0)
    more = with_markers(base, 9)
    assert more.marker_places is not None
    assert more.marker_places[::2] == base.marker_places
    assert with_markers(base, 5) is base
    assert with_markers(RopeConfiguration(), 11) == RopeConfiguration(markers=11)


@pytest.mark.parametrize("rate", [20, 60, 100, 144, 240])
def test_a_servo_is_asked_a_whole_number_of_times_in_a_period(rate):
    rope = with_servo(counterpart(own_rope(control_period=1 / rate, substeps=30), 0.0), 1 / rate)
    asked = 1 / rate / rope.control_period
    assert asked == pytest.approx(round(asked))
    assert 1.5e-3 < rope.control_period < 3e-3
    assert with_servo(RopeConfiguration(), 0.01) == RopeConfiguration(control_period=0.002)


def test_single_constants_are_changed_and_the_time_step_follows():
    base = counterpart(own_rope(), 1e-3)
    heavy = with_constants(base, {"mass": 0.2})
    assert heavy.mass == 0.2
    assert dataclasses.replace(heavy, mass=base.mass, time_step=base.time_step) == base
    stiff = with_constants(base, {"bending_stiffness": 0.01})
    assert stiff.time_step < base.time_step
    assert with_constants(base, {}) is base
    assert with_constants(RopeConfiguration(), {"length": 0.9}) == RopeConfiguration(length=0.9)


def test_a_policy_decides_on_every_second_frame_of_a_fast_camera(tmp_path, capsys):
    fast = Rope.uniform(0.5, 0.05, 5, drive="position", control_period=1 / 200, substeps=4)
    options = TrainRopeStabilization(model=tmp_path, observation_noise=1e-3)
    prepared = options.prepare(fast)
    assert (prepared.control_period, prepared.substeps) == (0.01, 8)
    assert "one in 2 of the recording's frames" in capsys.readouterr().out
    usual = dataclasses.replace(fast, control_period=1 / 120)
    assert options.prepare(usual).control_period == 1 / 120


def test_a_policy_is_trained_with_the_noise_of_its_recording(tmp_path):
    open_noise = TrainRopeStabilization(model=tmp_path)
    assert open_noise.completed({"observation_noise": 2e-3}).observation_noise == 2e-3
    assert open_noise.completed({}).observation_noise == 5e-4
    recorded = constants(RopeConfiguration(observation_noise=1e-3)) | {"source": "MuJoCo rope"}
    about = {"recordings": recorded, "observation_noise": 1.1e-3}
    assert open_noise.completed(about).observation_noise == 1e-3  # as it was simulated
    said = TrainRopeStabilization(model=tmp_path, observation_noise=0.0)
    assert said.completed(about).observation_noise == 0.0


def test_a_uniform_rope_shares_what_its_segments_have():
    options = IdentifyRope(recordings=(), uniform=True, shared=("node_mass",))
    assert options.shared == ("node_mass", *ALONG)
    assert IdentifyRope(recordings=()).shared == ()
