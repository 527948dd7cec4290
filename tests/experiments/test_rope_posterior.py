"""What `reproduce rope-posterior` simulates, asks for and counts; the command is stood in for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.experiments.rope import posterior as rope_posterior
from palpate.families.rope.recording import GRIPPER, MARKERS
from palpate.models.model import rollout
from palpate.parameters import sample_prior, value_of
from palpate.recordings.files import read_recording
from palpate.runs import Figure, Result
from palpate.runs.storage import write_json


@pytest.fixture(scope="module")
def rope():
    return rope_posterior.draw_rope(7)  # the first draw is softened


def test_a_rope_hangs_still_where_it_is_said_to(rope):
    start = jnp.asarray(rope_posterior.hanging(rope), jnp.float32)
    state = rope.initial_state(start[None])
    end = rollout(rope, state, jnp.zeros((50, 1, 3), jnp.float32)).position
    assert np.abs(np.asarray(end - start)).max() < 1e-5


def test_a_parameter_has_one_value_along_the_rope(rope):
    first = sample_prior(rope_posterior.nominal(), jax.random.fold_in(jax.random.key(7), 0))
    assert np.ptp(np.asarray(first.stretch_stiffness)) > 0.0
    for name in rope_posterior.free_parameters(rope):
        assert np.ptp(np.asarray(value_of(rope, name))) == 0.0


def test_intervals_are_counted_and_the_worst_rope_shown(tmp_path, monkeypatch):
    """The sampler's stand-in misses two intervals of the eleven, the fit's all of them."""
    monkeypatch.setattr(rope_posterior, "MOVING", 0.5)
    asked = []

    def run(options):
        asked.append(options)
        truth = rope_posterior.draw_rope(options.seed)
        names = rope_posterior.free_parameters(truth)
        missed = names if options.method == rope_posterior.FITTED else names[:2]
        rows = []
        for name in names:
            value = float(np.mean(value_of(truth, name)))
            shift = 2.0 * abs(value) if name in missed else 0.0
            edges = {"lower": [0.9 * value + shift], "upper": [1.1 * value + shift]}
            rows.append({"name": name, "fixed": False, **edges})
        figures = [
            Figure(name, 1.0 + 0.1 * (options.seed - rope_posterior.FIRST), "")
            for name in ("rhat_max_predictions", "ess_min", "wall_time_s", "coverage_90")
        ]
        result = Result("identify-rope", figures, {}, [0], None, 30.0, parameters=rows)
        write_json(options.out / "result.json", result.to_dict())
        return options.out

    monkeypatch.setattr(rope_posterior.identify, "run", run)
    monkeypatch.setattr(rope_posterior, "FULL", rope_posterior.Size(2, 3, 1))
    result = rope_posterior.reproduce(tmp_path)
    figures = {figure.name: figure for figure in result.figures}
    assert figures["coverage_90"].value == pytest.approx(9 / 11)
    assert figures["coverage_90"].met
    assert figures["coverage_90_over"].met
    assert figures["coverage_90.levenberg_marquardt"].value == 0.0
    assert figures["rhat_max_predictions"].value == pytest.approx(1.1)
    assert not figures["rhat_max_predictions"].met
    assert result.wall_time_s == 4 * 30.0
    assert result.seeds == [0, rope_posterior.FIRST, rope_posterior.FIRST + 1]
    assert {options.method for options in asked} == {"local-global", "levenberg-marquardt"}
    recording = read_recording(asked[0].recordings[0])
    assert len(recording.trials) == 3
    still = round(rope_posterior.STILL / rope_posterior.PERIOD)
    for trial in recording.trials:
        seen, gripper = trial[MARKERS].values, trial[GRIPPER].values
        assert np.std(seen[:still] - seen[:still].mean(axis=0)) < 1.1 * rope_posterior.NOISE
        assert np.ptp(gripper[:still]) < 1e-6
        assert np.ptp(gripper) > 1e-3
