"""The world of plates: what its sensors show follows from what it hides."""

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.contact import plates as plates_module
from palpate.worlds.contact.plates import DISTANCE, PlatesWorld
from palpate.worlds.contact.touching import FORCE, POSITION, record_touches, touches

SEED = 5


def pressed(world: PlatesWorld, setpoint, periods: int):
    world.reset(SEED)
    action = np.array([*setpoint, 500.0, 500.0])
    seen = [world.step(share * action * [1, 1, 0, 0] + action * [0, 0, 1, 1])
            for share in np.minimum(np.arange(periods) / 800.0, 1.0)]  # fmt: skip
    return seen[-200:], world.truth()


def test_a_pressed_plate_pushes_with_its_spring_and_with_the_impedance(monkeypatch):
    monkeypatch.setattr(plates_module, "WANDERING", 0.0)
    seen, truth = pressed(PlatesWorld(), (DISTANCE + 0.04, 0.0), 2000)
    plates = truth.plates
    normal = np.array([np.cos(plates.angle[0]), np.sin(plates.angle[0])])
    depth = plates.offset[0] - normal @ truth.position
    assert normal @ truth.force == pytest.approx(plates.stiffness[0] * depth, rel=5e-4)
    pull = 500.0 * (np.array([DISTANCE + 0.04, 0.0]) - truth.position)
    np.testing.assert_allclose(truth.force, -pull, atol=0.35)  # the arm's dry friction
    sensed = np.mean([one.force for one in seen], axis=0)
    np.testing.assert_allclose(sensed, truth.force + plates.bias, atol=0.2)
    shown = np.mean([one.position for one in seen], axis=0)
    np.testing.assert_allclose(shown, truth.position, atol=1e-4)


def test_what_slides_along_a_plate_feels_its_friction():
    world = PlatesWorld()
    _, truth = pressed(world, (DISTANCE + 0.04, 0.0), 1000)
    forces = []
    for number in range(400):
        world.step(np.array([DISTANCE + 0.04, 1.5e-4 * number, 500.0, 500.0]))
        forces.append(world.truth().force)
    # A mean: the light plate chatters, and for single steps of the simulation is not touched.
    angle, force = truth.plates.angle[0], np.mean(forces[-100:], axis=0)
    normal = np.array([np.cos(angle), np.sin(angle)])
    along = np.array([np.sin(angle), -np.cos(angle)])
    assert world.truth().velocity[1] > 0.05
    ratio = -(along @ force) / (normal @ force)
    assert ratio == pytest.approx(truth.plates.friction[0], rel=0.02)


def test_the_sensor_feels_the_tool_resist(monkeypatch):
    """A free tip that is pulled shows the tool's share of its acceleration, against it."""
    for noise in ("WANDERING", "FORCE_NOISE", "LOW_PASS"):
        monkeypatch.setattr(plates_module, noise, 2e-4 if noise == "LOW_PASS" else 0.0)
    world = PlatesWorld()
    world.reset(SEED)
    velocity = []
    for _ in range(20):
        seen = world.step(np.array([0.4, 0.0, 10.0, 0.0]))
        velocity.append(world.truth().velocity[0])
    plates = world.truth().plates
    felt = -plates.tool_mass * (velocity[-1] - velocity[-2]) / world.control_period
    assert felt < -0.2
    assert seen.force[0] - plates.bias[0] == pytest.approx(felt, rel=1e-2)


def test_the_noise_of_the_force_lasts():
    world = PlatesWorld()
    world.reset(SEED)
    force = np.array([world.step(np.zeros(4)).force for _ in range(20_000)])
    noise = force - world.truth().plates.bias
    lasting = np.mean(noise[:-50] * noise[50:]) / plates_module.WANDERING**2
    assert lasting == pytest.approx(np.exp(-0.05 / plates_module.CORRELATION), abs=0.15)


def test_a_recording_touches_both_plates_and_is_the_same_again():
    both = [record_touches(PlatesWorld(), SEED, 2, 2.5) for _ in range(2)]
    for trial, again in zip(both[0].trials, both[1].trials, strict=True):
        for name in (POSITION, FORCE):
            np.testing.assert_array_equal(trial[name].values, again[name].values)
        assert trial[POSITION].nominal_period == pytest.approx(5e-3)
    force = np.concatenate([trial[FORCE].values for trial in both[0].trials])
    assert np.all(np.quantile(np.abs(force), 0.9, axis=0) > 3.0)
    np.testing.assert_array_equal(touches(3, 1.0)[:500], touches(3, 0.6)[:500])
    assert not touches(3, 0.6)[:200, :2].any()  # at rest, as a sensor is tared


def test_actions_that_are_none_are_refused():
    world = PlatesWorld()
    with pytest.raises(PalpateError, match="after reset"):
        world.step(np.zeros(4))
    world.reset(0)
    for action in (np.zeros(3), np.array([0, 0, -1.0, 0]), np.array([np.nan, 0, 1, 1])):
        with pytest.raises(PalpateError, match="four finite numbers"):
            world.step(action)
    with pytest.raises(PalpateError, match="s or longer, not"):
        touches(0, 0.1)
