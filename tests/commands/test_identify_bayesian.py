"""`palpate identify` with a posterior: what is refused at once, and what is told of the rest."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from bayesian_toys import NOISE, Sled
from palpate.commands import identify
from palpate.commands.identification import draws as of_draws
from palpate.commands.identification import tables
from palpate.errors import PalpateError
from palpate.families.furniture.options import IdentifyFurniture
from palpate.families.furniture.recording import POSE, WRENCH
from palpate.identification.data.segments import known_start
from palpate.identification.posterior.comparison import begins_at_rest, compare
from palpate.identification.posterior.likelihood import known_scales, motion_posterior
from palpate.identification.posterior.posterior import Posterior
from palpate.identification.posterior.predictive import Predicted, score
from palpate.identification.posterior.settled import Settled
from palpate.identification.samplers.draws import Draws
from palpate.recordings import Aligned, Channel, Recording, Role, Trial
from palpate.recordings.files import write_recording
from palpate.runs import Result

RATE = 50.0
SLED = Sled(mass=14.0, friction=[6.0, 40.0])


@pytest.mark.parametrize("few", [{"draws": 3}, {"draws": -1}, {"chains": 0}, {"chains": -2}])
def test_fewer_draws_than_can_be_judged_are_refused_before_anything_is_read(few):
    with pytest.raises(PalpateError, match="expected at least 1 chain of 4 draws"):
        identify.run(IdentifyFurniture(recordings=(), **few))
    target = motion_posterior(SLED, unseen_angle(), known_scales(SLED, NOISE))
    with pytest.raises(PalpateError, match="expected at least 1 chain of 4 draws"):
        compare({"sled": target}, **few)


def still(path, seen=slice(None), count=150):
    """A recording of a box that stands still, and is seen in some frames only."""
    pose = np.full((count, 1, 3), np.nan)
    pose[seen] = 1e-3 * np.random.default_rng(0).standard_normal(pose[seen].shape)
    time = np.arange(len(pose)) / RATE
    corners = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    channels = {
        POSE: Channel(POSE, Role.OBSERVATION, time, pose, "m, m, rad"),
        WRENCH: Channel(WRENCH, Role.COMMAND, time[:-1], np.zeros((count - 1, 1, 3)), "N, N, N m"),
    }
    about = {"bodies": '["box"]', "outlines": json.dumps({"box": corners})}
    write_recording(path, Recording((Trial("one", channels),), about))
    return path


@pytest.mark.parametrize(
    ("seen", "sentence"),
    [
        (slice(0, 3), "no piece of 2 s can begin anywhere"),
        (slice(92, 101), "nothing is seen in these pieces"),  # what begins then shows nothing
    ],
)
def test_what_cannot_be_scored_on_is_refused_before_anything_is_sampled(
    tmp_path, monkeypatch, seen, sentence
):
    def began(*_):
        raise AssertionError("expected to be refused before what takes minutes")

    monkeypatch.setattr(identify, "identify", began)
    monkeypatch.setattr(IdentifyFurniture, "hypotheses", began)  # of several bodies it takes long
    fitted, scored = still(tmp_path / "R.npz"), still(tmp_path / "P.npz", seen)
    options = IdentifyFurniture(recordings=(fitted,), validate=(scored,), out=tmp_path / "out")
    with pytest.raises(PalpateError, match=sentence):
        identify.run(options)


def test_too_little_is_refused(tmp_path):
    short = still(tmp_path / "R.npz", count=6)
    with pytest.raises(PalpateError, match=r"last 0\.\d+ s in all: expected at least 0\.5 s"):
        identify.run(IdentifyFurniture(recordings=(short,)))


def test_nobody_knows_whether_what_is_seen_twice_began_at_rest():
    two = Aligned(0.05, np.zeros((1, 3, 3)), np.zeros((1, 2, 3)), np.array([3]))
    assert not begins_at_rest(two, SLED)
    long = Aligned(0.05, np.zeros((1, 9, 3)), np.zeros((1, 8, 3)), np.array([9]))
    assert begins_at_rest(long, SLED)


def unseen_angle():
    """Two pieces that show nothing of the angle, of y little, and nothing at all in the end."""
    shape = 2, 8, 3
    nothing, seen = jnp.zeros((2, 3)), np.ones(shape, bool)
    seen[0, :, 1], seen[1, 4:, 1], seen[..., 2], seen[:, 7] = False, False, False, False
    return known_start(nothing, nothing, jnp.zeros(shape), jnp.zeros(shape), jnp.asarray(seen))


def test_the_error_of_what_nobody_saw_is_said_to_be_unknown(capsys):
    pieces = unseen_angle()
    target = motion_posterior(SLED, pieces, known_scales(SLED, NOISE))
    random = np.random.default_rng(0)
    motion = np.broadcast_to([3.0, 6.0, 1.0], (100, 2, 8, 3))
    noise = random.normal(size=motion.shape)
    predicted = Predicted(motion, motion + noise, np.ones(motion.shape))
    position = random.normal(size=(2, 20, 3)).astype(np.float32)
    draws = Draws(position, np.zeros((2, 20)), np.ones(2), 0, 40, 1.0, 0.0)
    posterior = Posterior(Settled(target, ()), draws, pieces)
    found = score(target, predicted, pieces)
    figures = of_draws.posterior_figures(posterior, found, SLED, 1.0, "m, m, rad")
    values = {figure.name: figure.value for figure in figures}
    assert values["rmse_m"] == pytest.approx(np.sqrt((14 * 3**2 + 4 * 6**2) / 18))
    assert values["rmse_rad"] is None
    settings = {"structure": "sled", "scored_on": "what was fitted", "doubts": []}
    rows = of_draws.posterior_rows(posterior)
    settings["summary"] = of_draws.summary_of_draws(figures, settings, rows)
    tables.show(Result("x", figures, settings, [0], None, 1.0, parameters=rows))
    said = capsys.readouterr().out
    assert f"within {values['rmse_m']:.4g} m and unknown (root" in said
    assert "of what was seen, too little to rely on them. The data" in said  # 3 m off, noise of 1 m
    horizon = of_draws.expected_errors(predicted, pieces, SLED)
    for name in ("horizon.error", "horizon.expected"):
        assert np.isfinite(horizon[name]).tolist() == [True] * 7 + [False]
    assert horizon["horizon.error"][6] == pytest.approx(3.0)
