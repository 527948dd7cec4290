"""The MuJoCo rope against closed forms: swing, bending, energy, stability."""

import itertools
import math

import mujoco
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.rope import rope as rope_world
from palpate.worlds.rope.rope import (
    FORCE_NOISE,
    START_POSES,
    Disturbance,
    RopeConfiguration,
    RopeWorld,
)
from palpate.worlds.world import DivergedError
from small_rope import FREE, QUIET, SMALL, STILL, rope


def test_a_free_swing_has_the_period_of_a_hanging_chain_and_halves_in_2_to_6_periods():
    configuration = RopeConfiguration(**QUIET)  # the defaults, whose damping is promised
    world = RopeWorld(configuration)
    # The first mode of a hanging chain is J0(2.4048 sqrt(height above the tip / length)).
    height = np.linspace(1, 0, 101)
    angle = np.linspace(0, np.pi, 201)
    bessel = np.cos(2.40483 * np.sqrt(height)[:, None] * np.sin(angle)).mean(-1)
    world.reset(0, start=np.stack([0.03 * bessel, 0 * height, height], axis=-1), azimuth=0.0)
    steps = 700
    tip = np.array([world.step(STILL).markers[-1, 0] for _ in range(steps)])
    time = np.arange(1, steps + 1) * world.control_period

    crossing = np.flatnonzero(tip[:-1] * tip[1:] < 0)
    moment = time[crossing] + world.control_period * tip[crossing] / (
        tip[crossing] - tip[crossing + 1]
    )
    period = 2 * np.diff(moment).mean()
    closed_form = 2 * np.pi / (1.2024 * math.sqrt(configuration.gravity / configuration.length))
    assert period == pytest.approx(closed_form, rel=0.01)

    peaks = [abs(tip[a + 1 : b + 1]).max() for a, b in itertools.pairwise(crossing)]
    decay_per_period = -2 * np.polyfit(np.arange(len(peaks)), np.log(peaks), 1)[0]
    assert math.log(2) / decay_per_period == pytest.approx(3.6, abs=0.3)


def test_a_clamped_stiff_rope_bends_like_a_cantilever():
    force, stiffness, bodies = 0.02, 0.2, 20
    world = rope(
        grip="clamped", bodies=bodies, markers=21, gravity=0.0, bending_stiffness=stiffness,
        twisting_stiffness=1e-4, joint_damping=4.0, mass=2.0,
        disturbances=(Disturbance(0.0, 100.0, (force, 0.0, 0.0)),),
    )  # fmt: skip
    world.reset(0)
    for _ in range(800):
        observation = world.step(STILL)
    deflection = observation.markers[:, 0]
    # The first body does not bend; the beam begins half a body below the clamp.
    along = np.clip(np.linspace(0, 1, bodies + 1) - 0.5 / bodies, 0, None)
    beam = force * along**2 * (3 * along[-1] - along) / (6 * stiffness)
    assert deflection == pytest.approx(beam, abs=0.01 * beam[-1])


@pytest.mark.parametrize("grip", ["pivot", "clamped"])
def test_elastic_energy_is_the_potential_of_the_elastic_moments(grip):
    world = rope(grip=grip, gravity=0.0, twisting_stiffness=7e-5, bending_stiffness=2e-4, **FREE)
    world.reset(0)
    data, model = world._data, world._model
    random = np.random.default_rng(0)
    change = np.zeros(model.nv)
    change[3:] = 1e-3 * random.standard_normal(model.nv - 3)  # turns about all three axes
    mujoco.mj_integratePos(model, data.qpos, change, 1.0)
    mujoco.mj_forward(model, data)
    moments = data.qfrc_passive.copy()
    moments[:3] = 0  # the gripper's gravity compensation

    def energy_after(direction, size):
        before = data.qpos.copy()
        mujoco.mj_integratePos(model, data.qpos, direction, size)
        energy = world.truth().energy
        data.qpos[:] = before
        return energy

    for _ in range(3):
        direction = np.concatenate([np.zeros(3), random.standard_normal(model.nv - 3)])
        slope = (energy_after(direction, 1e-3) - energy_after(direction, -1e-3)) / 2e-3
        size = np.linalg.norm(moments) * np.linalg.norm(direction)
        assert -moments @ direction == pytest.approx(slope, abs=1e-3 * size)


def test_energy_is_counted_above_hanging_rest_in_closed_form():
    mass, length, gravity, tip_mass = 0.1, 1.2, 9.81, 0.03
    world = rope(length=length, mass=mass, tip_mass=tip_mass)
    world.reset(0, start="straight")
    raised = 1 - math.cos(math.pi / 3)
    expected = (mass / 2 + tip_mass) * gravity * length * raised
    assert world.truth().energy == pytest.approx(expected, rel=1e-3)

    world.reset(0, start="hanging")
    assert world.truth().energy == pytest.approx(0, abs=1e-6)

    weights = np.linspace(3, 1, 10)
    world = rope(mass_distribution=lambda fraction: 3.1 - 2.2 * fraction)
    heavier_above = rope(mass_distribution=weights)
    assert world._configuration.body_masses() == pytest.approx(
        0.1 * (3.1 - 2.2 * (np.arange(10) + 0.5) / 10) / 20
    )
    heavier_above.reset(0, start="straight")
    centre = (weights * (np.arange(10) + 0.5) / 10).sum() / weights.sum()
    assert heavier_above.truth().energy == pytest.approx(0.1 * 9.81 * centre * raised, rel=1e-5)


def test_bending_energy_of_a_half_circle_is_that_of_its_curvature():
    bodies = SMALL["bodies"]
    energy = {}
    for stiffness in (1e-4, 2e-4):
        world = rope(bending_stiffness=stiffness)
        world.reset(0, start="half_circle")
        energy[stiffness] = world.truth().energy
    curvature_energy = 0.5 * 1e-4 * np.pi**2  # EI kappa^2 length / 2 with kappa = pi / length
    joints = (bodies - 1) / bodies  # the half bodies at both ends do not bend
    assert energy[2e-4] - energy[1e-4] == pytest.approx(curvature_energy * joints, rel=1e-6)


@pytest.mark.parametrize("start", ["helix", "half_circle"])
def test_start_curves_hold_no_twist(start):
    energy = []
    for stiffness in (1e-5, 7e-5):
        world = rope(twisting_stiffness=stiffness)
        world.reset(0, start=start)
        energy.append(world.truth().energy)
    assert energy[0] == pytest.approx(energy[1], abs=1e-12)


def test_energy_is_conserved_without_damping_and_the_drift_falls_with_the_time_step():
    sideways = Disturbance(0.0, 0.1, (0.0, 0.05, 0.0))  # so that the swing is not in a plane
    drift = []
    for time_step in (2e-4, 1e-4):
        world = rope(time_step=time_step, disturbances=(sideways,), **FREE)
        world.reset(0, start="straight", azimuth=0.0)
        energy = []
        for _ in range(110):
            world.step(STILL)
            energy.append(world.truth().energy)
        drift.append(np.ptp(energy[10:]) / energy[10])
    assert drift[1] < 0.003
    assert drift[1] < 0.7 * drift[0]


@pytest.mark.parametrize("start", START_POSES)
def test_energy_decays_monotonically_under_a_still_gripper(start):
    world = rope()
    world.reset(1, start=start)
    energy = [world.truth().energy]
    for _ in range(150):
        world.step(STILL)
        energy.append(world.truth().energy)
    assert (np.diff(energy) < 1e-4 * energy[0]).all()
    assert energy[-1] < 0.8 * energy[0]


def test_lowering_the_gripper_earns_nothing():
    world = rope()
    world.reset(0)
    for velocity in (-0.2, 0.0):
        for _ in range(100):
            world.step(np.array([0, 0, velocity]))
    truth = world.truth()
    assert truth.gripper_position[2] == pytest.approx(1.3, abs=2e-3)
    assert truth.energy == pytest.approx(0, abs=1e-5)


def test_velocities_are_the_derivative_of_positions():
    world = rope(control_period=1e-3)
    world.reset(0, start="helix")
    random = np.random.default_rng(0)
    for _ in range(100):
        world.step(random.uniform(-1, 1, 3))
    before = world.truth()
    world.step(STILL)
    after = world.truth()
    difference = (after.positions - before.positions) / 1e-3
    mean = (after.velocities + before.velocities) / 2
    assert np.abs(difference).max() > 0.5
    assert mean == pytest.approx(difference, abs=0.02)


@pytest.mark.parametrize(
    "extreme",
    [
        {"length": 0.9, "mass": 0.125, "bending_stiffness": 5e-5},
        {"length": 1.1, "mass": 0.075, "bending_stiffness": 1.5e-4},
    ],
)
def test_hard_driving_of_extreme_ropes_stays_stable(extreme):
    thin = {"joint_damping": 1.5e-3, "air_density": 0.6, "air_viscosity": 1.5e-3}
    world = RopeWorld(RopeConfiguration(**extreme, **thin))
    world.reset(1, start="helix")
    random = np.random.default_rng(1)
    energy = []
    for step in range(100):
        if step % 20 == 0:
            command = 2 * random.standard_normal(3)
        world.step(command)
        energy.append(world.truth().energy)
    weight = 9.81 * extreme["mass"] * extreme["length"]
    assert max(energy) < 1.0 * weight
    links = np.linalg.norm(np.diff(world.truth().positions, axis=0), axis=-1)
    assert links == pytest.approx(extreme["length"] / 40, rel=1e-5)


def test_a_diverged_simulation_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log into the working folder
    world = rope(time_step=1e-3, **FREE)
    world.reset(0, start="helix")
    sentence = r"diverged at .* a smaller time_step than 0.001 s"
    with pytest.raises(DivergedError, match=sentence):
        [world.step(STILL) for _ in range(300)]
    with pytest.raises(DivergedError, match=sentence):  # and so it stays until the next reset
        world.step(STILL)
    world.reset(0)
    assert world.step(STILL).markers[-1] == pytest.approx([0, 0, 0.5], abs=1e-3)


def test_a_rope_that_diverges_while_it_is_shaken_is_not_started(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    world = rope()
    world.reset(0)

    def violent(period):
        world._data.qvel[:] = 1e9
        return np.zeros((3, 3))

    monkeypatch.setattr(rope_world, "shake_commands", violent)
    with pytest.raises(DivergedError):
        world.reset(0, start="shaken")
    with pytest.raises(PalpateError, match=r"stepped after reset\(seed\)"):
        world.step(STILL)
    world.reset(0)
    assert world.step(STILL).markers[-1] == pytest.approx([0, 0, 0.5], abs=1e-3)


def test_the_grip_feels_the_weight_at_rest_and_its_work_is_what_the_rope_gains():
    """Momentum and energy: without damping the rope has all that the gripper gave."""
    world = rope(**FREE, time_step=1e-4)
    configuration = world.truth().configuration
    world.reset(0)
    weight = configuration.mass * configuration.gravity
    # At first the servo has to give way by what its force takes.
    still = [world.step(np.zeros(3)).grip_force for _ in range(60)][30:]
    assert np.mean(still, axis=0) == pytest.approx([0.0, 0.0, -weight], abs=3 * FORCE_NOISE)
    begins = world.truth()
    work, before = 0.0, begins.gripper_position
    for number in range(100):
        wanted = 0.5 * np.array([np.sin(0.2 * number), 0.0, 0.4 * np.cos(0.15 * number)])
        force = world.step(wanted).grip_force
        now = world.truth().gripper_position
        work -= force @ (now - before)
        before = now
    ends = world.truth()
    lifted = weight * (ends.gripper_position[2] - begins.gripper_position[2])
    gained = ends.energy - begins.energy + lifted
    assert gained > 0.01
    assert work == pytest.approx(gained, rel=0.03)
