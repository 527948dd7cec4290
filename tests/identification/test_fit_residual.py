"""Corrections of toy models and a rope through the same code: found, bounded, kept or dropped."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.identification.gradient import residual
from palpate.identification.gradient.residual import ResidualSettings, fit_residual
from palpate.models.model import rollout
from palpate.models.planar import Planar, PlanarState, furniture
from palpate.models.planar.shapes import rectangle
from palpate.models.residual import Residual
from palpate.recordings import Aligned
from palpate.runs import Run
from toys import Cart, Pendulum

QUICK = ResidualSettings(
    horizons=(0.5,), iterations=(100,), windows=8, width=8, learning_rate=0.01, share=1.0
)


class StickyCart(Cart):
    """A cart with friction that grows with the square of its speed, which `Cart` lacks."""

    def step(self, state, action):
        slowed = state.velocity - 0.3 * self.control_period * state.velocity * jnp.abs(
            state.velocity
        )
        return super().step(type(state)(state.position, slowed), action)


class OddPendulum(Pendulum):
    """A pendulum that is pulled to one side, which `Pendulum` lacks."""

    def step(self, state, action):
        pulled = state.rate + 1.5 * self.control_period * jnp.cos(state.angle)
        return super().step(type(state)(state.angle, pulled), action)


class DraggedBody(Planar):
    """A body with a drag that grows with the square of its speed, which `Planar` lacks."""

    def stepper(self):
        step = super().stepper()

        def dragged(state, action):
            speed = jnp.linalg.norm(state.velocity[..., :2], axis=-1, keepdims=True)
            slowed = state.velocity * (1.0 - jnp.minimum(1.5 * self.control_period * speed, 0.9))
            return step(PlanarState(state.pose, slowed), action)

        return dragged


def body(kind):
    """One body that glides: 2 kg on casters."""
    glides = furniture([rectangle(0.5, 0.4)], mass=2.0, floor_friction=0.01, wheels=0)
    return kind(**vars(glides))


def recorded(model, trials=16, steps=60, noise=1e-4, seed=0):
    """Aligned trials from rest under smooth random actions."""
    rng = np.random.default_rng(seed)
    knots = rng.normal(size=(trials, steps // 10 + 1, *model.action_shape))
    action = jnp.asarray(3.0 * np.repeat(knots, 10, axis=1)[:, :steps], jnp.float32)
    if isinstance(model, Planar):
        action = action * jnp.array([1.0, 1.0, 0.02])  # N, N, N m: it hardly spins
    start = model.initial_state(jnp.zeros((trials, 1, *model.observation_shape)))
    states = rollout(model, start, action)
    observation = np.concatenate([model.observe(start)[:, None], model.observe(states)], axis=1)
    observation = observation + noise * rng.normal(size=observation.shape)
    length = np.full(trials, steps + 1)
    return Aligned(model.control_period, observation.astype(np.float32), np.asarray(action), length)


TOYS = [
    (Cart(1.0, 0.2), StickyCart(1.0, 0.2)),
    (Pendulum(1.0, 0.2), OddPendulum(1.0, 0.2)),
]


@pytest.mark.parametrize(("physics", "truth"), TOYS, ids=["cart", "pendulum"])
def test_what_the_physics_lacks_is_learned_and_kept(physics, truth):
    found = fit_residual(physics, recorded(truth), QUICK)
    assert found.kept
    assert found.reason.startswith("kept: on 4 held-out trials the error falls by ")
    assert isinstance(found.model, Residual)
    assert found.corrected.mean_absolute < 0.5 * found.physics.mean_absolute
    assert 0.0 < found.size < 1.0
    assert len(found.held_out) == 4


def test_what_the_physics_of_furniture_lacks_is_learned_and_kept():
    found = fit_residual(body(Planar), recorded(body(DraggedBody)), QUICK)
    assert found.kept
    assert found.corrected.mean_absolute < 0.6 * found.physics.mean_absolute


@pytest.mark.parametrize("physics", [toy for toy, _ in TOYS], ids=["cart", "pendulum"])
def test_where_the_physics_is_right_the_correction_is_dropped(physics):
    found = fit_residual(physics, recorded(physics, noise=1e-3), QUICK)
    assert not found.kept
    assert found.reason.startswith("dropped: on 4 held-out trials the error falls by ")
    assert found.model is physics


def test_a_gain_that_may_be_chance_is_not_enough():
    error = fit_residual(*dropped_case()).physics

    def with_trials(values):
        values = np.asarray(values)
        return dataclasses.replace(error, mean_absolute=float(np.nanmean(values)), by_trial=values)

    physics = with_trials([1.0, 1.0, 1.0, 1.0])
    found = residual._verdict(physics, with_trials([0.5, 0.5, 0.6, 0.6]), 0.1)
    assert found == (True, "kept: on 4 held-out trials the error falls by 45.0%, 4 of them gain")
    kept, reason = residual._verdict(physics, with_trials([0.1, 1.1, 1.1, 1.1]), 0.1)
    assert (kept, reason) == (
        False,
        "dropped: on 4 held-out trials the error falls by 15.0%, which may be chance (1 gain)",
    )
    # the same share of little and of much counts as much
    unlike = with_trials([1.0, 0.01, 0.05, 0.05])
    assert residual._verdict(unlike, with_trials([0.5, 0.005, 0.025, 0.03]), 0.1)[0]
    # little is not worth it, however surely it is gained
    kept, reason = residual._verdict(physics, with_trials([0.95, 0.95, 0.94, 0.95]), 0.1)
    assert not kept
    assert reason.endswith("falls by 5.2%, less than the 6% that would be worth it")
    kept, reason = residual._verdict(physics, with_trials([0.5, 0.5, 0.6, 0.6]), 0.002)
    assert not kept
    assert "it is 0.2% of what the physics changes: noise in the start" in reason
    kept, reason = residual._verdict(physics, with_trials([np.nan, np.nan, np.nan, 0.1]), 0.1)
    assert (kept, reason.partition(":")[0]) == (False, "dropped")


def dropped_case():
    physics = Cart(1.0, 0.2)
    once = dataclasses.replace(QUICK, iterations=(1,))
    return physics, recorded(physics), once


def test_a_cut_off_fit_goes_on_to_the_same_result(tmp_path, monkeypatch):
    physics, truth = TOYS[0]
    aligned = recorded(truth)
    settings = dataclasses.replace(QUICK, horizons=(0.3, 0.6), iterations=(20, 40))
    whole = fit_residual(physics, aligned, settings)

    class CutOff(Exception):
        pass

    class Fragile(Run):
        def save(self, step, tree):
            super().save(step, tree)
            if step == 40:
                raise CutOff

    with Fragile.open(tmp_path, {"seed": 0}) as run, pytest.raises(CutOff):
        fit_residual(physics, aligned, settings, run)
    with Run.open(tmp_path, {"seed": 0}) as run:
        resumed = fit_residual(physics, aligned, settings, run)
        steps = [line["step"] for line in run.metrics()]
    assert steps == list(range(1, 61))
    for ours, theirs in zip(
        jax.tree.leaves(eqx.filter(resumed.model, eqx.is_array)),
        jax.tree.leaves(eqx.filter(whole.model, eqx.is_array)),
        strict=True,
    ):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("count", "share", "judges"),
    [(8, 0.25, 4), (11, 0.25, 4), (16, 0.25, 4), (40, 0.25, 10), (8, 0.99, 4), (11, 0.99, 7)],
)
def test_four_trials_at_least_judge_and_four_teach(count, share, judges):
    """Few held-out trials agree by chance too often: by two of them, one correction in three made
    the motion of an oven worse. One that was learnt from two made that of a box worse."""
    ones = np.ones((count, 1, 1))
    aligned = Aligned(0.1, ones, ones, np.ones(count, int))
    fitted, held_out = residual._split_trials(aligned, ResidualSettings(held_out=share))
    assert len(held_out) == judges
    assert sorted([*fitted, *held_out]) == list(range(count))


def test_what_cannot_be_fitted_is_refused():
    physics, aligned, settings = dropped_case()

    class Stateless(Cart):
        def initial_state(self, observations):
            return observations[..., -1, :]

    with pytest.raises(PalpateError, match=r"^Stateless does not say which leaf of its state"):
        fit_residual(Stateless(1.0, 0.2), aligned, settings)
    few = Aligned(aligned.period, aligned.observation[:7], aligned.action[:7], aligned.length[:7])
    with pytest.raises(PalpateError, match=r"needs at least 8 trials.*the recording has 7$"):
        fit_residual(physics, few, settings)
    for wrong, sentence in (
        ({"share": 0.0}, "share"),
        ({"iterations": (1, 2)}, "iterations"),
        ({"horizons": (0.3, 1.5), "iterations": (1, 1)}, "horizons"),
        ({"held_out": 1.0}, "held out"),
    ):
        with pytest.raises(PalpateError, match=sentence):
            dataclasses.replace(settings, **wrong)
