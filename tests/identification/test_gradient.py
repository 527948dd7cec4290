"""Identification of toy models and a small rope through the same code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.identification.data.prediction import observation_scale, predict, prediction_error
from palpate.identification.data.segments import SegmentSource
from palpate.identification.gradient.descent import RECOVERY, Settings, identify
from palpate.identification.gradient.least_squares import Objective, intervals
from palpate.models.model import rollout
from palpate.models.rope import Rope
from palpate.parameters import FreeParameters, LogNormal, declare, value_of
from palpate.recordings import Aligned
from palpate.runs import Run
from toys import Cart, Pendulum

SHORT = Settings(horizons=(0.3, 1.0), iterations=(30, 80), windows=8)


def recorded(model, start, actions, noise=0.0, seed=0):
    """Aligned trials of a model from `start` (batched state): what a recording of it would be."""
    states = rollout(model, start, actions)
    first = model.observe(start)[:, None]
    observation = np.concatenate([first, model.observe(states)], axis=1)
    rng = np.random.default_rng(seed)
    observation = observation + noise * rng.normal(size=observation.shape)
    return Aligned(
        period=model.control_period,
        observation=observation.astype(np.float32),
        action=np.asarray(actions),
        length=np.full(len(observation), observation.shape[1]),
    )


def pushed(model, trials=6, steps=60, seed=1, size=2.0):
    """Smooth random actions from rest at zero."""
    rng = np.random.default_rng(seed)
    knots = rng.normal(size=(trials, steps // 10 + 2, *model.action_shape))
    actions = size * np.repeat(knots, 10, axis=1)[:, :steps]
    rest = jnp.zeros((trials, 1, *model.observation_shape))
    return model.initial_state(rest), jnp.asarray(actions, jnp.float32)


def inside(model, truth, coordinates, found):
    """Share of true values inside their intervals."""
    hits = []
    for path in coordinates.declarations:
        value = np.asarray(value_of(truth, path))
        low, high = np.asarray(found.lower[path]), np.asarray(found.upper[path])
        assert np.all(low < high)
        hits.append(np.ravel((low <= value) & (value <= high)))
    return np.mean(np.concatenate(hits))


@pytest.mark.parametrize("method", ["adam", "levenberg-marquardt"])
@pytest.mark.parametrize(
    ("truth", "start"),
    [
        (Cart(mass=2.0, friction=0.3), Cart(mass=1.0, friction=0.5)),
        (Pendulum(length=0.7, damping=0.2), Pendulum(length=1.0, damping=0.1)),
    ],
)
def test_toys_are_recovered_within_their_intervals(truth, start, method):
    # A seed at which all are in: 90 % intervals miss now and then, as that of the pendulum's length
    # does at seed 0. How often they hold is counted over seeds for the hinge.
    aligned = recorded(truth, *pushed(truth), noise=1e-3, seed=3)
    iterations = (20, 20, 150) if method == "adam" else (3, 3, 8)
    settings = Settings(method=method, iterations=iterations, windows=6, learning_rate=0.05)
    found = identify(start, aligned, settings)
    coordinates = FreeParameters(found)
    bounds = intervals(coordinates, coordinates.initial, aligned)
    for path in coordinates.declarations:
        assert float(value_of(found, path)) == pytest.approx(float(value_of(truth, path)), rel=0.1)
    assert inside(found, truth, coordinates, bounds) == 1.0
    assert all(verdict is None for verdict in bounds.verdict.values())
    assert not bounds.warnings


def test_what_the_data_cannot_tell_is_named():
    """With the force hidden (none acts) a cart's mass and friction are seen only as a ratio."""
    truth = Cart(mass=2.0, friction=1.0)
    rest, actions = pushed(truth)
    moving = jax.tree.map(lambda x: x, rest)
    moving = type(moving)(moving.position, moving.velocity + 1.0)
    aligned = recorded(truth, moving, jnp.zeros_like(actions), noise=1e-4)
    start = Cart(mass=1.0, friction=0.4)
    found = identify(start, aligned, Settings(iterations=(10, 10, 60), windows=6))
    assert float(found.friction / found.mass) == pytest.approx(0.5, rel=0.05)
    coordinates = FreeParameters(found)
    bounds = intervals(coordinates, coordinates.initial, aligned)
    assert any("mass" in w and "friction" in w for w in bounds.warnings)


def rope_data(nodes=6, trials=4, steps=80):
    truth = Rope.uniform(
        length=0.5,
        mass=0.05,
        nodes=nodes,
        bend_stiffness=4e-3,
        bend_damping=3e-4,
        air_drag=3e-3,
        drive="position",
    )
    rng = np.random.default_rng(3)
    time = np.arange(1, steps + 1) * truth.control_period
    phase = rng.uniform(0, 2 * np.pi, (trials, 1, 3))
    frequency = rng.uniform(0.8, 2.0, (trials, 1, 3))
    wave = np.sin(2 * np.pi * frequency * time[None, :, None] + phase) - np.sin(phase)
    grip = 0.06 * wave * np.array([1.0, 1.0, 0.5])
    hanging = np.zeros((trials, nodes, 3))
    hanging[..., 2] = -np.linspace(0, 0.5, nodes)
    start = truth.initial_state(jnp.asarray(hanging[:, None], jnp.float32))
    return truth, recorded(truth, start, jnp.asarray(grip[:, :, None], jnp.float32), noise=5e-5)


def test_a_rope_is_recovered():
    _, aligned = rope_data()
    names = ("stretch_stiffness", "stretch_damping", "bend_stiffness", "bend_damping")
    start = declare(
        Rope.uniform(length=0.5, mass=0.05, nodes=6, drive="position"),
        gravity={"fixed": True},
        **{name: {"shared": True} for name in (*names, "twist_stiffness")},
    )
    before = prediction_error(start, aligned).mean_absolute
    found = identify(start, aligned, SHORT)
    after = prediction_error(found, aligned).mean_absolute
    assert after < 0.2 * before
    assert after < 3e-4  # the noise is 5e-5, and makes the start's velocity uncertain
    assert float(found.bend_stiffness[0]) == pytest.approx(4e-3, rel=0.2)


def test_only_free_parameters_move_and_fixed_ones_may_be_zero():
    _, aligned = rope_data(steps=30)
    start = Rope.uniform(length=0.5, mass=0.05, nodes=6, drive="position", air_drag=0.0)
    start = declare(start, air_drag={"fixed": True}, gravity={"fixed": True})
    found = identify(start, aligned, Settings(horizons=(1.0,), iterations=(3,), windows=4))
    assert float(found.air_drag) == 0.0
    assert float(found.gravity) == pytest.approx(9.81)
    assert not np.allclose(found.bend_stiffness, start.bend_stiffness)


def test_resumes_to_the_same_result(tmp_path, monkeypatch):
    truth = Cart(mass=2.0, friction=0.3)
    aligned = recorded(truth, *pushed(truth))
    start = Cart(mass=1.0, friction=0.5)
    settings = Settings(iterations=(10, 10, 100), windows=6)
    whole = identify(start, aligned, settings)

    class Cut(Exception):
        pass

    def log(self, step, _log=Run.log, **metrics):
        """Fail after 70 steps, as a power cut would."""
        if step == 70:
            raise Cut
        _log(self, step, **metrics)

    with monkeypatch.context() as patch, Run.open(tmp_path / "run", {"a": 1}) as run:
        patch.setattr(Run, "log", log)
        with pytest.raises(Cut):
            identify(start, aligned, settings, run)
    with Run.open(tmp_path / "run", {"a": 1}) as run:
        resumed = identify(start, aligned, settings, run)
        assert [row["step"] for row in run.metrics()] == list(range(1, 121))
    assert float(resumed.mass) == float(whole.mass)
    assert float(resumed.friction) == float(whole.friction)


def test_gaps_are_bridged_and_do_not_count():
    truth = Cart(mass=2.0, friction=0.3)
    aligned = recorded(truth, *pushed(truth))
    observation = np.array(aligned.observation)
    observation[:, 20:30] = np.nan
    observation[0, :5] = np.nan
    holed = Aligned(aligned.period, observation, aligned.action, aligned.length)
    source = SegmentSource.of(holed, truth)
    assert source.starts[0][0] == 6  # the second of two that are seen
    segments = source.whole()
    assert not np.isnan(np.asarray(segments.target)).any()
    error = prediction_error(truth, holed)
    assert error.mean_absolute < 1e-4
    wrong = np.array(observation)
    wrong[1, 40] += 1.0
    spoiled = Aligned(aligned.period, wrong, aligned.action, aligned.length)
    assert prediction_error(truth, spoiled).mean_absolute > error.mean_absolute + 1e-3


def test_an_error_that_nobody_saw_is_not_known():
    truth = Cart(mass=2.0, friction=0.3)
    aligned = recorded(truth, *pushed(truth))
    observation = np.array(aligned.observation)
    observation[:, 30:33] = np.nan
    observation[:, -5:] = np.nan
    observation[2, 2:] = np.nan
    holed = Aligned(aligned.period, observation, aligned.action, aligned.length)
    error = prediction_error(Cart(mass=3.0, friction=0.3), holed)
    assert np.flatnonzero(np.isnan(error.rmse)).tolist() == [28, 29, 30, *range(54, 59)]
    assert error.last_seen == 53
    assert error.rmse[error.last_seen] > 0.1
    assert np.flatnonzero(np.isnan(error.by_trial)).tolist() == [2]
    observation[:, 2:] = np.nan
    with pytest.raises(PalpateError, match="nothing is seen after the first two"):
        prediction_error(truth, holed)


def test_unequal_lengths_end_where_the_trial_ends():
    truth = Cart(mass=2.0, friction=0.3)
    aligned = recorded(truth, *pushed(truth))
    observation = np.array(aligned.observation)
    observation[2, 30:] = np.nan
    length = np.array(aligned.length)
    length[2] = 30
    shorter = Aligned(aligned.period, observation, aligned.action, length)
    source = SegmentSource.of(shorter, truth)
    assert source.longest == 28
    seen = np.asarray(source.whole().seen)
    assert seen[2].sum() == 28
    assert seen[1].sum() == 59
    drawn = source.sample(np.random.default_rng(0), 32, 28)
    assert np.asarray(drawn.seen).all()


def test_a_segment_predicts_from_its_own_start():
    truth = Cart(mass=2.0, friction=0.3)
    aligned = recorded(truth, *pushed(truth))
    source = SegmentSource.of(aligned, truth)
    segments = source.at(source.tiles(10), 10, smoothed=False)
    assert segments.count == 6 * 10
    assert np.allclose(predict(truth, segments), segments.target, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observation": np.zeros((6, 61, 2), np.float32)}, "Cart expects observations of shape"),
        ({"period": 0.1}, "align it with period=0.05"),
        ({"observation": np.zeros((6, 61, 1), np.float32)}, "nothing moves in the recording"),
        (
            {"observation": np.full((6, 61, 1), np.nan, np.float32)},
            "no two consecutive frames in which everything is seen",
        ),
    ],
)
def test_errors_say_what_is_wrong(change, message):
    truth = Cart(mass=2.0, friction=0.3)
    aligned = recorded(truth, *pushed(truth))
    fields = {name: getattr(aligned, name) for name in ("observation", "action", "length")}
    wrong = Aligned(**({"period": aligned.period} | fields | change))
    with pytest.raises(PalpateError, match=message):
        identify(truth, wrong)


def test_settings_are_checked():
    with pytest.raises(PalpateError, match="one number of iterations"):
        Settings(iterations=(1, 2))
    with pytest.raises(PalpateError, match="at least one iteration"):
        Settings(iterations=(1, 0, 2))
    with pytest.raises(PalpateError, match="shares between 0 and 1"):
        Settings(horizons=(0.1, 0.5, 2.0))


def test_no_free_parameter_is_an_error():
    model = declare(Cart(mass=1.0, friction=1.0), mass={"fixed": True}, friction={"fixed": True})
    with pytest.raises(PalpateError, match="every parameter of Cart is fixed"):
        FreeParameters(model)


def test_observation_scale_is_the_motion_not_the_place():
    model = Cart(mass=1.0, friction=1.0)
    aligned = recorded(model, *pushed(model))
    moved = Aligned(aligned.period, aligned.observation + 100.0, aligned.action, aligned.length)
    scale = observation_scale(aligned, model)
    assert observation_scale(moved, model) == pytest.approx(scale, rel=1e-3)


def test_a_wide_prior_moves_faster_than_a_narrow_one():
    """Free values are whitened: one learning rate moves each parameter by its own uncertainty."""
    model = declare(
        Cart(mass=1.0, friction=1.0),
        mass={"prior": LogNormal(None, 1e-3)},
        friction={"prior": LogNormal(None, 1.0)},
    )
    truth = Cart(mass=2.0, friction=0.3)
    aligned = recorded(truth, *pushed(truth))
    found = identify(model, aligned, Settings(horizons=(1.0,), iterations=(5,), windows=6))
    assert abs(np.log(found.mass)) < 1e-3
    assert abs(np.log(found.friction)) > 1e-2


def test_an_infinite_gradient_shortens_the_horizon_for_a_while(monkeypatch, tmp_path):
    """A loss that is finite can have a gradient that is not: such an iteration changes nothing."""
    truth = Cart(mass=2.0, friction=0.3)
    aligned = recorded(truth, *pushed(truth))
    settings = Settings(horizons=(1.0,), iterations=(30,), windows=6)
    real = Objective.loss

    def spoiled(bearable):
        """Finite, but with an infinite slope in the mass beyond a horizon."""

        def loss(self, free, offset, segments):
            good, mean = real(self, free, offset, segments)
            if segments.horizon <= bearable:
                return good, mean
            still = free["mass"] - jax.lax.stop_gradient(free["mass"])
            return good + jnp.sqrt(jnp.abs(still)), mean

        return loss

    monkeypatch.setattr(Objective, "loss", spoiled(20))
    jax.clear_caches()
    with Run.open(tmp_path / "run", {}) as run:
        found = identify(Cart(mass=1.0, friction=0.5), aligned, settings, run)
        horizons = [line["horizon"] for line in run.metrics()]
    assert float(found.mass) > 1.1
    tried = [30, *RECOVERY * [15]]
    assert horizons == [59, *tried, *tried, *tried][:30]
    monkeypatch.setattr(Objective, "loss", spoiled(0))
    jax.clear_caches()
    with pytest.raises(PalpateError, match="however short the horizon"):
        identify(Cart(mass=1.0, friction=0.5), aligned, settings)
