"""Self-supervised DAgger on a pendulum: silent, mending, resuming, in words."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.learning import Training, dagger, loss_monitor, train
from palpate.learning.loss_monitor import Comparison, Observed, Promise, calibrate, in_model
from palpate.networks import Channel, CommandPolicy
from palpate.runs import Run
from palpate.tasks.task import Start
from toys import Pendulum, PendulumDamping, PendulumState

TASK = PendulumDamping(action_limit=12.0, action_rate_limit=200.0)
MODEL = Pendulum(1.0, 0.2, control_period=0.05)
SMALL = {"batch": 32, "starts": 256, "width": 16, "learning_rate": 3e-3, "observation_noise": 0.0}
ONCE = {"horizon_curriculum": False, "noise_curriculum": False, **SMALL}
FURTHER = Training(iterations=200, **ONCE)
TRIALS, STEPS = 24, 60


def usual(key) -> Start:
    return TASK.starts(MODEL, key, TRIALS)


def spinning(key) -> Start:
    """So fast that it turns over the top, as from no start of the training."""
    start = usual(key)
    rate = 9.0 * jnp.sign(start.state.rate) + 0.5 * start.state.rate
    return Start(PendulumState(start.state.angle, rate), start.command)


def world(starts, model=MODEL):
    """Trials in a world that is a model: what is seen is what there is."""

    def run(policy: CommandPolicy, seed: int) -> Observed:
        return in_model(TASK, model, policy, starts(jax.random.key(seed)), STEPS)

    return run


@pytest.fixture(scope="module")
def policy() -> CommandPolicy:
    return train(TASK, MODEL, Training(iterations=120, **ONCE), 0)


def run(policy, folder, watched, training=FURTHER, rounds=1, about=1):
    return dagger.dagger(
        TASK, MODEL, policy, world(usual), watched, training, folder,
        seed=1, rounds=rounds, about={"pendulum": about},
    )  # fmt: skip


def test_nothing_is_collected_where_nothing_shifted(policy, tmp_path):
    outcome = run(policy, tmp_path, world(usual), rounds=3)
    assert [one.collected.sum() for one in outcome.rounds] == [0]
    assert outcome.trained_rounds == 0
    assert outcome.policy is policy
    # The world is the model, so whatever is predicted comes true.
    np.testing.assert_allclose(*(getattr(outcome.nominal, n) for n in ("observed", "predicted")),
                               atol=1e-3)  # fmt: skip


def test_a_world_that_parts_from_the_model_is_seen(policy, tmp_path, monkeypatch):
    monkeypatch.setattr(dagger, "go_on", lambda task, model, policy, *rest: policy)
    outcome = run(policy, tmp_path, world(usual, Pendulum(2.5, 0.0, control_period=0.05)))
    (one,) = outcome.rounds
    assert one.collected.any(axis=1).mean() > 0.5
    assert one.comparison.gaps[0].max() > 10 * outcome.nominal.gaps[0].max()


def test_finished_stages_are_not_done_again(policy, tmp_path):
    tiny = dataclasses.replace(FURTHER, iterations=2)
    first = run(policy, tmp_path, world(spinning), tiny)

    def never(policy, seed):
        raise AssertionError

    again = run(policy, tmp_path, never, tiny)
    assert eqx.tree_equal(*(eqx.filter(each.policy, eqx.is_array) for each in (first, again)))
    np.testing.assert_array_equal(first.rounds[0].collected, again.rounds[0].collected)
    with pytest.raises(PalpateError, match=r"pendulum was 1, now 2"):
        run(policy, tmp_path, never, tiny, about=2)


def test_collected_states_are_half_of_the_pool(policy, tmp_path, monkeypatch):
    pools = []
    monkeypatch.setattr(dagger, "train", lambda *_, policy, pool: pools.append(pool) or policy)
    extra = spinning(jax.random.key(0))
    dagger.go_on(TASK, MODEL, policy, FURTHER, tmp_path / "with", 0, {}, extra)
    dagger.go_on(TASK, MODEL, policy, FURTHER, tmp_path / "without", 0, {})
    mixed, own = pools
    assert (len(mixed.command), len(own.command)) == (512, 256)
    np.testing.assert_array_equal(mixed.state.rate[:256], own.state.rate)
    assert set(np.ravel(mixed.state.rate[256:])) <= set(np.ravel(extra.state.rate))


# --- what counts as a shift -------------------------------------------------------------------


def comparison(worst) -> Comparison:
    """Trials whose loss parts this far from both predictions, once."""
    observed = np.zeros((len(worst), 5))
    observed[:, 2] = worst
    nothing = np.zeros_like(observed)
    return Comparison(nothing, np.arange(5), observed, nothing, nothing)


def alarm(trials=40):
    return calibrate(comparison(np.linspace(0.5, 1.0, trials)), Promise(np.ones(1), np.ones(1)))


def test_few_trials_beyond_the_limit_are_chance():
    quiet = np.full(20, 0.6)
    quiet[:2] = 5.0
    assert alarm().collected(comparison(quiet)).sum() == 0
    quiet[:8] = 5.0
    marked = alarm().collected(comparison(quiet))
    assert marked.sum() == 8
    assert marked[:8, 2].all()


def test_false_alarms_are_as_rare_as_said():
    random = np.random.default_rng(0)
    alarms = 0
    for _ in range(400):
        worst = random.lognormal(size=60)
        one = calibrate(comparison(worst[:40]), Promise(np.ones(1), np.ones(1)))
        alarms += one.collected(comparison(worst[40:])).any()
    assert alarms / 400 < loss_monitor.SIGNIFICANCE + 0.02


def test_rounding_is_no_gap():
    silent = calibrate(comparison(np.full(40, 1e-7)), Promise(np.array([2.0]), np.ones(1)))
    assert silent.scale == pytest.approx([2e-3, 2e-3])
    assert silent.score(comparison([2e-3])).max() == pytest.approx(1.0)


def test_windows_are_means_of_what_follows():
    loss = np.arange(12.0)[None]
    now, following = loss_monitor._windows(loss, np.array([0, 5]), 3)
    np.testing.assert_allclose(now, [[0, 5]])
    np.testing.assert_allclose(following, [[2, 7]])


def test_starts_follow_what_was_seen():
    seen = in_model(TASK, MODEL, untrained(), usual(jax.random.key(3)), 6)
    start = seen.starts(TASK, jnp.array([2, 4]), jnp.array([0, 5]))
    np.testing.assert_array_equal(start.state.angle[1], seen.states.angle[4, 5])
    np.testing.assert_array_equal(start.command[0], seen.command[2])
    np.testing.assert_array_equal(start.command[1], seen.actions[4, 4])
    following = MODEL.step(start.state, seen.actions[jnp.array([2, 4]), jnp.array([0, 5])])
    np.testing.assert_allclose(following.angle[0], seen.states.angle[2, 1], rtol=1e-5)


def test_what_cannot_be_compared_is_refused():
    seen = in_model(TASK, MODEL, untrained(), usual(jax.random.key(3)), 20)
    promise = Promise(np.ones(1), np.ones(1))
    broken = eqx.tree_at(lambda s: s.states.angle, seen, seen.states.angle.at[1, 3].set(jnp.nan))
    short = jax.tree.map(lambda leaf: leaf[:, :4], seen)
    none = jax.tree.map(lambda leaf: leaf[:0], seen)
    for bad, message in ((broken, "finite"), (short, "too short"), (none, "no trial")):
        with pytest.raises(PalpateError, match=message):
            loss_monitor.compare(TASK, MODEL, untrained(), promise, bad)


def untrained() -> CommandPolicy:
    key, seen = jax.random.key(0), jax.random.normal(jax.random.key(1), (8, 3))
    return CommandPolicy.create(
        key, seen, Channel("pivot", (1,), "", 6.0, 60.0), period=0.05, width=4
    )


def test_training_begins_in_the_pool_that_is_given(policy, tmp_path):
    still = Start(PendulumState(jnp.zeros((3, 1)), jnp.zeros((3, 1))), jnp.zeros((3, 1)))
    with Run.open(tmp_path, {}) as kept:
        train(TASK, MODEL, Training(iterations=1, **ONCE), 0, kept, policy=policy, pool=still)
        (line,) = kept.metrics()
    assert line["loss"] < 0.05  # of a pendulum that hangs at rest, and is hardly moved
