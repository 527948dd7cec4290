"""What `reproduce contact-model` counts; the command is stood in for."""

import numpy as np
import pytest

from palpate.experiments.contact import contact_model
from palpate.runs import Figure, Result
from palpate.runs.storage import write_json
from palpate.worlds.contact import plates
from palpate.worlds.contact.plates import PlatesWorld, plates_of
from palpate.worlds.contact.touching import record_touches

SEED = 7  # of no plates that are reproduced


@pytest.fixture(scope="module")
def touches():
    return record_touches(PlatesWorld(), SEED, 8, 1.25)


def off(rival, recording) -> dict:
    truth = contact_model.truth_of(plates_of(SEED), np.zeros(2))
    return contact_model.errors(rival(recording), truth)


def test_a_straight_line_finds_plates_that_face_as_they_were_meant_to_a_rough_size(
    touches, monkeypatch
):
    """No straw man: what it lacks is only how the plates are turned, which makes it worse."""
    turned = off(contact_model.straight_line, touches)
    monkeypatch.setattr(plates, "TURNED", 0.0)
    straight = off(contact_model.straight_line, record_touches(PlatesWorld(), SEED, 8, 1.25))
    assert np.all(straight["position"] < 5.0)
    assert np.all(straight["stiffness"] < 0.6)
    assert np.all(straight["friction"] < 0.6)
    assert straight["position"].max() < turned["position"].max()


def test_a_plane_finds_turned_plates_to_a_rough_size(touches):
    found = off(contact_model.plane, touches)
    assert np.all(found["position"] < 5.0)
    assert np.all(found["stiffness"] < 0.4)
    assert np.all(found["friction"] < 0.4)


def test_a_plane_keeps_the_direction_as_meant_where_nothing_is_felt_from_the_one_it_finds(
    monkeypatch,
):
    """Pushed with forces that grow along the wall, as by friction: the plane climbs across."""
    time = np.linspace(0.0, 1.0, 101)
    normal, across = (contact_model.unit(np.array(angle)) for angle in (np.pi, 1.5 * np.pi))
    wobble = np.sin(40.0 * time)
    pressed = 6.0 + 4.0 * time + 1e-4 * wobble
    position = np.outer(time, across) - np.outer(1e-3 * wobble, normal)
    force = np.outer(pressed, normal) - np.outer(0.2 * pressed, across)
    velocity = np.broadcast_to(across, position.shape)
    monkeypatch.setattr(contact_model, "NOMINAL", (np.pi,))
    monkeypatch.setattr(contact_model, "_states", lambda recording: (position, force, velocity))
    stand_in = record_touches(PlatesWorld(), SEED, 1, 0.5)
    found, straight = contact_model.plane(stand_in), contact_model.straight_line(stand_in)
    for name in contact_model.FOUND:
        np.testing.assert_array_equal(found[name], straight[name])


def test_positions_are_those_of_the_turned_plate_abreast_of_a_point():
    hidden = plates_of(SEED)
    here, there = (contact_model.truth_of(hidden, np.full(2, at))["position"] for at in (0.0, 0.1))
    tilt = hidden.angle - np.array(contact_model.NOMINAL)
    # Walls that face against x and y: their lefts are against y and along x.
    np.testing.assert_allclose(there - here, np.array([1.0, -1.0]) * 0.1 * np.tan(tilt), atol=1e-12)


def test_figures_are_medians_and_the_share_of_intervals_that_hold(tmp_path, monkeypatch):
    """The stand-in is 5 % off, and the draws miss the friction of both plates."""

    def run(options):
        drawn = options.method == contact_model.METHODS["posterior"]
        truth = contact_model.truth_of(plates_of(options.seed), np.zeros(2))
        rows = []
        for name, true in truth.items():
            value = true + 5e-4 if name == "position" else 1.05 * true
            low, high = value - 0.1 * np.abs(true), value + 0.1 * np.abs(true)
            high = 0.99 * true if drawn and name == "friction" else high
            rows.append({"name": name, "value": value, "lower": low, "upper": high})
        result = Result("x", [Figure("wall_time_s", 3.0, "s")], {}, [0], None, 3.0, parameters=rows)
        write_json(options.out / "result.json", result.to_dict())
        return options.out

    monkeypatch.setattr(contact_model.identify, "run", run)
    monkeypatch.setattr(contact_model, "centre_of", lambda options: np.zeros(2))
    result = contact_model.reproduce(tmp_path, quick=True, seed=3)
    figures = {figure.name: figure for figure in result.figures}
    for name in contact_model.METHODS:
        assert figures[f"{name}.position_mm"].value == pytest.approx(0.5)
        assert figures[f"{name}.stiffness_error"].value == pytest.approx(0.05)
        assert figures[f"{name}.friction_error"].met
    assert figures["gradient.coverage_90"].value == 1.0
    assert not figures["gradient.coverage_90_over"].met
    assert figures["posterior.coverage_90"].value == pytest.approx(2 / 3)
    assert "straight line" in (figures["gradient.friction_error"].rival or "")
    assert result.seeds == [3, contact_model.FIRST + 3]
    assert result.settings["missed"]["posterior"] == [["friction", "friction"]]
    assert result.wall_time_s == pytest.approx(6.0)
