"""Commands stay within their limits, and the search finds what is known to be fastest."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palpate.errors import PalpateError
from palpate.models.model import rollout
from palpate.planning.open_loop import CommandSequence, cma_package, search
from toys import Cart, CartState

pytestmark = pytest.mark.optimised

SEQUENCE = CommandSequence(knots=8, active=60, steps=90, period=0.01, limit=0.4, rate_limit=6.0)
NONE = jnp.zeros((5, 60, 1, 3))


def random_knots(seed: int) -> jax.Array:
    return 3 * jax.random.normal(jax.random.key(seed), (5, SEQUENCE.knots, 1, 3))


def test_commands_keep_the_limits_and_end_at_rest():
    commands = np.asarray(jax.jit(SEQUENCE.commands)(random_knots(0), NONE))
    assert commands.shape == (5, 90, 1, 3)
    speed = np.linalg.norm(commands, axis=-1)
    assert 0.39 < speed.max() < 0.4 * (1 + 1e-5)
    change = np.diff(commands, axis=1, prepend=0.0)
    rate = np.linalg.norm(change, axis=-1) / SEQUENCE.period
    assert 5.9 < rate.max() < 6.0 * (1 + 1e-4)
    assert np.all(commands[:, -1] == 0)


@pytest.mark.parametrize("length", [30, 90, 130])
def test_without_knots_the_reference_is_given_back(length):
    """One that keeps the limits, shorter or longer than the sequence."""
    time = 0.01 * jnp.arange(1, length + 1)[:, None, None]
    reference = 0.3 * jnp.sin(4 * time + jnp.arange(3.0))[None] * jnp.minimum(1.0, 3 * time)
    commands = SEQUENCE.commands(jnp.zeros((1, 8, 1, 3)), 0.5 * reference)
    kept = min(length, 90)
    np.testing.assert_allclose(commands[:, :kept], 0.5 * reference[:, :kept], atol=1e-6)
    assert not np.any(commands[:, kept + 10 :])


def test_knots_add_to_the_reference_where_they_stand():
    knots = jnp.zeros((1, 8, 2)).at[0, 3, 1].set(0.1)
    reference = jnp.full((1, 90, 2), 0.05).at[..., 1].set(0.0)
    commands = np.asarray(SEQUENCE.commands(knots, reference))
    assert commands[0, :, 1].argmax() == pytest.approx(59 * 3 / 7, abs=1)
    assert commands[0, :, 1].max() == pytest.approx(0.04, rel=0.05)
    assert not np.any(commands[0, 40:, 1])
    np.testing.assert_allclose(commands[0, 3:, 0], 0.05, atol=1e-6)


def excess_of(wanted: np.ndarray):
    """Above one until a time that grows with the distance from the knots wanted."""

    def excess(knots: np.ndarray) -> np.ndarray:
        away = np.sqrt(np.sum((knots - wanted) ** 2, axis=(2, 3)))
        values = 2.0 * np.exp(10 * away[..., None] - np.arange(60) / 10)
        return np.where(knots[:, :, :1, 0] > 2, np.nan, values)

    return excess


def test_searches_side_by_side_find_the_fastest_and_keep_what_led_there():
    wanted = np.random.default_rng(2).normal(size=(4, 1))
    settings = {"deadlines": [50, 20], "deviations": [0.3, 0.3], "rollouts": 6000, "seed": 0}
    found = search(excess_of(wanted), wanted.shape, **settings)
    assert len(found) == 2
    for each in found:
        assert np.all(np.diff(each.times) < 0)
        assert each.times[-1] == 8  # 2 exp(-7 / 10) is the first below one
        assert each.knots.shape == (len(each.times), 4, 1)
        np.testing.assert_allclose(each.knots[-1], wanted, atol=0.02)
        again = excess_of(wanted)(each.knots[None])[0]
        assert [int(np.argmax(row < 1)) + 1 for row in again] == each.times.tolist()
    assert not np.array_equal(found[0].times, found[1].times)
    same = search(excess_of(wanted), wanted.shape, **settings)
    np.testing.assert_array_equal(same[1].knots, found[1].knots)


def test_a_search_that_comes_upon_nothing_says_so():
    found = search(
        lambda knots: np.full((*knots.shape[:2], 30), 2.0), (3, 2),
        deadlines=[20], deviations=[0.3], rollouts=100, seed=0,
    )  # fmt: skip
    assert found[0].times.shape == (0,)
    assert found[0].knots.shape == (0, 3, 2)


def test_a_deadline_beyond_what_is_looked_at_is_refused():
    with pytest.raises(PalpateError, match="within the 9 control periods"):
        search(
            lambda knots: np.ones((*knots.shape[:2], 9)), (3, 1),
            deadlines=[10], deviations=[0.3], rollouts=40, seed=0,
        )  # fmt: skip


def test_the_global_generator_is_left_alone():
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    search(
        lambda knots: np.ones((*knots.shape[:2], 9)), (3, 1),
        deadlines=[5], deviations=[0.3], rollouts=80, seed=0,
    )  # fmt: skip
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_a_cart_is_moved_as_fast_as_its_force_allows():
    """0.5 m away and at rest, by at most 1 N on 1 kg: bang-bang needs 2 sqrt(0.5) = 1.41 s.

    What is left within 0.03 m and 0.1 m/s may be gained: no more than 0.15 s.
    """
    cart = Cart(mass=1.0, friction=1e-3)
    sequence = CommandSequence(12, active=32, steps=60, period=0.05, limit=1.0, rate_limit=40.0)

    @jax.jit
    def excess(knots):
        start = CartState(*jnp.zeros((2, knots.shape[1], 1)))
        states = rollout(cart, start, sequence.commands(knots[0], jnp.zeros_like(knots[0])))
        away = jnp.abs(states.position[..., 0] - 0.5) / 0.03
        return jnp.maximum(away, jnp.abs(states.velocity[..., 0]) / 0.1)[None]

    (found,) = search(excess, (12, 1), deadlines=[40], deviations=[0.3], rollouts=8000, seed=0)
    assert 1.25 < 0.05 * found.times[-1] <= 1.5


@pytest.mark.parametrize("counts", [(1, 5, 5), (6, 5, 5), (3, 6, 5)])
def test_sequences_that_cannot_be_are_refused(counts):
    with pytest.raises(PalpateError, match="at least 2 knots"):
        CommandSequence(*counts, period=0.01, limit=1.0, rate_limit=1.0)


def test_without_the_package_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(
        PalpateError, match=r"needs cma, which is not installed: `pip install 'palpate\[rivals"
    ):
        cma_package()
