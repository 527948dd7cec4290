"""Constants that make a rope, and those that do not."""

import dataclasses

import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.worlds.rope.configuration import in_step
from palpate.worlds.rope.rope import Disturbance, RopeConfiguration, sample_configurations


def test_sampled_ropes_span_their_ranges_and_nothing_else_changes():
    base = RopeConfiguration(tip_mass=0.01)
    ropes = sample_configurations(base, 200, seed=5)
    assert ropes == sample_configurations(base, 200, seed=5)
    spread = {"length": 0.1, "mass": 0.25, "tip_mass": 0.25, "bending_stiffness": 0.5,
              "joint_damping": 0.5, "air_density": 0.5, "air_viscosity": 0.5}  # fmt: skip
    factors = {}
    for field in dataclasses.fields(base):
        values = [getattr(rope, field.name) for rope in ropes]
        if field.name in spread:
            factors[field.name] = np.array(values) / getattr(base, field.name)
            width = spread[field.name]
            assert 1 - width <= factors[field.name].min() < 1 - 0.95 * width
            assert 1 + 0.95 * width < factors[field.name].max() <= 1 + width
        else:
            assert set(values) == {getattr(base, field.name)}
    assert factors["air_density"] == pytest.approx(factors["air_viscosity"])
    assert factors["mass"] == pytest.approx(factors["tip_mass"])
    independent = ["length", "mass", "bending_stiffness", "joint_damping", "air_density"]
    correlation = np.corrcoef([factors[name] for name in independent])
    assert np.abs(correlation - np.eye(5)).max() < 0.25


@pytest.mark.parametrize(
    ("constants", "sentence"),
    [
        ({"length": 0.0}, "length is greater than 0, not 0"),
        ({"mass": np.nan}, "mass is greater than 0, not nan"),
        ({"tip_mass": -1.0}, "tip_mass is 0 or greater, not -1"),
        ({"markers": 1}, "a whole number of markers, 2 or more: 1"),
        ({"markers": 3, "marker_places": (0.0, 1.0)}, "are 3 growing shares of its length"),
        ({"markers": 2, "marker_places": (0.5, 0.1)}, "are 2 growing shares of its length"),
        ({"markers": 2, "marker_places": (0.0, 1.1)}, "growing shares .* to 1 at the tip"),
        ({"grip_damping": -1.0}, "grip_damping is 0 or greater, not -1"),
        ({"bodies": 2}, "a whole number of bodies, 3 or more, not 2"),
        ({"control_period": 0.0101}, "makes 20.2 time steps; it has to be a whole number"),
        ({"observation_delay": 0.015}, "makes 1.5 control periods"),
        ({"observation_rate": 30.0}, "makes 3.33333 control periods between observations"),
        ({"observation_rate": 200.0}, "makes 0.5 control periods between observations"),
        ({"mass_distribution": "heavy"}, "'uniform', a weight per body or a function, not 'heavy'"),
        ({"mass_distribution": [1.0, 2.0]}, r"40 positive weights, one per body, not shape \(2,\)"),
        ({"bending_stiffness": 1.0}, "needs a time_step below .* not 0.0005"),
        ({"twisting_stiffness": 0.1}, "a twisting_stiffness of 0.1 N m.2 needs a time_step below"),
    ],
)
def test_constants_that_make_no_rope_are_refused(constants, sentence):
    with pytest.raises(PalpateError, match=sentence):
        RopeConfiguration(**constants)


@pytest.mark.parametrize("rate", [20, 30, 59.94, 60, 100, 120, 144, 200, 240])
def test_any_control_rate_is_kept_step_with(rate):
    rope = in_step(1 / rate, length=0.73, mass=0.055)
    steps = rope.control_period / rope.time_step
    assert rope.control_period == 1 / rate
    assert steps == pytest.approx(round(steps), abs=1e-9)
    assert 0.8 * 5e-4 < rope.time_step <= 5e-4 * (1 + 1e-9)


def test_steps_are_short_enough_for_stiff_ropes_and_those_drawn_around_them():
    stiff = in_step(0.01, bending_stiffness=0.02)
    assert max(stiff.fastest().values()) * stiff.time_step <= 1
    assert len(sample_configurations(stiff, 100, 0)) == 100
    assert in_step(0.01) == RopeConfiguration()
    with pytest.raises(PalpateError, match="too slow to wait for: expected one of less stiffness"):
        in_step(0.01, bending_stiffness=5.0)


@pytest.mark.parametrize(
    ("push", "sentence"),
    [
        ((0.0, 1.0, (np.nan, 0.0, 0.0)), "three finite newtons"),
        ((-1.0, 1.0, (1.0, 0.0, 0.0)), "time >= 0 and a duration > 0"),
        ((0.0, 0.0, (1.0, 0.0, 0.0)), "time >= 0 and a duration > 0"),
        ((0.0, 1.0, (1.0, 0.0, 0.0), 1.5), "between 0 .* and 1"),
    ],
)
def test_a_push_that_is_none_is_refused(push, sentence):
    with pytest.raises(PalpateError, match=sentence):
        Disturbance(*push)
